"""One characteristic as measured, and its comparison with a limit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from processor.adjustment import maximum_interval
from processor.inspection.result import Characteristics, Quantity
from processor.limits import judging, limit_bounds, measurands
from processor.limits.judging import Comparison, Measured
from processor.model import NORMAL_95, Floats, Reason, Tolerance, Verdict

NAN = float("nan")
Sizes = Mapping[str, float]


@dataclass(frozen=True)
class Characteristic:
    """A deviation from ``nominal`` with its 95 % interval ``low`` to ``high``, in ``unit``; NaN = not measured.

    A greatest departure is stated with its sign, and its interval is that of its ``size``. ``doubtful``: it may be
    wrong altogether, beyond its interval. ``why`` it was not measured, or what the value lacks.
    """

    id: str
    quantity: Quantity
    nominal: float
    deviation: float = NAN
    low: float = NAN
    high: float = NAN
    size: bool = False
    unit: str = "mm"
    why: tuple[Reason, ...] = ()
    doubtful: bool = False

    @property
    def ci95(self) -> float:
        """The wider side of the interval."""
        middle = abs(self.deviation) if self.size else self.deviation
        return max(self.high - middle, middle - self.low)


def normal(id_: str, quantity: Quantity, nominal: float, deviation: float, variance: float) -> Characteristic:
    """Return a characteristic whose error is normally distributed with a variance in mm^2."""
    half = NORMAL_95 * math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else NAN
    return Characteristic(id_, quantity, nominal, deviation=deviation, low=deviation - half, high=deviation + half)


def greatest(quantity: Quantity, departure: Floats, covariance: Floats) -> Characteristic:
    """Return the greatest of departures (n,) with its sign, and the interval of its size by their covariance (n, n).

    The first and the last are 0 by definition.
    """
    inner = slice(1, -1)
    sign = np.where(departure < 0.0, -1.0, 1.0)
    of_sizes = covariance * np.outer(sign, sign)
    size, low, high = maximum_interval.of_correlated(np.abs(departure)[inner], of_sizes[inner, inner], folded=True)
    at = 1 + int(np.argmax(np.abs(departure)[inner]))
    return Characteristic(str(quantity), quantity, 0.0, deviation=sign[at] * size, low=low, high=high, size=True)


def absent(id_: str, quantity: Quantity, nominal: float, *why: Reason) -> Characteristic:
    """Return a characteristic that was not measured, with the reasons."""
    return Characteristic(id_, quantity, nominal, why=why)


def table(
    found: Sequence[Characteristic], tolerance: Tolerance | None, component: str, sizes: Sizes, doubtful: bool
) -> Characteristics:
    """Compare characteristics of a ``component`` with the limits of a project, if it names any.

    ``sizes`` of the component, mm, by the names of ``Limit.of``; of a pitch its own is the spacing. Of a ``doubtful``
    component, all that is limited is indeterminate.
    """
    rows = [_compared(one, tolerance, component, sizes, doubtful) for one in found]
    return Characteristics(
        id=tuple(one.id for one in found),
        quantity=tuple(one.quantity for one in found),
        nominal=np.array([one.nominal for one in found]),
        actual=np.array([one.nominal + one.deviation for one in found]),
        deviation=np.array([one.deviation for one in found]),
        ci95=np.array([one.ci95 for one in found]),
        lower=np.array([NAN if row is None else row.low for row in rows]),
        upper=np.array([NAN if row is None else row.high for row in rows]),
        unit=tuple(one.unit for one in found),
        verdict=tuple(Verdict.NONE if row is None else row.verdict for row in rows),
        limit=tuple("" if row is None else row.limit.key for row in rows),
        clause=tuple(
            "" if row is None or tolerance is None else judging.clause_of(row.limit, tolerance) for row in rows
        ),
        verified=np.array([row is not None and row.limit.verified for row in rows], np.bool_),
        reasons=tuple(one.why for one in found),
    )


def _compared(
    one: Characteristic, tolerance: Tolerance | None, component: str, sizes: Sizes, doubtful: bool
) -> Comparison | None:
    """Compare a characteristic with the limit for a component of these sizes; None without a limit.

    Of several the last holds: a project's own come after those of its standard.
    """
    if tolerance is None:
        return None
    own = {**sizes, "spacing": one.nominal} if one.quantity is Quantity.HOLE_PITCH else sizes
    measure = measurands.PART + one.quantity
    limits = judging.limits_for(tolerance, measure, component)
    fitting = [limit for limit in limits if limit_bounds.applies(limit, own.get(limit.of, NAN))]
    if not fitting:
        return None
    unknown = doubtful or one.doubtful or not all(map(math.isfinite, (one.low, one.high)))
    measured = Measured(one.id, one.deviation, one.low, one.high, sizes_mm=own, doubtful=unknown, unsigned=one.size)
    return judging.compare(fitting[-1], measured)
