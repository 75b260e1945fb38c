"""One part of the bridge as scanned: registered to its design, its ends and edges measured; or the reason why not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from processor.adjustment import variance_components
from processor.adjustment.body_motions import distance_derivative
from processor.adjustment.point_groups import group_sums
from processor.geometry import box_girder_mesh, rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.geometry.mesh_distance import on_face
from processor.geometry.thinning import by_cell, thinned
from processor.large_arrays import allocate, blocks, chosen
from processor.model import ArchDesign, DesignPart, Floats, Ints, Reason, Scan, Status, reason
from processor.preassembly import topology
from processor.preassembly.ends import bottom_edges, joint_end, outer_end, outer_faces, tube_end, view_variance
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.ends.joint_end import FittedEnd, JointEnd
from processor.preassembly.ends.joint_frame import EndPlace, end_place
from processor.preassembly.ends.outer_end import OuterEnd
from processor.preassembly.ends.outer_faces import RegisteredPart
from processor.preassembly.ends.tube_end import FittedTube
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import (
    assignment,
    attitude,
    beyond_ends,
    contradictions,
    identity,
    systematic_errors,
)
from processor.preassembly.parts.assignment import ScanParts
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.parts.part_residuals import PartResiduals, part_residuals
from processor.registration import icp, located_part, main_body, pose_choice, principal, surface_registration
from processor.registration.pose_search import DesignSurface
from processor.robust_statistics import MAD_TO_SD

CELL_MM = 40.0  # points of a cell are looked up one after the other
SLICES, LEAST_OF_TYPICAL = (
    40,
    0.1,
)  # of a part's length; of the median number of points on a slice's side: it is covered
ACROSS = 0.7  # cosine to the part's axis, below which a normal is of the part's sides
# By the ends of two parts, of which one is longer: as built they are right to some mm, and steel is shown up to its end
# to a spacing of points.
SHORT_MM = 20.0
LEAST_COVERED = 0.7  # chosen: of a part less seen, bow and twist are guesses; the doubt states the share
RIGHT_PART = (reason("preassemble.right-part"),)


@dataclass(frozen=True)
class MeasuredPart:
    """One part as measured: pose by its whole surface, ends, edges; scan frame with the origin taken off."""

    name: str
    scans: tuple[Scan, ...]  # those used; poses and key points are in the frame of the first
    status: Status  # ok | ambiguous | weak | failed
    reasons: tuple[Reason, ...]
    T_bridge_scan: Floats  # of the first scan
    member: Member
    shrink: float  # lengths at the reference temperature by lengths as scanned
    T_rival: Floats  # (4, 4) of an ambiguous part: the other pose that fits as well; NaN of others
    residuals: PartResiduals
    identities: tuple[ScanParts, ...] = ()  # of its scans
    outer: OuterEnd | None = None  # of the first and the last part of a row
    T_further_scans: tuple[Floats, ...] = ()

    @property
    def of_others(self) -> tuple[Reason, ...]:
        """Why none of its scans is of the part; empty where one may be."""
        wrong = tuple(identity.wrong for identity in self.identities)
        return tuple(one for of_scan in wrong for one in of_scan) if all(wrong) else ()


class _Views(NamedTuple):
    """What errors of unit variance that each view of a part shares do to it.

    ``pose`` (6, 6) is the covariance of its registration, ``left`` the share of the variance that it leaves in a view.
    """

    pose: Floats
    left: float


@dataclass(frozen=True)
class FittedPart:
    """A part whose ends are fitted but not estimated yet: ``measured`` has no ends. ``joints`` are the ends' names."""

    part: DesignPart
    measured: MeasuredPart
    ends: tuple[FittedEnd | FittedTube | JointEnd | None, ...]
    joints: tuple[str, ...]
    views: _Views = field(default_factory=lambda: _Views(np.zeros((6, 6)), 0.0))


