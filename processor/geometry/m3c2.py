"""M3C2: distances between two clouds along local normals, each with its level of detection.

Lague, Brodu and Leroux (2013), "Accurate 3D comparison of complex topography with terrestrial laser scanner", as used
in paper 002. Every name says whether it is a diameter; all lengths are in one unit, that of the coordinates. Callers
take a local origin off coordinates that are far from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.geometry import point_grid
from processor.geometry.linalg_small import eigen
from processor.geometry.parallel import over_ranges
from processor.geometry.point_grid import SIDE, PointGrid, block_at
from processor.model import Floats, Ints

Bools = npt.NDArray[np.bool_]

CELLS_PER_DIAMETER = 4.0
FEWEST_FOR_LOD = 4  # points of either cloud; with fewer a level of detection says nothing
Z95 = 1.96
LEAST_RANGE = 256  # core points a thread takes at a time


@dataclass(frozen=True)
class CloudNormals:
    """Unit normals (k, 3), NaN where there is none; the sd (k,) of the points about the plane, their number (k,)."""

    normals: Floats
    roughness: Floats
    count: Ints


@dataclass(frozen=True)
class Distances:
    """What M3C2 says at each core point, compared minus reference along the normal.

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
        found: Bools = np.abs(self.distance) > self.lod95
        return found


def grid(points: Floats, diameter_mm: float) -> PointGrid:
    """Sort a cloud (n, 3) for cylinders or spheres of about a diameter."""
    return point_grid.of_points(points, diameter_mm / CELLS_PER_DIAMETER)


def normals(reference: PointGrid, core: Floats, normal_diameter_mm: float, threads: int = 0) -> CloudNormals:
    """Fit normals at core points (k, 3): principal components of the points within half ``normal_diameter_mm``.

    Their signs are arbitrary; see :func:`oriented`.
    """
    core = np.ascontiguousarray(core, np.float64)
    found, roughness, count = np.empty((len(core), 3)), np.empty(len(core)), np.empty(len(core), np.int64)
    order, radius = reference.beside(core), 0.5 * normal_diameter_mm
    over_ranges(
        lambda a, b: normals_at(reference.cells, core, order, a, b, radius, found, roughness, count),
        len(core), threads, LEAST_RANGE,
    )  # fmt: skip
    return CloudNormals(found, roughness, count)


def oriented(normals: Floats, towards: Floats) -> Floats:
    """Turn normals (k, 3) so that each looks along ``towards``: a direction (3,), or one a normal (k, 3).

    One square to its direction looks along +z, else +y, else +x.
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
    LOD95 = 1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + E), E the registration error, one for all or for each (paper 002
    eq. 10).
    """
    core = np.ascontiguousarray(core, np.float64)
    normals = np.ascontiguousarray(normals, np.float64)
    n1, mean1, std1 = _along(reference, core, normals, projection_diameter_mm, max_depth_mm, threads)
    n2, mean2, std2 = _along(compared, core, normals, projection_diameter_mm, max_depth_mm, threads)
    known = (n1 >= FEWEST_FOR_LOD) & (n2 >= FEWEST_FOR_LOD)
    spread = np.sqrt(std1**2 / np.maximum(n1, 1) + std2**2 / np.maximum(n2, 1))
    lod95 = np.where(known, Z95 * (spread + registration_error_mm), np.nan)
    return Distances(mean2 - mean1, lod95, n1, n2, std1, std2)


def _along(
    cloud: PointGrid, core: Floats, normals: Floats, diameter: float, depth: float, threads: int
) -> tuple[Ints, Floats, Floats]:
    """Return number, mean along the normal and population sd (k,) of the points in each cylinder."""
    count, mean, sd = np.empty(len(core), np.int64), np.empty(len(core)), np.empty(len(core))
    order = cloud.beside(core)
    over_ranges(
        lambda a, b: along_normals(
            cloud.cells, core, normals, order, a, b, 0.5 * diameter, depth, count, mean, sd
        ),
        len(core), threads, LEAST_RANGE,
    )  # fmt: skip
    return count, mean, sd


# --- The loops of M3C2 and of normals, compiled: each place's answer is its own, whatever thread computes it.


HALF_DIAGONAL = 0.5 * SIDE * 3.0**0.5 * (1.0 + 1e-9)  # of a block, in cells
FEWEST_OF_PLANE = 4


@njit(cache=True, nogil=True)
def along_normals(cells, places, normals, order, first, last, radius, depth, count, mean, sd):  # type: ignore[no-untyped-def]
    """Count, mean and population sd of the points in the cylinder about each normal, measured along it from its place.

    The cylinder has a ``radius`` and reaches ``depth`` to either side, rims included.
    """
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
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
        if x + ex < xl or y + ey < yl or z + ez < zl:
            continue
        i0, i1 = int(max((x - ex - xl) / size, 0.0)), int(min((x + ex - xl) / size, float(tops[0])))
        j0, j1 = int(max((y - ey - yl) / size, 0.0)), int(min((y + ey - yl) / size, float(tops[1])))
        k0, k1 = int(max((z - ez - zl) / size, 0.0)), int(min((z + ez - zl) / size, float(tops[2])))
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
                                    shift = t  # squares of what is left lose no digits
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
    """Fit a plane to the points within ``radius`` of each place: its normal, their sd from it, and their number.

    NaN where fewer than FEWEST_OF_PLANE are there or they lie on a line.
    """
    size, (xl, yl, zl) = cells.size, (cells.lower[0], cells.lower[1], cells.lower[2])
    tops = SIDE * cells.extent - 1
    points, starts = cells.points, cells.starts
    rim, extent = radius * radius, radius * (1.0 + 1e-9)
    A, V = np.empty((3, 3)), np.empty((3, 3))
    for at in range(first, last):
        row = order[at]
        x, y, z = places[row, 0], places[row, 1], places[row, 2]
        normals[row, :], roughness[row], count[row] = np.nan, np.nan, 0
        if not np.isfinite(x + y + z) or len(points) == 0:
            continue
        if x + extent < xl or y + extent < yl or z + extent < zl:
            continue
        i0, i1 = int(max((x - extent - xl) / size, 0.0)), int(min((x + extent - xl) / size, float(tops[0])))
        j0, j1 = int(max((y - extent - yl) / size, 0.0)), int(min((y + extent - yl) / size, float(tops[1])))
        k0, k1 = int(max((z - extent - zl) / size, 0.0)), int(min((z + extent - zl) / size, float(tops[2])))
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
        roughness[row] = np.sqrt(max(0.0, A[least, least]))
