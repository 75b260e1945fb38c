"""Plates or girders in a row, each of which can carry one defect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from designgen.designs.structure import Box, Component, component
from processor.model import Floats, UsageError

ABOUT = "plates or girders in a row, each with one defect: of every class"
FORMS = ("plate", "girder")


@dataclass(frozen=True)
class Params:
    """Sizes in mm. A component stands upright with its front, the face with the defect, towards -Y."""

    form: str = "plate"
    components: tuple[str, ...] = ("dent",)  # the classes of defects, a component each; "none" is an undamaged one
    length_mm: float = 1_000.0
    height_mm: float = 1_000.0
    plate_mm: float = 12.0  # a plate, or a girder's web
    flange_width_mm: float = 250.0
    flange_mm: float = 16.0
    gap_mm: float = 600.0  # between components
    lift_mm: float = 800.0  # above the ground

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise UsageError(f"structure.form: expected one of {', '.join(FORMS)}, got {self.form!r}")
        for key in ("length_mm", "height_mm", "plate_mm", "flange_width_mm", "flange_mm", "gap_mm"):
            if not getattr(self, key) > 0.0:
                raise UsageError(f"structure.{key}: expected a length above 0, got {getattr(self, key)!r}")
        if not 2.0 * self.flange_mm < self.height_mm:
            raise UsageError(f"structure.flange_mm: expected less than half of height_mm, got {self.flange_mm!r}")


AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # along, up, out of the front


@dataclass(frozen=True)
class Place:
    """Where a component stands: ``origin`` (3,) is the middle of its front; its axes are AXES."""

    name: str
    defect: str
    origin: Floats
    halves: bool  # built of two halves that meet in the middle

    def local(self, points: Floats) -> Floats:
        """Coordinates (n, 3) along, up and out of the front."""
        found: Floats = (points - self.origin) @ AXES.T
        return found


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
    """Return the boxes of a component: a plate, or the web and flanges of a girder; halves where it is built so."""
    pieces = [(-0.5, 0.5)] if not place.halves else [(-0.5, 0.0), (0.0, 0.5)]
    found = []
    for start, end in pieces:
        length, middle = (end - start) * params.length_mm, 0.5 * (start + end) * params.length_mm
        if params.form == "plate":
            found.append(
                _box(place, (middle, 0.0, -0.5 * params.plate_mm), (length, params.height_mm, params.plate_mm))
            )
            continue
        web = params.height_mm - 2.0 * params.flange_mm
        found.append(_box(place, (middle, 0.0, -0.5 * params.plate_mm), (length, web, params.plate_mm)))
        for sign in (-1.0, 1.0):
            up = sign * 0.5 * (params.height_mm - params.flange_mm)
            size = (length, params.flange_mm, params.flange_width_mm)
            found.append(_box(place, (middle, up, -0.5 * params.plate_mm), size))
    return found


def _box(place: Place, middle: tuple[float, float, float], size: tuple[float, float, float]) -> Box:
    return Box(place.origin + np.array(middle) @ AXES, AXES, np.array(size))


def build(params: Params) -> tuple[Component, ...]:
    """Build all components as designed."""
    return tuple(component(place.name, bodies(params, place)) for place in places(params))
