"""A part's end at a joint: its outer faces and its end ring fitted to their residuals against the design.

In the joint's zone each outer face departs from the design by a plane in x (along the bridge from the joint) and w
(across the face), a warp x w, and bending terms x^2, x^2 w, w^2 - 1 and x (w^2 - 1). The ring departs by a plane in u
and v and bending terms, see :mod:`processor.preassembly.ends.end_ring`. A corner is where its two faces and the ring
meet, as built; its covariance is that of these coefficients, 40 of a box, so points of one corner are correlated. Waves
of a face, what its 8 coefficients do not follow, are estimated at its corners and its middle by kriging.

Departure and noise are separated for all ends of a bridge together, see :mod:`processor.adjustment.model_averaging`:
the sizes of the other ends' departures set the weights of the hypotheses for each end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from processor import large_arrays
from processor.adjustment import kriging, model_averaging, variance_components
from processor.adjustment.model_averaging import SIZES_MM, Estimate
from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.nearest_neighbours import within_reach
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, reason
from processor.preassembly.ends import end_ring as ends_ring
from processor.preassembly.ends import outer_faces as ends_faces
from processor.preassembly.ends import plate_sides, section, view_variance
from processor.preassembly.ends.joint_frame import EndPlace
from processor.preassembly.ends.outer_faces import (
    FACE,
    FLOOR_MM,
    LEAST_POINTS,
    NODES,
    REACH_MM,
    ZONE_MM,
    FaceFit,
    RegisteredPart,
    UsedPoints,
)
from processor.preassembly.ends.section import EndFace, PlateFace
from processor.preassembly.ends.view_variance import Thickness, Variances
from processor.robust_statistics import robust_sd

# Sizes of bending terms, the finest for scans without noise, and their prior weights: ends are cut by a plane.
BENDS_MM = (0.0, 0.02, *SIZES_MM[1:])
BEND_WEIGHTS = (0.5, 0.5, *(0.1,) * (len(SIZES_MM) - 1))  # all larger ones together: 0.5
RING = 8  # coefficients of the ring
PLATE_SD_MM = 0.5  # of a plate's thickness: as delivered within -0.6 and +1.0 mm at 15 to 25 mm (EN 10029, class A)
PASS_POINTS = 50_000  # of an end whose departures are computed at once
ITERATIONS = 4  # of a corner's place on its faces
# Share of a departure, one standard deviation. Terms are taken where the design has the surface, not where the surface
# is. For a corner 20 mm off, on faces tilted by as much over their width, the difference is 0.5 mm. The coefficients
# follow most of it; the rest lies, uniformly distributed, within 0.005 of the departure.
SECOND_ORDER = 0.005 / np.sqrt(3.0)
ACROSS = [2, 3, 5, 6, 7]  # coefficients of a face that change across it
WIDE_MM = 200.0  # half the width of a face from which its shape across is as large as any


class _Layout(NamedTuple):
    """Rows of the coefficients of an end with a number of faces: of the faces, its ring, all, and the waves."""

    faces: slice
    ring: slice
    known: slice
    waves: slice  # after the coefficients, face by face

    @property
    def size(self) -> int:
        """Number of coefficients without the waves."""
        return int(self.known.stop)


def _layout(faces: int) -> _Layout:
    count = faces * FACE + RING
    waves = slice(count, count + faces * len(NODES))
    return _Layout(slice(0, faces * FACE), slice(faces * FACE, count), slice(0, count), waves)


@dataclass(frozen=True)
class JointEnd:
    """Departures (8, 3) of P1..P8 from the design in the joint's axes, mm, with covariance (24, 24); NaN = unknown.

    ``by_pose`` (24, 6) is the derivative of their errors by that of the part's registration, common to both ends.
    """

    departure: Floats
    covariance: Floats
    by_pose: Floats
    doubts: tuple[Reason, ...] = ()  # why the end is not known, or may be that of another plate side
    remarks: tuple[Reason, ...] = ()  # that do not put it in doubt

    def without_pose(self, pose: Floats) -> Floats:
        """Covariance (24, 24) without what it follows of the part's registration, of covariance ``pose`` (6, 6)."""
        covariance: Floats = self.covariance - self.by_pose @ pose @ self.by_pose.T
        return covariance


