"""The lengths that M3C2 needs, from the density of the clouds where nobody gives them.

A cylinder holds POINTS_A_CYLINDER points of the sparser cloud in the mean: paper 002 asks for 20 at least, and with 50
the standard deviations are no more than 1 % too small. The normal's sphere is twice as wide, as in the paper: fitted to
the cylinder's own points, a normal would take up some of their noise. Lengths are in the clouds' unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from processor.geometry import m3c2, neighbors
from processor.geometry.point_grid import PointGrid
from processor.model import Floats, InputError

POINTS_A_CYLINDER = 50.0
PAPER_POINTS_A_CYLINDER = 20
NORMAL_TO_ROUGHNESS = 25.0  # Lague et al. 2013: 20 to 25 times
NORMAL_SHARE = (2.0, 4.0)  # least and greatest, in projection diameters
DEEPEST = 10.0  # projection diameters
DEPTH_TO_DISTANCE = 2.0
FAR_SHARE = 0.95  # of the distances between the clouds lie below what the depth is made from
SAMPLE = 5_000


@dataclass(frozen=True)
class Scales:
    """What the cylinders and spheres measure across, how far the cylinders reach to either side, and the spacings."""

    normal_diameter_mm: float
    projection_diameter_mm: float
    max_depth_mm: float
    reference_spacing_mm: float
    compared_spacing_mm: float


def derived(
    reference: PointGrid,
    compared: PointGrid,
    core: Floats,
    normal_diameter_mm: float = 0.0,
    projection_diameter_mm: float = 0.0,
    max_depth_mm: float = 0.0,
) -> Scales:
    """Choose the scales for core points (k, 3) that are not given, those that are 0.

    Raises InputError for clouds that have no density.
    """
    spacings = neighbors.spacing(reference), neighbors.spacing(compared)
    projection = projection_diameter_mm or rounded(diameter_for(POINTS_A_CYLINDER, max(spacings)))
    if not (projection > 0.0 and math.isfinite(projection)):
        raise InputError(
            f"clouds of {reference.count} and {compared.count} points have no density to make a projection diameter "
            "from; expected several points at different places, or give the diameter"
        )
    normal = normal_diameter_mm or rounded(_normal_diameter(reference, projection))
    depth = max_depth_mm or rounded(_depth(compared, core, projection))
    return Scales(normal, projection, depth, *spacings)


def diameter_for(points: float, spacing_mm: float) -> float:
    """Diameter of the circle that holds a number of points, one in ``spacing_mm`` squared."""
    return spacing_mm * math.sqrt(4.0 * points / math.pi)


def rounded(value: float) -> float:
    """Round up to three digits: a scale that is written down is the one that was used."""
    if not (value > 0.0 and math.isfinite(value)):
        return value
    step = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{math.ceil(value / step - 1e-9) * step:.12g}")


def _normal_diameter(reference: PointGrid, projection: float) -> float:
    """Take NORMAL_TO_ROUGHNESS times the roughness at the projection's scale, within bounds."""
    places = _sample(reference.cells.points)
    roughness = m3c2.normals(reference, places, projection).roughness
    known = roughness[np.isfinite(roughness)]
    wanted = NORMAL_TO_ROUGHNESS * float(np.median(known)) if len(known) else 0.0
    return float(np.clip(wanted, NORMAL_SHARE[0] * projection, NORMAL_SHARE[1] * projection))


def _depth(compared: PointGrid, core: Floats, projection: float) -> float:
    """Take twice what most core points have to the other cloud, within bounds; what is beyond has no answer."""
    near = neighbors.nearest(compared, _sample(core))
    far = float(np.quantile(near[np.isfinite(near)], FAR_SHARE)) if np.isfinite(near).any() else 0.0
    return min(max(projection, DEPTH_TO_DISTANCE * far), DEEPEST * projection)


def _sample(points: Floats) -> Floats:
    return points[:: max(1, len(points) // SAMPLE)]
