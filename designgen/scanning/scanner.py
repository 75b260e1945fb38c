"""A terrestrial laser scanner: its classes and numbers, and the parameters of scans by rays.

Noise is along the ray. The variance of a range R is

    noise_mm^2 + (noise_ppm R)^2 + (noise_signal_mm signal^signal_power)^2 + (footprint_share w tan(incidence))^2
    + (noise_mixed spread)^2

The signal is relative to that of a white matt surface at normal incidence and 10 m; nearer than noise_near_mm it does
not lower the noise further. The spread is that of the ranges within a footprint over an edge, weighted by their energy.

The beam is Gaussian; w is its radius to 1/e^2 of the intensity, horizontally, and beam_aspect w vertically:

    2 w = sqrt(beam_waist_mm^2 + (divergence_mrad (R - beam_focus_mm))^2)

Ranges have a bias of bias_signal_mm for each decade of a surface's reflectance above 0.5: dark ones are nearer.
The returns of a ray are modelled in :mod:`designgen.scanning.returns`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.checks import expect, expect_all
from designgen.recipe_files import load
from processor.model import Bools, Floats, UsageError, instruments
from processor.model.inputs import Place

MODE = "rays"
SIGNAL_RANGE_MM = 10_000.0  # range at which the signal is 1
UNBIASED = 0.5  # reflectance whose bias is zero by definition: the offset of a station holds the rest
# Sub-rays of a beam, by their number: rings of (radius in radii of the beam, number of sub-rays, energy of the ring)
# about its middle, which has the rest. They integrate polynomials over a Gaussian beam exactly to degree 5 and 7 in the
# radius (Gauss-Radau rules of the exponential weight: nodes 1; (3 -+ sqrt 3) / 2 for the squared radius).
BEAM_RINGS: dict[int, list[tuple[float, int, float]]] = {
    1: [],
    7: [(1.0, 6, 0.5)],
    19: [
        (math.sqrt(1.5 - 0.5 * math.sqrt(3.0)), 6, (2.0 + math.sqrt(3.0)) / 6.0),
        (math.sqrt(1.5 + 0.5 * math.sqrt(3.0)), 12, (2.0 - math.sqrt(3.0)) / 6.0),
    ],
}
SPECULAR_POWER = 30.0  # of the cosine, in the specular part of a reflection


@dataclass(frozen=True)
class Scanner:
    """A class of scanner, see scanners.toml; ``offset_mm`` to ``tilt_urad`` are standard deviations over stations."""

    behaviour: str = "phase"  # range of a mixed pixel: phase: mean weighted by energy; pulse: of the strongest echo
    noise_mm: float = 0.25
    noise_ppm: float = 5.0
    noise_signal_mm: float = 0.2
    signal_power: float = -0.5
    noise_near_mm: float = 0.0
    noise_mixed: float = 0.0
    bias_signal_mm: float = 0.0
    encoder_urad: float = 20.0
    beam_waist_mm: float = 2.6
    beam_focus_mm: float = 2260.0
    divergence_mrad: float = 0.71
    beam_aspect: float = 1.1
    footprint_share: float = 0.1
    separation_mm: float = 0.0  # pulse: echoes closer than this merge
    min_range_mm: float = 400.0
    max_range_mm: float = 80_000.0
    threshold: float = 0.0005
    flying_share: float = 0.0002
    intensity_noise: float = 0.0  # relative standard deviation of the intensity
    offset_mm: float = 0.5
    scale_ppm: float = 5.0
    tilt_urad: float = 15.0

    def __post_init__(self) -> None:
        expect(self.behaviour in ("phase", "pulse"), "scanner.behaviour", self.behaviour, "phase or pulse")
        for key in self.__dataclass_fields__:
            if key not in ("behaviour", "signal_power", "bias_signal_mm"):
                expect(getattr(self, key) >= 0.0, f"scanner.{key}", getattr(self, key), "0 or more")
        further = self.max_range_mm > self.min_range_mm
        expect(further, "scanner.max_range_mm", self.max_range_mm, "more than min_range_mm")

    def beam_angle(self, R: Floats) -> Floats:
        """Return the angle (n,) subtended by the beam's horizontal radius at ranges R (n,), rad."""
        angle: Floats = 0.5 * np.hypot(
            self.beam_waist_mm / R, 1e-3 * self.divergence_mrad * (1.0 - self.beam_focus_mm / R)
        )
        return angle

    def noise(self, R: Floats, signal: Floats, tangent: Floats, spread: Floats) -> Floats:
        """Return the standard deviation (n,) of ranges R (n,), mm.

        By signal, tangent of the angle of incidence, and ``spread`` (n,) of the ranges within the footprint, mm.
        """
        signal = signal * np.minimum(R / self.noise_near_mm, 1.0) ** 2 if self.noise_near_mm else signal
        by_signal = self.noise_signal_mm * np.maximum(signal, 1e-12) ** self.signal_power
        along = self.footprint_share * self.beam_angle(R) * R * tangent
        terms = self.noise_mm**2 + (self.noise_ppm * 1e-6 * R) ** 2 + by_signal**2 + along**2
        result: Floats = np.sqrt(terms + (self.noise_mixed * spread) ** 2)
        return result

    def bias(self, reflectance: Floats) -> Floats:
        """Return the bias (n,) of ranges, mm, by the reflectance (n,) of surfaces."""
        found: Floats = self.bias_signal_mm * np.log10(np.maximum(reflectance, 1e-3) / UNBIASED)
        return found


