"""Draws from normal distributions of given covariance, the same every time."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from processor.model import Floats

SEED = 20  # any number: the draws are the same in every run


def errors_of(covariance: Floats, count: int, seed: int = SEED) -> Floats:
    """Draw errors (count, n) of mean 0 and a covariance (n, n), which may be singular."""
    scale, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    errors: Floats = (_standard_normal(count, len(scale), seed) * np.sqrt(np.maximum(scale, 0.0))) @ axes.T
    return errors


@lru_cache(maxsize=4)  # every quantity of a part has as many values: drawing them again takes a third of the time
def _standard_normal(count: int, n: int, seed: int) -> Floats:
    drawn: Floats = np.random.default_rng(seed).standard_normal((count, n))
    drawn.flags.writeable = False
    return drawn
