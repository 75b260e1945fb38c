"""Arch rib: a hollow box of four plates along the curve, open at both ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.curves import Curve
from designgen.designs.arch_part import ArchPart, Plates

ABOUT = "arch rib: hollow box section of four plates, open at both ends"


@dataclass(frozen=True)
class Params:
    """A rib between arc lengths s0 and s1, mm."""

    s0_mm: float
    s1_mm: float
    width_mm: float
    height_mm: float
    plates: Plates


def build(name: str, curve: Curve, params: Params) -> ArchPart:
    """Return the rib on a curve."""
    return ArchPart(
        name=name,
        curve=curve,
        plates=params.plates,
        knots=np.array([params.s0_mm, params.s1_mm]),
        half_widths=np.full(2, 0.5 * params.width_mm),
        heights=np.full(2, params.height_mm),
    )