class PlateSides(NamedTuple):
    """Thicknesses (f,) by which the faces may lie further in, and what is to be said of the sides of the plates."""

    either: Floats
    doubts: tuple[Reason, ...]
    remarks: tuple[Reason, ...]


@dataclass(frozen=True)
class FittedEnd:
    """The faces of an end with their waves, and its ring, as fitted before model averaging.

    ``shared`` (n, n) is the covariance of their coefficients by errors that points of a station share. ``motion``
    (n, 6) is their derivative by a motion of the part, ``pose`` (6, 6) the covariance of its registration.
    """

    faces: tuple[kriging.Hypotheses, ...]
    ring: kriging.Kriged
    shared: Floats
    motion: Floats
    pose: Floats
    place: EndPlace
    plates: tuple[Thickness | None, ...]  # of the faces; none where the points' stations are known
    sides: PlateSides
    thickness: Floats  # (f,) of the faces' plates as designed; 0 = unknown
    ring_noise: float  # variance of the ring's points, mm^2

    @property
    def doubts(self) -> tuple[Reason, ...]:
        """Why the end may be that of another plate side."""
        return self.sides.doubts

    @property
    def remarks(self) -> tuple[Reason, ...]:
        """Return the remarks that do not put the end in doubt."""
        return self.sides.remarks


class _Block(NamedTuple):
    """Some coefficients (n,) of an end, their noise (n, n), and the covariances (n, n) of departures by hypothesis."""

    coefficients: Floats
    noise: Floats
    priors: list[Floats]


def unknown(*why: Reason) -> JointEnd:
    """Return an end without a result, with the reasons."""
    return JointEnd(np.full((8, 3), np.nan), np.full((24, 24), np.nan), np.full((24, 6), np.nan), why)


def fit(part: RegisteredPart, place: EndPlace) -> FittedEnd | JointEnd:
    """Fit the faces and the ring of one end.

    The fit is completed by :func:`estimate`; a JointEnd without an answer is final.
    """
    part = part.only(_in_zone(part.points, place))
    if len(part.points) < 5 * LEAST_POINTS:
        return unknown(reason("preassemble.few-points-at-joint"))
    local = rigid.apply(rigid.invert(place.T_bridge_joint), part.points)
    thickness = _design_thickness(part.surface, place)
    faces = ends_faces.fit(part, local, place, thickness)
    if isinstance(faces, Reason):
        return unknown(faces)
    residual = np.concatenate([face.used.residual for face in faces])
    sigma = float(np.sqrt(residual @ residual / max(len(residual) - FACE * len(faces), 1)))
    faces, sides = _outer_sides(local, faces, place, thickness, sigma)
    ring, on_ring = _fit_ring(local, part.station, faces, place, thickness, sigma)
    if not len(ring.coefficients):
        return unknown(reason("preassemble.few-points-on-end-face"))
    lack_of_fit = variance_components.lack_of_fit_variance([(on_ring.residual, on_ring.cell)], RING)
    of_sectors = variance_components.group_covariance(on_ring.basis, on_ring.cell, lack_of_fit)
    stations = [(f.used.basis, f.used.station) for f in faces] + [(on_ring.basis, on_ring.station)]
    shared = [variance_components.group_covariance(*station, part.between_stations) for station in stations]
    return FittedEnd(
        faces=tuple(face.hypotheses for face in faces),
        ring=kriging.Kriged(ring.coefficients, ring.covariance + of_sectors),
        shared=block_diag(*shared),
        motion=_motion(place),
        pose=part.pose,
        place=place,
        plates=tuple(face.plate for face in faces) if (part.station == part.station[0]).all() else (),
        sides=sides,
        thickness=thickness,
        ring_noise=robust_sd(on_ring.residual) ** 2,
    )


