"""What preassembly answers."""

from __future__ import annotations

from dataclasses import dataclass

from processor.model import Checked, Floats, column, names


@dataclass(frozen=True)
class Result(Checked):
    """The assembled bridge. Axis of length 2: the start and the end of a component. NaN = no answer."""

    status: str  # ok | partial | failed
    method: str
    message: str = ""
    # a row a component, in assembly order
    components: tuple[str, ...] = names("c")
    component_status: tuple[str, ...] = names("c")  # ok | ambiguous | weak | failed
    component_message: tuple[str, ...] = names("c")
    T_bridge_scan: Floats = column("c", 4, 4)
    covariance: Floats = column("c", 6, 6)  # NaN: the paper's methods state none
    key_points_scan: Floats = column("c", 2, 8, 3)  # P1..P8 of the start and the end, in the scan's frame
    key_points_sd: Floats = column("c", 2, 8, 3)
    # a row a joint
    joints: tuple[str, ...] = names("j")
    joint_left: tuple[str, ...] = names("j")
    joint_right: tuple[str, ...] = names("j")
    gaps: Floats = column("j", 8, 3)  # right minus left at the assembled pose, bridge axes
    gap_ci95: Floats = column("j", 8, 3)
    verdict: tuple[str, ...] = names("j")  # pass | fail | indeterminate
    splicing_mean: float = float("nan")
    splicing_max: float = float("nan")
    # linear error as assembled (`gauge` says what holds the chain) and with Foot 1 best-fit to the design
    gauge: str = ""
    linear_mean: float = float("nan")
    linear_max: float = float("nan")
    best_fit_linear_mean: float = float("nan")
    best_fit_linear_max: float = float("nan")
    linear_station: Floats = column("s")  # arc length from the start of the design's bottom edge
    linear_edge: tuple[str, ...] = names("s")  # left | right
    linear_deviation: Floats = column("s")  # as assembled
    best_fit_linear_deviation: Floats = column("s")
    weight: float = float("nan")  # lambda of the adjustment
    # of the adjustment: over the weight lambda, splicing mean and max, linear mean and max
    trade_lambda: Floats = column("t")
    trade_figures: Floats = column("t", 4)
