"""M3C2: distances between two clouds along local normals, each with its level of detection.

Source: Lague, Brodu and Leroux (2013), "Accurate 3D comparison of complex topography with terrestrial laser scanner",
as used in paper 002. Every name says whether it is a diameter; all lengths are in one unit, that of the coordinates.
Callers subtract a local origin from coordinates that are far from it.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from processor import large_arrays
from processor.geometry import nearest_neighbours, point_grid
from processor.geometry.linalg_small import eigen
from processor.geometry.point_grid import HALF_DIAGONAL, SIDE, PointGrid, block_at, cells_within
from processor.geometry.thread_ranges import over_ranges
from processor.large_arrays import blocks
from processor.model import Bools, Columns, Floats, InputError, Ints

CELLS_PER_DIAMETER = 2.0  # work, not result: a cylinder meets 3 x 3 columns of cells
FEWEST_FOR_LOD = 4  # points of either cloud, below which there is no level of detection
Z95 = 1.96  # normal quantile of 97.5 %, as Lague et al. (2013) write it
LEAST_RANGE = 256  # core points per task of a thread


@dataclass(frozen=True)
class CloudNormals(Columns):
    """Unit normals (k, 3), NaN where there is none; the sd (k,) of the points about the plane, their number (k,)."""

    normals: Floats
    roughness: Floats
    count: Ints


@dataclass(frozen=True)
class Distances(Columns):
    """M3C2 at each core point: compared minus reference, along the normal.

    ``distance`` (k,) is NaN where either cloud has no point in the cylinder, ``lod95`` where either has fewer than
    FEWEST_FOR_LOD. ``n1``, ``std1`` (population sd) are of the reference, ``n2``, ``std2`` of the compared cloud.
    """

    distance: Floats
    lod95: Floats
    n1: Ints
    n2: Ints
    std1: Floats
    std2: Floats

    @property
    def significant(self) -> Bools:
        """Where (k,) the distance is beyond its level of detection; never where there is no level."""
        significant: Bools = np.abs(self.distance) > self.lod95
        return significant


def grid(points: Floats, diameter_mm: float) -> PointGrid:
    """Sort a cloud (n, 3) for cylinders or spheres of about a diameter."""
    return point_grid.of_points(points, diameter_mm / CELLS_PER_DIAMETER)


def normals(reference: PointGrid, core: Floats, normal_diameter_mm: float, threads: int = 0) -> CloudNormals:
    """Fit normals at core points (k, 3): principal components of the points within half ``normal_diameter_mm``.

    Their signs are arbitrary; see :func:`oriented`.
    """
    core = np.ascontiguousarray(core, np.float64)
    fitted, roughness, count = np.empty((len(core), 3)), np.empty(len(core)), np.empty(len(core), np.int64)
    order, radius = reference.beside(core), 0.5 * normal_diameter_mm
    over_ranges(
        lambda a, b: normals_at(reference.cells, core, order, a, b, radius, fitted, roughness, count),
        len(core), threads, LEAST_RANGE,
    )  # fmt: skip
    return CloudNormals(fitted, roughness, count)


def oriented(normals: Floats, towards: Floats) -> Floats:
    """Turn normals (k, 3) so that each points along ``towards``: a direction (3,), or one per normal (k, 3).

    A normal square to its direction is turned along +z, else +y, else +x.
    """
    side = np.sign(np.sum(normals * towards, axis=1))
    for axis in (2, 1, 0):
        side = np.where(side == 0.0, np.sign(normals[:, axis]), side)
    turned: Floats = normals * np.where(side < 0.0, -1.0, 1.0)[:, None]
    return turned


def distances(
    reference: PointGrid,
    compared: PointGrid,
    core: Floats,
    normals: Floats,
    *,
    projection_diameter_mm: float,
    max_depth_mm: float,
    registration_error_mm: float | Floats = 0.0,
    threads: int = 0,
) -> Distances:
    """Measure from one cloud to another at core points (k, 3) with unit normals (k, 3).

    The cylinder has ``projection_diameter_mm`` and reaches ``max_depth_mm`` to either side of the core point.
    LOD95 = 1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + E), where E is the registration error, one for all or one per core point
    (paper 002, eq. 10).
    """
    core = np.ascontiguousarray(core, np.float64)
    normals = np.ascontiguousarray(normals, np.float64)
    n1, mean1, std1 = _along(reference, core, normals, projection_diameter_mm, max_depth_mm, threads)
    n2, mean2, std2 = _along(compared, core, normals, projection_diameter_mm, max_depth_mm, threads)
    known = (n1 >= FEWEST_FOR_LOD) & (n2 >= FEWEST_FOR_LOD)
    spread = np.sqrt(std1**2 / np.maximum(n1, 1) + std2**2 / np.maximum(n2, 1))
    lod95 = np.where(known, Z95 * (spread + registration_error_mm), np.nan)
    return Distances(distance=mean2 - mean1, lod95=lod95, n1=n1, n2=n2, std1=std1, std2=std2)


def _along(
    cloud: PointGrid, core: Floats, normals: Floats, diameter: float, depth: float, threads: int
) -> tuple[Ints, Floats, Floats]:
    """Return number, mean along the normal and population sd (k,) of the points in each cylinder."""
    count, mean, sd = np.empty(len(core), np.int64), np.empty(len(core)), np.empty(len(core))
    order, cylinder = cloud.beside(core), (0.5 * float(diameter), float(depth))
    over_ranges(
        lambda a, b: along_normals(cloud.cells, core, normals, order, a, b, cylinder, count, mean, sd),
        len(core), threads, LEAST_RANGE,
    )  # fmt: skip
    return count, mean, sd


# --- Scales: the lengths that M3C2 needs, derived from the density of the clouds where they are not given


# A cylinder holds this many points of the sparser cloud on average. Paper 002 asks for 20 at least; with 50 the
# standard deviations are at most 1 % too small.
POINTS_A_CYLINDER = 50.0
PAPER_POINTS_A_CYLINDER = 20  # paper 002
NORMAL_TO_ROUGHNESS = 25.0  # Lague et al. 2013: 20 to 25 times
# Least and greatest, in projection diameters. As in the paper the normal's sphere is at least twice as wide as the
# cylinder: a normal fitted to the cylinder's own points would absorb some of their noise.
NORMAL_SHARE = (2.0, 4.0)
DEEPEST = 10.0  # projection diameters
DEPTH_TO_DISTANCE = 2.0  # chosen: a cylinder ends twice as far away as nearly all of the other cloud lies
FAR_QUANTILE = 0.95  # of the distances between the clouds, from which the depth is derived
SCALE_SAMPLE = 5_000  # work: points of each cloud from which scales are chosen


@dataclass(frozen=True)
class Scales:
    """Diameters of the normals' spheres and of the cylinders, half length of the cylinders, spacings of the clouds."""

    normal_diameter_mm: float
    projection_diameter_mm: float
    max_depth_mm: float
    reference_spacing_mm: float
    compared_spacing_mm: float


