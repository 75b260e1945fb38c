"""Arch rib: a hollow box of four plates along the curve, open at both ends."""

from __future__ import annotations

import numpy as np

from designgen.curves import Curve
from designgen.designs.arch_part import ArchPart, Plates

ABOUT = "arch rib: hollow box section of four plates, open at both ends"


def build(
    name: str, curve: Curve, ends_mm: tuple[float, float], width_mm: float, height_mm: float, plates: Plates
) -> ArchPart:
    """Return the rib between two arc lengths on a curve."""
    return ArchPart(
        name=name,
        curve=curve,
        plates=plates,
        knots=np.array(ends_mm),
        half_widths=np.full(2, 0.5 * width_mm),
        heights=np.full(2, height_mm),
    )
