"""The outer end of a foot, which no joint measures: how far its end face is from the design along the part.

The face may be cut as wrongly as an end at a joint, and the registration of a part follows all of its surface, not its
end. The faces across the part near its outer end, both sides of a base plate, are fitted with a plane of residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.adjustment import variance_components
from processor.geometry.mesh_distance import on_face
from processor.large_arrays import blocks
from processor.model import Floats
from processor.preassembly.ends.outer_faces import (
    ALONG,
    FLOOR_MM,
    LEAST_POINTS,
    REACH_MM,
    RegisteredPart,
    least_squares,
)

NEAR_MM = 100.0  # of the end along the part: the thickest base plate


@dataclass(frozen=True)
class OuterEnd:
    """Departure (3,) of an outer end at the middle of its bottom, mm, and the variance along its ``direction`` (3,)."""

    departure: Floats
    direction: Floats
    variance: float


def measure(part: RegisteredPart, at: Floats, direction: Floats) -> OuterEnd | None:
    """Measure the outer end at ``at`` (3,) along a unit ``direction`` (3,); None where it was not seen.

    The variance is of noise and of differences between named stations.
    """
    # A few of the points of a long part.
    near = np.zeros(len(part.points), bool)
    for some in blocks(len(near)):
        near[some] = np.abs(part.points[some] @ direction - at @ direction) < NEAR_MM
    rows = np.flatnonzero(near)
    points = part.points[rows]
    face, residual, beyond = part.surface.distances(points, REACH_MM)
    facing = part.surface.normals[face] @ direction
    offset = points - at
    used = on_face(face, beyond) & (np.abs(facing) > ALONG) & (np.abs(residual) < REACH_MM)
    if used.sum() < LEAST_POINTS:
        return None
    level = np.array([-direction[1], direction[0], 0.0])
    level /= np.linalg.norm(level)
    across = np.stack([level, np.cross(direction, level)], axis=1)
    # The plane's first coefficient is its value at the middle of the bottom.
    basis = np.hstack([np.ones((int(used.sum()), 1)), 1e-3 * offset[used] @ across])
    if np.linalg.cond(basis) > 1e4:
        return None
    coefficients, rest, inliers = least_squares(basis, np.sign(facing[used]) * residual[used])
    if not len(coefficients):
        return None
    basis, station = basis[inliers], part.station[rows][used][inliers]
    noise = max(float(rest @ rest) / (len(rest) - basis.shape[1]), FLOOR_MM**2)
    shared = variance_components.group_covariance(basis, station, part.between_stations)
    variance = noise * float(np.linalg.inv(basis.T @ basis)[0, 0]) + float(shared[0, 0]) + FLOOR_MM**2
    return OuterEnd(float(coefficients[0]) * direction, direction, variance)
