"""What preassembly answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.model import Checked, Floats, Labels, column, names
from processor.preassembly.verdicts.joint_measures import Measures
from processor.preassembly.verdicts.joints import Verdict
from processor.preassembly.verdicts.trim_and_shim import Proposal


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
    component_scans: tuple[str, ...] = names("used")  # names; poses and key points are in the frame of the first
    T_bridge_scan: Floats = column("c", 4, 4)
    covariance: Floats = column("c", 6, 6)  # NaN: the paper's methods state none
    T_rival_scan: Floats = column("r", 4, 4)  # of the adjustment: the other pose of an ambiguous part; NaN of others
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
    # of the adjustment alone, so empty or NaN for other methods, but for three bands: see ``bands_as_designed``
    measures: tuple[Measures, ...] = ()  # a record a joint
    judged: tuple[Verdict, ...] = ()
    proposals: tuple[Proposal, ...] = ()
    chain_judged: tuple[Verdict, ...] = ()  # one: span and edges against the limits of the whole chain
    not_held: tuple[str, ...] = names("n")  # keys of limits that the project states and nothing is held against
    not_held_what: tuple[str, ...] = names("n")
    linear_offset: Floats = column("o", 2)  # at each station: to the left and up, as assembled
    linear_offset_ci95: Floats = column("o", 2)
    linear_ci95: Floats = column("o")  # of linear_deviation: holds 95 % or more
    best_fit_linear_ci95: Floats = column("o")
    errors_ci95: Floats = column("e")  # of splicing mean, max; linear mean, max; the same with Foot 1: 95 % or more
    span_departure: float = float("nan")  # of the outer ends' distance from the design's, mm
    span_ci95: float = float("nan")
    closure: Floats = column("k")  # of the joints alone: mm along the bridge's axes, mrad about them
    closure_ci95: Floats = column("k")
    limiting: str = ""  # the joint and what was measured there that limit the accuracy
    advice: str = ""  # the further scan that would help most
    budget_source: tuple[str, ...] = names("b")
    budget_sd: Floats = column("b")  # mm, of an end of the longest part
    residual_points: Floats = column("p", 3)  # of all parts, thinned, on the design; bridge frame
    residual: Floats = column("p")  # distance from the design's surface
    residual_component: Labels = column("p", dtype=np.int32)
    weight: float = float("nan")  # lambda of the adjustment
    # of the adjustment: over the weight lambda, splicing mean and max, linear mean and max
    trade_lambda: Floats = column("t")
    trade_figures: Floats = column("t", 4)

    @property
    def bands_as_designed(self) -> bool:
        """Whether the bands say what the method makes of parts exactly as designed, not where the truth lies."""
        return bool(np.isfinite(self.errors_ci95).any() and not np.isfinite(self.weight))
