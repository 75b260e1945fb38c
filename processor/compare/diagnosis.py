"""Why a comparison has no distances, from extents, spacings and positions of the clouds."""

from __future__ import annotations

import numpy as np

from processor.deviation.scales import Scales
from processor.model import Floats

# What lengths in one unit are of those in another: mm and cm, inch, ft, m; cm and inch, ft, m; m and inch.
UNIT_RATIOS = (10.0, 25.4, 304.8, 1000.0, 30.48, 100.0, 39.37)
EXTENT_TOLERANCE = 0.05  # logarithmic, of the ratio of extents from one of UNIT_RATIOS
SPACING_TOLERANCE = 0.3  # logarithmic, of the ratio of spacings from that of the extents


def other_unit(reference: Floats, compared: Floats, used: Scales) -> str:
    """Return a message where the clouds (n, 3) and (m, 3) seem to differ in unit, else nothing.

    One is then larger than the other by a ratio of units, and coarser by the same ratio. With a common origin such
    clouds can still have distances: cylinders as wide as the coarser cloud needs contain all of the other.
    """
    ratio = _extent(compared) / _extent(reference) if _extent(reference) > 0.0 else 0.0
    spacing = used.compared_spacing_mm / used.reference_spacing_mm
    if ratio > 0.0 and spacing > 0.0 and abs(np.log(spacing / ratio)) < SPACING_TOLERANCE:
        return _unit_message(reference, compared)
    return ""


def _unit_message(reference: Floats, compared: Floats) -> str:
    sizes = _extent(reference), _extent(compared)
    if not min(sizes) > 0.0:
        return ""
    ratio = max(sizes) / min(sizes)
    near = min(UNIT_RATIOS, key=lambda known: abs(np.log(ratio / known)))
    if abs(np.log(ratio / near)) >= EXTENT_TOLERANCE:
        return ""
    larger, other = ("compared", "reference") if sizes[1] > sizes[0] else ("reference", "compared")
    return (
        f"the {larger} cloud is {ratio:.5g} times as large as the {other} one, about {near:g}: they seem to be in "
        "different units; convert one of them"
    )


def _extent(cloud: Floats) -> float:
    return float(np.linalg.norm(np.ptp(cloud, axis=0)))


def no_answer(reference: Floats, compared: Floats, core: Floats, without_normal: int, used: Scales) -> str:
    """Return a message why no core point (k, 3) has a distance between two clouds (n, 3) and (m, 3)."""
    if message := _unit_message(reference, compared):
        return message
    for name, cloud in (("core points", core), ("compared cloud", compared)):
        gap = _box_distance(reference, cloud)
        if gap > used.max_depth_mm:
            return (
                f"the {name} and the reference cloud lie {gap:.6g} apart (their boxes), farther than the max depth of "
                f"{used.max_depth_mm:.6g}; are they in one frame and unit? If so, give a larger --max-depth"
            )
    if without_normal == len(core):
        return (
            f"in the sphere of {used.normal_diameter_mm:.6g} across about each there are too few points of the "
            "reference for a plane; a larger --normal-diameter may help"
        )
    return (
        f"no cylinder of {used.projection_diameter_mm:.6g} across that reaches {used.max_depth_mm:.6g} to either side "
        "holds points of both clouds; a larger --max-depth or --projection-diameter may help"
    )


def _box_distance(first: Floats, second: Floats) -> float:
    """Distance between the boxes about two clouds (n, 3) and (m, 3), 0 where they overlap."""
    gap = np.maximum(first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0))
    return float(np.linalg.norm(np.maximum(gap, 0.0)))
