"""Principal axes of point clouds and of meshes, and the rotations that lay one set of axes on another.

Paper 000, section 2.2, and paper 002, section 2.3, without the four of the eight sign choices that are mirror images.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface
from processor.geometry.thinning import voxel_means
from processor.large_arrays import blocks, centroid, corners
from processor.model import Floats, Ints

ALIKE = 1.25  # ratio of the variances along two axes below which these may be swapped
SAME_TURN, SAME_SHIFT = 0.02, 0.01  # rad, and share of the size: poses that differ by less are one pose
SIZE_SHARE = 0.01  # of the longest size: scans of a part differ less from its sizes, by noise, form and voxels
FACE_COS, MOST_AREA, FACE_ROUNDS = 0.9, 0.5, 5  # faces about along an axis, their least share of the area
AMBIGUOUS = 1.3  # ratio of two poses' errors below which either may be right


@dataclass(frozen=True)
class PrincipalAxes:
    """Centre (3,), axes (3, 3) as columns of a proper rotation, longest first, and their variances (3,) in mm^2."""

    centre: Floats
    axes: Floats
    variances: Floats


def of_points(points: Floats) -> PrincipalAxes:
    """Principal axes of points (n, 3), every point of equal weight (paper 000, section 2.2)."""
    centre = centroid(points)
    moments = np.zeros((3, 3))
    for rows in blocks(len(points)):
        local = points[rows] - centre
        moments += local.T @ local
    return _from_moments(centre, moments / len(points))


def sizes(points: Floats) -> Floats:
    """Sizes (3,) of a surface's points (n, 3) along its principal axes, longest first, without single outliers."""
    low, high = corners(points)
    spread = float(np.linalg.norm(high - low))
    even = voxel_means(points, spread / 150.0, least=2)
    even = even if len(even) >= 50 else points
    size: Floats = np.sort(np.ptp(even @ of_points(even).axes, axis=0))[::-1]
    return size


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


def turns(orders: Sequence[tuple[int, ...]]) -> list[Floats]:
    """Proper rotations (3, 3) that take axis ``order[i]`` to axis i, in either direction: four for each order."""
    rotations = []
    for order in orders:
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0.0:
                rotations.append(turn)
    return rotations


def possible_turns(target_variances: Floats, source_variances: Floats, *, either_cross: bool = False) -> list[Floats]:
    """Proper rotations (3, 3) between two sets of axes with variances (3,): 4, up to 24 where variances are alike.

    With ``either_cross`` the two shorter axes are alike in any case.
    """

    def alike(variances: Floats, i: int, k: int) -> bool:
        a, b = variances[i], variances[k]
        return bool(max(a, b) <= ALIKE * min(a, b))

    def possible(order: tuple[int, ...]) -> bool:
        if either_cross and order == (0, 2, 1):
            return True
        swaps = [(i, k) for i, k in enumerate(order) if i != k]
        return all(alike(target_variances, i, k) or alike(source_variances, i, k) for i, k in swaps)

    return turns([order for order in itertools.permutations(range(3)) if possible(order)])


def differ(T: Floats, other: Floats, centre: Floats, size: float) -> bool:
    """Whether two poses (4, 4) of a body about ``centre`` (3,) and of a ``size`` (mm) are two and not one."""
    turn = rigid.rotation_angle(T[:3, :3] @ other[:3, :3].T)
    shift = float(np.linalg.norm(rigid.apply(T, centre) - rigid.apply(other, centre)))
    return turn > SAME_TURN or shift > SAME_SHIFT * size


def along_faces(axes: Floats, surface: MeshSurface) -> Floats:
    """Turn principal ``axes`` (3, 3) to the normals of the faces that look about along them, if most of the area does.

    A part on a plate turns the plate's principal axes by degrees: a half turn about these would tilt the plate.
    """
    weighted, size = mesh_distance.double_areas(surface.vertices, surface.faces)
    found = axes
    for _ in range(FACE_ROUNDS):
        along = weighted @ found
        axis = np.argmax(np.abs(along), axis=1)
        best = along[np.arange(len(axis)), axis]
        near = np.abs(best) > FACE_COS * size
        if size[near].sum() < MOST_AREA * size.sum():
            return axes
        towards = np.sign(best[near])[:, None] * weighted[near]
        found = rigid.nearest_rotation(np.stack([towards[axis[near] == k].sum(axis=0) for k in range(3)], axis=1))
    return found