def preset(name: str) -> dict[str, Any]:
    """Return the numbers of a class of scanner, or of a scanner.toml; UsageError for an unknown one."""
    classes = instruments.classes()
    if name.lower().endswith(".toml"):
        numbers = instruments.simulated(load(name)[1], Place(name))
    elif name in classes:
        numbers = classes[name]
    else:
        raise UsageError(f"scan.scanner: expected one of {', '.join(classes)}, or a scanner.toml, got {name!r}")
    return {key: value for key, value in numbers.items() if key in Scanner.__dataclass_fields__}


@dataclass(frozen=True)
class Params:
    """How stations scan a scene; their places depend on the kind of scene."""

    mode: str = MODE
    scanner: str = "phase"
    step_mrad: float = 0.6
    sub_rays: int = 7
    reflectance: float = 0.5
    specular: float = 0.3  # specular fraction of the reflection, as on bare steel; 0 = matt
    # (rows, columns) of a grid, or one number of stations; adding stations keeps the earlier ones
    stations: tuple[int, ...] = (2, 2)
    distance_mm: float = 5_000.0  # of the stations from a part's surface
    height_mm: float = 1_600.0  # of the scanner above the ground
    field_of_view_deg: float = 360.0  # truss bridges: width and height of a window about the x axis; 360 = all round
    elevation_deg: float = 0.0  # of the middle of the window
    clutter: int = 0  # number of objects that are no part of the structure
    registration_mm: float = 0.0  # standard deviation of a station's registered position along each axis
    registration_mrad: float = 0.0  # and of its attitude about each axis
    registered: bool = True  # structures: whether the scans have poses
    repeated: int = 0  # structures: number of stations that scan more than once, each time with a new heading
    scans_at_first: int = 2  # scans at each repeated station
    merged: bool = False  # one cloud in the project's frame instead of a scan a station
    origin_mm: tuple[float, ...] = (0.0, 0.0, 0.0)  # of the scene in project coordinates, e.g. georeferenced

    def __post_init__(self) -> None:
        count, posed = math.prod(self.stations), self.registered or not self.merged
        nonnegative = ("distance_mm", "height_mm", "clutter", "registration_mm", "registration_mrad", "repeated")
        expect_all(
            "scan",
            (0.05 <= self.step_mrad <= 50.0, "step_mrad", self.step_mrad, "0.05 to 50"),
            (self.sub_rays in BEAM_RINGS, "sub_rays", self.sub_rays, "1, 7 or 19"),
            (0.0 < self.reflectance <= 1.0, "reflectance", self.reflectance, "above 0 to 1"),
            (0.0 <= self.specular < 1.0, "specular", self.specular, "0 to less than 1"),
            (all(n >= 1 for n in self.stations), "stations", list(self.stations), "one number or two, from 1"),
            (len(self.stations) in (1, 2), "stations", list(self.stations), "one number or two"),
            (len(self.origin_mm) == 3, "origin_mm", list(self.origin_mm), "three numbers"),
            (
                10.0 <= self.field_of_view_deg <= 120.0 or self.turns,
                "field_of_view_deg",
                self.field_of_view_deg,
                "10 to 120, or 360",
            ),
            (abs(self.elevation_deg) <= 60.0, "elevation_deg", self.elevation_deg, "-60 to 60"),
            (self.scans_at_first >= 1, "scans_at_first", self.scans_at_first, "1 or more"),
            *((getattr(self, key) >= 0, key, getattr(self, key), "0 or more") for key in nonnegative),
            (self.repeated <= count, "repeated", self.repeated, f"no more than the {count} stations"),
            (posed, "merged", True, "false with registered = false: a cloud needs poses"),
        )

    @property
    def turns(self) -> bool:
        """Whether the scanner turns all round."""
        return self.field_of_view_deg == 360.0

    def in_view(self, azimuth: Floats, elevation: Floats) -> Bools:
        """Mark directions (n,) in the scanner's frame, rad, that it sees."""
        half = 0.5 * np.radians(self.field_of_view_deg)
        beside = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi)
        seen: Bools = (beside <= half) & (np.abs(elevation - np.radians(self.elevation_deg)) <= half)
        return seen if not self.turns else np.ones(np.shape(azimuth), bool)

    def sees(self, points: Floats) -> Bools:
        """Mark points (n, 3) in the scanner's frame that lie in its field of view."""
        x, y, z = points.T
        return self.in_view(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))

    def signal(self, cosine: Floats, R: Floats) -> Floats:
        """Return the signal (n,) of a whole beam by the cosine of the angle of incidence and the range, mm."""
        reflected = (1.0 - self.specular) * cosine + 4.0 * self.specular * cosine**SPECULAR_POWER
        signal: Floats = self.reflectance * reflected * (SIGNAL_RANGE_MM / R) ** 2
        return signal