def _in_zone(points: Floats, place: EndPlace) -> Bools:
    """Mark the points (n, 3) in the joint's zone; those of a sphere about it are found first, as it is faster."""
    sizes = np.array([0.5 * (ZONE_MM + REACH_MM), *(place.half[1:] + REACH_MM)])
    middle = rigid.apply(place.T_bridge_joint, np.array([[0.5 * place.outward * (REACH_MM - ZONE_MM), 0.0, 0.0]]))
    marked = within_reach(points, middle, float(np.linalg.norm(sizes)) + 1.0)[0]
    T_joint_bridge = rigid.invert(place.T_bridge_joint)
    for block in large_arrays.blocks(len(points)):
        rows = block.start + np.flatnonzero(marked[block])
        local = rigid.apply(T_joint_bridge, points[rows])
        depth = -place.outward * local[:, 0]
        beside = np.abs(local[:, 1:]) < place.half[1:] + REACH_MM
        marked[rows] = (depth < ZONE_MM) & (depth > -REACH_MM) & beside.all(axis=1)
    return marked


def estimate(ends: Sequence[FittedEnd], between: Sequence[Variances] = ()) -> list[JointEnd]:
    """Estimate the corners of all ends of one bridge by model averaging, in which each end learns from the others.

    ``between`` are each end's variances between viewpoints, or none.
    """
    if not ends:
        return []
    every = [face for end in ends for face in end.faces]
    weighted = zip(every, kriging.learned_weights(every), strict=True)
    faces = iter([kriging.average(*face) for face in weighted])
    viewed = between or (view_variance.NONE,) * len(ends)
    fitted = [_joined([next(faces) for _ in end.faces], end, view) for end, view in zip(ends, viewed, strict=True)]
    averaged = _averaged(ends, fitted)
    return [_corners_of(*of_end) for of_end in zip(ends, fitted, averaged, strict=True)]


def _outer_sides(
    local: Floats, faces: Sequence[FaceFit], place: EndPlace, thickness: Floats, sigma: float
) -> tuple[list[FaceFit], PlateSides]:
    """Replace faces that were fitted to the inner side of their plates by the outer side.

    A face further in than half its plate, with no second layer, may be the plate's inner side, seen where the outer one
    was not. The end face is between both sides, so its points lie outside of the inner side and inside of the outer
    one. Where they are too few, the inner side is the more probable one, because a departure by just the plate's
    thickness is rare. The other side then is within the interval.
    """
    outer, either = list(faces), np.zeros(len(faces))
    shown: list[PlateFace] = []
    doubtful: list[PlateFace] = []
    level = np.eye(1, FACE + len(NODES))[0]
    for k, (of_design, face) in enumerate(zip(place.section.faces, faces, strict=True)):
        name, plate = of_design.name, float(thickness[k])
        if not (of_design.plate and face.single_layer and face.coefficients[0] < -0.5 * plate < 0.0):
            continue
        inward, wide = _inward(local, face, of_design)
        beyond = place.outward * local[wide, 0]
        outside, inside = plate_sides.beside(beyond, inward[wide], sigma)
        if inside >= max(plate_sides.FEWEST_BESIDE, 2 * outside):
            continue
        if outside >= max(plate_sides.FEWEST_BESIDE, 2 * inside):
            plate = plate_sides.ring_width(beyond, -inward[wide], sigma, plate)
            shown.append(name)
        else:
            either[k] = plate
            doubtful.append(name)
        moved = face.hypotheses._replace(
            means=face.hypotheses.means + plate * level,
            covariances=face.hypotheses.covariances + PLATE_SD_MM**2 * np.outer(level, level),
        )
        outer[k] = replace(face, coefficients=face.coefficients + plate * level, hypotheses=moved)
    doubts = (reason("preassemble.inner-side", faces=tuple(doubtful)),) if doubtful else ()
    remarks = (reason("preassemble.by-inner-side", faces=tuple(shown)),) if shown else ()
    return outer, PlateSides(either, doubts, remarks)