@dataclass(frozen=True, eq=False)
class _PlacedScan:
    """One scan registered to the design; ``rejected`` are the reasons where it is not.

    ``doubts`` are reasons why it may be of another part.
    ``points`` (n, 3) are the scan's at the reference temperature, cell by cell; ``station`` (n,) numbers the station of
    each.
    """

    scan: Scan
    points: Floats
    station: Ints
    attitude: attitude.Attitude
    registration: surface_registration.SurfaceFit = surface_registration.NOWHERE
    rejected: tuple[Reason, ...] = ()
    identity: identity.Identity = field(default_factory=identity.Identity)
    doubts: tuple[Reason, ...] = ()
    parts: tuple[str, ...] = ()  # that it may be of

    @property
    def sure(self) -> tuple[bool, bool]:
        """Whether it is distinguished from its rival poses, and all motions of the part are determined."""
        return self.attitude.status == Status.OK, not self.registration.weak and not self.doubts

    @property
    def weak(self) -> tuple[Reason, ...]:
        """State the motions of the part that the scan does not determine."""
        return (reason("preassemble.weak", motions=self.registration.weak),) if self.registration.weak else ()


def fit(
    scans: Sequence[Scan], index: int, shapes: attitude.Shapes, shrink: float, systematic: SystematicParams
) -> FittedPart:
    """Register the scans of a part, the design's number ``index``, and fit its ends and edges.

    Each scan is registered to the design by itself. The best one gives the part's pose; others that are as sure add
    their points. ``shrink`` is the ratio of lengths at the reference temperature to lengths as scanned. The covariance
    of the edges includes ``systematic`` errors, that of the ends does not yet.
    """
    design, shape = shapes.design, shapes[index]
    part = design.parts[index]
    places = topology.ends_of(design.joined, index)
    joints = [end.joint for end in places]
    placed = [_place(scan, index, shapes, shrink) for scan in scans]
    usable = [scan for scan in placed if not scan.rejected]
    if not usable:
        return _failed(part, joints, placed, shrink)
    usable.sort(key=lambda scan: (scan.sure, len(scan.scan.points)), reverse=True)
    first = usable[0]
    used = [first, *(scan for scan in usable[1:] if scan.sure == (True, True))]
    registered = _registered(used, shape, [design.joint_points[j] for j in joints if j is not None])
    ends = tuple(_fit_end(registered, end, design, first.attitude) for end in places)
    edges = _edges(registered, part, first.registration.sigma_mm, systematic)
    known = [
        (design.joint_names[j], end) for end, j in zip(ends, joints, strict=True) if end is not None and j is not None
    ]
    of_ends = tuple(
        reason("preassemble.at", place=joint, reasons=(*end.doubts, *end.remarks))
        for joint, end in known
        if end.doubts or end.remarks
    )
    doubtful = first.doubts or any(end.doubts for _, end in known)
    status = Status.WEAK if first.registration.weak or doubtful else Status.OK
    status = Status.AMBIGUOUS if first.attitude.status == Status.AMBIGUOUS else status
    resemblance = _resemblance(first.points, index, shapes) if status != Status.OK else ()
    outer = _outer_end(registered, part, joints) if len(part.bottom_edge_left) else None
    open_end = None in joints and len(part.bottom_edge_left) > 0
    unseen = (reason("preassemble.outer-end-not-seen"),) if open_end and outer is None else ()
    measured = MeasuredPart(
        name=part.name,
        scans=tuple(scan.scan for scan in used),
        status=status,
        reasons=(*_reasons(placed, used, part, of_ends), *resemblance, *unseen),
        T_bridge_scan=first.registration.T_design_scan,
        member=Member((None,) * len(joints), edges, part.vertices.mean(axis=0), registered.pose),
        shrink=shrink,
        T_rival=first.attitude.T_rival,
        residuals=part_residuals(registered.points, shape.mesh),
        identities=_identities(placed, part),
        outer=outer,
        T_further_scans=tuple(scan.registration.T_design_scan for scan in used[1:]),
    )
    several = bool((registered.station != registered.station[0]).any())
    names = tuple("" if joint is None else design.joint_names[joint] for joint in joints)
    fitted = FittedPart(part, measured, ends, names)
    return fitted if several else replace(fitted, views=_views(registered, shape))


