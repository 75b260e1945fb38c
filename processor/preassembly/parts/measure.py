"""One part of the bridge as scanned: registered to its design, its ends and edges measured, or why that failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from processor.adjustment import variance_components
from processor.geometry import box_girder, icp, principal, rigid, surface_registration
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.geometry.neighbors import by_cell, thinned, voxel_means
from processor.geometry.polyline import Polyline
from processor.model import ArchDesign, DesignPart, Floats, Ints, Scan
from processor.preassembly.baselines import edge_features
from processor.preassembly.chain import adjustment
from processor.preassembly.ends import bottom_edges, faces, joint_end
from processor.preassembly.parts import attitude, identity, systematic_errors
from processor.preassembly.parts.systematic_errors import SystematicParams

CELL_MM = 40.0  # points of one are looked up one after the other
SIZE_SHARE = 0.01  # of its length, within which a scan is as large as a part: noise, form and voxels move it by less
SLICES, LEAST_OF_TYPICAL = 40, 0.1  # of a part's length; of the points on a side of one, that cover another
ACROSS = 0.7  # cosine: what looks less along the part is of its sides
LEAST_COVERED = 0.7
WHICH = "is this the right part, and whole?"
RESIDUALS = 4_000  # points of a part whose distances from the design are kept


@dataclass(frozen=True)
class Measured:
    """One part as measured: pose by its whole surface, ends, edges; scan frame with the origin taken off."""

    name: str
    scans: tuple[Scan, ...]  # those used; poses and key points are in the frame of the first
    status: str  # ok | ambiguous | weak | failed
    message: str
    T_bridge_scan: Floats
    member: adjustment.Member
    shrink: float  # lengths at the reference temperature by lengths as scanned
    T_rival: Floats  # (4, 4) of an ambiguous part: the other pose that fits as well; NaN of others
    residual_points: Floats  # (r, 3) of the scan, thinned, on the design
    residuals: Floats  # (r,) from the design's surface, outward


@dataclass(frozen=True)
class _Placed:
    """One scan registered to the design, or why it is not: then ``trouble`` says so.

    ``points`` (n, 3) are the scan's at the reference temperature, cell by cell, ``station`` (n,) from where each is.
    """

    scan: Scan
    points: Floats
    station: Ints
    found: attitude.Attitude
    fitted: surface_registration.SurfaceFit
    trouble: str
    told: identity.Told = field(default_factory=identity.Told)
    doubt: str = ""  # why it may be of another part

    @property
    def rank(self) -> tuple[bool, bool, int]:
        """How well it stands: told from its mirror poses, held in all directions, by many points."""
        return self.found.status == "ok", not self.fitted.weak and not self.doubt, len(self.scan.points)


@dataclass(frozen=True)
class Seen:
    """One part whose ends are still to be judged: those of ``measured`` say nothing yet."""

    part: DesignPart
    measured: Measured
    ends: tuple[joint_end.Observed | joint_end.JointEnd | None, ...]


def measure(scans: Sequence[Scan], index: int, design: ArchDesign, shrink: float, doubts: SystematicParams) -> Measured:
    """Measure one part by itself; see :func:`see` and :func:`finished`."""
    return finished([see(scans, index, design, shrink, doubts)], doubts)[0]


def finished(parts: Sequence[Seen], doubts: SystematicParams) -> list[Measured]:
    """Judge the ends of all parts together; ``doubts`` are added to their covariance."""
    ends = iter(joint_end.judged([end for one in parts for end in one.ends if isinstance(end, joint_end.Observed)]))
    found = []
    for one in parts:
        own = [next(ends) if isinstance(end, joint_end.Observed) else end for end in one.ends]
        first, last = (None if end is None else systematic_errors.of_end(end, doubts, one.part) for end in own)
        found.append(replace(one.measured, member=replace(one.measured.member, ends=(first, last))))
    return found


def see(scans: Sequence[Scan], index: int, design: ArchDesign, shrink: float, doubts: SystematicParams) -> Seen:
    """Register the scans of one part and measure its ends and edges; ``index`` is its place in the design's order.

    Each scan is registered to the design by itself; the best of them is the part's, and others that are as sure add
    their points to it. ``doubts`` are added to the covariance of edges.
    """
    part = design.parts[index]
    shape = attitude.sample_surface(part)
    joints = [j if 0 <= j < len(design.joint_names) else None for j in (index - 1, index)]
    every = [_place(scan, part, design, shape, shrink) for scan in scans]
    usable = sorted((one for one in every if not one.trouble), key=lambda one: one.rank, reverse=True)
    if not usable:
        return _failed(part, scans, joints, "; ".join(_named(one, one.trouble, every) for one in every), shrink)
    first = usable[0]
    used = [first, *(one for one in usable[1:] if one.rank[:2] == (True, True))]
    said_of = [first.found.message] if first.found.message else []
    for one in every:
        if one not in used:
            why = one.trouble or one.found.message or one.doubt or _unheld(one)
            said_of.append(f"scan {one.scan.name} is not used: {why}")
    moved = np.vstack([rigid.apply(one.fitted.T_bridge_scan, one.points) for one in used])
    station = _stations([one.station for one in used])
    apart = _between_stations(moved, station, shape)
    outer = faces.of_part(shape.mesh, [design.joint_points[j] for j in joints if j is not None])
    ends: list[joint_end.Observed | joint_end.JointEnd | None] = []
    pose = first.fitted.covariance
    for outward, joint in zip((-1.0, 1.0), joints, strict=True):
        if joint is None:
            ends.append(None)
            continue
        corners = design.joint_points[joint]
        frame = edge_features.joint_frame(corners)
        end = joint_end.observe(moved, shape.mesh, outer, frame, corners[:4], outward, pose, station, apart)
        said_of += [f"{design.joint_names[joint]}: {end.trouble}"] if end.trouble else []
        ends.append(end)
    lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
    edges = bottom_edges.measure(moved, shape.mesh, outer, *lines, first.fitted.sigma_mm, pose)
    edges = systematic_errors.of_edges(edges, doubts, apart * variance_components.share(station))
    member = adjustment.Member((None, None), edges, part.vertices.mean(axis=0), pose)
    said_of += [_unheld(first)] if first.fitted.weak else []
    said_of += [first.doubt] if first.doubt else []
    cost = box_girder.cost(part)
    said_of += [cost] if cost else []
    # One scan of the part that shows its mark is enough.
    said_of += [] if any(not one.told.open for one in used) else first.told.open
    weak = bool(first.fitted.weak or first.doubt) or any(end is not None and end.trouble for end in ends)
    status = "ambiguous" if first.found.status == "ambiguous" else "weak" if weak else "ok"
    like = _looks_like(first.points, design, part) if status != "ok" else ""
    said_of += [like] if like else []
    measured = Measured(
        part.name, tuple(one.scan for one in used), status, "; ".join(said_of), first.fitted.T_bridge_scan,
        member, shrink, first.found.T_rival, *_residuals(moved, shape.mesh),
    )  # fmt: skip
    return Seen(part, measured, tuple(ends))


def _between_stations(moved: Floats, station: Ints, shape: attitude.Surface) -> float:
    """Variance between the stations that points (n, 3) on the design were seen from, mm^2."""
    moved, station = (
        thinned(moved, surface_registration.LAST_POINTS),
        thinned(station, surface_registration.LAST_POINTS),
    )
    face, residual, beyond = shape.mesh.distances(moved, 60.0)
    near = on_face(face, beyond) & (np.abs(residual) < surface_registration.GATES_MM[1])
    normals = shape.mesh.normals[face[near]]
    cell = surface_registration.cells(moved[near] @ shape.axes, icp.facing(normals, shape.axes), normals @ shape.axes)
    return variance_components.variance(residual[near], station[near], cell)


def _stations(given: Sequence[Ints]) -> Ints:
    """Return a number (n,) for each point of the scans, joined: one for all that were seen from one station."""
    found, before = [], 0
    for one in given:
        own = np.unique(one, return_inverse=True)[1].reshape(-1).astype(np.int64)
        found.append(own + before)
        before += int(own.max(initial=-1)) + 1
    return np.concatenate(found)


def _place(scan: Scan, part: DesignPart, design: ArchDesign, shape: attitude.Surface, shrink: float) -> _Placed:
    order = by_cell(scan.points, CELL_MM)
    points = scan.points[order] * shrink
    station = scan.point_station[order].astype(np.int64) if len(scan.point_station) else np.zeros(len(points), np.int64)
    found = attitude.find(points, part, shape)
    if found.status == "failed":
        return _Placed(scan, points, station, found, surface_registration.NOWHERE, found.message)
    fitted = surface_registration.fine(points, shape.mesh, shape.axes, found.T_surface)
    trouble = ""
    if not (fitted.used_share > surface_registration.LEAST_SHARE and np.isfinite(fitted.covariance).all()):
        trouble = f"only {fitted.used_share:.0%} of the points lie near the design's surface"
    elif not surface_registration.fits(fitted):
        trouble = f"{1.0 - fitted.used_share:.0%} of the points are away from the design's surface, "
        trouble += f"the others typically {fitted.sigma_mm / 1.4826:.0f} mm"
    if trouble:
        like = _looks_like(points, design, part) or WHICH
        return _Placed(scan, points, station, found, fitted, f"{trouble}; {like}")
    doubt = ""
    # Of a part without a mesh much lies beside what stands for it, the right one's points as well.
    if fitted.used_share < 1.0 - surface_registration.CLUTTER_SHARE and part.source != box_girder.SOURCE:
        # A part of another size lies on the design as far as the two are alike, and the rest passes for clutter.
        away = f"{1.0 - fitted.used_share:.0%} of the points are away from the design's surface"
        like = _looks_like(points, design, part)
        if like:
            return _Placed(scan, points, station, found, fitted, f"{away}; {like}")
        covered = _covered(points, fitted.T_bridge_scan, shape)
        doubt = f"{away} and the others cover {covered:.0%} of its sides; {WHICH}" if covered < LEAST_COVERED else ""
    told = identity.tell(points, fitted.T_bridge_scan, shape, part, design)
    # A part of another size may have its mark, by chance, where the twin has its own.
    wrong = told.wrong and (_looks_like(points, design, part) or told.wrong)
    return _Placed(scan, points, station, found, fitted, wrong, told, doubt)


def _covered(points: Floats, T: Floats, shape: attitude.Surface) -> float:
    """Share of the design's outer faces, in slices of its length, that points (n, 3) taken by T (4, 4) lie on."""
    along = shape.points @ shape.axes[:, 0]
    bounds = np.linspace(along.min(), along.max(), SLICES + 1)[1:-1]
    slices = np.digitize(along, bounds)
    sums = np.stack([np.bincount(slices, x, SLICES) for x in shape.points.T], axis=1)
    middle: Floats = sums / np.maximum(np.bincount(slices, minlength=SLICES), 1)[:, None]

    def counted(at: Floats, normals: Floats) -> Floats:
        own = np.digitize(at @ shape.axes[:, 0], bounds)
        across = normals @ shape.axes
        outer = (np.abs(across[:, 0]) < ACROSS) & (np.einsum("ni,ni->n", at - middle[own], normals) > 0.0)
        level = np.abs(across[:, 1]) > np.abs(across[:, 2])
        face = 2 * level + (np.where(level, across[:, 1], across[:, 2]) > 0.0)
        found: Floats = np.bincount(4 * own[outer] + face[outer], minlength=4 * SLICES).astype(float)
        return found

    moved = rigid.apply(T, thinned(points, surface_registration.POINTS))
    face, distance, beyond = shape.mesh.distances(moved, surface_registration.GATES_MM[0])
    near = on_face(face, beyond) & (np.abs(distance) < attitude.TELLING_MM)
    seen = counted(moved[near], shape.mesh.normals[face[near]])[counted(shape.points, shape.normals) > 0.0]
    return float((seen > LEAST_OF_TYPICAL * np.median(seen[seen > 0.0])).mean()) if seen.any() else 0.0