def _inward(local: Floats, face: FaceFit, of_design: EndFace) -> tuple[Floats, Bools]:
    """Distances (n,) of points inward from a face, and a mark of those away from the section's corners."""
    half = of_design.half
    departure = np.empty(len(local))
    for rows in large_arrays.blocks(len(local), PASS_POINTS):
        some = local[rows]
        departure[rows] = ends_faces.departures(some[:, 0], of_design.w(some)) @ face.coefficients
    wide = np.abs(of_design.from_middle(local)) < half - np.minimum(plate_sides.REACH_MM, 0.5 * half)
    return of_design.offset + departure - of_design.sense * local[:, of_design.axis], wide


def _joined(faces: Sequence[kriging.Kriged], end: FittedEnd, between: Variances) -> kriging.Kriged:
    """Coefficients and waves (n,) of an end, and their covariance (n, n)."""
    count = _layout(len(faces)).size
    blocks = (*(face.covariance[:FACE, :FACE] for face in faces), end.ring.covariance)
    covariance = block_diag(*blocks, *(face.covariance[FACE:, FACE:] for face in faces))
    tilted = (between.level, between.along, between.across, *np.zeros(FACE - 3))
    ring = (between.ring, between.across, between.across, *np.zeros(RING - 3))
    covariance[:count, :count] += end.shared
    if end.plates:
        covariance[:count, :count] += np.diag([*(tilted * len(faces)), *ring])
    for number, face in enumerate(faces):
        rows = slice(FACE * number, FACE * (number + 1))
        waves = slice(count + len(NODES) * number, count + len(NODES) * (number + 1))
        covariance[rows, waves], covariance[waves, rows] = face.covariance[:FACE, FACE:], face.covariance[FACE:, :FACE]
    coefficients = [*(face.mean[:FACE] for face in faces), end.ring.mean, *(face.mean[FACE:] for face in faces)]
    return kriging.Kriged(np.concatenate(coefficients), covariance)


def _corners_of(end: FittedEnd, fitted: kriging.Kriged, averaged: Estimate) -> JointEnd:
    """Key points of an end by its coefficients (n,) as averaged; the waves follow what the average changed."""
    _, _, known, of_waves = layout = _layout(len(end.faces))
    noise = fitted.covariance[known, known] + FLOOR_MM**2 * np.eye(layout.size)
    gain = np.linalg.solve(noise, fitted.covariance[known, of_waves]).T
    rest = fitted.covariance[of_waves, of_waves] - gain @ fitted.covariance[known, of_waves]
    waves = fitted.mean[of_waves] + gain @ (averaged.mean - fitted.mean[known])
    follow = np.vstack([np.eye(layout.size), gain])
    covariance = follow @ averaged.covariance @ follow.T
    covariance[of_waves, of_waves] += rest
    departure, derivative = _key_points(end.place, np.concatenate([averaged.mean, waves]))
    second_order = np.repeat(SECOND_ORDER * np.linalg.norm(departure.reshape(8, 3), axis=1), 3)
    covariance = derivative @ covariance @ derivative.T + np.diag(FLOOR_MM**2 + second_order**2)
    levels = derivative[:, : layout.faces.stop : FACE] * end.sides.either / NORMAL_95
    covariance += levels @ levels.T
    by_pose = derivative @ follow @ averaged.not_followed(end.motion)
    return JointEnd(departure.reshape(8, 3), covariance, by_pose, end.doubts, end.remarks)


def _design_thickness(surface: MeshSurface, place: EndPlace) -> Floats:
    """Thickness (f,) of the faces' plates at the joint as designed; 0 = unknown, and of edges."""
    of_box = _thickness_by_end_face(surface, place)
    found = []
    for face in place.section.faces:
        thickness = float(of_box[face.axis - 1]) if face.plate else 0.0
        if thickness > section.THICKEST_OF_RING_MM or (face.plate and not all(f.plate for f in place.section.faces)):
            # The end faces of stiffeners, or of a web between flanges, reach deeper than the plate.
            thickness = section.plate_thickness(place.half, place.T_bridge_joint, surface, face.axis, face.sense)
        found.append(thickness)
    return np.array(found)


