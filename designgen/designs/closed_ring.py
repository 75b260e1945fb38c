"""Closed ring of ribs: box sections along a full circle."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from designgen.checks import expect, expect_positive
from designgen.curves import ring
from designgen.designs import arch_rib
from designgen.designs.arch_part import ArchPart, Plates

ABOUT = "closed ring: ribs of a box section along a full circle"


@dataclass(frozen=True)
class Params:
    """Sizes in mm; ``radius_mm`` is that of the inner side. All parts are equally long."""

    parts: int = 6
    radius_mm: float = 4_000.0
    width_mm: float = 600.0
    height_mm: float = 800.0
    plate_mm: float = 20.0

    def __post_init__(self) -> None:
        expect(3 <= self.parts <= 100, "ring.parts", self.parts, "3 to 100")
        expect_positive(self, "ring", "radius_mm", "width_mm", "height_mm", "plate_mm")
        fits = 2.0 * self.plate_mm < min(self.width_mm, self.height_mm)
        expect(fits, "ring.plate_mm", self.plate_mm, "less than half of the section")


def build(params: Params) -> tuple[ArchPart, ...]:
    """Build the parts, in order: the last one meets the first."""
    curve = ring(params.radius_mm)
    cuts = [curve.length * k / params.parts for k in range(params.parts + 1)]
    plates = Plates(params.plate_mm, params.plate_mm, params.plate_mm)
    return tuple(
        arch_rib.build(f"segment{k + 1}", curve, ends, params.width_mm, params.height_mm, plates)
        for k, ends in enumerate(pairwise(cuts))
    )
