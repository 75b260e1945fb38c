"""M3C2: distances between two clouds along local normals, each with its level of detection.

Lague, Brodu and Leroux (2013), "Accurate 3D comparison of complex topography with terrestrial laser scanner", as used
in paper 002. Every name says whether it is a diameter; all lengths are in one unit, that of the coordinates. Callers
take a local origin off coordinates that are far from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.geometry import m3c2_kernels as kernels
from processor.geometry import point_grid
from processor.geometry.point_grid import PointGrid
from processor.geometry.threads import over_ranges
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
        lambda a, b: kernels.normals_at(reference.cells, core, order, a, b, radius, found, roughness, count),
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
        lambda a, b: kernels.along_normals(
            cloud.cells, core, normals, order, a, b, 0.5 * diameter, depth, count, mean, sd
        ),
        len(core), threads, LEAST_RANGE,
    )  # fmt: skip
    return count, mean, sd
