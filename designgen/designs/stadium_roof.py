"""Stadium roof: cantilever trusses of tubes around an oval, joined by rings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.checks import expect, expect_positive
from designgen.designs.boxes_and_tubes import Component, Tube, component
from processor.model import Floats, UsageError

ABOUT = "stadium roof: cantilever trusses of tubes around an oval, joined by rings"


@dataclass(frozen=True)
class Params:
    """Sizes in mm. The trusses reach inward from an oval of half axes ``length_mm``, ``width_mm``."""

    trusses: int = 12
    bays: int = 4
    length_mm: float = 40_000.0
    width_mm: float = 30_000.0
    reach_mm: float = 12_000.0
    depth_mm: float = 1_800.0
    height_mm: float = 15_000.0
    chord_diameter_mm: float = 219.0
    web_diameter_mm: float = 114.0

    def __post_init__(self) -> None:
        if not 4 <= self.trusses <= 200 or not 1 <= self.bays <= 40:
            raise UsageError(f"structure.trusses, bays: expected 4 to 200 and 1 to 40, got {self.trusses}, {self.bays}")
        sizes = ("length_mm", "width_mm", "reach_mm", "depth_mm", "height_mm", "chord_diameter_mm", "web_diameter_mm")
        expect_positive(self, "structure", *sizes)
        fits = self.reach_mm < 0.8 * min(self.length_mm, self.width_mm)
        expect(fits, "structure.reach_mm", self.reach_mm, "less than 0.8 of the oval's half axes")


def build(params: Params) -> tuple[Component, ...]:
    """Return a component for each truss, and one of all rings."""
    angles = 2.0 * np.pi * np.arange(params.trusses) / params.trusses
    fractions = np.linspace(0.0, 1.0, params.bays + 1)  # from the outer ring inward
    top = np.array([[_node(params, a, q, 0.0) for q in fractions] for a in angles])
    low = np.array([[_node(params, a, q, 1.0) for q in fractions] for a in angles])
    chord, web = 0.5 * params.chord_diameter_mm, 0.5 * params.web_diameter_mm
    trusses = []
    for k in range(params.trusses):
        tubes = [Tube(top[k, i], top[k, i + 1], chord) for i in range(params.bays)]
        tubes += [Tube(low[k, i], low[k, i + 1], chord) for i in range(params.bays)]
        tubes += [Tube(low[k, i], top[k, i], web) for i in range(params.bays + 1)]
        tubes += [Tube(low[k, i], top[k, i + 1], web) for i in range(params.bays)]
        trusses.append(component(f"truss{k + 1}", tubes))
    after = np.roll(np.arange(params.trusses), -1)
    rings = [
        Tube(line[k, i], line[after[k], i], chord)
        for line in (top, low)
        for i in (0, params.bays)
        for k in range(params.trusses)
    ]
    return (*trusses, component("rings", rings))


def _node(params: Params, angle: float, fraction: float, depth: float) -> Floats:
    """Return a node (3,) at a fraction of the reach inward, on the top (depth 0) or bottom (1) chord; trusses taper."""
    inward = fraction * params.reach_mm
    x, y = (params.length_mm - inward) * np.cos(angle), (params.width_mm - inward) * np.sin(angle)
    rise = 0.08 * inward
    return np.array([x, y, params.height_mm + rise - depth * params.depth_mm * (1.0 - 0.6 * fraction)])