def _thickness_by_end_face(surface: MeshSurface, place: EndPlace) -> Floats:
    """Thickness (2,) of webs and flanges at the joint: the depth of the facets of the design's end face."""
    T_joint_bridge = rigid.invert(place.T_bridge_joint)
    across = np.flatnonzero(np.abs(surface.normals @ T_joint_bridge[0, :3]) > 0.9)
    corners = rigid.apply(T_joint_bridge, surface.vertices[surface.faces[across]])
    corners = corners[(np.abs(corners[:, :, 0]) < 0.5).all(axis=1)]
    depth = place.half[1:] - np.abs(corners[:, :, 1:])
    # By its middle: the ends of a flange that runs from side to side are on the webs' outer faces.
    middle = place.half[1:] - np.abs(corners[:, :, 1:].mean(axis=1))
    on_web = middle[:, 0] < middle[:, 1]
    return np.array([depth[on_web, :, 0].max(initial=0.0), depth[~on_web, :, 1].max(initial=0.0)])


def _fit_ring(
    local: Floats, station: Ints, faces: Sequence[FaceFit], place: EndPlace, thickness: Floats, sigma: float
) -> tuple[ends_ring.Ring, UsedPoints]:
    """Fit the end ring to points (n, 3) of the joint's frame, plate by plate between the corners.

    Also return the points that are surely of the ring.
    """
    half = place.half
    depth, plates, x = [], [], place.outward * local[:, 0]
    for k, (of_design, face) in enumerate(zip(place.section.faces, faces, strict=True)):
        e, wide = _inward(local, face, of_design)
        known = float(thickness[k])
        plates.append(plate_sides.plate_thickness(x[wide], e[wide], sigma, known) if of_design.plate else 0.0)
        depth.append(e)
    thickest = [max(plates[k] for k, one in enumerate(place.section.faces) if one.axis == axis) for axis in (1, 2)]
    clear = np.array(thickest) + ends_ring.REACH * sigma + 1.0
    columns = []
    for of_design, e, plate in zip(place.section.faces, depth, plates, strict=True):
        if not of_design.plate:
            continue
        across = of_design.across
        near = np.abs(local[:, across]) < half[across] - clear[across - 1]  # off the corners, where two walls meet
        near &= (e < plate + 60.0) & (e > -60.0) & (np.abs(x) < 80.0)
        basis = _ring_basis(local[near, 1] / half[1], local[near, 2] / half[2])
        columns.append((x[near], e[near], np.full(near.sum(), plate), basis, station[near]))
    at, inward, plate_mm, basis, at_station = (np.concatenate(column) for column in zip(*columns, strict=True))
    ring = ends_ring.fit(at, inward, plate_mm, basis, sigma)
    residual = at - basis @ ring.coefficients if len(ring.coefficients) else np.full(len(at), np.inf)
    margin = np.minimum(2.0 * sigma, 0.35 * plate_mm)
    surely = (inward > margin) & (inward < plate_mm - margin)
    surely &= np.abs(residual) < ends_ring.REACH * max(sigma, FLOOR_MM)
    sector = ends_ring.sectors(basis[surely])
    return ring, UsedPoints(basis[surely], residual[surely], at_station[surely], sector)


def _ring_basis(u: Floats, v: Floats) -> Floats:
    constant = np.ones_like(u)
    bent_u, bent_v = u * u - constant, v * v - constant
    return np.stack([constant, u, v, u * v, bent_u, bent_v, v * bent_u, u * bent_v], axis=1)


