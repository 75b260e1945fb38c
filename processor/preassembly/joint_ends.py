"""A joint end from its surfaces: faces and end ring fitted to their residuals against the design.

In the joint's zone each outer face departs from the design by ``c0 + c1 x + c2 w + c3 x w`` (x along the bridge from
the joint, w across the face), the ring by ``c0 + c1 u + c2 v`` and what bends it, see
:mod:`processor.preassembly.end_ring`. A corner moves by what its two faces and the ring say; the covariance is that of
these 22 numbers, so points of one corner are as dependent as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from processor.geometry import rigid
from processor.geometry.mesh_surface import MeshSurface, on_face, outermost
from processor.model import Floats, Ints
from processor.preassembly import between, end_ring, layers
from processor.preassembly.evidence import SIZES_MM, Believed, weigh

Bools = npt.NDArray[np.bool_]

ZONE_MM = 500.0
FACES = (("bottom", 2, -1.0), ("right", 1, -1.0), ("top", 2, 1.0), ("left", 1, 1.0))  # axis and sense of the normal
LEAST_POINTS = 60
# Weights of bends of each size beforehand: ends are cut by a plane.
STRAIGHT = (1.0, 1.0, 0.3, *(0.03,) * (len(SIZES_MM) - 3))
FORM_MM = 5.0  # a face may depart from the design by this much more than noise before it is fitted
FLOOR_MM = 0.004  # of the design's mesh and of rounding: no standard deviation is smaller


@dataclass(frozen=True)
class JointEnd:
    """What was built at one end: movements (8, 3) of P1..P8 from the design, joint axes; covariance (24, 24)."""

    moved: Floats
    covariance: Floats
    sigma_mm: float  # noise of the points about the fitted faces
    trouble: str


def nothing(trouble: str) -> JointEnd:
    """Return the end of which nothing is known."""
    return JointEnd(np.full((8, 3), np.nan), np.full((24, 24), np.nan), float("nan"), trouble)


def fit(
    points: Floats,
    surface: MeshSurface,
    T_bridge_joint: Floats,
    corners: Floats,
    outward: float,
    pose: Floats,
    station: Ints,
    apart: float,
) -> JointEnd:
    """Fit one joint end of points (n, 3), bridge frame, registered to the design with a covariance ``pose`` (6, 6).

    ``corners`` (4, 3) are the design's P1..P4; ``outward`` is +1 where the part ends at the joint, -1 where it starts.
    ``station`` (n,) says from where each point was seen, ``apart`` is the variance between stations, mm^2.
    """
    T_joint_bridge = rigid.invert(T_bridge_joint)
    size = np.ptp(rigid.apply(T_joint_bridge, corners), axis=0)
    local = rigid.apply(T_joint_bridge, points)
    depth = -outward * local[:, 0]
    zone = (depth < ZONE_MM) & (depth > -50.0) & (np.abs(local[:, 1:]) < 0.5 * size[1:] + 60.0).all(axis=1)
    if zone.sum() < 5 * LEAST_POINTS:
        return nothing("too few points near the joint")
    local, x = local[zone], local[zone, 0]
    face, residual, beyond = surface.distances(points[zone], 60.0)
    seen = on_face(face, beyond)
    normal = np.zeros_like(local)
    normal[seen] = surface.normals[face[seen]] @ T_bridge_joint[:3, :3]
    out_of = [residual * np.sign(sense * normal[:, axis]) for _, axis, sense in FACES]
    on, inner = _faces(surface, local, normal, face, seen, out_of)
    noise = _noise(residual[seen & ~inner & (np.abs(normal[:, 0]) < 0.3)])
    margin = 3.0 * noise + 2.0
    half = 0.5 * size
    fits: list[tuple[Floats, Floats]] = []
    sums, freedom = 0.0, 0
    station = station[zone]
    for (name, axis, _), own, out in zip(FACES, on, out_of, strict=True):
        across = 1 if axis == 2 else 2
        own = own & (np.abs(local[:, across]) < half[across] - margin) & (-outward * x > margin)
        basis = _face_basis(x[own], local[own, across] / half[across])
        coefficients, covariance, rest, used = _least_squares(basis, out[own])
        if not len(coefficients):
            return nothing(f"too few points on the {name} face")
        fits.append((coefficients, covariance + between.added(basis[used], station[own][used], apart)))
        sums, freedom = sums + float(rest @ rest), freedom + len(rest)
    sigma = float(np.sqrt(sums / max(freedom, 1)))
    ring, on_ring = _ring(local, station, fits, half, _thickness(surface, T_joint_bridge, half), outward, sigma)
    if not len(ring.coefficients):
        return nothing("too few points on the end face")
    fits.append((ring.coefficients, ring.covariance + between.added(*on_ring, apart)))
    number = np.concatenate([coefficients for coefficients, _ in fits])
    believed = _weighed(
        number, block_diag(*(block for _, block in fits)), _by_pose(T_bridge_joint, half, outward, pose)
    )
    derivative = _corners(half, outward)
    moved = (derivative @ believed.mean).reshape(8, 3)
    covariance = derivative @ believed.covariance @ derivative.T + FLOOR_MM**2 * np.eye(24)
    return JointEnd(moved, covariance, sigma, "")


def _faces(
    surface: MeshSurface, local: Floats, normal: Floats, face: Ints, seen: Bools, out_of: list[Floats]
) -> tuple[list[Bools], Bools]:
    """Mark the points (n,) of each of FACES, and those about any of them that are of the plate's inner side."""
    found, inner = [], np.zeros(len(local), bool)
    for (_, axis, sense), out in zip(FACES, out_of, strict=True):
        # Not by the sense of the normals: meshes come with either. Of the faces that lie so the outermost is meant.
        own = seen & (np.abs(normal[:, axis]) > 0.9) & (sense * local[:, axis] > 0.0)
        own[own] = surface.part_of[face[own]] == outermost(surface.part_of[face[own]], sense * local[own, axis])
        layer = layers.outer(out[own])
        inner[np.flatnonzero(own)[~layer]] = True
        own[own] = layer
        found.append(own)
    return found, inner


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
    fits: list[tuple[Floats, Floats]],
    half: Floats,
    thickness: Floats,
    outward: float,
    sigma: float,
) -> tuple[end_ring.Ring, tuple[Floats, Ints]]:
    """Fit the end ring to points (n, 3) of the joint's frame, plate by plate between the corners.

    Also the basis and the station of the points that are surely of the ring.
    """
    columns = []
    depth, plates, x = [], [], outward * local[:, 0]
    for (_, axis, sense), (coefficients, _) in zip(FACES, fits, strict=True):
        across = 1 if axis == 2 else 2
        w = local[:, across] / half[across]
        e = half[axis] + _face_basis(np.zeros(len(w)), w) @ coefficients - sense * local[:, axis]
        wide = np.abs(local[:, across]) < half[across] - np.minimum(layers.REACH_MM, 0.5 * half[across])
        plates.append(layers.plate_mm(x[wide], e[wide], sigma, float(thickness[axis - 1])))
        depth.append(e)
    clear = np.array([max(plates[1], plates[3]), max(plates[0], plates[2])]) + end_ring.REACH * sigma + 1.0
    for (_, axis, _), e, plate in zip(FACES, depth, plates, strict=True):
        across = 1 if axis == 2 else 2
        near = np.abs(local[:, across]) < half[across] - clear[across - 1]  # of the corners, where two walls meet
        near &= (e < plate + 60.0) & (e > -60.0) & (np.abs(x) < 80.0)
        basis = _ring_basis(local[near, 1] / half[1], local[near, 2] / half[2])
        columns.append((x[near], e[near], np.full(near.sum(), plate), basis, station[near]))
    at, inward, thick, basis, seen_from = (np.concatenate(column) for column in zip(*columns, strict=True))
    found = end_ring.fit(at, inward, thick, basis, sigma)
    rest = at - basis @ found.coefficients if len(found.coefficients) else np.full(len(at), np.inf)
    margin = np.minimum(2.0 * sigma, 0.35 * thick)
    surely = (np.abs(rest) < end_ring.REACH * max(sigma, FLOOR_MM)) & (inward > margin) & (inward < thick - margin)
    return found, (basis[surely], seen_from[surely])