def _unheld(one: _Placed) -> str:
    return f"what the scan shows does not hold {' and '.join(one.fitted.weak)}"


def _named(one: _Placed, said: str, every: Sequence[_Placed]) -> str:
    return f"scan {one.scan.name}: {said}" if len(every) > 1 else said


def _residuals(moved: Floats, surface: MeshSurface) -> tuple[Floats, Floats]:
    """Return thinned points (r, 3) and their distances (r,) from the design's surface."""
    thin = thinned(moved, RESIDUALS)
    face, distance, beyond = surface.distances(thin, 60.0)
    near = on_face(face, beyond)
    return thin[near], distance[near]


def _looks_like(points: Floats, design: ArchDesign, part: DesignPart) -> str:
    """Name every other part of the design that has the size of the scan, where the part itself has not; or nothing."""
    size = _size_of(points)
    same = SIZE_SHARE * float(size.max())
    named = [o.name for o in design.parts if np.abs(_size_of(attitude.samples_of(o)[0]) - size).max() < same]
    return f"by its size it is rather {' or '.join(named)}" if named and part.name not in named else ""


def _size_of(points: Floats) -> Floats:
    """Return the sizes (3,) of a surface's points (n, 3) along its principal axes; single stray points do not count."""
    spread = float(np.linalg.norm(np.ptp(points, axis=0)))
    even = voxel_means(points, spread / 150.0, least=2)
    even = even if len(even) >= 50 else points
    found: Floats = np.sort(np.ptp(even @ principal.of_points(even).axes, axis=0))
    return found


def _failed(part: DesignPart, scans: Sequence[Scan], joints: Sequence[int | None], message: str, shrink: float) -> Seen:
    ends = tuple(None if joint is None else joint_end.nothing(message) for joint in joints)
    lines = (Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right))
    edges = bottom_edges.unseen(*lines)
    member = adjustment.Member((None, None), edges, part.vertices.mean(axis=0), np.zeros((6, 6)))
    nowhere = np.full((4, 4), np.nan)
    no_points = np.empty((0, 3))
    measured = Measured(
        part.name, (scans[0],), "failed", message, nowhere, member, shrink, nowhere, no_points, np.empty(0)
    )
    return Seen(part, measured, ends)