def _averaged(ends: Sequence[FittedEnd], fitted: Sequence[kriging.Kriged]) -> list[Estimate]:
    """Average the coefficients (n,) of ends over hypotheses of their departures' sizes.

    The levels of the faces have one unknown size, their tilts another, their bends a third; likewise the ring's plane
    and its bends. Faces and ring share the error of the registration.
    """
    layouts = [_layout(len(end.faces)) for end in ends]
    averaged = [Estimate(np.zeros(of.size), *np.zeros((2, of.size, of.size))) for of in layouts]
    bends = list(zip(BENDS_MM, BEND_WEIGHTS, strict=True))
    faces = [
        (weight, np.repeat([level, tilt, bend], (1, 3, 4)))
        for level in SIZES_MM
        for tilt in SIZES_MM
        for bend, weight in bends
    ]
    ring = [(weight, np.repeat([plane, bend], (3, RING - 3))) for plane in SIZES_MM for bend, weight in bends]
    for of_faces, hypotheses in ((True, faces), (False, ring)):
        prior = np.array([weight for weight, _ in hypotheses])
        sizes = np.array([size for _, size in hypotheses])
        at = [of.faces if of_faces else of.ring for of in layouts]
        every = [
            np.hstack([sizes * _shares(face) for face in end.place.section.faces]) if of_faces else sizes
            for end in ends
        ]
        blocks = [_block(*of_end) for of_end in zip(ends, fitted, at, every, strict=True)]
        logs = np.array([model_averaging.log_likelihoods(*block) for block in blocks])
        # Numbers (2, h) of the hypotheses' common sizes: of level and tilt, and of bends
        traits = np.stack(
            [np.unique(of, axis=0, return_inverse=True)[1].ravel() for of in (sizes[:, :2], sizes[:, -1:])]
        )
        weights = model_averaging.weights_by_others(logs, prior, traits)
        for whole, rows, block, log, weight in zip(averaged, at, blocks, logs, weights, strict=True):
            part = _average_block(block, log, sizes, prior, weight)
            whole.mean[rows], whole.covariance[rows, rows] = part.mean, part.covariance
            whole.gain[rows, rows] = part.gain
    for end, of, whole in zip(ends, layouts, averaged, strict=True):
        by_pose = whole.not_followed(end.motion)
        common = by_pose[of.faces] @ end.pose @ by_pose[of.ring].T
        whole.covariance[of.faces, of.ring], whole.covariance[of.ring, of.faces] = common, common.T
    return averaged


def _shares(face: EndFace) -> Floats:
    """Sizes (8,) of a face's departures by those of a wide face; a narrow one changes less across."""
    shares = np.ones(FACE)
    if face.narrow:
        shares[ACROSS] = face.half / WIDE_MM
    return shares


def _block(end: FittedEnd, fitted: kriging.Kriged, rows: slice, sizes: Floats) -> _Block:
    """Coefficients of an end under hypotheses of their ``sizes`` (h, n)."""
    noise = fitted.covariance[rows, rows] + FLOOR_MM**2 * np.eye(sizes.shape[1])
    by_pose = end.motion[rows] @ end.pose @ end.motion[rows].T
    return _Block(fitted.mean[rows], noise, [by_pose + np.diag(size**2) for size in sizes])


def _average_block(block: _Block, logs: Floats, sizes: Floats, prior: Floats, weights: Floats) -> Estimate:
    """Average some coefficients of an end over hypotheses with log likelihoods ``logs`` (h,).

    ``weights`` (h,) are learned from the other ends, ``prior`` (h,) holds without them.
    """
    plane = sizes[:, :2]  # level and tilt, or the ring's plane twice
    as_designed, largest = (plane == 0.0).all(axis=1), (plane == SIZES_MM[-1]).all(axis=1)

    def over(hypotheses: Bools, weight: Floats) -> Estimate:
        priors = [block.priors[h] for h in np.flatnonzero(hypotheses)]
        log_weights = logs[hypotheses] + np.log(weight[hypotheses])
        return model_averaging.average(block.coefficients, block.noise, priors, log_weights)

    # It is prior knowledge that ends are cut by planes. Where a departing plane lies is known no better than measured.
    departing = model_averaging.with_least_covariance(over(~as_designed, weights), over(largest, prior).covariance)
    return model_averaging.mixture(over(as_designed, weights), departing)


