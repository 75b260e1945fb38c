"""Plates or girders in a row, each with at most one defect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.checks import expect, expect_positive
from designgen.designs.boxes_and_tubes import Box, Component, component
from processor.model import Floats

ABOUT = "row of plates or girders, one defect of any class each"
FORMS = ("plate", "girder")


@dataclass(frozen=True)
class Params:
    """Sizes in mm. A component stands upright; its front, the face with the defect, looks towards -Y."""

    form: str = "plate"
    components: tuple[str, ...] = ("dent",)  # class of defect of each component, or "none"
    length_mm: float = 1_000.0
    height_mm: float = 1_000.0
    plate_mm: float = 12.0  # a plate, or a girder's web
    flange_width_mm: float = 250.0
    flange_mm: float = 16.0
    gap_mm: float = 600.0  # between components
    lift_mm: float = 800.0  # above the ground

    def __post_init__(self) -> None:
        expect(self.form in FORMS, "structure.form", self.form, f"one of {', '.join(FORMS)}")
        lengths = ("length_mm", "height_mm", "plate_mm", "flange_width_mm", "flange_mm", "gap_mm")
        expect_positive(self, "structure", *lengths)
        thin = 2.0 * self.flange_mm < self.height_mm
        expect(thin, "structure.flange_mm", self.flange_mm, "less than half of height_mm")


AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # along, up, out of the front


@dataclass(frozen=True)
class Place:
    """Where a component stands: ``origin`` (3,), mm, is the middle of its front; its axes are AXES."""

    name: str
    defect: str
    origin: Floats
    halves: bool  # built of two halves that meet in the middle

    def local(self, points: Floats) -> Floats:
        """Return coordinates (n, 3) along, up and out of the front."""
        result: Floats = (points - self.origin) @ AXES.T
        return result


def places(params: Params) -> tuple[Place, ...]:
    """Return where the components stand, in order."""
    step = params.length_mm + params.gap_mm
    return tuple(
        Place(
            f"{params.form}-{i + 1}-{defect}",
            defect,
            np.array([i * step, 0.0, params.lift_mm + 0.5 * params.height_mm]),
            halves=defect == "step",
        )
        for i, defect in enumerate(params.components)
    )


def bodies(params: Params, place: Place) -> list[Box]:
    """Return the boxes of a component: a plate, or the web and flanges of a girder; two of each for halves."""
    pieces = [(-0.5, 0.5)] if not place.halves else [(-0.5, 0.0), (0.0, 0.5)]
    boxes = []
    for start, end in pieces:
        length, middle = (end - start) * params.length_mm, 0.5 * (start + end) * params.length_mm
        depth = -0.5 * params.plate_mm
        web = params.height_mm - (2.0 * params.flange_mm if params.form == "girder" else 0.0)
        boxes.append(_box(place, (middle, 0.0, depth), (length, web, params.plate_mm)))
        for sign in (-1.0, 1.0) if params.form == "girder" else ():
            up = sign * 0.5 * (params.height_mm - params.flange_mm)
            size = (length, params.flange_mm, params.flange_width_mm)
            boxes.append(_box(place, (middle, up, depth), size))
    return boxes


def _box(place: Place, middle: tuple[float, float, float], size: tuple[float, float, float]) -> Box:
    return Box(place.origin + np.array(middle) @ AXES, AXES, np.array(size))


def build(params: Params) -> tuple[Component, ...]:
    """Return all components as designed."""
    return tuple(component(place.name, bodies(params, place)) for place in places(params))
