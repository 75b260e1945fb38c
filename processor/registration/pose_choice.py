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

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import components, distinct
from processor.geometry import mesh_distance, nearest_neighbours, rigid
from processor.geometry.mesh_distance import GRAZING_COS, FacetGrid, MeshSurface
from processor.geometry.thinning import thinned
from processor.model import Bools, Floats, Ints

ERROR_RATE = 0.05  # probability that one group of points deviates so that it fits the wrong pose
SURE_ODDS = 19.0  # 95 % against 5 %
GROUP_SPACINGS = 4.0  # side of a group by the spacing of the points: about 16 points
FEWEST_POINTS = 4  # of a group
ON, OFF = 2.0, 4.0  # times the median group's distance: up to ON on the design, from OFF on off it
LEAST_OFF_MM = 1.0  # plates may deviate by as much in thickness (EN 10029), so less distinguishes no pose
REACH_MM = 60.0  # from the design, the most that the distance of a point counts
SAMPLE = 200_000  # work: points of which groups of 16 show the surface of a mark


def choose(
    points: Floats, poses: Sequence[tuple[MeshSurface, Floats]], scanner: Floats | None = None, sample: int = SAMPLE
) -> list[int]:
    """Return the row of the pose that points (n, 3) support, then those of the poses that they do not rule out.

    ``poses`` are (4, 4), each with its design: of one design, or of several. ``scanner`` (n, 3) is the position that
    each point was measured from, if known: points are then compared with facets that face it alone. At most about
    ``sample`` points are compared.
    """
    if len(poses) < 2:
        return list(range(len(poses)))
    few = thinned(points, sample)
    seen_from = None if scanner is None else thinned(scanner, sample)
    group, voxel = _groups(few)
    if not len(voxel):
        return list(range(len(poses)))
    placed = [
        (surface, rigid.apply(T, few), None if seen_from is None else rigid.apply(T, seen_from)) for surface, T in poses
    ]
    every = np.stack([_from_facets(*one, np.full(len(few), REACH_MM)) for one in placed])
    distances = np.stack([_means(row, group) for row in every])
    near = [row[row < REACH_MM] for row in distances]  # without clutter
    typical = min((float(np.median(row)) for row in near if len(row)), default=REACH_MM)
    typical = max(typical, 0.5 * LEAST_OFF_MM / OFF)
    least_off = max(OFF * typical, ON * typical + LEAST_OFF_MM)
    grids = {id(surface): _grid(surface) for surface, _ in poses}  # several poses are of one surface
    for k, (surface, places, sight) in enumerate(placed):
        rows = np.flatnonzero((group >= 0) & (distances[k] > ON * typical)[group])
        seen_from_there = None if sight is None else sight[rows]
        every[k, rows] = _from_nearest(grids[id(surface)], surface, places[rows], seen_from_there, every[k, rows])
        distances[k] = _means(every[k], group)
    on, off = distances <= ON * typical, distances >= least_off

    def odds(i: int, j: int) -> float:
        """Logarithm of the odds of pose i against pose j."""
        return _weight(voxel[off[j]], on[i][off[j]]) - _weight(voxel[off[i]], on[j][off[i]])

    best = 0
    for other in range(1, len(poses)):
        best = other if odds(best, other) < 0.0 else best
    sure = np.log(SURE_ODDS) - 1e-9
    return [best, *(k for k in range(len(poses)) if k != best and odds(best, k) < sure)]


def _groups(points: Floats) -> tuple[Ints, Ints]:
    """Return the group (n,) of each point, -1 in a voxel of few points, and the voxel (groups, 3) of each group."""
    size = GROUP_SPACINGS * max(nearest_neighbours.surface_spacing(points), 1e-6)
    voxel = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    groups = distinct(voxel)
    full = groups.count >= FEWEST_POINTS
    number = np.where(full, np.cumsum(full) - 1, -1)
    return number[groups.number], groups.rows[full]


def off_surface(points: Floats, surface: MeshSurface, least_mm: float) -> Bools:
    """Mark the points (n, 3) that lie farther than ``least_mm``, less than REACH_MM, from a surface."""
    distance = _from_facets(surface, points, None, np.full(len(points), REACH_MM))
    # Where nothing is in reach, no face is: the most of two poses' samples, and the costly ones to search for.
    rows = np.flatnonzero((distance > least_mm) & (distance < REACH_MM))
    distance[rows] = _from_nearest(_grid(surface), surface, points[rows], None, distance[rows])
    marked: Bools = distance > least_mm
    return marked


def _grid(surface: MeshSurface) -> FacetGrid:
    return mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, REACH_MM)


def _from_nearest(
    grid: FacetGrid, surface: MeshSurface, placed: Floats, scanner: Floats | None, most: Floats
) -> Floats:
    """Return the distance (n,) of points (n, 3) from a surface as :func:`_from_facets`, also near its corners.

    Of faces that meet at a corner one may have all samples near it: a strip in facets far smaller than it is wide.
    """
    none = np.full(len(placed), -1)
    by_eye = (np.zeros((1, 3)), none) if scanner is None else (scanner, np.arange(len(placed)))
    return _from_facets(surface, placed, scanner, most, mesh_distance.nearest_visible(grid, placed, *by_eye)[0])


def _from_facets(
    surface: MeshSurface, placed: Floats, scanner: Floats | None, most: Floats, facet: Ints | None = None
) -> Floats:
    """Return the distance (n,) of points (n, 3) from the face of a ``facet`` (n,), each at most ``most`` (n,).

    Without facets they are those of the nearest samples: near a corner it may be on the other face, from which the
    search over facets does not get round. A facet that does not face the ``scanner`` (n, 3) does not count.
    """
    facet, along, beyond = surface.distances(placed, REACH_MM, facet)
    distance: Floats = np.fmin(np.hypot(along, beyond), most)
    if scanner is not None:
        sight = scanner - placed
        slope = np.einsum("ni,ni->n", surface.normals[facet], sight)
        distance = np.where(slope < GRAZING_COS * np.linalg.norm(sight, axis=1), most, distance)
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