def _fit_end(
    part: RegisteredPart, end: topology.PartEnd, design: ArchDesign, pose: attitude.Attitude
) -> FittedEnd | FittedTube | JointEnd | None:
    """Fit an end of a part; None without a joint."""
    if end.joint is None:
        return None
    place = end_place(design.joint_points[end.joint], end.outward, part.surface)
    if place.section.radius:
        return tube_end.fit(part, place, pose.turn_known)
    return joint_end.fit(part, place)


def estimate(parts: Sequence[FittedPart], systematic: SystematicParams) -> list[MeasuredPart]:
    """Estimate the ends of all parts together, and add ``systematic`` errors to their covariance."""
    between = _between_viewpoints(parts)
    if not systematic.known:
        between = between.or_of_class()
    examined = [
        contradictions.Examined(
            tuple((j, e) for j, e in zip(part.joints, part.ends, strict=True) if isinstance(e, FittedEnd)),
            part.measured.member.edges,
        )
        for part in parts
    ]
    seen = [_as_seen(part, between) for part in parts]
    fitted = [(end, part.views.left) for part in seen for end in part.ends if isinstance(end, FittedEnd)]
    of_ends = [between._replace(level=left * between.level) for _, left in fitted]
    estimated = iter(joint_end.estimate([end for end, _ in fitted], of_ends))
    measured = []
    for part, contradiction in zip(seen, contradictions.find(examined), strict=True):
        of_tubes = between._replace(level=part.views.left * between.level)
        ends = [
            next(estimated)
            if isinstance(end, FittedEnd)
            else tube_end.estimate(end, of_tubes)
            if isinstance(end, FittedTube)
            else end
            for end in part.ends
        ]
        common = systematic_errors.end_variances(systematic, part.part)
        of_end = np.kron(np.ones((8, 8)), np.diag(common[:3]))
        ends = [None if end is None else replace(end, covariance=end.covariance + of_end) for end in ends]
        member = replace(part.measured.member, ends=tuple(ends))
        outer = part.measured.outer
        if outer is not None:
            variance = outer.variance + common[0]
            outer = replace(outer, variance=variance + (between.ring if part.views.left else 0.0))
        reasons = (*contradiction, *part.measured.reasons, *_viewpoint_remarks(part, between))
        status = Status.WEAK if contradiction and part.measured.status == Status.OK else part.measured.status
        measured.append(replace(part.measured, member=member, status=status, reasons=reasons, outer=outer))
    return measured


def _viewpoint_remarks(part: FittedPart, between: view_variance.Variances) -> Iterator[Reason]:
    """Yield what is known of differences between the views of a part whose points' stations are not named."""
    if any(isinstance(end, FittedEnd | FittedTube) and end.plates for end in part.ends):
        if between.evident:
            yield reason("preassemble.viewpoints-differ", sd=float(np.sqrt(between.level)))
        elif not between.known and between.level > 0.0:
            yield reason("preassemble.viewpoints-by-class", sd=float(np.sqrt(between.level)))
        elif not between.known:
            yield reason("preassemble.viewpoints-not-compared")


def _between_viewpoints(parts: Sequence[FittedPart]) -> view_variance.Variances:
    """Variances between viewpoints by the plates of all parts."""
    plates: list[view_variance.Thickness] = []
    rings: list[float] = []
    same: list[tuple[int, int]] = []
    for part in parts:
        fitted = [end for end in part.ends if isinstance(end, FittedEnd | FittedTube)]
        of_ends: list[dict[int, int]] = []  # the rows of each end's plates, by their faces
        for end in fitted:
            known = {k: plate for k, plate in enumerate(end.plates) if plate is not None}
            of_ends.append({k: len(plates) + i for i, k in enumerate(known)})
            plates += known.values()
            rings += [end.ring_noise] if end.plates else []
        # Nothing but an open end shows the inner sides of the plates of a section without open sides
        if len(part.ends) == len(fitted) == 2 and all(face >= 0 for face in fitted[1].place.section.middles):
            first, last = of_ends
            same += [(first[k], last[k]) for k in last if k in first]
    return view_variance.variances(plates, rings, same)


