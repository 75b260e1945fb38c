"""Registration of a part's whole scan to its design's surface, fine: from an attitude that is right to a few mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_surface import MeshSurface
from processor.model import Floats

POINTS = 120_000
GATES_MM = (60.0, 30.0)
CUT = 4.5  # standard deviations
FLOOR_MM = 0.01  # of sigma, for scans without noise
LEAST_SHARE = 0.5  # of the points that must lie within the last gate


@dataclass(frozen=True)
class Registration:
    """T_bridge_scan (4, 4), its covariance (6, 6: turn about the bridge's axes, translation), sigma and shares."""

    T_bridge_scan: Floats
    covariance: Floats
    sigma_mm: float
    used_share: float


def fine(points: Floats, surface: MeshSurface, start: Floats) -> Registration:
    """Robust point-to-surface least squares of points (n, 3), scan frame, from ``start`` (4, 4)."""
    thin = points[:: max(1, len(points) // POINTS)]
    T = start.copy()
    gate, sigma, covariance, share = GATES_MM[0], float("nan"), np.full((6, 6), np.nan), 0.0
    for turn in range(30):
        moved = rigid.apply(T, thin)
        face, residual, beyond = surface.distances(moved, gate + 60.0)
        used = (face >= 0) & (np.abs(residual) < gate) & (beyond < 1.0)
        if used.sum() < 100:
            break
        r, n = residual[used], surface.normals[face[used]]
        middle = moved[used].mean(axis=0)
        J = np.hstack([np.cross(moved[used] - middle, n), n])
        sigma = max(1.4826 * float(np.median(np.abs(r))), FLOOR_MM)
        weight = np.clip(1.0 - (r / (CUT * sigma)) ** 2, 0.0, 1.0) ** 2  # Tukey's
        normal = J.T @ (J * weight[:, None])
        if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)) + 1e-300)) > 1e10:
            break  # what is seen does not hold the part: no covariance, and so no answer
        step = np.linalg.solve(normal, -J.T @ (weight * r))
        R = rigid.rotation_from_vector(step[:3])
        T = rigid.transform(R, middle - R @ middle + step[3:]) @ T
        covariance = _about_origin(sigma**2 * np.linalg.inv(normal), middle)
        share = float(used.mean())
        if turn >= 3:
            gate = max(GATES_MM[1], 6.0 * sigma)
        if turn > 4 and np.linalg.norm(step[3:]) < 1e-5 and np.linalg.norm(step[:3]) < 1e-9:
            break
    return Registration(T, covariance, sigma, share)


def _about_origin(covariance: Floats, middle: Floats) -> Floats:
    """Covariance of a turn and a translation about ``middle`` (3,) as one about the frame's origin."""
    x, y, z = middle
    move = np.eye(6)
    move[3:, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]  # t_origin = t_middle - w x middle
    found: Floats = move @ covariance @ move.T
    return found
