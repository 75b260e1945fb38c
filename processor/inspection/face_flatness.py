"""Flatness of a face: the greatest less the least departure of its pieces from their plane, noise taken out.

The extremes of noisy values are too far apart: departures are shrunk by their variance against their noise (empirical
Bayes: Efron and Morris 1973, Journal of the American Statistical Association 68), and what their noise still adds is
taken off (bias by the parametric bootstrap: Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapters 6 and
10). The interval is a simultaneous band over all pieces.
"""

from __future__ import annotations

import numpy as np

from processor.adjustment import maximum_interval
from processor.inspection import flat_faces
from processor.inspection.flat_faces import Pieces
from processor.inspection.result import Quantity
from processor.limits.judging import Measured
from processor.model import Floats

FEWEST_PIECES = 9  # of a face whose flatness is stated
SEED, REPETITIONS = 20, 200  # of the noise, for the bias of a flatness


def peak_to_valley(id_: str, pieces: Pieces, along: Floats, across: Floats) -> Measured:
    """Return the flatness of a face from its pieces at places (m,) along and across it, in any unit."""
    plane = np.stack([np.ones_like(along), along, across], axis=1)
    root = 1.0 / np.sqrt(pieces.noise)
    solve = np.linalg.pinv(plane * root[:, None]) * root
    off = np.eye(len(plane)) - plane @ solve
    rest = off @ pieces.value
    variance = np.maximum(np.einsum("ij,j,ij->i", off, pieces.noise, off), flat_faces.FLOOR_MM**2)
    form = max(float(np.mean(rest**2 - variance)), 0.0)
    gain, sd = form / (form + variance), np.sqrt(variance)
    shrunk = gain * rest
    # Of several pieces that are about equal the noise picks the extremes: its effect is found by repetition.
    repeated = shrunk + gain * sd * np.random.default_rng(SEED).standard_normal((REPETITIONS, len(sd)))
    by_noise = float(np.ptp(repeated, axis=1).mean() - np.ptp(shrunk))
    _, high_low, high_high = maximum_interval.of_independent(rest, sd)
    _, low_low, low_high = maximum_interval.of_independent(-rest, sd)
    return Measured(
        id_,
        max(float(np.ptp(shrunk)) - by_noise, 0.0),
        max(high_low + low_low, 0.0),
        high_high + low_high,
        what=Quantity.FLATNESS,
        unsigned=True,
    )
