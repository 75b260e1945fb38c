"""Characteristics of components as measured, and the table of them with their verdicts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from processor.adjustment import maximum_interval
from processor.inspection.result import Characteristics, Quantity
from processor.limits import judging, limit_bounds, measurands
from processor.limits.judging import Judged, Measured
from processor.model import NORMAL_95, Floats, Reason, Tolerance

NAN = float("nan")


def normal(id_: str, quantity: Quantity, nominal: float, deviation: float, variance: float) -> Measured:
    """Return a characteristic whose error is normally distributed with a variance in mm^2."""
    half = NORMAL_95 * math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else NAN
    return Measured.within(id_, deviation, half, what=quantity, nominal=nominal)


def greatest(quantity: Quantity, departure: Floats, covariance: Floats) -> Measured:
    """Return the greatest of departures (n,) with its sign, and the interval of its size by their covariance (n, n).

    The first and the last are 0 by definition.
    """
    inner = slice(1, -1)
    sign = np.where(departure < 0.0, -1.0, 1.0)
    of_sizes = covariance * np.outer(sign, sign)
    size, low, high = maximum_interval.of_correlated(np.abs(departure)[inner], of_sizes[inner, inner], folded=True)
    at = 1 + int(np.argmax(np.abs(departure)[inner]))
    return Measured(str(quantity), sign[at] * size, low, high, what=quantity, unsigned=True)


def absent(id_: str, quantity: Quantity, nominal: float, *why: Reason) -> Measured:
    """Return a characteristic that was not measured, with the reasons."""
    return Measured(id_, what=quantity, nominal=nominal, reasons=why)


def table(
    found: Sequence[Measured],
    tolerance: Tolerance | None,
    component: str,
    sizes_mm: Mapping[str, float],
    doubtful: bool,
) -> Characteristics:
    """Judge characteristics of a ``component`` by the limits of a project, if it names any.

    ``sizes_mm`` are of the component, by the names of ``Limit.of``; of a pitch its own is the spacing. Of a
    ``doubtful`` component, all that is limited is indeterminate. Of several limits of a characteristic the last holds:
    a project's own come after those of its standard.
    """

    def judged() -> Iterator[Judged]:
        for one in found:
            of_pitch = {"spacing": one.nominal} if one.what == Quantity.HOLE_PITCH else {}
            unknown = doubtful or one.doubtful or not (math.isfinite(one.low) and math.isfinite(one.high))
            known = replace(one, sizes_mm={**sizes_mm, **of_pitch}, doubtful=unknown)
            limits = judging.limits_for(tolerance or Tolerance(), measurands.PART + one.what, component)
            fitting = [limit for limit in limits if limit_bounds.applies(limit, known.sizes_mm.get(limit.of, NAN))]
            yield judging.judge(fitting[-1] if fitting else None, known, tolerance or Tolerance())

    rows = tuple(judged())
    return Characteristics.from_items(
        rows,
        id=tuple(row.of for row in rows),
        quantity=tuple(one.what for one in found),
        deviation=tuple(row.value for row in rows),
        ci95=tuple(one.wider_side for one in found),
        lower=tuple(row.low for row in rows),
        upper=tuple(row.high for row in rows),
        unit=tuple(one.unit for one in found),
        limit=tuple(row.key for row in rows),
        reasons=tuple(one.reasons for one in found),
    )
