"""Errors with their sign as figures of a check: what a certificate of accuracy is made of."""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, Metric, Statistic


def signed(quantity: str, errors: Floats, bound: Floats | None = None, unit: str = "mm") -> list[Metric]:
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
    return [Metric(quantity, value, statistic, unit=own) for statistic, value, own in figures]


def coverage(quantity: str, errors: Floats, half_widths: Floats) -> list[Metric]:
    """Share of errors within the half-widths of their 95 % intervals; those without either (NaN) are left out."""
    known = np.isfinite(errors) & np.isfinite(half_widths)
    if not known.any():
        return []
    share = 100.0 * float(np.mean(np.abs(errors[known]) <= half_widths[known]))
    return [Metric(quantity, share, Statistic.COVERAGE, unit="%")]


def covered(quantity: str, errors: Floats, half_widths: Floats, unit: str = "mm") -> list[Metric]:
    """:func:`coverage` with the figures of :func:`signed`; a quantity that has intervals always has both."""
    with_interval = errors[np.isfinite(half_widths)]
    return [*coverage(quantity, errors, half_widths), *signed(quantity, with_interval, unit=unit)]


def pose_pulls(T: Floats, true: Floats, covariance: Floats) -> Floats:
    """Return the errors (6,) of a pose T_a_b in standard deviations: turns about and shifts along the axes of a.

    ``T`` and ``true`` are 4 x 4, the covariance (6, 6) is of the left perturbation of T; where its variance is not
    positive, the error is NaN. A scale within T is no part of the error.
    """
    off = T @ rigid.invert(true)
    R = off[:3, :3] / np.cbrt(np.linalg.det(off[:3, :3]))
    variance = np.diag(covariance)
    error = np.concatenate([rigid.vector_from_rotation(R), off[:3, 3]])
    return np.asarray(error / np.sqrt(np.where(variance > 0.0, variance, np.nan)))


def covered_pulls(quantity: str, pulls: Floats) -> list[Metric]:
    """Share of errors within their 95 % intervals, of errors in standard deviations; without figures in a unit."""
    shares = coverage(quantity, pulls, np.full_like(pulls, NORMAL_95))
    number = float(np.isfinite(pulls).sum())
    return [*shares, Metric(quantity, number, Statistic.NUMBER)] if shares else []
