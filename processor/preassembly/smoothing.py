"""The smooth departure behind a row of noisy values along a part: a straight line and a curve, each of unknown size."""

from __future__ import annotations

import numpy as np

from processor.model import Floats
from processor.preassembly.evidence import SIZES_MM, Believed, weigh

LENGTHS_MM = (400.0, 1200.0, 4000.0)  # over which a curve changes
LEAST_VALUES = 5


def smooth(arc: Floats, value: Floats, variance: Floats, pose: Floats) -> Believed:
    """Smooth values (k,), NaN = unknown, with variances (k,), at arc lengths (k,) in mm.

    ``pose`` (k, k) is the covariance of what the part's registration moves them by. NaN where too few are known.
    """
    known = np.isfinite(value) & np.isfinite(variance)
    if known.sum() < LEAST_VALUES:
        nothing = np.full((len(arc),) * 2, np.nan)
        return Believed(np.full(len(arc), np.nan), nothing, nothing)
    x = (arc - 0.5 * (arc[0] + arc[-1])) / max(0.5 * float(np.ptp(arc)), 1.0)
    line = 1.0 + np.outer(x, x)
    apart = np.sqrt(3.0) * np.abs(arc[:, None] - arc)
    curves = [(1.0 + apart / length) * np.exp(-apart / length) for length in LENGTHS_MM]  # Matern 3/2
    hypotheses = []
    for size in SIZES_MM:
        straight = pose + size**2 * line
        hypotheses.append((1.0, straight))
        # A curve of size 0 has no length; each other size has all of them in equal parts.
        hypotheses += [(1.0 / len(curves), straight + bent**2 * curve) for bent in SIZES_MM[1:] for curve in curves]
    return weigh(value[known], np.diag(variance[known]), hypotheses, known)
