"""Parameters of stitching."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model import UsageError

METHODS = ("automatic", "three-point")  # the first is the default
SCALES = ("fixed", "free")


@dataclass(frozen=True)
class Params:
    """Parameters of both methods."""

    method: str = METHODS[0]
    seed: int = 0
    reference: str = ""  # name of the scan whose pose is fixed; empty: the first
    scale: str = SCALES[
        0
    ]  # three-point: fixed = six parameters with scale as a diagnostic, free = the paper's seven, written too
    scale_limit_ppm: float = 1000.0  # three-point: a significant scale beyond this is a blunder
    cell_mm: float = 0.0  # side of the cells; 0 = from the density of the points
    levelled_mrad: float = 0.0  # tilt of the instruments at most; 0 = unknown
    weak_mm: float = 5.0  # largest standard deviations of a pose that is not called weak
    weak_mrad: float = 0.5

    def __post_init__(self) -> None:
        if self.scale not in SCALES:
            raise UsageError(f"stitch.scale: expected one of {', '.join(SCALES)}, got {self.scale!r}")
        for key in ("cell_mm", "levelled_mrad"):
            if not getattr(self, key) >= 0.0:
                raise UsageError(f"stitch.{key}: expected 0 or more, got {getattr(self, key)!r}")
        for key in ("scale_limit_ppm", "weak_mm", "weak_mrad"):
            if not getattr(self, key) > 0.0:
                raise UsageError(f"stitch.{key}: expected a number above 0, got {getattr(self, key)!r}")
