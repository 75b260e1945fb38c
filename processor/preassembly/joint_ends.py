"""A joint end from its surfaces: faces and end ring fitted to their residuals against the design.

In the joint's zone each outer face departs from the design by ``c0 + c1 x + c2 w + c3 x w`` (x along the bridge from
the joint, w across the face), the ring by ``c0 + c1 u + c2 v``. A corner moves by what its two faces and the ring say;
the covariance is that of these 19 numbers, so points of one corner are as dependent as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.geometry import rigid
from processor.geometry.mesh_surface import MeshSurface, outermost
from processor.model import Floats

Bools = npt.NDArray[np.bool_]

ZONE_MM = 500.0
ALONG, ACROSS = 0, 1
FACES = (("bottom", 2, -1.0), ("right", 1, -1.0), ("top", 2, 1.0), ("left", 1, 1.0))  # axis and sense of the normal
LEAST_POINTS = 60
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


def fit(points: Floats, surface: MeshSurface, T_bridge_joint: Floats, corners: Floats, outward: float) -> JointEnd:
    """Fit one joint end of points (n, 3), bridge frame, registered to the design.

    ``corners`` (4, 3) are the design's P1..P4; ``outward`` is +1 where the part ends at the joint, -1 where it starts.
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
    seen = (face >= 0) & (beyond < 1.0)
    normal = np.zeros_like(local)
    normal[seen] = surface.normals[face[seen]] @ T_bridge_joint[:3, :3]
    noise = _noise(residual[seen & (np.abs(normal[:, 0]) < 0.3)])
    margin = 3.0 * noise + 2.0
    half = 0.5 * size
    fits: list[tuple[Floats, Floats]] = []
    sums, freedom = 0.0, 0
    for name, axis, sense in FACES:
        across = 1 if axis == 2 else 2
        # Not by the sense of the normals: meshes come with either. Of the faces that lie so the outermost is meant.
        own = seen & (np.abs(normal[:, axis]) > 0.9) & (sense * local[:, axis] > 0.0)
        outer = outermost(surface.part_of[face[own]], sense * local[own, axis])
        own[own] = surface.part_of[face[own]] == outer
        own &= (np.abs(local[:, across]) < half[across] - margin) & (-outward * x > margin)
        basis = _face_basis(x[own], local[own, across] / half[across])
        out = residual[own] * np.sign(sense * normal[own, axis])
        coefficients, covariance, rest = _least_squares(basis, out)
        if not len(coefficients):
            return nothing(f"too few points on the {name} face")
        fits.append((coefficients, covariance))
        sums, freedom = sums + float(rest @ rest), freedom + len(rest)
    own = seen & (np.abs(normal[:, 0]) > 0.9) & (np.abs(x) < max(20.0, 6.0 * noise))
    own &= _on_ring(local, half, _thickness(surface, T_joint_bridge, half), margin)
    basis = np.stack([np.ones(own.sum()), local[own, 1] / half[1], local[own, 2] / half[2]], axis=1)
    out = residual[own] * np.sign(outward * normal[own, 0])
    coefficients, covariance, rest = _least_squares(basis, out)
    if not len(coefficients):
        return nothing("too few points on the end face")
    fits.append((coefficients, covariance))
    moved, derivative = _corners(fits, half, outward)
    whole = np.zeros((19, 19))
    for k, (_, block) in enumerate(fits):
        whole[4 * k : 4 * k + len(block), 4 * k : 4 * k + len(block)] = block
    covariance = derivative @ whole @ derivative.T + FLOOR_MM**2 * np.eye(24)
    return JointEnd(moved, covariance, float(np.sqrt(sums / max(freedom, 1))), "")


def _thickness(surface: MeshSurface, T_joint_bridge: Floats, half: Floats) -> Floats:
    """Return the thickness (2,) of webs and flanges at the joint, as deep as samples of the design's end face lie."""
    samples = rigid.apply(T_joint_bridge, np.asarray(surface.tree.data))
    upright = np.abs(surface.normals[surface.sample_face] @ T_joint_bridge[0, :3]) > 0.9
    depth = half[1:] - np.abs(samples[upright & (np.abs(samples[:, 0]) < 0.5), 1:])
    on_web = depth[:, 0] < depth[:, 1]
    return np.array([depth[on_web, 0].max(initial=0.0), depth[~on_web, 1].max(initial=0.0)])


def _on_ring(local: Floats, half: Floats, thickness: Floats, margin: float) -> Bools:
    """Mark points (n, 3) on the end ring, a margin away from its edges, where points of other faces would mix in."""
    depth = half[1:] - np.abs(local[:, 1:])
    on_web = depth[:, 0] < thickness[0] - margin
    on_flange = depth[:, 1] < thickness[1] - margin
    marked: Bools = (depth > margin).all(axis=1) & (on_web | on_flange)
    return marked


def _face_basis(x: Floats, w: Floats) -> Floats:
    scaled = x / ZONE_MM
    return np.stack([np.ones_like(scaled), scaled, w, scaled * w], axis=1)


def _noise(residual: Floats) -> float:
    middle = np.median(residual) if len(residual) else 0.0
    return float(1.4826 * np.median(np.abs(residual - middle))) if len(residual) else 0.0


def _least_squares(basis: Floats, residual: Floats) -> tuple[Floats, Floats, Floats]:
    """Coefficients (k,), covariance (k, k) and rests of the used points; empty for too few. Outliers are left out."""
    middle = np.median(residual) if len(residual) else 0.0
    used = np.abs(residual - middle) < 6.0 * _noise(residual) + FORM_MM
    coefficients: Floats = np.empty(0, np.float64)
    for _ in range(6):
        if used.sum() < LEAST_POINTS:
            return np.empty(0), np.empty((0, 0)), np.empty(0)
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
    return coefficients, variance * np.linalg.inv(normal), rest


def _corners(fits: list[tuple[Floats, Floats]], half: Floats, outward: float) -> tuple[Floats, Floats]:
    """Movements (8, 3) of P1..P8 and their derivative (24, 19) by the coefficients of the four faces and the ring."""
    # P1..P4: bottom left, bottom right, top right, top left, with their upright and their level face.
    places = [(1.0, -1.0, 3, 0), (-1.0, -1.0, 1, 0), (-1.0, 1.0, 1, 2), (1.0, 1.0, 3, 2)]
    derivative = np.zeros((8, 3, 19))
    for k, (u, v, upright, level) in enumerate(places):
        derivative[k, 0, 16:19] = outward * np.array([1.0, u, v])
        side = FACES[upright][2]
        derivative[k, 1, 4 * upright : 4 * upright + 4] = side * _face_basis(np.zeros(1), np.array([v]))[0]
        side = FACES[level][2]
        derivative[k, 2, 4 * level : 4 * level + 4] = side * _face_basis(np.zeros(1), np.array([u]))[0]
    for k, (a, b) in enumerate(((0, 1), (1, 2), (2, 3), (3, 0))):  # the middles of the edges
        derivative[4 + k] = 0.5 * (derivative[a] + derivative[b])
    flat = derivative.reshape(24, 19)
    numbers = np.concatenate([coefficients for coefficients, _ in fits])
    return (flat @ numbers).reshape(8, 3), flat