def _as_seen(part: FittedPart, between: view_variance.Variances) -> FittedPart:
    """Return a part with variances between viewpoints in the covariances of its registration and its edges.

    What the registration follows of them cancels in the adjustment, where the edges have all of their views' errors.
    """
    if not part.views.left:
        return part
    pose = part.measured.member.pose + between.level * part.views.pose
    edges = bottom_edges.with_errors_of_views(part.measured.member.edges, between.level, between.across)
    measured = replace(part.measured, member=replace(part.measured.member, edges=edges, pose=pose))
    ends = tuple(replace(end, pose=pose) if isinstance(end, FittedEnd | FittedTube) else end for end in part.ends)
    return replace(part, measured=measured, ends=ends)


def assigned(parts: Sequence[MeasuredPart]) -> list[MeasuredPart]:
    """Assign the scans of all parts together; a part whose scan is of another by exclusion alone is ambiguous."""
    solved = iter(assignment.solve([scan for part in parts for scan in part.identities]))
    found = [replace(part, identities=tuple(next(solved) for _ in part.identities)) for part in parts]
    return [
        replace(part, status=Status.AMBIGUOUS, reasons=(*part.of_others, *part.reasons))
        if part.of_others and part.status != Status.FAILED
        else part
        for part in found
    ]


def _reasons(
    placed: Sequence[_PlacedScan], used: Sequence[_PlacedScan], part: DesignPart, of_ends: Sequence[Reason]
) -> Iterator[Reason]:
    """Yield the remarks on a part, in the order in which they are shown."""
    first = used[0]
    yield from first.attitude.reasons
    for scan in placed:
        if scan not in used:
            why = scan.rejected or scan.attitude.reasons or scan.doubts or scan.weak
            yield reason("preassemble.scan-not-used", scan=scan.scan.name, reasons=why)
    yield from (*of_ends, *first.weak, *first.doubts)
    if part.source == box_girder_mesh.SOURCE:
        yield reason("preassemble.no-mesh")
    # One scan that shows the part's mark is enough.
    if all(scan.identity.open_questions for scan in used):
        yield from first.identity.open_questions


def _registered(used: Sequence[_PlacedScan], shape: DesignSurface, joints: Sequence[Floats]) -> RegisteredPart:
    """Join the points of the scans used, on the design; ``joints`` are the key points (8, 3) of the part's joints."""
    points = rigid.placed([(scan.registration.T_design_scan, scan.points) for scan in used])
    station, done, first = allocate(len(points), dtype=np.int64), 0, 1  # -1: of no station
    for scan in used:
        np.add(scan.station, first, out=station[done : done + len(scan.station)])
        done, first = done + len(scan.station), first + int(scan.station.max(initial=-1)) + 2
    return RegisteredPart(
        points=points,
        station=station,
        between_stations=_between_stations(points, station, shape),
        pose=used[0].registration.covariance,
        surface=shape.mesh,
        outer=outer_faces.outer_faces(shape.mesh, joints),
    )


def _edges(
    registered: RegisteredPart, part: DesignPart, sigma_mm: float, systematic: SystematicParams
) -> EdgeDepartures:
    if not len(part.bottom_edge_left):
        return bottom_edges.NONE
    edges = bottom_edges.measure(registered, *_design_edges(part), sigma_mm)
    return systematic_errors.added_to_edges(
        bottom_edges.with_errors_of_views(edges, registered.between_stations), systematic
    )


def _outer_end(registered: RegisteredPart, part: DesignPart, joints: Sequence[int | None]) -> OuterEnd | None:
    """Measure the end of a part that has no joint; None where both have one, or it was not seen."""
    for joint, outermost, next_to_it in zip(joints, (0, -1), (1, -2), strict=True):
        if joint is None:
            at, before = (0.5 * (part.bottom_edge_left[k] + part.bottom_edge_right[k]) for k in (outermost, next_to_it))
            return outer_end.measure(registered, at, (at - before) / np.linalg.norm(at - before))
    return None


