"""The result of step ``inspect``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from processor.model import (
    AMOUNT,
    COORDINATE,
    NUMBER,
    OPEN,
    SHARE,
    Bools,
    Checked,
    Floats,
    Reason,
    Rows,
    Status,
    Verdict,
    Word,
    column,
    described,
    names,
    reason,
    reasons,
    words,
    worst,
)


class Quantity(Word):
    """What a characteristic measures."""

    LENGTH = "length"
    WIDTH = "width"
    HEIGHT = "height"
    DIAGONAL = "diagonal"
    DIAGONAL_DIFFERENCE = "diagonal-difference"
    TWIST = "twist"
    SWEEP = "sweep"
    CAMBER = "camber"
    FLATNESS = "flatness"
    SQUARENESS = "squareness"
    THICKNESS = "thickness"
    HOLE_POSITION = "hole-position"
    HOLE_PITCH = "hole-pitch"
    PASS_THROUGH = "pass-through"
    HOLE_DIAMETER = "hole-diameter"
    DIAMETER = "diameter"
    BOW = "bow"
    ANGLE = "angle"
    ALIGNMENT = "alignment"


@dataclass(frozen=True)
class Characteristics(Rows):
    """The characteristics of one component; NaN = not measured; ``reasons`` state why.

    ``ci95`` is the half-width of the 95 % interval of the deviation, actual less nominal; that of a greatest departure
    is its wider side. ``lower`` and ``upper`` bound the deviation, -inf or inf without a bound, NaN where nothing
    limits it or the bound depends on an unknown size. ``risk_accept`` and ``risk_reject`` are the probabilities that it
    is wrong to accept and to reject. ``clause`` is of the standard, or the source of the limit.
    """

    id: tuple[str, ...] = names("r")
    quantity: tuple[Quantity, ...] = words("r", Quantity)
    nominal: Floats = column("r", means=NUMBER)
    actual: Floats = column("r", means=NUMBER)
    deviation: Floats = column("r", means=NUMBER)
    ci95: Floats = column("r", means=AMOUNT)
    lower: Floats = column("r", means=OPEN)
    upper: Floats = column("r", means=OPEN)
    unit: tuple[str, ...] = names("r")
    verdict: tuple[Verdict, ...] = words("r", Verdict)
    risk_accept: Floats = column("r", newer=True, means=SHARE)
    risk_reject: Floats = column("r", newer=True, means=SHARE)
    limit: tuple[str, ...] = names("r")
    clause: tuple[str, ...] = names("r")
    verified: Bools = column("r", dtype=np.bool_)
    reasons: tuple[tuple[Reason, ...], ...] = reasons("r")


@dataclass(frozen=True)
class AxisDepartures(Rows):
    """Departure of a component's axis from the design's, the chord between its own ends as reference; mm.

    ``chainage`` is from the component's start; ``sideways`` is positive to the left, ``up`` upward.
    """

    chainage: Floats = column("a", unit="mm", means=COORDINATE)
    sideways: Floats = column("a", unit="mm", means=COORDINATE)
    sideways_ci95: Floats = column("a", unit="mm", means=AMOUNT)
    up: Floats = column("a", unit="mm", means=COORDINATE)
    up_ci95: Floats = column("a", unit="mm", means=AMOUNT)


@dataclass(frozen=True)
class InspectedComponent(Checked):
    """One component: its characteristics, and why some or all of them are not known."""

    name: str = described("")
    status: Status = described(Status.OK, words=Status)
    reasons: tuple[Reason, ...] = reasons()
    characteristics: Characteristics = field(default_factory=Characteristics)
    axis: AxisDepartures = field(default_factory=AxisDepartures)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict on its characteristics."""
        return worst(self.characteristics.verdict)


@dataclass(frozen=True)
class Result(Checked):
    """The characteristics of all components."""

    status: Status = described(words=Status)
    method: str = described()
    reasons: tuple[Reason, ...] = reasons()
    components: tuple[InspectedComponent, ...] = described((), joined=True)

    @classmethod
    def of_components(
        cls, components: Sequence[InspectedComponent], method: str, remarks: Sequence[Reason] = ()
    ) -> Result:
        """Return the result with the status that follows from those of the components."""
        failed = [component.status is Status.FAILED for component in components]
        status = Status.PARTIAL if any(failed) else Status.OK
        if failed and all(failed):
            status, remarks = Status.FAILED, (reason("inspect.none-seen"), *remarks)
        return cls(status=status, method=method, reasons=tuple(remarks), components=tuple(components))

    @property
    def overall(self) -> Verdict:
        """The worst verdict on the components."""
        return worst(component.verdict for component in self.components)