def derive_scales(
    reference: PointGrid,
    compared: PointGrid,
    core: Floats,
    normal_diameter_mm: float = 0.0,
    projection_diameter_mm: float = 0.0,
    max_depth_mm: float = 0.0,
) -> Scales:
    """Derive the scales for core points (k, 3) that are 0, not given, from the spacings of the clouds.

    Raises InputError for clouds without a density.
    """
    spacings = nearest_neighbours.spacing(reference), nearest_neighbours.spacing(compared)
    projection = projection_diameter_mm or rounded(diameter_for(POINTS_A_CYLINDER, max(spacings)))
    if not (projection > 0.0 and math.isfinite(projection)):
        raise InputError(
            f"clouds of {reference.count} and {compared.count} points have no density to make a projection diameter "
            "from; expected several points at different places, or give the diameter"
        )
    return Scales(
        normal_diameter_mm=normal_diameter_mm or rounded(_normal_diameter(reference, projection)),
        projection_diameter_mm=projection,
        max_depth_mm=max_depth_mm or rounded(_depth(compared, core, projection)),
        reference_spacing_mm=spacings[0],
        compared_spacing_mm=spacings[1],
    )


def diameter_for(points: float, spacing_mm: float) -> float:
    """Diameter of the circle that holds a number of points, one per ``spacing_mm`` squared."""
    return spacing_mm * math.sqrt(4.0 * points / math.pi)