def _face_basis(x: Floats, w: Floats) -> Floats:
    scaled = x / ZONE_MM
    return np.stack([np.ones_like(scaled), scaled, w, scaled * w], axis=1)


def _ring_basis(u: Floats, v: Floats) -> Floats:
    one = np.ones_like(u)
    return np.stack([one, u, v, u * u - one, u * v, v * v - one], axis=1)


def _noise(residual: Floats) -> float:
    middle = np.median(residual) if len(residual) else 0.0
    return float(1.4826 * np.median(np.abs(residual - middle))) if len(residual) else 0.0


def _least_squares(basis: Floats, residual: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Coefficients (k,), covariance (k, k), rests of the used points, and which they are; outliers are left out.

    Empty for too few points.
    """
    middle = np.median(residual) if len(residual) else 0.0
    used = np.abs(residual - middle) < 6.0 * _noise(residual) + FORM_MM
    coefficients: Floats = np.empty(0, np.float64)
    for _ in range(6):
        if used.sum() < LEAST_POINTS:
            return np.empty(0), np.empty((0, 0)), np.empty(0), used
        coefficients = np.asarray(np.linalg.lstsq(basis[used], residual[used], rcond=None)[0], np.float64)
        rest = residual - basis @ coefficients
        limit = 4.5 * max(_noise(rest[used]), FLOOR_MM)
        now = np.abs(rest) < limit
        if (now == used).all():
            break
        used = now
    rest = residual[used] - basis[used] @ coefficients
    variance = float(rest @ rest) / max(len(rest) - len(coefficients), 1)
    normal = basis[used].T @ basis[used]
    return coefficients, variance * np.linalg.inv(normal), rest, used


def _weighed(number: Floats, covariance: Floats, by_pose: Floats) -> Believed:
    """Weigh the numbers (22,) of an end against an end as designed, which the registration alone moves: ``by_pose``.

    The faces' shifts are of one unknown size, how they lie and bend of another; so are the ring's plane and its bends.
    """
    mean, spread = np.zeros(len(number)), np.zeros((len(number),) * 2)
    faces = [(1.0, np.tile([shift, bend, bend, bend], 4)) for shift in SIZES_MM for bend in SIZES_MM]
    ring = [
        (before, np.repeat([plane, bend], 3))
        for plane in SIZES_MM
        for bend, before in zip(SIZES_MM, STRAIGHT, strict=True)
    ]
    for rows, sizes in ((slice(0, 16), faces), (slice(16, 22), ring)):
        noise = covariance[rows, rows] + FLOOR_MM**2 * np.eye(rows.stop - rows.start)
        found = weigh(number[rows], noise, [(before, by_pose[rows, rows] + np.diag(size**2)) for before, size in sizes])
        mean[rows], spread[rows, rows] = found.mean, found.covariance
    return Believed(mean, spread)


def _by_pose(T_bridge_joint: Floats, half: Floats, outward: float, pose: Floats) -> Floats:
    """Covariance (22, 22) of an end's numbers by that of the part's registration, (6, 6) about the bridge's origin."""
    rows = []
    x, w = (a.ravel() for a in np.meshgrid([0.0, -outward * ZONE_MM], [-1.0, 1.0]))
    for _, axis, sense in FACES:
        local = np.zeros((4, 3))
        local[:, 0], local[:, axis], local[:, 3 - axis] = x, sense * half[axis], w * half[3 - axis]
        field = sense * np.einsum(
            "i,nij->nj", T_bridge_joint[:3, axis], rigid.motion(rigid.apply(T_bridge_joint, local))
        )
        rows.append(np.linalg.solve(_face_basis(x, w), field))
    u, v = np.array([1.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    local = np.stack([np.zeros(3), u * half[1], v * half[2]], axis=1)
    field = outward * np.einsum("i,nij->nj", T_bridge_joint[:3, 0], rigid.motion(rigid.apply(T_bridge_joint, local)))
    rows.append(np.linalg.solve(_ring_basis(u, v)[:, :3], field))
    moves = np.vstack([*rows, np.zeros((3, 6))])
    found: Floats = moves @ pose @ moves.T
    return found


def _corners(half: Floats, outward: float) -> Floats:
    """Return the derivative (24, 22) of the movements of P1..P8 by the numbers of the four faces and the ring."""
    # P1..P4: bottom left, bottom right, top right, top left, with their upright and their level face.
    places = [(1.0, -1.0, 3, 0), (-1.0, -1.0, 1, 0), (-1.0, 1.0, 1, 2), (1.0, 1.0, 3, 2)]
    derivative = np.zeros((8, 3, 22))
    for k, (u, v, upright, level) in enumerate(places):
        derivative[k, 0, 16:] = outward * _ring_basis(np.array([u]), np.array([v]))[0]
        for axis, face, w in ((1, upright, v), (2, level, u)):
            derivative[k, axis, 4 * face : 4 * face + 4] = FACES[face][2] * _face_basis(np.zeros(1), np.array([w]))[0]
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 3), (3, 0))):  # the middles of the edges
        derivative[4 + k] = 0.5 * (derivative[a] + derivative[b])
        u, v = (0.5 * (places[a][i] + places[b][i]) for i in range(2))
        derivative[4 + k, 0, 16:] = outward * _ring_basis(np.array([u]), np.array([v]))[0]
    return derivative.reshape(24, 22)