def _design_edges(part: DesignPart) -> tuple[Polyline, Polyline]:
    return Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right)


def _views(part: RegisteredPart, shape: DesignSurface) -> _Views:
    """Propagate errors of views into the registration of a part.

    A view is one side of one half of the part: neither the sides nor the ends of a part are seen from one place.
    """
    points = thinned(part.points, surface_registration.POINTS)
    face, residual, beyond = shape.mesh.distances(points, 60.0)
    near = on_face(face, beyond) & (np.abs(residual) < surface_registration.GATES_MM[1])
    points, normals = points[near], shape.mesh.normals[face[near]]
    middle = points.mean(axis=0)
    axis = icp.facing(normals, shape.axes)
    side = (normals @ shape.axes)[np.arange(len(axis)), axis] > 0.0
    half = (points - middle) @ shape.axes[:, 0] > 0.0
    view = np.unique(4 * axis + 2 * side + half, return_inverse=True)[1].reshape(-1)
    J = distance_derivative(points - middle, normals)
    sums, inverse = group_sums(J, view), np.linalg.pinv(J.T @ J)
    rest = np.eye(len(sums)) - sums / np.bincount(view)[:, None] @ inverse @ sums.T
    pose = rigid.about_origin(inverse @ sums.T @ sums @ inverse, middle)
    return _Views(pose, min(float(np.mean(rest**2)) * len(rest), 1.0))


def _between_stations(points: Floats, station: Ints, shape: DesignSurface) -> float:
    """Variance between the stations of points (n, 3) on the design, mm^2."""
    station = thinned(station, surface_registration.LAST_POINTS)
    if (station == station[0]).all():
        return 0.0
    points = thinned(points, surface_registration.LAST_POINTS)
    face, residual, beyond = shape.mesh.distances(points, 60.0)
    near = on_face(face, beyond) & (np.abs(residual) < surface_registration.GATES_MM[1])
    normals = shape.mesh.normals[face[near]]
    facing = icp.facing(normals, shape.axes)
    cell = surface_registration.cells(points[near] @ shape.axes, facing, normals @ shape.axes)
    return variance_components.between_stations(residual[near], station[near], cell)


def _place(scan: Scan, index: int, shapes: attitude.Shapes, shrink: float) -> _PlacedScan:
    """Register one scan, without the ground and what stands about the part, and check that it is of part ``index``."""
    if not len(scan.points):
        why = (reason("preassemble.no-scan"),)
        return _PlacedScan(scan, scan.points, np.empty(0, np.int64), attitude.NOWHERE, rejected=why)
    points, row = by_cell(scan.points, CELL_MM)
    station = allocate(len(points), dtype=np.int64)
    for rows in blocks(len(points)):
        points[rows] *= shrink
        station[rows] = scan.point_station[row[rows]] if len(scan.point_station) else 0
    del row
    if not main_body.holds_more(points, shapes.sizes):
        placed = _identified(scan, points, station, index, shapes)
        if shrink == 1.0 and placed.attitude is not attitude.NOWHERE and shapes[index].tube is None:
            shapes.attitudes[index] = placed.attitude
        return placed
    located = assignment.locate(points, index, shapes)
    if located is None:
        return _identified(scan, points, station, index, shapes)
    T, number, rival = located
    of_part = located_part.at_design(points, T, shapes[number])
    placed = _identified(scan, chosen(points, of_part), chosen(station, of_part), index, shapes)
    if placed.rejected:
        return placed
    of_part = located_part.at_design(points, placed.registration.T_design_scan, shapes[index])
    fit, at = placed.registration, np.flatnonzero(of_part)
    # On a surface made from design curves the inner sides of plates would be taken for what touches the part.
    if shapes.design.parts[index].source != box_girder_mesh.SOURCE:
        of_part[at] = located_part.consistent(points[at], fit.T_design_scan, shapes[index], fit.sigma_mm)
    placed = replace(placed, points=chosen(points, of_part), station=chosen(station, of_part))
    doubts = placed.doubts
    # Another part that lies on the design in part has lost the rest of its points with the surroundings.
    covered = _covered(placed.points, placed.registration.T_design_scan, shapes[index], any_side=True)
    if covered < LEAST_COVERED and not doubts:
        away = 1.0 - float(of_part.mean())
        doubts = (reason("preassemble.sides-not-covered", share=away, covered=covered), *RIGHT_PART)
    if rival > 0.0:
        doubts += (reason("preassemble.another-of-shape", share=rival),)
    return replace(placed, doubts=doubts)


