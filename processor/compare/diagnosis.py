"""Reasons why a comparison has no distance at all, found from the extents of the clouds."""

from __future__ import annotations

import numpy as np

from processor import large_arrays, unit_ratio
from processor.geometry.m3c2 import Scales
from processor.model import Floats

# Ratios of mm to cm, inch, ft, m; of cm to ft, m; of inch to m.
UNIT_RATIOS = (10.0, 25.4, 304.8, 1000.0, 30.48, 100.0, 39.37)
RATIO_TOLERANCE = 0.05  # relative difference of the ratio of extents from a ratio of units
SPACING_TOLERANCE = 0.3  # logarithm: difference of the ratio of spacings from the ratio of extents


def other_unit(reference: Floats, compared: Floats, used: Scales) -> str:
    """Return why two clouds (n, 3), (m, 3) seem to be in different units, "" if they do not.

    One must be larger than the other by a ratio of units, and its points as much farther apart. Such clouds can have
    distances if they share an origin: the cylinders derived from the coarser cloud contain all of the other one.
    """
    ratio = _extent(compared) / _extent(reference) if _extent(reference) > 0.0 else 0.0
    spacing = used.compared_spacing_mm / used.reference_spacing_mm
    if ratio > 0.0 and spacing > 0.0 and abs(np.log(spacing / ratio)) < SPACING_TOLERANCE:
        return _different_units(reference, compared)
    return ""


def _different_units(reference: Floats, compared: Floats) -> str:
    sizes = _extent(reference), _extent(compared)
    if not min(sizes) > 0.0:
        return ""
    ratio = max(sizes) / min(sizes)
    factor = unit_ratio.nearest_factor(ratio, UNIT_RATIOS, RATIO_TOLERANCE)
    if factor is None:
        return ""
    larger, smaller = ("compared", "reference") if sizes[1] > sizes[0] else ("reference", "compared")
    return (
        f"the {larger} cloud is {ratio:.5g} times as large as the {smaller} one, about {factor:g}: they seem to be in "
        "different units; convert one of them"
    )


def _extent(cloud: Floats) -> float:
    low, high = large_arrays.corners(cloud)
    return float(np.linalg.norm(high - low))


def no_distance(reference: Floats, compared: Floats, core: Floats, without_normal: int, used: Scales) -> str:
    """Return why no core point (k, 3) has a distance between two clouds (n, 3), (m, 3)."""
    if reason := _different_units(reference, compared):
        return reason
    for name, points in (("core points", core), ("compared cloud", compared)):
        (low, high), (other_low, other_high) = large_arrays.corners(reference), large_arrays.corners(points)
        between = np.maximum(low - other_high, other_low - high)
        gap = float(np.linalg.norm(np.maximum(between, 0.0)))
        if gap > used.max_depth_mm:
            return (
                f"the {name} and the reference cloud lie {gap:.6g} apart (their boxes), farther than the max depth of "
                f"{used.max_depth_mm:.6g}; are they in one frame and unit? If so, give a larger --max-depth"
            )
    if without_normal == len(core):
        return (
            f"spheres of diameter {used.normal_diameter_mm:.6g} about them hold too few points of the reference for a "
            "plane; a larger --normal-diameter may help"
        )
    return (
        f"no cylinder of diameter {used.projection_diameter_mm:.6g} and {used.max_depth_mm:.6g} to either side holds "
        "points of both clouds; a larger --max-depth or --projection-diameter may help"
    )
