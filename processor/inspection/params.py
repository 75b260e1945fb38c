"""Parameters of step ``inspect``."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model import UsageError

METHODS = ("default",)


@dataclass(frozen=True)
class Params:
    """Parameters (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = 0
    least_face_mm: float = 60.0  # least width of a face measured by core points; narrower: by the points on it

    def check(self) -> None:
        """Raise UsageError for parameters that make no sense."""
        if not 0.0 < self.least_face_mm < 1e6:
            raise UsageError(f"inspect: expected least_face_mm above 0 and below 1e6, found {self.least_face_mm}")
