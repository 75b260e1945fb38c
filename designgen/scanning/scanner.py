"""A terrestrial laser scanner: its classes, its numbers, and how a recipe asks for scans by rays.

Noise runs along the ray. A range R has the variance

    noise_mm^2 + (noise_ppm R)^2 + (noise_signal_mm signal^signal_power)^2 + (footprint_share w tan(incidence))^2

with the signal relative to a white matt surface seen square on at 10 m, and w the radius of the beam where it falls.
What the device does with a ray is told in :mod:`designgen.scanning.returns`.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from processor.model import Floats, UsageError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MODE = "rays"
SIGNAL_RANGE_MM = 10_000.0  # where the signal is 1
SPECULAR_POWER = 30.0  # of the cosine, for the mirror-like part of a reflection


@dataclass(frozen=True)
class Scanner:
    """A class of scanner, see scanners.toml; ``offset_mm`` to ``tilt_urad`` are standard deviations of stations."""

    behaviour: str = "phase"  # phase: a mixed pixel's range is the mean by energy; pulse: that of its strongest echo
    noise_mm: float = 0.25
    noise_ppm: float = 5.0
    noise_signal_mm: float = 0.2
    signal_power: float = -0.5
    encoder_urad: float = 20.0
    beam_exit_mm: float = 3.5
    divergence_mrad: float = 0.3
    footprint_share: float = 0.1
    separation_mm: float = 0.0  # pulse: echoes closer than this are one
    min_range_mm: float = 400.0
    max_range_mm: float = 80_000.0
    threshold: float = 0.0005
    flying_share: float = 0.0002
    offset_mm: float = 0.5
    scale_ppm: float = 5.0
    tilt_urad: float = 15.0

    def __post_init__(self) -> None:
        if self.behaviour not in ("phase", "pulse"):
            raise UsageError(f"scanner.behaviour: expected phase or pulse, got {self.behaviour!r}")
        for key in self.__dataclass_fields__:
            if key not in ("behaviour", "signal_power") and getattr(self, key) < 0.0:
                raise UsageError(f"scanner.{key}: expected 0 or more, got {getattr(self, key)!r}")
        if not self.max_range_mm > self.min_range_mm:
            raise UsageError(f"scanner.max_range_mm: expected more than min_range_mm, got {self.max_range_mm!r}")

    def beam_angle(self, R: Floats) -> Floats:
        """Return the angle (n,) of the beam's radius at ranges R (n,), rad."""
        found: Floats = 0.5 * (1e-3 * self.divergence_mrad + self.beam_exit_mm / R)
        return found

    def noise(self, R: Floats, signal: Floats, tangent: Floats) -> Floats:
        """Return the standard deviation (n,) of ranges R (n,), mm, by signal and tangent of incidence."""
        by_signal = self.noise_signal_mm * np.maximum(signal, 1e-12) ** self.signal_power
        spread = self.footprint_share * self.beam_angle(R) * R * tangent
        result: Floats = np.sqrt(self.noise_mm**2 + (self.noise_ppm * 1e-6 * R) ** 2 + by_signal**2 + spread**2)
        return result


def presets() -> dict[str, dict[str, Any]]:
    """Return the classes of scanners by name, with what they are and where their numbers come from."""
    found: dict[str, dict[str, Any]] = tomllib.loads(
        (resources.files("designgen") / "scanners.toml").read_text("utf-8")
    )
    return found


def preset(name: str) -> dict[str, Any]:
    """Return the numbers of one class of scanner. UsageError names the classes there are."""
    known = presets()
    if name not in known:
        raise UsageError(f"scan.scanner: expected one of {', '.join(known)}, got {name!r}")
    return {key: value for key, value in known[name].items() if key in Scanner.__dataclass_fields__}


@dataclass(frozen=True)
class Params:
    """How stations scan a scene. The stations' places follow from the kind of scene."""

    mode: str = MODE
    scanner: str = "phase"
    step_mrad: float = 0.6
    sub_rays: int = 7
    reflectance: float = 0.5
    specular: float = 0.3  # share of the reflection that is mirror-like, as on bare steel; 0 = matt
    stations: tuple[int, ...] = (2, 2)  # two numbers: a grid below a frame; one: places that stay as more are added
    distance_mm: float = 5_000.0  # of the stations from a part's surface
    height_mm: float = 1_600.0  # of the scanner above the ground
    clutter: int = 0  # things in the way that are no part of the structure; poles go round the stations
    registration_mm: float = 0.0  # standard deviation of each axis of a station's registered position
    registration_mrad: float = 0.0  # and of its attitude about each axis
    registered: bool = True  # structures: whether the scans come with poses
    repeated: int = 0  # structures: so many stations scan more than once, with a new heading
    scans_at_first: int = 2  # how often
    merged: bool = False  # one cloud in the project's frame instead of a scan a station
    origin_mm: tuple[float, ...] = (0.0, 0.0, 0.0)  # of the scene in the project's coordinates: georeferenced

    def __post_init__(self) -> None:
        _expect(0.05 <= self.step_mrad <= 50.0, "step_mrad", self.step_mrad, "0.05 to 50")
        _expect(self.sub_rays in (1, 7, 19), "sub_rays", self.sub_rays, "1, 7 or 19")
        _expect(0.0 < self.reflectance <= 1.0, "reflectance", self.reflectance, "above 0 to 1")
        _expect(0.0 <= self.specular < 1.0, "specular", self.specular, "0 to less than 1")
        _expect(all(n >= 1 for n in self.stations), "stations", list(self.stations), "one number or two, from 1")
        _expect(len(self.stations) in (1, 2), "stations", list(self.stations), "one number or two")
        _expect(len(self.origin_mm) == 3, "origin_mm", list(self.origin_mm), "three numbers")
        _expect(self.scans_at_first >= 1, "scans_at_first", self.scans_at_first, "1 or more")
        for key in ("distance_mm", "height_mm", "clutter", "registration_mm", "registration_mrad", "repeated"):
            _expect(getattr(self, key) >= 0, key, getattr(self, key), "0 or more")
        count = math.prod(self.stations)
        _expect(self.repeated <= count, "repeated", self.repeated, f"no more than the {count} stations")
        _expect(
            self.registered or not self.merged, "merged", True, "false with registered = false: a cloud needs poses"
        )

    def signal(self, cosine: Floats, R: Floats) -> Floats:
        """Return the signal (n,) of a whole beam by the cosine of incidence and the range."""
        reflected = (1.0 - self.specular) * cosine + 4.0 * self.specular * cosine**SPECULAR_POWER
        found: Floats = self.reflectance * reflected * (SIGNAL_RANGE_MM / R) ** 2
        return found


def _expect(fits: bool, key: str, came: object, expected: str) -> None:
    if not fits:
        raise UsageError(f"scan.{key}: expected {expected}, got {came!r}")
