"""Arch foot: a box that widens towards a closed base and is open at its joint."""

from __future__ import annotations

import dataclasses

import numpy as np

from designgen.designs.arch_part import ArchPart

ABOUT = "arch foot: box section widening to a closed base, open at the joint"


def build(rib: ArchPart, base_width_mm: float, base_height_mm: float, taper: float, base_at: str) -> ArchPart:
    """Return a rib that widens over the fraction ``taper`` of its length to a base at its "start" or "end"."""
    length, order = taper * (rib.s1 - rib.s0), slice(None, None, 1 if base_at == "start" else -1)
    kink = rib.s0 + length if base_at == "start" else rib.s1 - length
    return dataclasses.replace(
        rib,
        knots=np.array([rib.s0, kink, rib.s1]),
        half_widths=np.array([0.5 * base_width_mm, *rib.half_widths])[order],
        heights=np.array([base_height_mm, *rib.heights])[order],
        closed=base_at,
    )
