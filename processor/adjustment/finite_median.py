"""Median of the values that are numbers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def finite_median(values: npt.ArrayLike) -> float:
    """Return the median of the finite values (n,); NaN if there is none."""
    array = np.asarray(values, np.float64)
    finite = array[np.isfinite(array)]
    return float(np.median(finite)) if len(finite) else float("nan")
