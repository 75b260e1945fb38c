"""Splicing error and linear error of an assembled bridge (paper 000, section 2.8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.polyline import Polyline
from processor.model import Floats

STATION_MM = 200.0


@dataclass(frozen=True)
class BottomEdges:
    """The bottom edges of a part: as scanned (k, 3), (m, 3) in the scan's frame; as designed in the bridge's frame."""

    left: Floats
    right: Floats
    design_left: Polyline
    design_right: Polyline


@dataclass(frozen=True)
class LinearError:
    """How the assembled edges lie beside the design's, (n, 3) in mm, at stations of the arc length along each edge."""

    station: Floats
    edge: tuple[str, ...]
    vector: Floats

    @property
    def deviation(self) -> Floats:
        """Distances (n,); NaN without points."""
        found: Floats = np.linalg.norm(self.vector, axis=1)
        return found

    @property
    def mean(self) -> float:
        """Mean over all stations of both edges that have points; NaN without any."""
        known = self.deviation[np.isfinite(self.deviation)]
        return float(np.mean(known)) if len(known) else float("nan")

    @property
    def max(self) -> float:
        """Largest over all stations of both edges that have points; NaN without any."""
        known = self.deviation[np.isfinite(self.deviation)]
        return float(np.max(known)) if len(known) else float("nan")


def linear_error(parts: list[BottomEdges], poses: list[Floats]) -> LinearError:
    """Linear error of parts at poses T_bridge_scan, a station every 200 mm of both edges.

    The stations are those of the design, NaN where no scanned point is near. The deviation at a station is the length
    of the median vector (by component) from the design's edge to the scanned points of the 200 mm around: single
    distances would all be positive and never fall below the noise, and near a joint some points are of its end face.
    """
    stations: list[float] = []
    edges: list[str] = []
    every: list[Floats] = []
    for edge in ("left", "right"):
        before = 0.0
        for part, pose in zip(parts, poses, strict=True):
            design: Polyline = getattr(part, f"design_{edge}")
            points: Floats = getattr(part, edge)
            count = int(np.ceil(design.length / STATION_MM))
            vectors = np.full((count, 3), np.nan)
            if len(points) and np.isfinite(pose).all():
                s, offset = design.nearest(rigid.apply(pose, points))
                inner = (s > 0.0) & (s < design.length)  # beyond the ends the vector is not square to the edge
                cell = np.floor(s[inner] / STATION_MM).astype(np.int64)
                for c in np.unique(cell):
                    vectors[c] = np.median(offset[inner][cell == c], axis=0)
            stations += [before + (c + 0.5) * STATION_MM for c in range(count)]
            edges += [edge] * count
            every.append(vectors)
            before += design.length
    return LinearError(np.array(stations), tuple(edges), np.vstack(every))


def gaps(left: Floats, right: Floats, T_left: Floats, T_right: Floats) -> Floats:
    """Gap vectors (8, 3) of P1..P8: right part minus left part at the assembled pose, bridge axes, mm."""
    return rigid.apply(T_right, right) - rigid.apply(T_left, left)


def splicing_error(all_gaps: Floats) -> tuple[float, float]:
    """Mean and maximum of |d| over joints, the 8 point pairs and the 3 axes of gaps (j, 8, 3); NaN left out."""
    size = np.abs(all_gaps)
    if not np.isfinite(size).any():
        return float("nan"), float("nan")
    return float(np.nanmean(size)), float(np.nanmax(size))
