"""One characteristic as measured, and its comparison with a limit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from processor.inspection.result import Characteristics, Quantity
from processor.limits import judging, standards
from processor.limits.guard_band import guard_band
from processor.model import NORMAL_95, Limit, Reason, Tolerance, Verdict

NAN = float("nan")
Sizes = Mapping[str, float]


@dataclass(frozen=True)
class Characteristic:
    """A deviation from ``nominal`` with its 95 % interval ``low`` to ``high``, mm; NaN = not measured.

    A greatest departure is stated with its sign, and its interval is that of its ``size``.
    """

    id: str
    quantity: Quantity
    nominal: float
    deviation: float = NAN
    low: float = NAN
    high: float = NAN
    size: bool = False
    why: tuple[Reason, ...] = ()

    @property
    def ci95(self) -> float:
        """The wider side of the interval."""
        middle = abs(self.deviation) if self.size else self.deviation
        return max(self.high - middle, middle - self.low)


def normal(id_: str, quantity: Quantity, nominal: float, deviation: float, variance: float) -> Characteristic:
    """Return a characteristic whose error is normally distributed with a variance in mm^2."""
    half = NORMAL_95 * math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else NAN
    return Characteristic(id_, quantity, nominal, deviation=deviation, low=deviation - half, high=deviation + half)


def absent(id_: str, quantity: Quantity, nominal: float, *why: Reason) -> Characteristic:
    """Return a characteristic that was not measured, with the reasons."""
    return Characteristic(id_, quantity, nominal, why=why)


def table(
    found: Sequence[Characteristic], tolerance: Tolerance | None, sizes: Sizes, doubtful: bool
) -> Characteristics:
    """Compare characteristics with the limits of a project, if it names any.

    ``sizes`` of the component, mm, by the names of ``Limit.of``. Of a ``doubtful`` component, all that is limited is
    indeterminate.
    """
    limits = [_limit(one, tolerance, sizes) for one in found]
    bounds = [(NAN, NAN) if limit is None else standards.bounds(limit, sizes) for limit in limits]
    return Characteristics(
        id=tuple(one.id for one in found),
        quantity=tuple(one.quantity for one in found),
        nominal=np.array([one.nominal for one in found]),
        actual=np.array([one.nominal + one.deviation for one in found]),
        deviation=np.array([one.deviation for one in found]),
        ci95=np.array([one.ci95 for one in found]),
        lower=np.array([low for low, _ in bounds]),
        upper=np.array([high for _, high in bounds]),
        unit=("mm",) * len(found),
        verdict=tuple(
            _verdict(one, limit, bound, doubtful) for one, limit, bound in zip(found, limits, bounds, strict=True)
        ),
        limit=tuple("" if limit is None else limit.key for limit in limits),
        clause=tuple(
            "" if limit is None or tolerance is None else judging.clause_of(limit, tolerance) for limit in limits
        ),
        verified=np.array([limit is not None and limit.verified for limit in limits], np.bool_),
        reasons=tuple(one.why for one in found),
    )


def _limit(one: Characteristic, tolerance: Tolerance | None, sizes: Sizes) -> Limit | None:
    """Return the limit of a characteristic for a component of these sizes."""
    if tolerance is None:
        return None
    measure = standards.PART + one.quantity
    rows = (limit for limit in tolerance.limits if limit.measure == measure)
    return next((limit for limit in rows if standards.applies(limit, sizes.get(limit.of, NAN))), None)


def _verdict(one: Characteristic, limit: Limit | None, bounds: tuple[float, float], doubtful: bool) -> Verdict:
    if limit is None:
        return Verdict.NONE
    if doubtful or not all(map(math.isfinite, (one.low, one.high))) or any(map(math.isnan, bounds)):
        return Verdict.INDETERMINATE
    low, high = bounds
    if one.size:  # the sign of the greatest departure is not sure, so the tighter bound counts
        low, high = -math.inf, min(-low, high)
    return guard_band((one.low, one.high), low, high)
