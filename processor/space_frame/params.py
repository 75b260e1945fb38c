"""Parameters of step ``spheres``."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processor.model import UsageError
from processor.space_frame.members import member_extraction

METHODS = ("ray", "ransac", "least-squares")  # the first is the default
NAN = float("nan")


@dataclass(frozen=True)
class Params:
    """Parameters of all methods (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = 0
    catalogue: str = "plausible"  # ray: of radii, by name; "none" leaves radii free
    radii_mm: tuple[float, ...] = ()  # ray: the user's catalogue, instead
    register_stations: bool = True  # ray: against each other, on the tubes, where their errors require it
    datum_mm: float = 0.0  # ray: standard deviation per axis of a shift common to all stations, without control points
    members: member_extraction.Params = field(default_factory=member_extraction.Params)  # ray
    crop_margin_mm: float = 20.0  # the paper's methods: beyond the nominal radius, about the nominal centre
    raw_crops: bool = True  # the paper's methods beside ray: on all points about its nodes; false: on those it used
    tau_mm: float = 4.0  # ransac: largest distance of an inlier from the surface; two sd of a 2 mm scanner
    probability: float = 0.99  # ransac: that one minimal set has no outliers
    max_iterations: int = 10_000  # ransac: minimal sets at most
    min_points: int = 20  # the paper's methods: low confidence below it; without members: no sphere, and at least 40
    radius_mm: float = NAN  # of spheres without members: the known radius, fixed; NaN = estimated
    max_balls: int = 10  # without members: spheres to search for, in succession

    def check(self, has_design: bool) -> None:
        """Raise UsageError for invalid parameters."""
        if self.method not in METHODS:
            raise UsageError(f"spheres: unknown method {self.method!r}; it has {', '.join(METHODS)}")
        for name, sound, expected in (
            ("crop_margin_mm", self.crop_margin_mm > 0.0, "above 0"),
            ("tau_mm", self.tau_mm > 0.0, "above 0"),
            ("probability", 0.0 < self.probability < 1.0, "between 0 and 1"),
            ("max_iterations", self.max_iterations >= 1, "1 or more"),
            ("min_points", self.min_points >= 1, "1 or more"),
            ("max_balls", self.max_balls >= 1, "1 or more"),
            ("seed", self.seed >= 0, "0 or more"),
            ("datum_mm", 0.0 <= self.datum_mm < np.inf, "0 or more"),
            ("radius_mm", np.isnan(self.radius_mm) or 0.0 < self.radius_mm < np.inf, "above 0"),
        ):
            if not sound:
                raise UsageError(f"spheres: {name}: expected {expected}, found {getattr(self, name)}")
        if not np.isnan(self.radius_mm) and (has_design or self.method == "least-squares"):
            raise UsageError(
                "spheres: radius_mm holds the radius of a ball searched for without a design; "
                "with a design, and by least-squares, the radius is free: take radius_mm out"
            )
