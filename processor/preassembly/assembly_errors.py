"""Splicing error and linear error of an assembled bridge (paper 000, section 2.8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import Floats

INTERVAL_MM = 200.0  # of chainage, at which the linear error is taken


@dataclass(frozen=True)
class BottomEdges:
    """The bottom edges of a part: as scanned (k, 3), (m, 3) in the scan's frame; as designed in the bridge's frame."""

    left: Floats
    right: Floats
    design_left: Polyline
    design_right: Polyline


@dataclass(frozen=True)
class LinearError:
    """Vectors (n, 3), mm, from the design's bottom edges to the assembled ones at chainages (n,); NaN = no points."""

    chainage: Floats
    edge: tuple[str, ...]
    vector: Floats

    @property
    def deviation(self) -> Floats:
        """Distances (n,); NaN without points."""
        distance: Floats = np.linalg.norm(self.vector, axis=1)
        return distance

    @property
    def mean(self) -> float:
        """Mean over all chainages of both edges that have points; NaN without any."""
        return mean_max(self.deviation)[0]

    @property
    def max(self) -> float:
        """Largest over all chainages of both edges that have points; NaN without any."""
        return mean_max(self.deviation)[1]


def mean_max(values: Floats) -> tuple[float, float]:
    """Mean and maximum of the values that are known; NaN without any."""
    known = values[np.isfinite(values)]
    return (float(known.mean()), float(known.max())) if len(known) else (float("nan"), float("nan"))


def splicing_error(gaps: Floats) -> tuple[float, float]:
    """Mean and maximum of |d| over joints, the 8 point pairs and the 3 axes of gaps (j, 8, 3); NaN left out."""
    return mean_max(np.abs(gaps))


def linear_error(parts: list[BottomEdges], poses: list[Floats]) -> LinearError:
    """Linear error of parts at poses T_bridge_scan, in intervals of 200 mm of both edges.

    The chainages are those of the design, NaN where no scanned point is near. The deviation is the length of the median
    vector (by component) from the design's edge to the scanned points of the interval: single distances would all be
    positive and never fall below the noise, and near a joint some points are of its end face.
    """
    chainages: list[float] = []
    edges: list[str] = []
    vectors: list[Floats] = []
    for edge in ("left", "right"):
        start = 0.0
        for part, pose in zip(parts, poses, strict=True):
            design: Polyline = getattr(part, f"design_{edge}")
            of_part = _median_vectors(getattr(part, edge), pose, design)
            chainages += [start + (interval + 0.5) * INTERVAL_MM for interval in range(len(of_part))]
            edges += [edge] * len(of_part)
            vectors.append(of_part)
            start += design.length
    return LinearError(np.array(chainages), tuple(edges), np.vstack(vectors))


def _median_vectors(points: Floats, pose: Floats, design: Polyline) -> Floats:
    """Median vector (k, 3) from one edge of the design to points (n, 3) at a pose, an interval a row."""
    vectors = np.full((int(np.ceil(design.length / INTERVAL_MM)), 3), np.nan)
    if len(points) and np.isfinite(pose).all():
        s, offset = design.nearest(rigid.apply(pose, points))
        inner = (s > 0.0) & (s < design.length)  # beyond the ends the vector is not square to the edge
        interval = np.floor(s[inner] / INTERVAL_MM).astype(np.int64)
        for k in np.unique(interval):
            vectors[k] = np.median(offset[inner][interval == k], axis=0)
    return vectors
