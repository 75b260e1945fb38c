"""Parameters of step ``spheres``."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processor.model import UsageError
from processor.model.inputs import Parameters, entry, number
from processor.space_frame.members import member_extraction

METHODS = ("ray", "ransac", "least-squares")  # the first is the default
NAN = float("nan")
COUNT, SIZE = number(least=1, whole=True), number(above=0, infinite=True)


@dataclass(frozen=True)
class Params(Parameters, table="spheres"):
    """Parameters of all methods (lengths in mm)."""

    method: str = METHODS[0]
    seed: int = entry(number(least=0, whole=True), default=0)
    catalogue: str = "plausible"  # ray: of radii, by name; "none" leaves radii free
    radii_mm: tuple[float, ...] = ()  # ray: the user's catalogue, instead
    register_stations: bool = True  # ray: against each other, on the tubes, where their errors require it
    # ray: standard deviation per axis of a shift common to all stations, without control points
    datum_mm: float = entry(number(least=0), default=0.0)
    members: member_extraction.Params = field(default_factory=member_extraction.Params)  # ray
    # the paper's methods: beyond the nominal radius, about the nominal centre
    crop_margin_mm: float = entry(SIZE, default=20.0)
    raw_crops: bool = True  # the paper's methods beside ray: on all points about its nodes; false: on those it used
    # ransac: largest distance of an inlier from the surface; two sd of a 2 mm scanner
    tau_mm: float = entry(SIZE, default=4.0)
    probability: float = entry(number(above=0, below=1), default=0.99)  # ransac: that one minimal set has no outliers
    max_iterations: int = entry(COUNT, default=10_000)  # ransac: minimal sets at most
    # the paper's methods: low confidence below it; without members: no sphere, and at least 40
    min_points: int = entry(COUNT, default=20)
    # of spheres without members: the known radius, fixed; NaN = estimated
    radius_mm: float = entry(number(above=0, unknown=True), default=NAN)
    max_balls: int = entry(COUNT, default=10)  # without members: spheres to search for, in succession

    def check(self, has_design: bool) -> None:
        """Raise UsageError for parameters that contradict each other, or a scene with or without a design."""
        if self.method not in METHODS:
            raise UsageError(f"spheres: unknown method {self.method!r}; it has {', '.join(METHODS)}")
        if not np.isnan(self.radius_mm) and (has_design or self.method == "least-squares"):
            raise UsageError(
                "spheres: radius_mm holds the radius of a ball searched for without a design; "
                "with a design, and by least-squares, the radius is free: take radius_mm out"
            )
