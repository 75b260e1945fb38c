"""A joint end from its surfaces: faces and end ring fitted to their residuals against the design.

In the joint's zone each outer face departs from the design by a plane in x (along the bridge from the joint) and w
(across the face), a warp x w, and what bends it: x^2, x^2 w, w^2 - 1 and x (w^2 - 1). The ring departs by a plane in u
and v and what bends it, see :mod:`processor.preassembly.ends.ring`. A corner is where its two faces and the ring meet,
as built; the covariance is that of these 40 numbers, so points of one corner are as dependent as they are. What bends a
face beyond them (x^3 and on) is not followed; how large it is at the joint is learned from all ends, and is added.

Whether numbers are departures or noise is judged for all ends of a bridge together, see
:mod:`processor.adjustment.model_averaging`: how far the others depart says what one's numbers mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from processor.adjustment import variance_components
from processor.adjustment.model_averaging import (
    SIZES_MM,
    Believed,
    averaged,
    by_the_others,
    either,
    explained,
    no_surer,
)
from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.model import Floats, Ints
from processor.preassembly.ends import faces as ends_faces
from processor.preassembly.ends import plate_sides
from processor.preassembly.ends import ring as ends_ring
from processor.preassembly.ends.faces import FACE, FACES, FLOOR_MM, LEAST_POINTS, REACH_MM, ZONE_MM

# Sizes of bends, the finest for scans without noise, and their weights beforehand: ends are cut by a plane.
BENDS_MM = (0.0, 0.02, *SIZES_MM[1:])
STRAIGHT = (0.5, 0.5, *(0.1,) * (len(SIZES_MM) - 1))
RING = 8  # numbers of the ring
TURNS = 4
# Of a movement: shapes are held against the design where they are, not where they came from. A corner 20 mm off, on
# faces tilted by as much over their width, is 0.5 mm off in ways of which the numbers follow most, but not all: the
# rest is within 0.005 of the movement, anywhere within.
SECOND_ORDER = 0.005 / np.sqrt(3.0)
COUNT = len(FACES) * FACE + RING
THERE = [FACE * face + number for face in range(len(FACES)) for number in (0, 2)]  # where a face is at the joint


@dataclass(frozen=True)
class JointEnd:
    """What was built at one end: movements (8, 3) of P1..P8 from the design, joint axes; covariance (24, 24).

    ``by_pose`` (24, 6) is how their errors follow that of the part's registration: it is the same at both ends.
    """

    moved: Floats
    covariance: Floats
    by_pose: Floats
    sigma_mm: float  # noise of the points about the fitted faces
    trouble: str


@dataclass(frozen=True)
class _OnRing:
    """Points of the ring: their basis (n, 8), rests (n,), and from where and where on the ring they were seen."""

    basis: Floats
    rest: Floats
    station: Ints
    sector: Ints


@dataclass(frozen=True)
class Observed:
    """What the points of one end say before it is weighed: 40 numbers and their covariance.

    ``moves`` (40, 6) is how the part's registration moves them, ``pose`` (6, 6) the covariance of that; ``half`` (3,)
    is half of the joint's size, ``outward`` +1 where the part ends at the joint.
    """

    number: Floats
    covariance: Floats
    moves: Floats
    pose: Floats
    half: Floats
    outward: float
    sigma_mm: float
    third_order: Floats  # (8, 2): see form.third_order, of the four faces
    trouble: str


def nothing(trouble: str) -> JointEnd:
    """Return the end of which nothing is known."""
    return JointEnd(np.full((8, 3), np.nan), np.full((24, 24), np.nan), np.full((24, 6), np.nan), float("nan"), trouble)


def observe(
    points: Floats,
    surface: MeshSurface,
    outer: MeshSurface,
    T_bridge_joint: Floats,
    corners: Floats,
    outward: float,
    pose: Floats,
    station: Ints,
    apart: float,
) -> Observed | JointEnd:
    """Fit one joint end to points (n, 3), bridge frame, registered to the design with a covariance ``pose`` (6, 6).

    What comes back is still to be :func:`judged`, but for an end of which too little was seen: that is final.
    ``outer`` are the outer faces of ``surface``, ``corners`` (4, 3) the design's P1..P4; ``outward`` is +1 where the
    part ends at the joint, -1 where it starts. ``station`` (n,) says from where each point was seen, ``apart`` is the
    variance between stations, mm^2.
    """
    T_joint_bridge = rigid.invert(T_bridge_joint)
    size = np.ptp(rigid.apply(T_joint_bridge, corners), axis=0)
    local = rigid.apply(T_joint_bridge, points)
    depth = -outward * local[:, 0]
    zone = (depth < ZONE_MM) & (depth > -REACH_MM) & (np.abs(local[:, 1:]) < 0.5 * size[1:] + REACH_MM).all(axis=1)
    if zone.sum() < 5 * LEAST_POINTS:
        return nothing("too few points near the joint")
    local = local[zone]
    half = 0.5 * size
    station = station[zone]
    faces = ends_faces.fit(points[zone], local, station, surface, outer, T_bridge_joint, half, outward)
    if isinstance(faces, str):
        return nothing(faces)
    rest = np.concatenate([face.rest for face in faces])
    sigma = float(np.sqrt(rest @ rest / max(len(rest) - FACE * len(faces), 1)))
    unfollowed = variance_components.lack_of_fit_variance([(face.rest, face.cell) for face in faces], FACE)
    fits = [
        (
            face.coefficients,
            face.covariance
            + variance_components.added(face.basis, face.station, apart)
            + variance_components.added(face.basis, face.cell, unfollowed),
        )
        for face in faces
    ]
    thickness = _thickness(surface, T_joint_bridge, half)
    ring, about = _ring(local, station, [face.coefficients for face in faces], half, thickness, outward, sigma)
    if not len(ring.coefficients):
        return nothing("too few points on the end face")
    unfollowed = variance_components.lack_of_fit_variance([(about.rest, about.sector)], RING)
    fits.append(
        (
            ring.coefficients,
            ring.covariance
            + variance_components.added(about.basis, about.station, apart)
            + variance_components.added(about.basis, about.sector, unfollowed),
        )
    )
    number = np.concatenate([coefficients for coefficients, _ in fits])
    doubtful = [
        name
        for (name, axis, _), face in zip(FACES, faces, strict=True)
        if face.alone and face.coefficients[0] < -0.5 * thickness[axis - 1] < 0.0
    ]
    trouble = f"the {' and the '.join(doubtful)} face may be the plate's inner side" if doubtful else ""
    covariance = block_diag(*(block for _, block in fits))
    third = np.vstack([variance_components.third_order(face.basis, face.rest) for face in faces])
    moves = _moves(T_bridge_joint, half, outward)
    return Observed(number, covariance, moves, pose, half, outward, sigma, third, trouble)


def judged(ends: Sequence[Observed]) -> list[JointEnd]:
    """Weigh the ends of one bridge against the design: by how far each departs, and by how far the others do."""
    if not ends:
        return []
    bent = variance_components.excess(np.vstack([end.third_order for end in ends]))
    return [_corners_of(end, own, bent) for end, own in zip(ends, _weighed(ends), strict=True)]


def _corners_of(end: Observed, believed: Believed, bent: float) -> JointEnd:
    """Return the corners of an end; ``bent`` is the variance at the joint of what faces' numbers do not follow."""
    moved, derivative = _corners(end.half, end.outward, believed.mean)
    second_order = np.repeat(SECOND_ORDER * np.linalg.norm(moved.reshape(8, 3), axis=1), 3)
    covariance = derivative @ believed.covariance @ derivative.T + np.diag(FLOOR_MM**2 + second_order**2)
    there = derivative[:, THERE]
    covariance += bent * there @ there.T
    by_pose = derivative @ believed.left_of(end.moves)
    return JointEnd(moved.reshape(8, 3), covariance, by_pose, end.sigma_mm, end.trouble)


