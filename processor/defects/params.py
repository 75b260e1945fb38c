"""Parameters of step ``defects``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from processor.model import UsageError

METHODS = ("default", "paper")


@dataclass(frozen=True)
class Paper:
    """Parameters of method ``paper``, mm; the paper gives none: 0 = a multiple of the cloud's spacing.

    ``defect_mm`` is the distance from the design above which a point belongs to a defect.
    """

    voxel_mm: float = 0.0  # size of the voxels that the cloud is thinned to
    points: int = 60_000  # most points after thinning
    cluster_radius_mm: float = 0.0
    cluster_points: int = 4
    smallest_cluster_share: float = 0.01
    feature_points: int = 300
    trials: int = 400
    huber_mm: float = 0.0
    defect_mm: float = 0.0
    strips: int = 20  # sub-regions of a deflection curve


@dataclass(frozen=True)
class Params:
    """Parameters of both methods.

    ``reach_mm`` is the distance from the design within which a point belongs to it. ``false_alarms`` is the number of
    false alarms allowed on ``per_m2`` of surface. ``cell_mm`` = 0: by the density of the points.
    """

    method: str = METHODS[0]
    seed: int = 0
    reach_mm: float = 60.0
    cell_mm: float = 0.0
    false_alarms: float = 1.0
    per_m2: float = 100.0
    systematic_mm: float = 0.02  # systematic error of a surface by the scanner, one sd, however many points
    edge_mm: float = 8.0  # border of every face that is left out: beams there hit other faces too
    align: bool = True  # fit stations and whole to the design before the search
    registration_error_mm: float = math.nan  # one standard deviation; nan = from the fit to the design
    pictures: int = 200  # most defects with a picture
    paper: Paper = field(default_factory=Paper)

    def check(self) -> None:
        """Raise UsageError for a number out of range."""
        for key in ("reach_mm", "false_alarms", "per_m2"):
            if not getattr(self, key) > 0.0:
                raise UsageError(f"defects.{key}: expected a number above 0, got {getattr(self, key)!r}")
        for key in ("cell_mm", "edge_mm", "pictures", "systematic_mm"):
            if not getattr(self, key) >= 0:
                raise UsageError(f"defects.{key}: expected 0 or more, got {getattr(self, key)!r}")
        if self.registration_error_mm < 0.0:
            raise UsageError(f"defects.registration_error_mm: expected 0 or more, got {self.registration_error_mm!r}")
        for key in ("points", "cluster_points", "feature_points", "trials", "strips"):
            if not getattr(self.paper, key) >= 3:
                raise UsageError(f"defects.paper.{key}: expected 3 or more, got {getattr(self.paper, key)!r}")
