"""Parameters of preassembly: of the adjustment, and of the source paper's methods."""

from __future__ import annotations

from dataclasses import dataclass, field

from processor.model import UsageError
from processor.preassembly.baselines.edge_features import BoxParams, SliceParams
from processor.preassembly.baselines.joint_alignment import MatchParams
from processor.preassembly.parts.systematic_errors import SystematicParams
from processor.preassembly.verdicts.trim_and_shim import TrimParams

PAPER_METHODS = ("design-aided", "line", "corner")
METHODS = ("adjustment", *PAPER_METHODS)  # the first is the default


@dataclass(frozen=True)
class AdjustParams:
    """Parameters of the adjustment."""

    weight: float = 0.1  # lambda: of a squared departure of the edges from the design, against a squared gap

    def __post_init__(self) -> None:
        if not self.weight > 0.0:
            raise UsageError(f"preassemble.adjust.weight: expected a number above 0, got {self.weight!r}")


@dataclass(frozen=True)
class Params:
    """Parameters of the adjustment, and of the paper's methods: reduced boxes, slices, and the registration."""

    method: str = METHODS[0]
    seed: int = 0
    end_limit_mm: float = 100.0  # a joint end found farther than this from its place in the design is not used
    gap_limit_mm: float = 100.0  # a part that leaves a wider gap is called weak
    repetitions: int = 5  # of the scans as designed, for a band of the paper's methods; fewer than 3: none
    adjust: AdjustParams = field(default_factory=AdjustParams)
    systematic: SystematicParams = field(default_factory=SystematicParams)
    trim: TrimParams = field(default_factory=TrimParams)
    boxes: BoxParams = field(default_factory=BoxParams)
    slices: SliceParams = field(default_factory=SliceParams)
    match: MatchParams = field(default_factory=MatchParams)
