"""The deflection curve of a bent member: by strips along it, and by slopes of sub-regions as in paper 004."""

from __future__ import annotations

import numpy as np

from processor.model import NORMAL_95, Floats


def by_strips(along: Floats, deviation: Floats, variance: Floats, strips: int) -> tuple[Floats, Floats, Floats]:
    """Middles (s,), weighted means (s,) and 95 % half-widths (s,) of deviations by strips of places ``along`` (n,).

    Strips without points are left out.
    """
    edges = np.linspace(along.min(), along.max(), strips + 1)
    index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, strips - 1)
    w = 1.0 / variance
    total = np.bincount(index, w, strips)
    used = total > 0.0
    some = np.where(used, total, 1.0)
    at, mean = np.bincount(index, w * along, strips) / some, np.bincount(index, w * deviation, strips) / some
    return at[used], mean[used], NORMAL_95 / np.sqrt(some[used])


def by_slopes(along: Floats, deviation: Floats, strips: int) -> tuple[Floats, Floats]:
    """Return ends of sub-regions (s + 1,) and displacement there (s + 1,), zero at the first (paper 004).

    Of each sub-region s the slope tan(theta) of a line through its points is taken, and integrated over its length h:
    mu_s(h) = int tan(theta) dh + mu_(s-1). A sub-region of fewer than two places keeps the slope before it.
    """
    edges = np.linspace(along.min(), along.max(), strips + 1)
    index = np.clip(np.searchsorted(edges, along, side="right") - 1, 0, strips - 1)
    slopes = np.zeros(strips)
    for s in range(strips):
        x, y = along[index == s], deviation[index == s]
        if len(x) >= 2 and np.ptp(x) > 0.0:
            arm = x - x.mean()
            slopes[s] = float(arm @ (y - y.mean()) / (arm @ arm))
        elif s:
            slopes[s] = slopes[s - 1]
    return edges, np.concatenate([[0.0], np.cumsum(slopes * np.diff(edges))])
