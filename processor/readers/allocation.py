"""Allocation of the arrays that readers fill: in the process of ``sandbox`` they lie in shared memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

_new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]] = np.empty


def allocate(*shape: int, dtype: type = np.float64) -> npt.NDArray[Any]:
    """Return an array to be filled; pages that are never written take no memory."""
    return _new_array(shape, dtype)


def allocate_with(new_array: Callable[[tuple[int, ...], type], npt.NDArray[Any]]) -> None:
    """Replace the function that allocates the arrays of ``allocate``."""
    global _new_array
    _new_array = new_array
