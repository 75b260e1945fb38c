"""Parameters of step ``inspect``."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model.inputs import Parameters, entry, number

METHODS = ("default",)


@dataclass(frozen=True)
class Params(Parameters, table="inspect"):
    """Parameters (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = 0
    # least width of a face measured by core points; narrower: by the points on it
    least_face_mm: float = entry(number(above=0, below=1e6), default=60.0)
