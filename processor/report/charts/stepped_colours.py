"""Colours of a map in steps: one step for the band that is allowed or not sure, and equal steps to either side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap

from processor.language.messages import Message
from processor.model import Floats
from processor.report.style import DIVERGING

LEAST_BAND = 1e-3  # of a step of colour
STEPS = 4  # of colour beyond the band, to either side
COLOUR_QUANTILE = 0.995  # the few largest do not take the steps from the rest; they have the last colour
WITHIN = "#e9e9e9"


@dataclass(frozen=True)
class Band:
    """Deviations drawn without a colour, from ``low`` to ``high``, and what they are."""

    low: float
    high: float
    name: Message


def stepped_colours(values: Floats, band: Band) -> tuple[BoundaryNorm, Colormap, list[float]]:
    """Return the steps of colour: one for the band, STEPS to either side up to the largest values, and beyond."""
    sizes = np.abs(values[np.isfinite(values)])
    largest = float(np.quantile(sizes, COLOUR_QUANTILE)) if len(sizes) else 0.0
    widest = max(abs(band.low), abs(band.high), 1e-9)
    wanted = max(largest - widest, widest) / STEPS
    ten = 10.0 ** np.floor(np.log10(wanted))
    step = float(next(ten * one for one in (1.0, 2.0, 5.0, 10.0) if ten * one >= wanted * (1.0 - 1e-9)))
    least = LEAST_BAND * step if band.high - band.low < LEAST_BAND * step else 0.0  # clouds without noise have no band
    up, down = _multiples(band.high + least, step), [-level for level in _multiples(least - band.low, step)]
    outer = np.linspace(0.0, 0.42, STEPS + 1), np.linspace(0.58, 1.0, STEPS + 1)
    colours: Colormap = ListedColormap([*DIVERGING(outer[0][1:]), WITHIN, *DIVERGING(outer[1][:-1])])
    colours = colours.with_extremes(under=DIVERGING(0.0), over=DIVERGING(1.0))
    levels = [*reversed(down), *up]
    return BoundaryNorm(levels, len(levels) - 1), colours, levels


def _multiples(bound: float, step: float) -> list[float]:
    """Return a bound and the next STEPS multiples of ``step`` beyond it, none close to it."""
    first = np.floor(bound / step + 0.25) + 1.0
    return [bound, *(float((first + k) * step) for k in range(STEPS))]
