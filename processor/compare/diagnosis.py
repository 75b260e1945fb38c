"""Why a comparison has no answer at all, as far as the clouds themselves tell."""

from __future__ import annotations

import numpy as np

from processor.geometry.m3c2 import Scales
from processor.model import Floats

# What lengths in one unit are of those in another: mm and cm, inch, ft, m; cm and inch, ft, m; m and inch.
UNIT_RATIOS = (10.0, 25.4, 304.8, 1000.0, 30.48, 100.0, 39.37)
NAMED = 0.05  # logarithm of how far from such a ratio extents are that differ by the unit
ALIKE = 0.3  # and of how far from it the spacings may be


def other_unit(reference: Floats, compared: Floats, used: Scales) -> str:
    """Say that a cloud (n, 3) has another unit than the other (m, 3): larger by a unit's ratio, and as much coarser.

    Nothing where that is not so. Such clouds may well have answers, where they share an origin: cylinders as wide as
    the coarser cloud asks for hold all of the other.
    """
    ratio = _extent(compared) / _extent(reference) if _extent(reference) > 0.0 else 0.0
    spacing = used.compared_spacing_mm / used.reference_spacing_mm
    if ratio > 0.0 and spacing > 0.0 and abs(np.log(spacing / ratio)) < ALIKE:
        return _unit_said(reference, compared)
    return ""


def _unit_said(reference: Floats, compared: Floats) -> str:
    sizes = _extent(reference), _extent(compared)
    if not min(sizes) > 0.0:
        return ""
    ratio = max(sizes) / min(sizes)
    near = min(UNIT_RATIOS, key=lambda one: abs(np.log(ratio / one)))
    if abs(np.log(ratio / near)) >= NAMED:
        return ""
    larger, other = ("compared", "reference") if sizes[1] > sizes[0] else ("reference", "compared")
    return (
        f"the {larger} cloud is {ratio:.5g} times as large as the {other} one, about {near:g}: they seem to be in "
        "different units; convert one of them"
    )


def _extent(cloud: Floats) -> float:
    return float(np.linalg.norm(np.ptp(cloud, axis=0)))


def no_answer(reference: Floats, compared: Floats, core: Floats, without_normal: int, used: Scales) -> str:
    """Say why no core point (k, 3) has a distance between two clouds (n, 3), (m, 3), in one unit and frame or not."""
    if said := _unit_said(reference, compared):
        return said
    for name, one in (("core points", core), ("compared cloud", compared)):
        gap = apart(reference, one)
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


def apart(one: Floats, other: Floats) -> float:
    """Distance between the boxes about two clouds (n, 3) and (m, 3), 0 where they overlap."""
    gap = np.maximum(one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0))
    return float(np.linalg.norm(np.maximum(gap, 0.0)))
