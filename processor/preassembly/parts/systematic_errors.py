"""What the points' noise does not show: registration of the stations, the scanner's offset and scale, temperature.

They move all points of an end together, so they are added to the covariance of what was measured there: along each axis
what stations and offset do, and along the part what is wrong with its length, half at either end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from processor.model import DesignPart, Floats, UsageError
from processor.preassembly.ends.bottom_edges import EdgeStations
from processor.preassembly.ends.joint_end import JointEnd

EXPANSION_PER_K = 12e-6


@dataclass(frozen=True)
class SystematicParams:
    """Standard deviations of what is the same for all points of a scan; 0 where nothing is known of it."""

    registration_mm: float = 0.0  # of the stations of one scan against each other, each axis
    offset_mm: float = 0.0  # zero offset of the scanner
    scale_ppm: float = 0.0
    temperature_C: float = 0.0  # of the steel's stated temperature

    def __post_init__(self) -> None:
        for key, value in self.__dict__.items():
            if not 0.0 <= value < np.inf:
                raise UsageError(f"preassemble.systematic.{key}: expected 0 or more, got {value!r}")

    @property
    def known(self) -> bool:
        """Whether anything was stated."""
        return any(value > 0.0 for value in self.__dict__.values())

    def budget(self, length_mm: float) -> dict[str, float]:
        """Return the standard deviation (mm) that each gives an end of a part of a length, along the part."""
        half = 0.5 * length_mm
        return {
            "registration of stations": self.registration_mm,
            "scanner offset": self.offset_mm,
            "scanner scale": 1e-6 * self.scale_ppm * half,
            "temperature of the steel": EXPANSION_PER_K * self.temperature_C * half,
        }


def of_end(end: JointEnd, params: SystematicParams, part: DesignPart) -> JointEnd:
    """Add what is systematic to an end's covariance; ``part`` says how long the part is."""
    same = np.kron(np.ones((8, 8)), np.diag(same_of_end(params, part)[:3]))
    return replace(end, covariance=end.covariance + same)


def same_of_end(params: SystematicParams, part: DesignPart) -> Floats:
    """Return the variances (24,) of an end's coordinates by what is systematic, the same for all of its points."""
    terms = params.budget(_length(part))
    any_axis = terms["registration of stations"] ** 2 + terms["scanner offset"] ** 2
    along = terms["scanner scale"] ** 2 + terms["temperature of the steel"] ** 2
    return np.tile([any_axis + along, any_axis, any_axis], 8)


def of_edges(edges: EdgeStations, params: SystematicParams, between_stations: float) -> EdgeStations:
    """Add what is systematic, and a variance between stations, to the covariance of edges: all of an edge moves."""
    variance = params.registration_mm**2 + params.offset_mm**2 + between_stations
    return replace(edges, covariance=edges.covariance + variance)


def _length(part: DesignPart) -> float:
    ends: Floats = part.bottom_edge_left[[0, -1]]
    return float(np.linalg.norm(ends[1] - ends[0]))
