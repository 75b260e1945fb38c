"""What a fitted surface does not follow: the means of its cells scatter by more than the points' noise explains."""

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
