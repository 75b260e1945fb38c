"""Parameters of step ``deviation``."""

from __future__ import annotations

from dataclasses import dataclass, field

from processor.model.inputs import Parameters, entry, number, text

METHODS = ("default", "paper")  # the first is the default
REGISTER = ("auto", "none", "fine", "coarse")
FIT = ("stable", "all")
NAN = float("nan")
LENGTH, SIZE = number(least=0, below=1e6), number(above=0, below=1e6)  # mm: less than 1 km


@dataclass(frozen=True)
class Paper(Parameters, table="deviation.paper"):
    """The source paper's numbers (002): voxels of 2 mm with 5 points, scales in mm; it states no depth.

    It does not say by how much voxels grow, either: by a factor of two they end at 14 % of the points, as many hold far
    more than 5; twice the volume is near the paper's 20 %, which is one in 5.
    """

    voxel_mm: float = entry(SIZE, default=2.0)
    voxel_points: int = entry(number(least=1, whole=True), default=5)
    voxel_growth: float = entry(number(least=1.01, most=16), default=1.26)
    normal_diameter_mm: float = entry(SIZE, default=110.541)
    projection_diameter_mm: float = entry(SIZE, default=55.270)
    max_depth_mm: float = entry(SIZE, default=100.0)


@dataclass(frozen=True)
class Params(Parameters, table="deviation"):
    """Parameters (lengths in mm; 0 = made from the scan's density or extent)."""

    method: str = METHODS[0]
    seed: int = 0
    # none: the frame as it is; fine: from where it is; coarse: from anywhere; auto: none if half of the scan is near
    # the design, else coarse
    register: str = entry(text(*REGISTER), default="auto")
    # a scan that is registered is fitted to: the largest part that agrees (stable); all: best fit
    fit: str = entry(text(*FIT), default="stable")
    most_points: int = entry(number(least=0, whole=True), default=0)  # of more every k-th is used; 0 = all are used
    neighbours: int = entry(number(least=1, whole=True), default=20)  # K of the outlier removal
    # n: standard deviations of the mean distance to K neighbours; 0 = no removal
    outlier_ratio: float = entry(number(least=0, below=1e6), default=1.0)
    projection_diameter_mm: float = entry(LENGTH, default=0.0)
    max_depth_mm: float = entry(LENGTH, default=0.0)
    core_spacing_mm: float = entry(LENGTH, default=0.0)
    # one standard deviation, as a length; NaN = from the fits to the design
    registration_error_mm: float = entry(number(least=0, unknown=True), default=NAN)
    paper: Paper = field(default_factory=Paper)
