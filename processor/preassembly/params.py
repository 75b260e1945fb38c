"""Parameters of preassembly: of the adjustment, and of the source paper's methods."""

from __future__ import annotations

from dataclasses import dataclass, field

from processor.model.inputs import Parameters, entry, number

PAPER_METHODS = ("design-aided", "line", "corner")
METHODS = ("adjustment", *PAPER_METHODS)  # the first is the default
AMOUNT, LIMIT = number(least=0), number(least=0, infinite=True)


@dataclass(frozen=True)
class AdjustParams(Parameters, table="preassemble.adjust"):
    """Parameters of the adjustment."""

    # lambda: of a squared departure of the edges from the design, against a squared gap
    weight: float = entry(number(above=0, infinite=True), default=0.1)
    # of the designed place, each axis, of what no measured joint ties to the rest; half of 60 m / 3000 (JTG arch rib)
    place_sd_mm: float = entry(number(above=0), default=10.0)


@dataclass(frozen=True)
class SystematicParams(Parameters, table="preassemble.systematic"):
    """Standard deviations of the errors common to all points of a scan; 0 = not stated, but for the gradient."""

    registration_mm: float = entry(AMOUNT, default=0.0)  # of the stations of one scan against each other, each axis
    offset_mm: float = entry(AMOUNT, default=0.0)  # zero offset of the scanner
    scale_ppm: float = entry(AMOUNT, default=0.0)
    temperature_C: float = entry(AMOUNT, default=0.0)  # of the steel's stated temperature
    # of a difference of temperature across a part, along each of both axes: 0 to 10 K in any direction; 0: none
    gradient_K: float = entry(AMOUNT, default=4.1)

    @property
    def known(self) -> bool:
        """Whether anything was stated of the scanner, the stations or the mean temperature."""
        return any(value > 0.0 for name, value in self.__dict__.items() if name != "gradient_K")


@dataclass(frozen=True)
class TrimParams(Parameters, table="preassemble.trim"):
    """Parameters of the proposals (mm)."""

    cut_sd_mm: float = entry(AMOUNT, default=1.0)  # of a cut or build-up, at the corners of the section
    aim_mm: float = entry(number(), default=0.0)  # wanted gap after it, less the design's root gap
    least_mm: float = entry(AMOUNT, default=0.5)  # less, at its deepest, is not worth a cut or build-up


@dataclass(frozen=True)
class BoxParams:
    """Parameters of the reduced boxes (mm); the paper's values where it gives them."""

    end_search_mm: float = 1000.0  # a part ends this near to its joint by principal axes
    # A wall that tapers by 40 mrad, or axes that tilt, leave a box of L_edge where the zone is longer.
    joint_zone_mm: float = 150.0  # length of the zone that is cut out at the end
    edge_box_mm: float = 0.0  # L_edge; 0 = 1.5 times the thickness of the plate at hand, as its two sides are scanned
    plate_mm: float = 28.0  # thickness of a plate of which one side alone is scanned
    box_count: int = 10  # boxes per edge
    box_range: float = 0.4  # k1, k2 run from -range to +range
    search_offset_mm: float = 200.0  # of P beyond the end
    line_threshold: float = 1.0  # of the RANSAC line, in spacings
    line_probability: float = 0.99
    line_iterations: int = 500
    distance_threshold: float = 1.0  # d_t in spacings
    denoise_neighbours: int = 20
    denoise_ratio: float = 3.0


@dataclass(frozen=True)
class SliceParams:
    """Parameters of the slices; the paper's values where it gives them."""

    # The paper has 0.5: such a slice of random points holds few, the nearest of them is half a spacing off the edge,
    # and the part is placed by that. On a net every other slice has none on the edge.
    thickness: float = 4.0  # of a slice, in spacings
    check_thickness: float = 4.0  # of a slice for the linear error, in spacings
    search_offset_mm: float = 200.0  # of the lines l1, l2 outside the part's bounding box
    filter_radius: float = 4.0  # of the radius filter, in spacings or slices, whichever is longer
    filter_neighbours: int = 3
    direction_radius: float = 8.0  # neighbourhood of the direction filter, in the same unit
    direction_offset: float = 0.5  # largest distance from the line of that neighbourhood, in the same unit
    direction_limit_deg: float = 30.0  # from the part's main direction


@dataclass(frozen=True)
class MatchParams:
    """Parameters of the registration (mm); PFH with 5 bins and ICP as in the paper."""

    pfh_bins: int = 5
    pfh_voxel_mm: float = 100.0  # features are thinned to this before the histograms
    pfh_radius_mm: float = 500.0
    pfh_tolerance_mm: float = 100.0
    pfh_iterations: int = 2000
    pfh_limit_deg: float = 15.0  # largest turn of the coarse pose from the principal axes' attitude
    pfh_limit_mm: float = 100.0  # largest move of a feature point from its place by joint and attitude
    icp_max_distance_mm: float = 200.0
    icp_iterations: int = 200
    icp_tolerance: float = 1e-7


@dataclass(frozen=True)
class Params(Parameters, table="preassemble"):
    """Parameters of the adjustment, and of the paper's methods: reduced boxes, slices, and the registration."""

    method: str = METHODS[0]
    seed: int = 0
    # a joint end found farther than this from its place in the design is not used
    end_limit_mm: float = entry(LIMIT, default=100.0)
    gap_limit_mm: float = entry(LIMIT, default=100.0)  # a part that leaves a wider gap is called weak
    adjust: AdjustParams = field(default_factory=AdjustParams)
    systematic: SystematicParams = field(default_factory=SystematicParams)
    trim: TrimParams = field(default_factory=TrimParams)
    boxes: BoxParams = field(default_factory=BoxParams)
    slices: SliceParams = field(default_factory=SliceParams)
    match: MatchParams = field(default_factory=MatchParams)
