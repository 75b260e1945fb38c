"""What a fitted surface does not follow, by its points' rests: the means of cells, and the next shape in order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processor.model import Floats, Ints


def variance(fits: Sequence[tuple[Floats, Ints]], numbers: int) -> float:
    """Return the variance of cells' means about fitted surfaces beyond noise, mm^2, for all surfaces together.

    A fit is the rests (n,) of its points and their cells (n,); each surface has so many ``numbers``. By moments: the
    sum of squares between the cells less what noise would give it.
    """
    between = within = 0.0
    freedom, points, inside = 0, 0, 0
    for rest, cell in fits:
        number = np.bincount(cell)
        kept = number > 0
        mean = np.bincount(cell, rest)[kept] / number[kept]
        between += float((number[kept] * mean**2).sum())
        within += float(((rest - (np.bincount(cell, rest) / np.maximum(number, 1))[cell]) ** 2).sum())
        freedom += int(kept.sum()) - numbers
        points += len(rest)
        inside += len(rest) - int(kept.sum())
    if freedom <= 0 or inside <= 0:
        return 0.0
    noise = within / inside
    return max((between - freedom * noise) / points, 0.0)


def third_order(basis: Floats, rest: Floats) -> Floats:
    """Return how far a face departs at the joint by the next shapes its numbers do not follow, with variances (2, 2).

    The numbers follow a bend along the part; the third Legendre polynomial, 1 at the joint, is the simplest shape that
    they do not, alike all across the face and from one side to the other. ``basis`` (n, 8) and ``rest`` (n,) are those
    of the points of the face's zone, see :func:`processor.preassembly.end_faces.basis`.
    Where the zone is evenly seen these shapes and the numbers' have nothing in common: variance 7 sigma^2 / n.
    """
    t = 1.0 - 2.0 * np.abs(basis[:, 1])
    shapes = (0.5 * (5.0 * t**3 - 3.0 * t))[:, None] * np.stack([np.ones_like(t), basis[:, 2]], axis=1)
    own = shapes - basis @ np.linalg.lstsq(basis, shapes, rcond=None)[0]
    inverse = np.linalg.inv(own.T @ own)
    noise = float(rest @ rest) / max(len(rest) - basis.shape[1], 1)
    return np.stack([inverse @ (own.T @ rest), noise * np.diag(inverse)], axis=1)


def excess(departures: Floats) -> float:
    """Return the variance of departures (n, 2), each with its variance by noise, beyond what noise explains."""
    return max(float(np.mean(departures[:, 0] ** 2 - departures[:, 1])), 0.0)