def _thickness(surface: MeshSurface, T_joint_bridge: Floats, half: Floats) -> Floats:
    """Return the thickness (2,) of webs and flanges at the joint: how deep the facets of the design's end reach."""
    upright = np.flatnonzero(np.abs(surface.normals @ T_joint_bridge[0, :3]) > 0.9)
    corners = rigid.apply(T_joint_bridge, surface.vertices[surface.faces[upright]])
    corners = corners[(np.abs(corners[:, :, 0]) < 0.5).all(axis=1)]
    depth = half[1:] - np.abs(corners[:, :, 1:])
    middle = depth.mean(axis=1)
    on_web = middle[:, 0] < middle[:, 1]
    return np.array([depth[on_web, :, 0].max(initial=0.0), depth[~on_web, :, 1].max(initial=0.0)])


def _ring(
    local: Floats,
    station: Ints,
    faces: list[Floats],
    half: Floats,
    thickness: Floats,
    outward: float,
    sigma: float,
) -> tuple[ends_ring.Ring, _OnRing]:
    """Fit the end ring to points (n, 3) of the joint's frame, plate by plate between the corners.

    ``faces`` are the coefficients of the outer faces. Also what is known of the points that are surely of the ring.
    """
    columns = []
    depth, plates, x = [], [], outward * local[:, 0]
    for (_, axis, sense), coefficients in zip(FACES, faces, strict=True):
        across = 1 if axis == 2 else 2
        w = local[:, across] / half[across]
        e = half[axis] + ends_faces.basis(local[:, 0], w) @ coefficients - sense * local[:, axis]
        wide = np.abs(local[:, across]) < half[across] - np.minimum(plate_sides.REACH_MM, 0.5 * half[across])
        plates.append(plate_sides.plate_mm(x[wide], e[wide], sigma, float(thickness[axis - 1])))
        depth.append(e)
    clear = np.array([max(plates[1], plates[3]), max(plates[0], plates[2])]) + ends_ring.REACH * sigma + 1.0
    for (_, axis, _), e, plate in zip(FACES, depth, plates, strict=True):
        across = 1 if axis == 2 else 2
        near = np.abs(local[:, across]) < half[across] - clear[across - 1]  # of the corners, where two walls meet
        near &= (e < plate + 60.0) & (e > -60.0) & (np.abs(x) < 80.0)
        basis = _ring_basis(local[near, 1] / half[1], local[near, 2] / half[2])
        columns.append((x[near], e[near], np.full(near.sum(), plate), basis, station[near]))
    at, inward, thick, basis, seen_from = (np.concatenate(column) for column in zip(*columns, strict=True))
    found = ends_ring.fit(at, inward, thick, basis, sigma)
    rest = at - basis @ found.coefficients if len(found.coefficients) else np.full(len(at), np.inf)
    margin = np.minimum(2.0 * sigma, 0.35 * thick)
    surely = (np.abs(rest) < ends_ring.REACH * max(sigma, FLOOR_MM)) & (inward > margin) & (inward < thick - margin)
    return found, _OnRing(basis[surely], rest[surely], seen_from[surely], ends_ring.sectors(basis[surely]))


