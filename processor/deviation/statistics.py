"""What all core points say together: the share beyond its level of detection, with an interval."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.geometry.m3c2 import Z95, Distances
from processor.model import Floats

CELL = 2.0  # projection diameters: core points nearer to each other share points


@dataclass(frozen=True)
class Share:
    """A share of core points with its 95 % interval; NaN of none."""

    share: float
    low: float
    high: float


@dataclass(frozen=True)
class Summary:
    """Counts of core points, and figures of those with a level of detection; NaN where there is none."""

    core_points: int
    without_normal: int
    without_lod: int
    few_points: int  # of those with a level: fewer than 20 of either cloud in the cylinder
    significant: int
    significant_share: Share
    mean: float
    median: float
    sd: float
    rms: float
    min: float
    max: float
    lod95_median: float
    min_lod95: float = float("nan")  # of the core points where the least and the greatest distance are
    max_lod95: float = float("nan")


def of_distances(found: Distances, core: Floats, normals: Floats, projection_diameter_mm: float, few: int) -> Summary:
    """Summarise distances at core points (k, 3) with normals (k, 3)."""
    known = np.isfinite(found.lod95)
    distance = found.distance[known]
    beyond = found.significant[known]

    def figure(of: str) -> float:
        return float(getattr(np, of)(distance)) if len(distance) else float("nan")

    return Summary(
        core_points=len(core),
        without_normal=int((~np.isfinite(normals).all(axis=1)).sum()),
        without_lod=int((~known).sum()),
        few_points=int((np.minimum(found.n1, found.n2)[known] < few).sum()),
        significant=int(beyond.sum()),
        significant_share=share(beyond, core[known], CELL * projection_diameter_mm),
        mean=figure("mean"),
        median=figure("median"),
        sd=figure("std"),
        rms=float(np.sqrt(np.mean(distance**2))) if len(distance) else float("nan"),
        min=figure("min"),
        max=figure("max"),
        lod95_median=float(np.median(found.lod95[known])) if known.any() else float("nan"),
        min_lod95=float(found.lod95[known][np.argmin(distance)]) if len(distance) else float("nan"),
        max_lod95=float(found.lod95[known][np.argmax(distance)]) if len(distance) else float("nan"),
    )


def share(which: npt.NDArray[np.bool_], places: Floats, cell: float) -> Share:
    """Share of places (k, 3) that are marked (k,), and Wilson's interval for as many of them as are independent.

    How many are is told by how the marks vary from cell to cell: neighbours share points, so they agree.
    """
    if not len(which):
        return Share(float("nan"), float("nan"), float("nan"))
    p = float(which.mean())
    number = np.unique(np.floor((places - places.min(axis=0)) / cell).astype(np.int64), axis=0, return_inverse=True)[1]
    sums = np.bincount(number.reshape(-1), which - p)
    cells = len(sums)
    variance = float(sums @ sums) / len(which) ** 2 * cells / max(cells - 1, 1)
    count = min(max(p * (1.0 - p) / variance, 1.0), float(len(which))) if variance > 0.0 else float(cells)
    middle = (p + Z95**2 / (2.0 * count)) / (1.0 + Z95**2 / count)
    half = Z95 / (1.0 + Z95**2 / count) * math.sqrt(p * (1.0 - p) / count + Z95**2 / (4.0 * count**2))
    return Share(p, max(0.0, min(p, middle - half)), min(1.0, max(p, middle + half)))
