"""Epochs of step ``deviation``: how far the surface of each component moved, on average and where it moved most.

The mean of a component has an interval as if the errors of all its core points were the same, which no correlation can
exceed. Core points are the same ones at two epochs where the design's surface was sampled alike; the one that changed
most by its levels of detection stands for all, its interval widened for their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.deviation.result import ErrorSource, Result
from processor.deviation.verdicts import WHOLE
from processor.epochs.series import Series
from processor.language.messages import text
from processor.model import Flags, Floats, Ints, Reason, Status, reason

BY_DESIGN = True
SAME_MM = 0.01  # core points of one place


@dataclass(frozen=True)
class _Core:
    """Core points of a component at one epoch: places (r, 3), distances (r,) and levels of detection (r,)."""

    places: Floats
    distance: Floats
    lod95: Floats

    @classmethod
    def of(cls, result: Result | None, rows: Ints | None) -> _Core:
        if result is None or rows is None:
            return cls(np.empty((0, 3)), np.empty(0), np.empty(0))
        core = result.core
        return cls(core.points[rows] + result.origin, core.distance[rows], core.lod95[rows])


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the mean deviation of each component, and that of its core point that changed most."""
    doubtful = np.array([one is not None and _unsure(one) for one in results], np.bool_)
    for name in dict.fromkeys(name for one in results if one is not None for name in one.bodies or (WHOLE,)):
        marked = [None if one is None else _of_body(one, name) for one in results]
        pairs = [_mean(one, rows) for one, rows in zip(results, marked, strict=True)]
        value, half = np.array(pairs).T
        yield Series(component=name, quantity=text("mean deviation"), value=value, ci95=half, doubtful=doubtful)
        yield from _strongest(name, results, marked, doubtful)


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what deviations of two epochs have in common."""
    if sum(result is not None for result in results) > 1:
        yield reason("epochs.registered-to-design")


def _unsure(result: Result) -> bool:
    return result.status in (Status.FAILED, Status.AMBIGUOUS) or result.registration_error_from is ErrorSource.UNKNOWN


def _of_body(result: Result, name: str) -> Ints:
    """Return the rows (r,) of the core points of a component that have a distance and a level of detection."""
    core = result.core
    known = np.isfinite(core.distance) & np.isfinite(core.lod95)
    if result.bodies:
        known &= core.body == (result.bodies.index(name) if name in result.bodies else -2)
    elif name != WHOLE:
        known[:] = False
    return np.flatnonzero(known)


def _mean(result: Result | None, rows: Ints | None) -> tuple[float, float]:
    if result is None or rows is None or not len(rows):
        return np.nan, np.nan
    return float(result.core.distance[rows].mean()), float(result.core.lod95[rows].mean())


def _strongest(
    name: str, results: Sequence[Result | None], marked: Sequence[Ints | None], doubtful: Flags
) -> Iterator[Series]:
    """Yield the deviation at the core point that changed most of those that all epochs with the component have."""
    known = [e for e, rows in enumerate(marked) if rows is not None and len(rows)]
    if len(known) < 2:
        return
    cores = [_Core.of(result, rows) for result, rows in zip(results, marked, strict=True)]
    first = cores[known[0]]
    common = np.arange(len(first.places))
    matched: dict[int, Ints] = {}
    for e in known:
        away, matched[e] = cKDTree(cores[e].places).query(first.places, distance_upper_bound=SAME_MM)
        common = common[np.isfinite(away[common])]
    if not len(common):
        return
    distance, lod95 = np.full((2, len(results), len(common)), np.nan)
    for e in known:
        rows = matched[e][common]
        distance[e], lod95[e] = cores[e].distance[rows], cores[e].lod95[rows]
    ratio = _ratios(distance[known], lod95[known])
    k = int(ratio.argmax())
    x, y, z = first.places[common[k]].tolist()
    quantity = text("deviation at {x:.0f}, {y:.0f}, {z:.0f}", x=x, y=y, z=z)
    yield Series(
        component=name, quantity=quantity, value=distance[:, k], ci95=lod95[:, k], doubtful=doubtful,
        chosen_from=len(common),
    )  # fmt: skip


def _ratios(distance: Floats, lod95: Floats) -> Floats:
    """Return the greatest change (k,) from the first epoch, by its half-width, of values (e, k)."""
    ratios: Floats = (np.abs(distance[1:] - distance[0]) / np.hypot(lod95[1:], lod95[0])).max(axis=0)
    return ratios
