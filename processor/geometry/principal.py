"""Principal axes of point clouds and of meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Floats, Ints


@dataclass(frozen=True)
class PrincipalAxes:
    """Centre (3,), axes (3, 3) as columns of a proper rotation, longest first, and their variances (3,) in mm^2."""

    centre: Floats
    axes: Floats
    variances: Floats


def of_points(points: Floats) -> PrincipalAxes:
    """Principal axes of points (n, 3), every point of equal weight (paper 000, section 2.2)."""
    centre = points.mean(axis=0)
    local = points - centre
    return _from_moments(centre, local.T @ local / len(points))


def of_mesh(vertices: Floats, faces: Ints) -> PrincipalAxes:
    """Principal axes of a triangle mesh's surface, exact: every mm^2 of equal weight.

    The second moment of a triangle a, b, c of area A about the origin is A/12 (aa' + bb' + cc' + ss'), s = a + b + c.
    """
    origin = vertices.mean(axis=0)
    a, b, c = ((vertices - origin)[faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = area.sum()
    centre = (area[:, None] * (a + b + c)).sum(axis=0) / (3.0 * total)
    moment = sum(np.einsum("n,ni,nj->ij", area, x, x) for x in (a, b, c, a + b + c)) / (12.0 * total)
    return _from_moments(origin + centre, moment - np.outer(centre, centre))


def _from_moments(centre: Floats, covariance: Floats) -> PrincipalAxes:
    variances, axes = np.linalg.eigh(covariance)
    axes = axes[:, ::-1].copy()
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    return PrincipalAxes(centre, axes, variances[::-1].copy())


def proper_sign_choices() -> tuple[Floats, ...]:
    """Give the four of the eight sign choices of three axes that are rotations and not mirror images."""
    return tuple(
        np.array(signs) for signs in ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
    )
