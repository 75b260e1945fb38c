"""Errors with their sign as figures of a check: what a certificate of accuracy is made of."""

from __future__ import annotations

import numpy as np

from processor.model import Floats, Metric, Statistic


def signed(step: str, quantity: str, errors: Floats, bound: Floats | None = None, unit: str = "mm") -> list[Metric]:
    """Bias, standard deviation, 95 % error and number of errors, measured less true; NaN among them are left out.

    ``bound`` holds the least possible standard deviation of each (Cramér-Rao), of the same shape: then also the
    efficiency, 1 / rms(error / bound). The quantity is in the plural. None of these has a limit.
    """
    known = np.isfinite(errors)
    found = errors[known]
    nan = float("nan")
    if not len(found):
        return []
    figures = [
        (Statistic.BIAS, float(np.mean(found)), unit),
        (Statistic.SD, float(np.std(found, ddof=1)) if len(found) > 1 else nan, unit),
        (Statistic.ERROR_95, float(np.quantile(np.abs(found), 0.95)), unit),
        (Statistic.NUMBER, float(len(found)), ""),
    ]
    if bound is not None:
        least = bound[known]
        bounded = np.isfinite(least) & (least > 0.0)
        if bounded.any():
            rms = float(np.sqrt(np.mean((found[bounded] / least[bounded]) ** 2)))
            figures.append((Statistic.EFFICIENCY, 1.0 / rms if rms > 0.0 else nan, ""))
    return [Metric(step, quantity, value, statistic, unit=own) for statistic, value, own in figures]