def _motion(place: EndPlace) -> Floats:
    """Return the derivative (n, 6) of an end's coefficients by a motion of the part about the bridge's origin."""
    T, half = place.T_bridge_joint, place.half
    rows = []
    x, w = (a.ravel() for a in np.meshgrid([0.0, -place.outward * ZONE_MM], [-1.0, 1.0]))
    for face in place.section.faces:
        axis, sense, local = face.axis, face.sense, np.zeros((4, 3))
        local[:, 0], local[:, axis], local[:, face.across] = x, sense * face.offset, w * face.half + face.middle
        field = sense * np.einsum("i,nij->nj", T[:3, axis], rigid.motion(rigid.apply(T, local)))
        rows += [np.linalg.solve(ends_faces.basis(x, w)[:, :4], field), np.zeros((FACE - 4, 6))]
    u, v = np.array([1.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    local = np.stack([np.zeros(3), u * half[1], v * half[2]], axis=1)
    field = place.outward * np.einsum("i,nij->nj", T[:3, 0], rigid.motion(rigid.apply(T, local)))
    rows.append(np.linalg.solve(_ring_basis(u, v)[:, :3], field))
    return np.vstack([*rows, np.zeros((RING - 3, 6))])


def _key_points(place: EndPlace, coefficients: Floats) -> tuple[Floats, Floats]:
    """Departures (24,) of P1..P8 by the coefficients and waves (n,) of faces and ring, and their derivative (24, n).

    A corner is where its faces and the ring meet. Each surface is evaluated at the corner as the others place it, by
    fixed-point iteration. The middle of an open side is that of its corners.
    """
    half, faces = place.half, place.section.faces
    corners, middles = place.section.corners, place.section.middles
    ring = _layout(len(faces)).ring
    departure, derivative = np.zeros((8, 3)), np.zeros((8, 3, len(coefficients)))
    for k, (u, v, upright, level) in enumerate(corners):
        for _ in range(ITERATIONS):
            at_u, at_v = u + departure[k, 1] / half[1], v + departure[k, 2] / half[2]
            derivative[k, 0, ring] = place.outward * _ring_basis(np.array([at_u]), np.array([at_v]))[0]
            for axis, face, w in ((1, upright, at_v), (2, level, at_u)):
                one = faces[face]
                at = w if one.plate else (w * half[one.across] - one.middle) / one.half
                derivative[k, axis] = _on_face(faces, face, departure[k, 0], at)
            departure[k] = derivative[k] @ coefficients
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 3), (3, 0))):  # the middles of the edges
        derivative[4 + k] = 0.5 * (derivative[a] + derivative[b])
        departure[4 + k] = 0.5 * (departure[a] + departure[b])
        if middles[k] < 0:
            continue
        u, v = (
            0.5 * (corners[a][i] + corners[b][i]) + departure[4 + k, axis] / half[axis] for i, axis in ((0, 1), (1, 2))
        )
        derivative[4 + k, 0, ring] = place.outward * _ring_basis(np.array([u]), np.array([v]))[0]
        axis, w = (2, u) if k % 2 == 0 else (1, v)
        derivative[4 + k, axis] = _on_face(faces, middles[k], departure[4 + k, 0], w)
        departure[4 + k] = derivative[4 + k] @ coefficients
    return departure.ravel(), derivative.reshape(24, len(coefficients))


def _on_face(faces: Sequence[EndFace], face: int, x: float, w: float) -> Floats:
    """Return the derivative (n,) of a coordinate on a face, at x and w, by coefficients and waves."""
    layout = _layout(len(faces))
    derivative = np.zeros(layout.waves.stop)
    departures = faces[face].sense * ends_faces.departures(np.array([x]), np.array([w]))[0]
    waves = layout.size + len(NODES) * face
    derivative[FACE * face : FACE * (face + 1)] = departures[:FACE]
    derivative[waves : waves + len(NODES)] = departures[FACE:]
    return derivative