def _ring_basis(u: Floats, v: Floats) -> Floats:
    one = np.ones_like(u)
    bent_u, bent_v = u * u - one, v * v - one
    return np.stack([one, u, v, u * v, bent_u, bent_v, v * bent_u, u * bent_v], axis=1)


def _weighed(ends: Sequence[Observed]) -> list[Believed]:
    """Weigh the numbers (40,) of ends against ends as designed, which the registration alone moves.

    The faces' shifts are of one unknown size, how they lie of another, how they bend of a third; so are the ring's
    plane and its bends. Faces and ring have in common what the registration is wrong by.
    """
    found = [Believed(np.zeros(COUNT), *np.zeros((2, COUNT, COUNT))) for _ in ends]
    faces = [
        (before, np.tile(np.repeat([shift, tilt, bend], (1, 3, 4)), 4))
        for shift in SIZES_MM
        for tilt in SIZES_MM
        for bend, before in zip(BENDS_MM, STRAIGHT, strict=True)
    ]
    ring = [
        (before, np.repeat([plane, bend], (3, RING - 3)))
        for plane in SIZES_MM
        for bend, before in zip(BENDS_MM, STRAIGHT, strict=True)
    ]
    of_faces, of_ring = slice(0, COUNT - RING), slice(COUNT - RING, COUNT)
    for rows, hypotheses in ((of_faces, faces), (of_ring, ring)):
        before = np.array([weight for weight, _ in hypotheses])
        sizes = np.array([size for _, size in hypotheses])
        seen = [_rows(end, rows, sizes) for end in ends]
        logs = np.array([explained(*one) for one in seen])
        by_others = by_the_others(logs, before, _traits(sizes))
        for one, log, weights, into in zip(seen, logs, by_others, found, strict=True):
            own = _of_rows(one, log, sizes, before, weights)
            into.mean[rows], into.covariance[rows, rows], into.gain[rows, rows] = own.mean, own.covariance, own.gain
    for end, into in zip(ends, found, strict=True):
        left = into.left_of(end.moves)
        both = left[of_faces] @ end.pose @ left[of_ring].T
        into.covariance[of_faces, of_ring], into.covariance[of_ring, of_faces] = both, both.T
    return found


def _traits(sizes: Floats) -> Ints:
    """Return numbers (2, h) of what hypotheses have in common: where an end lies, and how it bends."""
    return np.stack([np.unique(of, axis=0, return_inverse=True)[1].ravel() for of in (sizes[:, :2], sizes[:, -1:])])


def _rows(end: Observed, rows: slice, sizes: Floats) -> tuple[Floats, Floats, list[Floats]]:
    """Return some numbers of an end, their noise, and the covariance of departures by each of ``sizes`` (h, n)."""
    noise = end.covariance[rows, rows] + FLOOR_MM**2 * np.eye(sizes.shape[1])
    by_pose = end.moves[rows] @ end.pose @ end.moves[rows].T
    return end.number[rows], noise, [by_pose + np.diag(size**2) for size in sizes]


