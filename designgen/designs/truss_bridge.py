"""Truss bridge: two trusses of box sections on abutments, with floor beams and bracing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.checks import expect, expect_positive
from designgen.designs.boxes_and_tubes import Box, Component, component
from processor.model import Floats

ABOUT = "truss bridge: two trusses of box sections on abutments, with floor beams and bracing"


@dataclass(frozen=True)
class Params:
    """Sizes in mm; all bays look alike, as on real bridges."""

    bays: int = 6
    bay_mm: float = 5_000.0
    depth_mm: float = 5_000.0
    width_mm: float = 6_000.0
    height_mm: float = 4_500.0  # of the bottom chords above the ground
    chord_mm: float = 400.0
    web_mm: float = 300.0
    beam_mm: float = 350.0

    def __post_init__(self) -> None:
        expect(3 <= self.bays <= 100, "structure.bays", self.bays, "3 to 100")
        sizes = ("bay_mm", "depth_mm", "width_mm", "height_mm", "chord_mm", "web_mm", "beam_mm")
        expect_positive(self, "structure", *sizes)
        fits = self.chord_mm < 0.3 * min(self.bay_mm, self.depth_mm, self.width_mm)
        expect(fits, "structure.chord_mm", self.chord_mm, "less than 0.3 of a bay's sizes")


def build(params: Params) -> tuple[Component, ...]:
    """Return trusses, floor beams, top bracing, abutments and the ground."""
    x: Floats = params.bay_mm * np.arange(params.bays + 1.0)
    components = []
    for name, y in (("truss-left", 0.5 * params.width_mm), ("truss-right", -0.5 * params.width_mm)):
        low = np.stack([x, np.full_like(x, y), np.full_like(x, params.height_mm)], axis=1)
        top = low[1:-1] + np.array([0.0, 0.0, params.depth_mm])
        bars = [_bar(low[0], low[-1], params.chord_mm), _bar(top[0], top[-1], params.chord_mm)]
        bars += [_bar(low[0], top[0], params.chord_mm), _bar(low[-1], top[-1], params.chord_mm)]
        bars += [_bar(low[i], top[i - 1], params.web_mm) for i in range(1, params.bays)]
        middle = params.bays // 2
        bars += [_bar(top[i - 1], low[i + 1], params.web_mm) for i in range(1, middle)]
        bars += [_bar(low[i - 1], top[i - 1], params.web_mm) for i in range(params.bays - 1, middle, -1)]
        components.append(component(name, bars))
    half = np.array([0.0, 0.5 * params.width_mm, 0.0])
    beams = [_bar(at - half, at + half, params.beam_mm) for at in _line(x, params.height_mm)]
    components.append(component("floor-beams", beams))
    tops = _line(x[1:-1], params.height_mm + params.depth_mm)
    components.append(component("top-bracing", [_bar(at - half, at + half, params.web_mm) for at in tops]))
    # Only the abutments and the boxes beside them break the symmetry of the two ends.
    size = np.array([1_500.0, params.width_mm + 2_000.0, params.height_mm - 0.5 * params.chord_mm])
    abutments = [
        Box(np.array([-600.0, 0.0, 0.5 * size[2]]), np.eye(3), size),
        Box(np.array([x[-1] + 900.0, 0.0, 0.5 * size[2]]), np.eye(3), size * [1.4, 1.0, 1.0]),
        Box(np.array([x[-1] + 2_500.0, 4_500.0, 1_100.0]), np.eye(3), np.array([2_000.0, 1_200.0, 2_200.0])),
        Box(np.array([2_000.0, -7_000.0, 700.0]), np.eye(3), np.array([1_500.0, 900.0, 1_400.0])),
    ]
    ground = Box(np.array([0.5 * x[-1], 0.0, -50.0]), np.eye(3), np.array([x[-1] + 30_000.0, 40_000.0, 100.0]))
    return (*components, component("abutments", abutments), component("ground", [ground]))


def _line(x: Floats, z: float) -> Floats:
    return np.stack([x, np.zeros_like(x), np.full_like(x, z)], axis=1)


def _bar(start: Floats, end: Floats, size: float) -> Box:
    """Return a square bar between two points, with two sides parallel to Y unless the bar runs along Y."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    unit = axis / length
    reference = np.array([0.0, 1.0, 0.0] if abs(unit[1]) < 0.9 else [1.0, 0.0, 0.0])
    side = reference - unit * np.dot(reference, unit)
    side /= np.linalg.norm(side)
    axes = np.stack([unit, side, np.cross(unit, side)])
    return Box(0.5 * (start + end), axes, np.array([length, size, size]))