def _identified(scan: Scan, points: Floats, station: Ints, index: int, shapes: attitude.Shapes) -> _PlacedScan:
    """Register the points (n, 3) of a scan, and check that they are of part ``index``."""
    part, every = shapes.design.parts[index], tuple(part.name for part in shapes.design.parts)
    other = assignment.rather(points, index, shapes)
    placed: _PlacedScan | None = None
    if other is not None:
        # Only a scan that fits the other part is of the other part; a misfit may have other causes.
        there = _register(scan, points, station, other, shapes) if other >= 0 else None
        parts = () if there is None else there.identity.parts(shapes.design.parts[other].name)
        if part.name not in parts and (there is None or not (there.rejected or there.doubts)):
            if there is not None or not assignment.of_size(points, shapes):
                placed = _register(scan, points, station, index, shapes)
                if any(one.code == "preassemble.splice-plates" for one in placed.rejected):  # longer than any part
                    return replace(placed, parts=every)
            if there is None or not _fits_with_ends(placed, index, there, other, shapes):
                why = (*ScanParts(scan.name, part.name, parts).wrong, *_resemblance(points, index, shapes))
                return _PlacedScan(scan, points, station, attitude.NOWHERE, rejected=why, parts=parts)
    placed = placed or _register(scan, points, station, index, shapes)
    if placed.identity.contradiction and not placed.rejected:
        # A part of another size may by chance have its mark where the other part of this shape has its own.
        resemblance = _resemblance(points, index, shapes)
        if resemblance:
            return replace(placed, rejected=resemblance, parts=every)
        why = (*ScanParts(scan.name, part.name, placed.identity.rather).wrong, *placed.identity.contradiction)
        return replace(placed, rejected=why, parts=placed.identity.rather)
    if placed.rejected:
        return replace(placed, parts=every)
    of_ends = _by_ends(placed, index, shapes)
    return of_ends or replace(placed, parts=placed.identity.parts(part.name))


def _by_ends(placed: _PlacedScan, index: int, shapes: attitude.Shapes) -> _PlacedScan | None:
    """Return a scan as one of other parts whose ends it shows, where part ``index`` goes on; None where it is not.

    On a longer part of the same section all its points lie on the design, which has steel where they end.
    """
    T, points, part = placed.registration.T_design_scan, placed.points, shapes[index]
    missing = sum(_not_shown(points, T, index, shapes))
    found: list[str] = []
    for k in assignment.other_shapes(index, range(len(shapes)), shapes) if SHORT_MM < missing < part.size else ():
        shorter, limit = shapes.sizes[index][0] - shapes.sizes[k][0], principal.SIZE_SHARE * shapes.sizes[index][0]
        if abs(shorter - missing) > SHORT_MM + limit:
            continue
        there = _register(placed.scan, points, placed.station, k, shapes)
        T_there = there.registration.T_design_scan
        if there.rejected or there.doubts or max(_not_shown(points, T_there, k, shapes)) > SHORT_MM:
            continue
        if 1 in pose_choice.choose(points, [(part.mesh, T), (shapes[k].mesh, T_there)]):
            found += there.identity.parts(shapes.design.parts[k].name)
    why = reason("preassemble.ends-of-other", parts=tuple(found), length=missing)
    return replace(placed, doubts=(*placed.doubts, why), parts=tuple(found)) if found else None


