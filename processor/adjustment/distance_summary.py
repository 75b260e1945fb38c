"""Statistics of the distances at core points, with 95 % intervals.

The share of significant distances has Wilson's interval for the effective number of core points; the least and the
greatest distance have intervals that hold for the extreme of all of them, see :mod:`maximum_interval`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor import large_arrays
from processor.adjustment import maximum_interval
from processor.distinct_rows import distinct
from processor.geometry.m3c2 import Z95, Distances
from processor.large_arrays import allocate, blocks, chosen, total
from processor.model import Bools, Floats, Ints

UNKNOWN = (math.nan, math.nan)
SHARE_CELL = 2.0  # projection diameters: core points nearer to each other share points


@dataclass(frozen=True)
class Share:
    """A share of core points with its 95 % interval; NaN for no core points."""

    share: float
    low: float
    high: float


@dataclass(frozen=True)
class Summary:
    """Numbers of core points, and statistics of those with a level of detection; NaN where there is none."""

    core_points: int
    without_normal: int
    without_lod: int
    few_points: int  # core points with a level of detection and few points of either cloud in the cylinder
    significant: int
    significant_share: Share
    mean: float = math.nan
    median: float = math.nan
    sd: float = math.nan
    rms: float = math.nan
    min: float = math.nan
    max: float = math.nan
    lod95_median: float = math.nan
    min_ci95: tuple[float, float] = UNKNOWN
    max_ci95: tuple[float, float] = UNKNOWN


def of_distances(
    measured: Distances, core: Floats, normals: Floats, projection_diameter_mm: float, few: int
) -> Summary:
    """Summarise distances at core points (k, 3) with normals (k, 3); fewer than ``few`` points count as few."""
    known, beyond = (allocate(len(core), dtype=np.bool_) for _ in range(2))
    without_normal = few_points = 0
    for rows in blocks(len(core)):
        known[rows] = np.isfinite(measured.lod95[rows])
        beyond[rows] = measured.take(rows).significant
        without_normal += int((~np.isfinite(normals[rows]).all(axis=1)).sum())
        few_points += int((np.minimum(measured.n1[rows], measured.n2[rows])[known[rows]] < few).sum())
    distance, lod95, places = (chosen(column, known) for column in (measured.distance, measured.lod95, core))
    significant = chosen(beyond, known)
    return Summary(
        core_points=len(core),
        without_normal=without_normal,
        without_lod=len(core) - len(distance),
        few_points=few_points,
        significant=int(np.count_nonzero(significant)),
        significant_share=share(significant, places, SHARE_CELL * projection_diameter_mm),
        **(_figures(distance, lod95) if len(distance) else {}),
    )


def _figures(distance: Floats, lod95: Floats) -> dict[str, Any]:
    """Return the statistics, by field of Summary, of distances (k,) with levels of detection (k,), k > 0."""
    count = len(distance)
    mean = total(distance) / count
    low, *of_low = maximum_interval.of_extreme(distance, lod95, 1.0 / Z95, sign=-1)
    high, *of_high = maximum_interval.of_extreme(distance, lod95, 1.0 / Z95, sign=1)
    return {
        "mean": mean,
        "median": large_arrays.median(distance),
        "sd": math.sqrt(total(distance, lambda part: (part - mean) ** 2) / count),
        "rms": math.sqrt(total(distance, np.square) / count),
        "min": low,
        "max": high,
        "lod95_median": large_arrays.median(lod95),
        "min_ci95": tuple(of_low),
        "max_ci95": tuple(of_high),
    }


def share(marked: Bools, places: Floats, cell: float) -> Share:
    """Share of places (k, 3) that are ``marked`` (k,), with Wilson's interval for the effective number of places.

    Neighbouring places share points and so agree. The effective number follows from how the marks vary between cells.
    """
    if not len(marked):
        return Share(math.nan, math.nan, math.nan)
    p = int(np.count_nonzero(marked)) / len(marked)
    low = large_arrays.corners(places)[0]

    def cells_of(rows: slice) -> Ints:
        return np.floor((places[rows] - low) / cell).astype(np.int64)

    filled = np.empty((0, 3), np.int64)
    for rows in blocks(len(marked)):
        filled = distinct(np.concatenate([filled, distinct(cells_of(rows)).rows])).rows
    cells = len(filled)
    sums = np.zeros(cells)
    for rows in blocks(len(marked)):  # added in the order of the rows, whatever the blocks are
        number = distinct(np.concatenate([filled, cells_of(rows)])).number[cells:]
        np.add.at(sums, number, marked[rows] - p)
    variance = float(sums @ sums) / len(marked) ** 2 * cells / max(cells - 1, 1)
    count = min(max(p * (1.0 - p) / variance, 1.0), float(len(marked))) if variance > 0.0 else float(cells)
    middle = (p + Z95**2 / (2.0 * count)) / (1.0 + Z95**2 / count)
    half = Z95 / (1.0 + Z95**2 / count) * math.sqrt(p * (1.0 - p) / count + Z95**2 / (4.0 * count**2))
    return Share(p, max(0.0, min(p, middle - half)), min(1.0, max(p, middle + half)))
