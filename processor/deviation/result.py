"""The result of step ``deviation``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from processor.geometry.m3c2 import Distances
from processor.model import Checked, Floats, Ints, column, optional

NAN = float("nan")


@dataclass(frozen=True)
class Result(Checked):
    """Deviations at core points of the design's surface, mm; a distance outward is positive, NaN = no answer.

    Core points are less ``origin``, in the design's frame. ``T_design_scan`` maps the frame of the scans as merged;
    ``T_best_fit`` is that of a best fit, applied or not, with ``covariance`` (design frame, turn about its origin and
    translation). By method ``default``, ``n1`` is the number of the surface's places that points were held against,
    and ``std1`` is 0.
    """

    status: str  # ok | ambiguous | weak | failed
    method: str
    message: str = ""
    T_design_scan: Floats = optional(4, 4)
    registration: str = ""  # as given | fine | coarse
    registration_error: float = NAN  # one standard deviation as a length: E of the level of detection
    registration_error_from: str = ""
    T_best_fit: Floats = optional(4, 4)
    covariance: Floats = optional(6, 6)
    best_fit_shift: Floats = optional(3)  # of the scan's middle by the best fit against the frame used
    best_fit_turn: float = NAN
    ambiguity: float = NAN  # error of the second best attitude over that of the best; near 1: either could be right
    spacing: float = NAN
    sigma: float = NAN
    points_read: int = 0
    points_kept: int = 0  # by the outlier removal
    on_surface_share: float = NAN  # of them within the depth of the design
    normal_diameter: float = NAN
    projection_diameter: float = NAN
    max_depth: float = NAN
    significant_share: float = NAN
    significant_low: float = NAN
    significant_high: float = NAN
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64}
    )
    core: Floats = column("k", 3)
    normals: Floats = column("k", 3)
    distance: Floats = column("k")
    lod95: Floats = column("k")
    n1: Ints = column("k", dtype=np.int64)
    n2: Ints = column("k", dtype=np.int64)
    std1: Floats = column("k")
    std2: Floats = column("k")

    @property
    def distances(self) -> Distances:
        """What M3C2 says at each core point."""
        return Distances(self.distance, self.lod95, self.n1, self.n2, self.std1, self.std2)