def _fits_with_ends(
    placed: _PlacedScan | None, index: int, there: _PlacedScan, other: int, shapes: attitude.Shapes
) -> bool:
    """Whether a scan fits part ``index`` with all ends, while part ``other`` goes on where the scan's points end."""
    if placed is None or placed.rejected or placed.doubts:
        return False
    of_part, of_other = (
        max(_not_shown(one.points, one.registration.T_design_scan, k, shapes), default=0.0)
        for one, k in ((placed, index), (there, other))
    )
    return of_part <= SHORT_MM < of_other


def _not_shown(points: Floats, T: Floats, index: int, shapes: attitude.Shapes) -> list[float]:
    """Length before each of a part's joints, mm, that points (n, 3) placed by T (4, 4) do not show."""
    placed = rigid.apply(T, thinned(points, surface_registration.LAST_POINTS))
    face, off, beyond = shapes[index].mesh.distances(placed, surface_registration.GATES_MM[1])
    on = placed[on_face(face, beyond) & (np.abs(off) < attitude.TELLING_MM)]
    return [beyond_ends.not_shown(on, place) for _, place in _joint_ends(index, shapes)]


def _register(scan: Scan, points: Floats, station: Ints, index: int, shapes: attitude.Shapes) -> _PlacedScan:
    """Register a scan to part ``index``, and compare it with the parts of the same shape."""
    part, shape = shapes.design.parts[index], shapes[index]
    pose = attitude.find(points, part, shape)
    placed = _PlacedScan(scan, points, station, pose)
    if pose.status == Status.FAILED:
        return replace(placed, rejected=pose.reasons)
    registration = surface_registration.fine(points, shape.mesh, shape.axes, pose.T_surface)
    placed = replace(placed, registration=registration)
    at_design = rigid.apply(registration.T_design_scan, thinned(points, surface_registration.LAST_POINTS))
    plated = tuple(joint for joint, place in _joint_ends(index, shapes) if beyond_ends.plates(at_design, place))
    if plated:
        return replace(placed, rejected=(reason("preassemble.splice-plates", joints=plated),))
    misfit = _misfit(registration)
    if misfit:
        return replace(placed, rejected=(*misfit, *(_resemblance(points, index, shapes) or RIGHT_PART)))
    # A part without a mesh has approximate surfaces: points of the right part lie off them, too.
    if registration.used_share < 1.0 - surface_registration.CLUTTER_SHARE and part.source != box_girder_mesh.SOURCE:
        # A part of another size fits the design as far as the two are alike; the rest looks like clutter.
        away = 1.0 - registration.used_share
        resemblance = _resemblance(points, index, shapes)
        if resemblance:
            return replace(placed, rejected=(reason("preassemble.points-away", share=away), *resemblance))
        covered = _covered(points, registration.T_design_scan, shape)
        if covered < LEAST_COVERED:
            doubt = reason("preassemble.sides-not-covered", share=away, covered=covered)
            placed = replace(placed, doubts=(doubt, *RIGHT_PART))
    return replace(placed, identity=identity.identify(points, registration.T_design_scan, index, shapes))


def _joint_ends(index: int, shapes: attitude.Shapes) -> list[tuple[str, EndPlace]]:
    """Return the joints of a part by their names, with its end at each."""
    design = shapes.design
    return [
        (design.joint_names[joint], end_place(design.joint_points[joint], outward, shapes[index].mesh))
        for joint, outward in topology.ends_of(design.joined, index)
        if joint is not None
    ]


def _identities(placed: Sequence[_PlacedScan], part: DesignPart) -> tuple[ScanParts, ...]:
    return tuple(ScanParts(scan.scan.name, part.name, scan.parts) for scan in placed)


