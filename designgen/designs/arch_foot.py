"""Arch foot: a box that widens towards a closed base and is open at its joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.curves import Curve
from designgen.designs.arch_part import ArchPart, Plates

ABOUT = "arch foot: box section widening to a closed base, open at the joint"


@dataclass(frozen=True)
class Params:
    """A foot between arc lengths s0 and s1, mm. ``taper`` is the fraction of its length over which it widens."""

    s0_mm: float
    s1_mm: float
    width_mm: float
    height_mm: float
    base_width_mm: float
    base_height_mm: float
    taper: float
    plates: Plates
    base_at: str  # start | end


def build(name: str, curve: Curve, params: Params) -> ArchPart:
    """Return the foot on a curve."""
    length = params.taper * (params.s1_mm - params.s0_mm)
    kink = params.s0_mm + length if params.base_at == "start" else params.s1_mm - length
    b, h = 0.5 * params.width_mm, params.height_mm
    widths, heights = [0.5 * params.base_width_mm, b, b], [params.base_height_mm, h, h]
    if params.base_at == "end":
        widths.reverse()
        heights.reverse()
    return ArchPart(
        name=name,
        curve=curve,
        plates=params.plates,
        knots=np.array([params.s0_mm, kink, params.s1_mm]),
        half_widths=np.array(widths),
        heights=np.array(heights),
        closed=params.base_at,
    )
