"""Parameters of step ``defects``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from processor.model.inputs import Parameters, entry, number

METHODS = ("default", "paper")
FEW = number(least=3, whole=True)  # points that fix a plane
AMOUNT, SIZE = number(least=0), number(above=0, infinite=True)


@dataclass(frozen=True)
class Paper(Parameters, table="defects.paper"):
    """Parameters of method ``paper``, mm; the paper gives none: 0 = a multiple of the cloud's spacing.

    ``defect_mm`` is the distance from the design above which a point belongs to a defect.
    """

    voxel_mm: float = 0.0  # size of the voxels that the cloud is thinned to
    points: int = entry(FEW, default=60_000)  # most points after thinning
    cluster_radius_mm: float = 0.0
    cluster_points: int = entry(FEW, default=4)
    smallest_cluster_share: float = 0.01
    feature_points: int = entry(FEW, default=300)
    trials: int = entry(FEW, default=400)
    huber_mm: float = 0.0
    defect_mm: float = 0.0
    strips: int = entry(FEW, default=20)  # sub-regions of a deflection curve


@dataclass(frozen=True)
class Params(Parameters, table="defects"):
    """Parameters of both methods."""

    method: str = METHODS[0]
    seed: int = 0
    reach_mm: float = entry(SIZE, default=60.0)  # distance from the design within which a point belongs to it
    cell_mm: float = entry(AMOUNT, default=0.0)  # of the surface; 0 = by the density of the points
    false_alarms: float = entry(SIZE, default=1.0)  # allowed on per_m2
    per_m2: float = entry(SIZE, default=100.0)  # of surface
    # systematic error of a surface by the scanner, one sd, however many points
    systematic_mm: float = entry(AMOUNT, default=0.02)
    # border of every face that is left out: beams there hit other faces too
    edge_mm: float = entry(AMOUNT, default=8.0)
    align: bool = True  # fit stations and whole to the design before the search
    # one standard deviation; nan = from the fit to the design
    registration_error_mm: float = entry(number(least=0, unknown=True), default=math.nan)
    pictures: int = entry(number(least=0, whole=True), default=200)  # most defects with a picture
    paper: Paper = field(default_factory=Paper)