def _misfit(registration: surface_registration.SurfaceFit) -> tuple[Reason, ...]:
    """Why a registered scan is not of its design; empty where it is."""
    share = registration.used_share
    if not (share > surface_registration.LEAST_SHARE and np.isfinite(registration.covariance).all()):
        return (reason("preassemble.few-points-near", share=share),)
    if not surface_registration.fits(registration):
        distance = registration.sigma_mm / MAD_TO_SD
        return (reason("preassemble.misfit", share=1.0 - share, distance=distance),)
    return ()


def _covered(points: Floats, T: Floats, shape: DesignSurface, *, any_side: bool = False) -> float:
    """Share of the design's outer faces, in slices of its length, with points (n, 3) placed by T (4, 4) on them.

    With ``any_side`` a slice is covered that has points on one of its sides: others may be hidden by what it lies on.
    """
    along = shape.points @ shape.axes[:, 0]
    bounds = np.linspace(along.min(), along.max(), SLICES + 1)[1:-1]
    slices = np.digitize(along, bounds)
    sums = np.stack([np.bincount(slices, x, SLICES) for x in shape.points.T], axis=1)
    middle: Floats = sums / np.maximum(np.bincount(slices, minlength=SLICES), 1)[:, None]

    def counted(at: Floats, normals: Floats) -> Floats:
        """Count points on each of the four sides of each slice."""
        which = np.digitize(at @ shape.axes[:, 0], bounds)
        across = normals @ shape.axes
        outer = (np.abs(across[:, 0]) < ACROSS) & (np.einsum("ni,ni->n", at - middle[which], normals) > 0.0)
        level = np.abs(across[:, 1]) > np.abs(across[:, 2])
        side = 2 * level + (np.where(level, across[:, 1], across[:, 2]) > 0.0)
        counts: Floats = np.bincount(4 * which[outer] + side[outer], minlength=4 * SLICES).astype(float)
        return counts

    placed = rigid.apply(T, thinned(points, surface_registration.POINTS))
    face, distance, beyond = shape.mesh.distances(placed, surface_registration.GATES_MM[0])
    near = on_face(face, beyond) & (np.abs(distance) < attitude.TELLING_MM)
    counts, designed = counted(placed[near], shape.mesh.normals[face[near]]), counted(shape.points, shape.normals)
    if any_side:
        counts, designed = (of_sides.reshape(SLICES, -1).max(axis=1) for of_sides in (counts, designed))
    counts = counts[designed > 0.0]
    return float((counts > LEAST_OF_TYPICAL * np.median(counts[counts > 0.0])).mean()) if counts.any() else 0.0


def _resemblance(points: Floats, index: int, shapes: attitude.Shapes) -> tuple[Reason, ...]:
    """State which parts of the design have the size of the scan, unless the part itself is one."""
    alike = assignment.of_size(points, shapes)
    names = tuple(shapes.design.parts[k].name for k in alike)
    return (reason("preassemble.size-of-other", parts=names),) if alike and index not in alike else ()


def _failed(part: DesignPart, joints: Sequence[int | None], placed: Sequence[_PlacedScan], shrink: float) -> FittedPart:
    why = placed[0].rejected
    if len(placed) > 1:
        why = tuple(reason("preassemble.of-scan", scan=scan.scan.name, reasons=scan.rejected) for scan in placed)
    edges = bottom_edges.unknown(*_design_edges(part)) if len(part.bottom_edge_left) else bottom_edges.NONE
    nowhere = np.full((4, 4), np.nan)
    measured = MeasuredPart(
        name=part.name,
        scans=(placed[0].scan,),
        status=Status.FAILED,
        reasons=why,
        T_bridge_scan=nowhere,
        member=Member((None,) * len(joints), edges, part.vertices.mean(axis=0), np.zeros((6, 6))),
        shrink=shrink,
        T_rival=nowhere,
        residuals=PartResiduals(np.empty((0, 3)), np.empty(0)),
        identities=_identities(placed, part),
    )
    ends = tuple(None if joint is None else joint_end.unknown(*why) for joint in joints)
    return FittedPart(part, measured, ends, ("",) * len(ends))