def _of_rows(
    seen: tuple[Floats, Floats, list[Floats]], logs: Floats, sizes: Floats, before: Floats, weights: Floats
) -> Believed:
    """Weigh some numbers of an end: ``logs`` (h,) is how well hypotheses explain them.

    ``weights`` (h,) are those of the hypotheses by the other ends, ``before`` (h,) those without.
    """
    number, noise, priors = seen
    lies = sizes[:, :2]  # shift and tilt, or the plane twice
    designed, largest = (lies == 0.0).all(axis=1), (lies == SIZES_MM[-1]).all(axis=1)

    def weighed(of: npt.NDArray[np.bool_], by: Floats) -> Believed:
        return averaged(number, noise, [priors[h] for h in np.flatnonzero(of)], logs[of] + np.log(by[of]))

    # That ends are cut by planes is known beforehand; where these lie that depart, no better than the points say.
    departing = no_surer(weighed(~designed, weights), weighed(largest, before).covariance)
    return either(weighed(designed, weights), departing)


def _moves(T_bridge_joint: Floats, half: Floats, outward: float) -> Floats:
    """Return how an end's numbers follow a motion of the part about the bridge's origin, (40, 6)."""
    rows = []
    x, w = (a.ravel() for a in np.meshgrid([0.0, -outward * ZONE_MM], [-1.0, 1.0]))
    for _, axis, sense in FACES:
        local = np.zeros((4, 3))
        local[:, 0], local[:, axis], local[:, 3 - axis] = x, sense * half[axis], w * half[3 - axis]
        field = sense * np.einsum(
            "i,nij->nj", T_bridge_joint[:3, axis], rigid.motion(rigid.apply(T_bridge_joint, local))
        )
        rows += [np.linalg.solve(ends_faces.basis(x, w)[:, :4], field), np.zeros((FACE - 4, 6))]
    u, v = np.array([1.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    local = np.stack([np.zeros(3), u * half[1], v * half[2]], axis=1)
    field = outward * np.einsum("i,nij->nj", T_bridge_joint[:3, 0], rigid.motion(rigid.apply(T_bridge_joint, local)))
    rows.append(np.linalg.solve(_ring_basis(u, v)[:, :3], field))
    return np.vstack([*rows, np.zeros((RING - 3, 6))])


def _corners(half: Floats, outward: float, number: Floats) -> tuple[Floats, Floats]:
    """Return the movements (24,) of P1..P8 by the numbers (40,) of faces and ring, and their derivative (24, 40).

    A corner is where its faces and the ring meet: each of them is taken where the others have it, so it is found by
    turns.
    """
    # P1..P4: bottom left, bottom right, top right, top left, with their upright and their level face.
    places = [(1.0, -1.0, 3, 0), (-1.0, -1.0, 1, 0), (-1.0, 1.0, 1, 2), (1.0, 1.0, 3, 2)]
    moved, derivative = np.zeros((8, 3)), np.zeros((8, 3, COUNT))
    for k, (u, v, upright, level) in enumerate(places):
        for _ in range(TURNS):
            at_u, at_v = u + moved[k, 1] / half[1], v + moved[k, 2] / half[2]
            derivative[k, 0, -RING:] = outward * _ring_basis(np.array([at_u]), np.array([at_v]))[0]
            for axis, face, w in ((1, upright, at_v), (2, level, at_u)):
                derivative[k, axis, FACE * face : FACE * (face + 1)] = _of_face(face, moved[k, 0], w)
            moved[k] = derivative[k] @ number
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 3), (3, 0))):  # the middles of the edges
        derivative[4 + k] = 0.5 * (derivative[a] + derivative[b])
        moved[4 + k] = 0.5 * (moved[a] + moved[b])
        u, v = (0.5 * (places[a][i] + places[b][i]) + moved[4 + k, axis] / half[axis] for i, axis in ((0, 1), (1, 2)))
        derivative[4 + k, 0, -RING:] = outward * _ring_basis(np.array([u]), np.array([v]))[0]
        axis, w = (2, u) if k % 2 == 0 else (1, v)
        derivative[4 + k, axis] = 0.0
        derivative[4 + k, axis, FACE * k : FACE * (k + 1)] = _of_face(k, moved[4 + k, 0], w)
        moved[4 + k] = derivative[4 + k] @ number
    return moved.ravel(), derivative.reshape(24, COUNT)


def _of_face(face: int, x: float, w: float) -> Floats:
    """Return the derivative (8,) of a coordinate of a face, at x and w, by the face's numbers."""
    found: Floats = FACES[face][2] * ends_faces.basis(np.array([x]), np.array([w]))[0]
    return found
