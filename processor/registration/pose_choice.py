"""Choice between poses of a nearly symmetric structure, by the surface that only one of them has.

Poses that a structure's symmetry allows leave the same distances on most of its surface. They differ where small parts,
holes and plate thicknesses break the symmetry. Points are therefore grouped by voxels: a group is evidence for a pose
if its points lie on the design there, and off the design in the other pose. Groups that touch are one piece of
evidence, as a part that is displaced or missing has all its points in common.

A structure deviates from its design, so a piece may be evidence for the wrong pose. An as-built deviation that extends
over n groups is taken to have the probability ERROR_RATE / n (sizes without a scale, Jeffreys 1946). The logarithm of
the odds of two poses is the sum over their pieces, and a pose is sure from SURE_ODDS.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor.distinct_rows import components, distinct
from processor.geometry import mesh_distance, nearest_neighbours, rigid, thinning
from processor.geometry.mesh_distance import FacetGrid, MeshSurface
from processor.geometry.thread_ranges import over_ranges
from processor.model import Bools, Floats, Ints

ERROR_RATE = 0.05  # probability that one group of points deviates so that it fits the wrong pose
SURE_ODDS = 19.0  # 95 % against 5 %
GROUP_SPACINGS = 4.0  # side of a group by the spacing of the points: about 16 points
FEWEST_POINTS = 4  # of a group
ON, OFF = 2.0, 4.0  # times the median group's distance: up to ON on the design, from OFF on off it
LEAST_OFF_MM = 1.0  # plates may deviate by as much in thickness (EN 10029), so less distinguishes no pose
REACH_MM = 60.0  # from the design, the most that the distance of a point counts
SAMPLE = 200_000
LEAST_RANGE = 2_000  # points per task of a thread


@dataclass(frozen=True)
class Choice:
    """The row of the most probable pose, and the rows of the poses that are not improbable beside it."""

    best: int
    rivals: tuple[int, ...]


def choose(points: Floats, surface: MeshSurface, poses: list[Floats], scanner: Floats | None = None) -> Choice:
    """Choose between fitted poses (4, 4 each, design from scan) of points (n, 3).

    ``scanner`` (n, 3) is the position each point was measured from, in the points' frame; a point is then compared with
    facets that face it alone.
    """
    if len(poses) < 2:
        return Choice(0, ())
    few = thinning.thinned(points, SAMPLE)
    seen_from = None if scanner is None else thinning.thinned(scanner, SAMPLE)
    group, voxel = _groups(few)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, REACH_MM)
    distances = np.stack([_means(_distances(few, seen_from, grid, T), group) for T in poses])
    near = [row[row < REACH_MM] for row in distances]  # without clutter
    typical = min((float(np.median(row)) for row in near if len(row)), default=REACH_MM)
    typical = max(typical, 0.5 * LEAST_OFF_MM / OFF)
    least_off = max(OFF * typical, ON * typical + LEAST_OFF_MM)

    on, off = distances <= ON * typical, distances >= least_off

    def odds(i: int, j: int) -> float:
        """Logarithm of the odds of pose i against pose j."""
        return _weight(voxel[off[j]], on[i][off[j]]) - _weight(voxel[off[i]], on[j][off[i]])

    best = 0
    for other in range(1, len(poses)):
        best = other if odds(best, other) < 0.0 else best
    sure = np.log(SURE_ODDS) - 1e-9
    return Choice(best, tuple(k for k in range(len(poses)) if k != best and odds(best, k) < sure))


def _groups(points: Floats) -> tuple[Ints, Ints]:
    """Return the group (n,) of each point, -1 in a voxel of few points, and the voxel (groups, 3) of each group."""
    size = GROUP_SPACINGS * max(nearest_neighbours.surface_spacing(points), 1e-6)
    voxel = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    groups = distinct(voxel)
    full = groups.count >= FEWEST_POINTS
    number = np.where(full, np.cumsum(full) - 1, -1)
    return number[groups.number], groups.rows[full]


def _distances(points: Floats, scanner: Floats | None, grid: FacetGrid, T: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3), placed by T (4, 4), from the design, each at most REACH_MM."""
    placed = np.ascontiguousarray(rigid.apply(T, points))
    if scanner is None:
        seen_from, station = np.zeros((1, 3)), np.full(len(points), -1, np.int64)
    else:
        seen_from, station = np.ascontiguousarray(rigid.apply(T, scanner)), np.arange(len(points))
    distance = np.empty(len(points))

    def fill(first: int, last: int) -> None:
        part = placed[first:last]
        facet, _ = mesh_distance.nearest_visible(grid, part, seen_from, station[first:last])
        distance[first:last] = to_facets(grid.corners, part, facet, grid.reach)

    over_ranges(fill, len(points), least=LEAST_RANGE)
    return distance


@njit(cache=True, nogil=True)
def to_facets(corners: Floats, points: Floats, facet: Ints, most: float) -> Floats:
    """Return the distance (n,) of points (n, 3) from their facets (n,); ``most`` where the facet is -1."""
    distance = np.full(len(points), most)
    for row in range(len(points)):
        if facet[row] >= 0:
            distance[row] = min(most, np.sqrt(mesh_distance.square_to(corners[facet[row]], points[row])))
    return distance


def _means(values: Floats, group: Ints) -> Floats:
    """Return the mean (groups,) of values (n,) of each group."""
    used = group >= 0
    total: Floats = np.bincount(group[used], values[used]) / np.maximum(np.bincount(group[used]), 1)
    return total


def _weight(voxel: Ints, explained: Bools) -> float:
    """Return minus the log-probability that groups off a pose deviate by an error of the structure.

    The groups in voxels (k, 3) are ``explained`` (k,) if they lie on the design in the other pose. A piece of which
    most groups are not explained deviates in both poses, and parts of it lie on the design by chance.
    """
    if not len(voxel):
        return 0.0
    pairs = cKDTree(voxel).query_pairs(1.0, p=np.inf, output_type="ndarray")
    piece = components(len(voxel), *pairs.T)
    size, agreeing = np.bincount(piece), np.bincount(piece, explained)
    return float(np.log(agreeing[agreeing > 0.5 * size] / ERROR_RATE).sum())