def rounded(value: float) -> float:
    """Round up to three digits, so that the scale in a report is exactly the one used."""
    if not (value > 0.0 and math.isfinite(value)):
        return value
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(value / step - 1e-9) * step:.12g}")


def _normal_diameter(reference: PointGrid, projection: float) -> float:
    """Take NORMAL_TO_ROUGHNESS times the roughness at the scale of the projection, within bounds."""
    places = _scale_sample(reference.cells.points)
    parts = [normals(reference, places[part], projection) for part in blocks(len(places), nearest_neighbours.SEARCHED)]
    roughness = np.concatenate([np.empty(0), *(part.roughness for part in parts)])
    known = roughness[np.isfinite(roughness)]
    wanted = NORMAL_TO_ROUGHNESS * float(np.median(known)) if len(known) else 0.0
    return float(np.clip(wanted, NORMAL_SHARE[0] * projection, NORMAL_SHARE[1] * projection))


def _depth(compared: PointGrid, core: Floats, projection: float) -> float:
    """Take twice the distance of most core points from the other cloud, within bounds; farther ones get no distance."""
    places = _scale_sample(core)
    parts = [
        nearest_neighbours.nearest(compared, places[part]) for part in blocks(len(places), nearest_neighbours.SEARCHED)
    ]
    near = np.concatenate([np.empty(0), *parts])
    far = float(np.quantile(near[np.isfinite(near)], FAR_QUANTILE)) if np.isfinite(near).any() else 0.0
    return min(max(projection, DEPTH_TO_DISTANCE * far), DEEPEST * projection)


