"""Arch bridge of two feet and any number of ribs between them: foot1, rib1, rib2, ..., foot2."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from designgen.checks import expect_all, expect_positive
from designgen.curves import NAMES as CURVES
from designgen.curves import make as make_curve
from designgen.designs import arch_foot, arch_rib
from designgen.designs.arch_part import ArchPart, Plates

ABOUT = "arch bridge: two feet and ribs in a row along a parabola, catenary or circle"
MOST_PARTS = 100  # work: bridges have some ten


@dataclass(frozen=True)
class Params:
    """Sizes of the bridge in mm; ``joints`` are fractions of the soffit's arc length.

    ``parts``, if above 0, makes as many parts of equal length instead.
    """

    curve: str = "parabola"
    span_mm: float = 24_000.0
    rise_mm: float = 6_000.0
    width_mm: float = 900.0
    height_mm: float = 1_100.0
    plate_bottom_mm: float = 24.0
    plate_top_mm: float = 24.0
    plate_web_mm: float = 20.0
    base_width_mm: float = 1_300.0
    base_height_mm: float = 1_600.0
    joints: tuple[float, ...] = (0.19, 0.40, 0.60, 0.81)
    parts: int = 0
    taper: float = 0.6

    def __post_init__(self) -> None:
        lengths = ("span_mm", "rise_mm", "width_mm", "height_mm", "plate_bottom_mm", "plate_top_mm", "plate_web_mm")
        expect_positive(self, "bridge", *lengths)
        plates = self.plate_bottom_mm + self.plate_top_mm
        rising = 0 < len(self.joints) < MOST_PARTS and all(a < z for a, z in pairwise((0.0, *self.joints, 1.0)))
        expect_all(
            "bridge",
            (self.curve in CURVES, "curve", self.curve, f"one of {', '.join(CURVES)}"),
            (self.rise_mm < 0.5 * self.span_mm, "rise_mm", self.rise_mm, "less than half of span_mm"),
            (self.plate_web_mm < 0.5 * self.width_mm, "plate_web_mm", self.plate_web_mm, "less than half of width_mm"),
            (plates < self.height_mm, "plate_bottom_mm + plate_top_mm", plates, "less than height_mm"),
            (self.base_width_mm >= self.width_mm, "base_width_mm", self.base_width_mm, "at least width_mm"),
            (self.base_height_mm >= self.height_mm, "base_height_mm", self.base_height_mm, "at least height_mm"),
            (0.0 < self.taper < 1.0, "taper", self.taper, "between 0 and 1"),
            (rising, "joints", list(self.joints), "rising fractions between 0 and 1"),
            (self.parts == 0 or 2 <= self.parts <= MOST_PARTS, "parts", self.parts, f"0, or 2 to {MOST_PARTS}"),
        )

    @property
    def cuts(self) -> tuple[float, ...]:
        """Fractions of the soffit's arc length at which the parts start and end."""
        if self.parts:
            return tuple(k / self.parts for k in range(self.parts + 1))
        return (0.0, *self.joints, 1.0)


def names(count: int) -> tuple[str, ...]:
    """Names of the parts in order: two feet and the ribs between them."""
    return ("foot1", *(f"rib{k + 1}" for k in range(count - 2)), "foot2")


def build(params: Params) -> tuple[ArchPart, ...]:
    """Build the parts, in order."""
    curve = make_curve(params.curve, params.span_mm, params.rise_mm)
    plates = Plates(params.plate_bottom_mm, params.plate_top_mm, params.plate_web_mm)
    cuts = [curve.length * c for c in params.cuts]
    parts = []
    for name, ends in zip(names(len(cuts) - 1), pairwise(cuts), strict=True):
        part = arch_rib.build(name, curve, ends, params.width_mm, params.height_mm, plates)
        if name.startswith("foot"):
            base_at = "start" if name == "foot1" else "end"
            part = arch_foot.build(part, params.base_width_mm, params.base_height_mm, params.taper, base_at)
        parts.append(part)
    return tuple(parts)
