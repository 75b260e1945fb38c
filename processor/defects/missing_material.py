"""Places of the surface that a scanner should have seen and that are not there.

A cell is expected from a station that looks at it squarely enough, that saw other parts of the same face, and whose
rays in this direction met nothing on their way. How many points to expect follows from the points by solid angle of
that station. Where far fewer are there, the surface is missing. Where rays were stopped before, nothing is said.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from processor.defects.alignment import chart_of_cells
from processor.defects.observations import CHUNK, Pairs, Stations
from processor.defects.surface_charts import DesignSurface
from processor.geometry import rigid
from processor.model import Floats, Ints, Scene

SQUARE_COS = 0.34
NEARER_MM = 100.0  # than the surface: something in the way
LEAST_BIN_RAD = 0.003
BIN_STEPS = 5.0  # of a scanner in a bin of directions
SAME_FACE = 0.2  # share of a face's cells seen by a station, from which on the rest is expected
FIELD_MARGIN_RAD = 0.02


@dataclass(frozen=True)
class Expected:
    """Points (cells,) that should be there, and whether rays from any station went on behind the cell."""

    points: Floats
    passed: Floats


def expected(
    scene: Scene, T_design_project: Floats, pairs: Pairs, surface: DesignSurface, stations: Stations
) -> Expected:
    """Return how many points all stations together should have on every cell."""
    cells = len(surface.share)
    found, passed = np.zeros(cells), np.zeros(cells)
    chart = chart_of_cells(surface)
    charts = len(surface.charts.kind)
    area = surface.share * surface.charts.cell_mm**2
    whole = np.bincount(chart, surface.share > 0.5, charts)
    rows_of = _rows(pairs, len(stations.names))
    for k, position in enumerate(stations.positions):
        if not np.isfinite(position).all() or not len(rows_of[k]):
            continue
        own = pairs.cell[rows_of[k]]
        count = (pairs.count + pairs.stray)[rows_of[k]]
        usual = np.bincount(chart[own], minlength=charts) >= SAME_FACE * np.maximum(whole, 1)
        cell = np.flatnonzero(usual[chart] & (surface.share > 0.05))
        arm = surface.centres[cell] - position
        away = np.linalg.norm(arm, axis=1)
        cosine = -np.einsum("ni,ni->n", arm, surface.outward[cell]) / away
        keep = cosine > SQUARE_COS
        cell, arm, away, cosine = cell[keep], arm[keep], away[keep], cosine[keep]
        if not len(cell):
            continue
        angle = area[cell] * cosine / away**2
        got = np.zeros(cells)
        got[own] = count
        there = got[cell] > 0
        if there.sum() < 10:
            continue
        density = float(np.median(got[cell][there] / angle[there]))
        bin_ = max(LEAST_BIN_RAD, BIN_STEPS / np.sqrt(density))
        nearest, farthest, inside = _ranges(scene, T_design_project, k, stations, bin_, arm)
        slack = NEARER_MM + 3.0 * bin_ * away * np.sqrt(1.0 - cosine**2) / cosine
        clear = inside & ~(nearest < away - slack)
        found[cell[clear]] += density * angle[clear]
        passed[cell[clear & (farthest > away + slack)]] = 1.0
    return Expected(found, passed)


def _rows(pairs: Pairs, stations: int) -> list[Ints]:
    order = np.argsort(pairs.station, kind="stable")
    at = np.searchsorted(pairs.station[order], np.arange(stations + 1))
    return [order[at[k] : at[k + 1]] for k in range(stations)]


def directions(arm: Floats) -> tuple[Floats, Floats]:
    """Azimuth and elevation (n,), rad."""
    return np.arctan2(arm[:, 1], arm[:, 0]), np.arctan2(arm[:, 2], np.hypot(arm[:, 0], arm[:, 1]))


def _ranges(
    scene: Scene, T_design_project: Floats, station: int, stations: Stations, bin_: float, arm: Floats
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return the nearest and farthest range about the directions arm (n, 3), and whether a station looked there."""
    wide, high = int(np.ceil(2.0 * np.pi / bin_)), int(np.ceil(np.pi / bin_))
    near, far = np.full(wide * high, np.inf), np.full(wide * high, -np.inf)
    low_high = [np.inf, -np.inf]
    columns = np.zeros(wide, bool)
    for points in points_of(scene, T_design_project, station):
        local = points - stations.positions[station]
        azimuth, elevation = directions(local)
        away = np.linalg.norm(local, axis=1)
        i = np.minimum((azimuth + np.pi) / bin_, wide - 1).astype(np.int64)
        j = np.minimum((elevation + 0.5 * np.pi) / bin_, high - 1).astype(np.int64)
        np.minimum.at(near, i * high + j, away)
        np.maximum.at(far, i * high + j, away)
        columns[i] = True
        low_high = [min(low_high[0], float(elevation.min())), max(low_high[1], float(elevation.max()))]
    near = ndimage.minimum_filter(near.reshape(wide, high), 3, mode=("wrap", "nearest"))
    far = ndimage.maximum_filter(far.reshape(wide, high), 3, mode=("wrap", "nearest"))
    azimuth, elevation = directions(arm)
    i = np.minimum((azimuth + np.pi) / bin_, wide - 1).astype(np.int64)
    j = np.minimum((elevation + 0.5 * np.pi) / bin_, high - 1).astype(np.int64)
    # Columns without any return are where it did not look, but for gaps no wider than structures leave between them.
    gap = int(0.5 / bin_)
    looked = ndimage.binary_closing(np.tile(columns, 3), np.ones(max(1, gap)))[wide : 2 * wide] | columns
    inside = looked[i] & (elevation > low_high[0] - FIELD_MARGIN_RAD) & (elevation < low_high[1] + FIELD_MARGIN_RAD)
    return near[i, j], far[i, j], inside


def points_of(scene: Scene, T_design_project: Floats, station: int) -> Iterator[Floats]:
    """Give the points of a station, in the design's frame, some at a time."""
    first = 0
    for scan in scene.scans:
        T = T_design_project @ (scan.T_project_scan if scan.T_project_scan.size else np.eye(4))
        T = rigid.transform(T[:3, :3], T[:3, :3] @ scan.origin + T[:3, 3])
        many = 1
        if not scan.position.size and scene.stations is not None and len(scan.point_station):
            many = len(scene.stations.ids) + 1
        if first <= station < first + many:
            for start in range(0, len(scan.points), CHUNK):
                rows = slice(start, start + CHUNK)
                points = scan.points[rows]
                if many > 1:
                    points = points[scan.point_station[rows] == station - first]
                if len(points):
                    yield rigid.apply(T, points)
        first += many