def _scale_sample(points: Floats) -> Floats:
    return large_arrays.every(points, max(1, len(points) // SCALE_SAMPLE))


# --- The loops of M3C2 and of normals, compiled. Each place is independent, so that threads do not change results.


FEWEST_OF_PLANE = 3  # three points determine a plane


@njit(cache=True, nogil=True)
def along_normals(cells, places, normals, order, first, last, cylinder, count, mean, sd):  # type: ignore[no-untyped-def]
    """Fill count, mean and population sd of the points in the cylinder about each normal, measured along it.

    The ``cylinder`` is its radius and how far it reaches to either side of its place, both inclusive.
    """
    radius, depth = cylinder
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    points, starts = cells.points, cells.starts
    rim, reach = radius * radius, radius + HALF_DIAGONAL * size
    reach2, end = reach * reach, depth + HALF_DIAGONAL * size
    slack = 1e-9 * (radius + depth)
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        a, b, c = normals[row, 0], normals[row, 1], normals[row, 2]
        count[row], mean[row], sd[row] = 0, np.nan, np.nan
        if not np.isfinite(a + b + c + x + y + z) or len(points) == 0:
            continue
        ex = depth * abs(a) + radius * np.sqrt(max(0.0, 1.0 - a * a)) + slack
        ey = depth * abs(b) + radius * np.sqrt(max(0.0, 1.0 - b * b)) + slack
        ez = depth * abs(c) + radius * np.sqrt(max(0.0, 1.0 - c * c)) + slack
        i0, i1, j0, j1, k0, k1 = cells_within(cells, x, y, z, ex, ey, ez)
        n, shift, total, square = 0, 0.0, 0.0, 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    u = xl + SIDE * (bi + 0.5) * size - x
                    v = yl + SIDE * (bj + 0.5) * size - y
                    w = zl + SIDE * (bk + 0.5) * size - z
                    t = u * a + v * b + w * c
                    if abs(t) > end or u * u + v * v + w * w - t * t > reach2:
                        continue
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                t = u * a + v * b + w * c
                                if abs(t) > depth:
                                    continue
                                u, v, w = u - t * a, v - t * b, w - t * c
                                if u * u + v * v + w * w > rim:
                                    continue
                                if n == 0:
                                    shift = t  # squares of small differences lose no digits
                                t -= shift
                                n += 1
                                total += t
                                square += t * t
        count[row] = n
        if n > 0:
            mean[row] = shift + total / n
            sd[row] = np.sqrt(max(0.0, (square - total * total / n) / n))


@njit(cache=True, nogil=True)
def normals_at(cells, places, order, first, last, radius, normals, roughness, count):  # type: ignore[no-untyped-def]
    """Fit a plane to the points within ``radius`` of each place: fill its normal, their sd from it and their number.

    NaN for fewer than FEWEST_OF_PLANE points, and for points on a line. Of so few points the sd is NaN: none is off.
    """
    points, starts = cells.points, cells.starts
    rim, extent = radius * radius, radius * (1.0 + 1e-9)
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        normals[row, :], roughness[row], count[row] = np.nan, np.nan, 0
        if not np.isfinite(x + y + z) or len(points) == 0:
            continue
        i0, i1, j0, j1, k0, k1 = cells_within(cells, x, y, z, extent, extent, extent)
        n = 0
        su = sv = sw = suu = suv = suw = svv = svw = sww = 0.0
        for bi in range(i0 // SIDE, i1 // SIDE + 1):
            for bj in range(j0 // SIDE, j1 // SIDE + 1):
                for bk in range(k0 // SIDE, k1 // SIDE + 1):
                    block = block_at(cells, bi, bj, bk)
                    if block < 0:
                        continue
                    low, high = max(k0 - SIDE * bk, 0), min(k1 - SIDE * bk, SIDE - 1)
                    for i in range(max(i0, SIDE * bi), min(i1, SIDE * bi + SIDE - 1) + 1):
                        for j in range(max(j0, SIDE * bj), min(j1, SIDE * bj + SIDE - 1) + 1):
                            cell = ((i - SIDE * bi) * SIDE + (j - SIDE * bj)) * SIDE
                            for p in range(starts[block, cell + low], starts[block, cell + high + 1]):
                                u, v, w = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                                if u * u + v * v + w * w > rim:
                                    continue
                                n += 1
                                su, sv, sw = su + u, sv + v, sw + w
                                suu, suv, suw = suu + u * u, suv + u * v, suw + u * w
                                svv, svw, sww = svv + v * v, svw + v * w, sww + w * w
        count[row] = n
        if n < FEWEST_OF_PLANE:
            continue
        mu, mv, mw = su / n, sv / n, sw / n
        A[0, 0], A[1, 1], A[2, 2] = suu / n - mu * mu, svv / n - mv * mv, sww / n - mw * mw
        A[0, 1] = A[1, 0] = suv / n - mu * mv
        A[0, 2] = A[2, 0] = suw / n - mu * mw
        A[1, 2] = A[2, 1] = svw / n - mv * mw
        eigen(A, V)
        least, most = 0, 0
        for k in range(1, 3):
            least = k if A[k, k] < A[least, least] else least
            most = k if A[k, k] >= A[most, most] else most
        between = 3 - least - most
        if least == most or not A[between, between] > 1e-10 * A[most, most]:
            continue
        length = np.sqrt(V[0, least] ** 2 + V[1, least] ** 2 + V[2, least] ** 2)
        for k in range(3):
            normals[row, k] = V[k, least] / length
        if n > FEWEST_OF_PLANE:
            roughness[row] = np.sqrt(max(0.0, A[least, least]))
