"""Scan statistic: significant deviations in windows of every size, with a bound on false alarms.

Square windows of many sizes are moved over each face in steps of a quarter of their side. The weighted mean of a window
is compared with its standard deviation. The threshold of a size follows from the number of windows of that size on the
surface by Bonferroni's bound, so that all sizes together keep the rate of false alarms. Noise that is correlated
between points shows in the scatter of the windows' means, and raises the thresholds. A variance that few points show is
widened to Student's t at the threshold.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.special import ndtr, ndtri, stdtrit

from processor.defects.deviation_field import Field
from processor.defects.surface_charts import CYLINDER
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import robust_sd_about_median

SIDES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # of windows, in cells
COVERED = 0.5  # share of a window that must have been seen
FEWEST_WINDOWS = 60  # to estimate a scatter from
GROWTH = 2.5  # standard deviations of a window of half the size, that cells of a region exceed
PIECE_SHARE = 0.3  # of the largest piece within the same windows
LINES_AFTER = 4  # side of the windows after which lines are searched
LINE_CELLS, LINE_TURNS = (10, 25), 8  # chosen: lengths of cracks; 8 turns: none of 10 cells is off by one
LINE_GROWTH = 0.7  # standard deviations of a cell, that cells of a line exceed
EIGHT_NEIGHBOURS = np.ones((3, 3))  # cells that touch at a corner are connected


@dataclass(frozen=True)
class Levels:
    """Levels of significance by size of window (k,).

    ``sides`` in cells; ``inflation`` of the noise over that of single points; ``common`` (k,), the standard deviation
    of means that the same scatter would be independent of the number of points, mm; ``threshold`` in standard
    deviations; ``per_mm2``, the number of windows on one mm2, times the number of sizes.
    """

    sides: tuple[int, ...]
    inflation: Floats
    common: Floats
    threshold: Floats
    per_mm2: Floats
    line_threshold: float
    line_per_mm2: float
    line_inflation: float
    line_common: float
    systematic_mm: float


@dataclass(frozen=True)
class Finding:
    """Cells (cells,) of significant windows, inward -1 and outward 1, and the largest z there.

    ``chance`` is the expected number of false alarms as strong as the strongest there on one mm2.
    """

    sign: npt.NDArray[np.int8]
    z: Floats
    chance: Floats


def levels_of(field: Field, alarms_per_mm2: float, systematic_mm: float) -> Levels:
    """Return the thresholds for a field, and by how much its noise exceeds that of independent points."""
    charts = field.surface.charts
    used = _used(field)
    sides = tuple(side for side in SIDES if any(side <= charts.shape[k].min() for k in used)) or (1,)
    scatter: list[tuple[float, float]] = []
    for side in sides:
        z, sd = _windows(field, used, side)
        scatter.append(_scatter(z, sd, field.views) if len(z) >= FEWEST_WINDOWS else (scatter or [(1.0, 0.0)])[-1])
    inflation, common = np.array(scatter, float).T
    line_inflation, line_common = _line_scatter(field, used)
    cell = charts.cell_mm
    kinds = len(sides) + len(LINE_CELLS)
    windows = kinds / np.array([max(1, side // 4) * cell for side in sides]) ** 2
    lines = kinds * LINE_TURNS / cell**2
    return Levels(
        sides=sides,
        inflation=np.maximum.accumulate(inflation),
        common=common,
        threshold=-ndtri(0.5 * np.minimum(alarms_per_mm2 / windows, 0.5)),
        per_mm2=windows,
        line_threshold=-float(ndtri(0.5 * min(alarms_per_mm2 / lines, 0.5))),
        line_per_mm2=lines,
        line_inflation=line_inflation,
        line_common=line_common,
        systematic_mm=systematic_mm,
    )


def search(field: Field, levels: Levels) -> Finding:
    """Search from small windows to large; cells of a region do not count in larger windows.

    ``field`` is that of :func:`widened`.
    """
    count = len(field.deviation)
    finding = Finding(np.zeros(count, np.int8), np.zeros(count), np.full(count, np.inf))
    for chart in _used(field):
        rows = field.surface.charts.cells(chart)
        of_chart = _search_chart(field, chart, levels)
        finding.sign[rows] = of_chart.sign.ravel()
        finding.z[rows] = of_chart.z.ravel()
        finding.chance[rows] = of_chart.chance.ravel()
    return finding


def widened(field: Field, levels: Levels) -> Field:
    """Return the field with the variances by which a cell exceeds its threshold as often as Student's t does."""
    if not len(field.dof):
        return field
    threshold = float(levels.threshold[0])
    student = -stdtrit(np.maximum(field.dof, 1.0), ndtr(-threshold))
    return dataclasses.replace(field, variance=field.variance * (student / threshold) ** 2)


def mean_sd(weight: Any, inflation: Any, common: Any, field: Field, levels: Levels) -> Any:
    """Return the standard deviation of means of cells, mm: noise, differences of unnamed views, systematic errors.

    ``weight`` are sums of the inverse variances of cells. What means scatter more than by these is noise that is
    ``inflation`` times as large, as by correlated points, or ``common`` mm, as by bias of a paint or an incidence,
    which more points do not reduce: the larger of both counts.
    """
    noise = np.maximum(inflation / np.sqrt(weight), np.hypot(1.0 / np.sqrt(weight), common))
    return np.hypot(noise, np.hypot(levels.systematic_mm, field.views))


def _used(field: Field) -> list[int]:
    """Return the charts with observed cells."""
    charts = field.surface.charts
    return [k for k in range(len(charts.kind)) if field.seen[charts.cells(k)].any()]


def _windows(field: Field, used: list[int], side: int) -> tuple[Floats, Floats]:
    """Return the means of all windows of a size by their formal standard deviation, and that standard deviation."""
    z, sd = [np.empty(0)], [np.empty(0)]
    for chart in used:
        top, weight = _window_sums(field, chart, side, None)
        z.append((top / np.sqrt(np.maximum(weight, 1e-30)))[weight > 0.0])
        sd.append(1.0 / np.sqrt(weight[weight > 0.0]))
    return np.concatenate(z), np.concatenate(sd)


def _scatter(z: Floats, sd: Floats, views_mm: float) -> tuple[float, float]:
    """Return by how much means scatter more than by their formal standard deviations (n,) and by unnamed views.

    As a factor on these, and as a standard deviation of its own, mm.
    """
    typical = float(np.median(sd))
    surplus = max(robust_sd_about_median(z) ** 2 - 1.0 - (views_mm / typical) ** 2, 0.0)
    return float(np.sqrt(1.0 + surplus)), float(np.sqrt(surplus)) * typical


def _search_chart(field: Field, chart: int, levels: Levels) -> Finding:
    """Search a face; the arrays of the finding have its shape."""
    shape = tuple(field.surface.charts.shape[chart])
    finding = Finding(np.zeros(shape, np.int8), np.zeros(shape), np.full(shape, np.inf))
    sign = finding.sign
    for side, inflation, common, threshold, per_mm2 in zip(
        levels.sides, levels.inflation, levels.common, levels.threshold, levels.per_mm2, strict=True
    ):
        if side > min(shape):
            break
        top, weight = _window_sums(field, chart, side, sign != 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(weight > 0.0, top / weight / mean_sd(weight, inflation, common, field, levels), 0.0)
        if side == LINES_AFTER:
            _search_lines(field, chart, levels, finding)
        if not (np.abs(z) > threshold).any():
            continue
        small_top, small_weight = _smoothed(field, chart, max(1, side // 2), sign != 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            small_sd = np.hypot(inflation / np.sqrt(small_weight), field.views)
            local_z = np.where(small_weight > 0.0, small_top / small_weight / small_sd, 0.0)
        for direction in (-1, 1):
            hits = direction * z > threshold
            if not hits.any():
                continue
            # What views differ by raises the threshold alike for the middle of a region and for what is around it.
            least = GROWTH if field.views else threshold
            covered, best = _spread(np.where(direction * z > least, direction * z, 0.0), side, shape)
            grown = covered & (direction * local_z > GROWTH) & (sign == 0)
            grown = _whole_pieces(_pieces_with(grown, best > threshold), covered)
            sign[grown] = direction
            finding.z[grown] = best[grown]
            finding.chance[grown] = 2.0 * ndtr(-best[grown]) * per_mm2
    return finding


def _search_lines(field: Field, chart: int, levels: Levels, finding: Finding) -> None:
    """Search lines of cells in LINE_TURNS directions, for what is narrower than a window and long; add to a finding."""
    top, weight = _images(field, chart, finding.sign != 0)
    score = top / np.sqrt(np.maximum(weight, 1e-30))
    margin = max(LINE_CELLS)
    padded = np.pad(np.stack([top, weight, weight > 0.0]), ((0, 0), (margin, margin), (margin, margin)))
    for length in LINE_CELLS:
        if length > max(top.shape):
            continue
        for turn in range(LINE_TURNS):
            offsets = _line(length, np.pi * turn / LINE_TURNS)
            sum_top, sum_weight, number = _along(padded, margin, offsets)
            with np.errstate(invalid="ignore", divide="ignore"):
                sd = mean_sd(sum_weight, levels.line_inflation, levels.line_common, field, levels)
                z = np.where(number >= COVERED * length, sum_top / sum_weight / sd, 0.0)
            for direction in (-1, 1):
                towards = direction * score
                for i, j in np.argwhere(direction * z > levels.line_threshold):
                    a, b = _long_runs(towards, np.add(offsets, (i, j))).T
                    strongest = direction * z[i, j]
                    finding.sign[a, b] = direction
                    finding.z[a, b] = np.maximum(finding.z[a, b], strongest)
                    chance = 2.0 * ndtr(-strongest) * levels.line_per_mm2
                    finding.chance[a, b] = np.minimum(finding.chance[a, b], chance)


def _long_runs(score: Floats, cells: Ints) -> Ints:
    """Return a line's cells (n, 2) whose ``score`` (rows, columns) deviates, without runs far below the longest.

    A line that crosses a region has deviating cells beyond it by chance, which are no regions of their own.
    """
    inside = ((cells >= 0) & (cells < score.shape)).all(axis=1)
    deviate = np.zeros(len(cells), np.bool_)
    deviate[inside] = score[tuple(cells[inside].T)] > LINE_GROWTH
    run, count = ndimage.label(deviate)
    sizes = np.bincount(run, minlength=count + 1)
    sizes[0] = 0
    long: Ints = cells[deviate & (sizes[run] >= PIECE_SHARE * sizes.max())]
    return long


def _line_scatter(field: Field, used: list[int]) -> tuple[float, float]:
    """Return by how much the means of lines along the grid scatter more than by independent noise; see _scatter."""
    scores, sds = [np.empty(0)], [np.empty(0)]
    for chart in used:
        top, weight = _images(field, chart, None)
        for axis in (0, 1):
            length = min(LINE_CELLS[-1], top.shape[axis])
            sum_top, sum_weight, number = (
                ndimage.uniform_filter1d(x, length, axis=axis, mode="constant") * length
                for x in (top, weight, (weight > 0.0).astype(float))
            )
            enough = number >= COVERED * length
            sds.append(1.0 / np.sqrt(sum_weight[enough]))
            scores.append(sum_top[enough] * sds[-1])
    z = np.concatenate(scores)
    return _scatter(z, np.concatenate(sds), field.views) if len(z) >= FEWEST_WINDOWS else (1.0, 0.0)


def _line(length: int, angle: float) -> list[tuple[int, int]]:
    """Return the cells of a line through a cell, as offsets from it."""
    at = np.arange(length) - length // 2
    steep = max(abs(np.cos(angle)), abs(np.sin(angle)))
    steps = np.stack([np.round(at * np.cos(angle) / steep), np.round(at * np.sin(angle) / steep)], axis=1)
    return [(int(i), int(j)) for i, j in steps]


def _along(padded: Floats, margin: int, offsets: list[tuple[int, int]]) -> Floats:
    """Sum images (k, n, m), ``padded`` by a margin, over the cells at ``offsets`` from each of their cells."""
    rows, columns = (length - 2 * margin for length in padded.shape[1:])
    total = np.zeros((len(padded), rows, columns))
    for i, j in offsets:
        total += padded[:, margin + i : margin + i + rows, margin + j : margin + j + columns]
    return total


def _whole_pieces(cells: Bools, windows: Bools) -> Bools:
    """Return cells without the small pieces within connected windows, which are no regions of their own."""
    label, count = ndimage.label(cells, EIGHT_NEIGHBOURS)
    if count < 2:
        return cells
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    cluster = ndimage.label(windows, EIGHT_NEIGHBOURS)[0]
    cluster_of = np.zeros(count + 1, np.int64)
    cluster_of[label.ravel()] = cluster.ravel()
    largest = np.zeros(int(cluster.max()) + 1, np.int64)
    np.maximum.at(largest, cluster_of[1:], sizes[1:])
    large = np.concatenate([[False], sizes[1:] >= PIECE_SHARE * largest[cluster_of[1:]]])
    pieces: Bools = large[label]
    return pieces


def _pieces_with(cells: Bools, some: Bools) -> Bools:
    """Return the connected pieces of cells that have some of the given ones."""
    label, count = ndimage.label(cells, EIGHT_NEIGHBOURS)
    held = np.zeros(count + 1, np.bool_)
    held[label[some]] = True
    held[0] = False
    pieces: Bools = held[label]
    return pieces


def _images(field: Field, chart: int, without: Bools | None) -> tuple[Floats, Floats]:
    """Return images of weighted deviations and of weights."""
    charts = field.surface.charts
    weight = charts.image(field.seen / field.variance, chart)
    if without is not None:
        weight = np.where(without, 0.0, weight)
    return weight * charts.image(field.deviation, chart), weight


def _window_sums(field: Field, chart: int, side: int, without: Bools | None) -> tuple[Floats, Floats]:
    """Return sums of weighted deviations and of weights over a face's windows; 0 where too little was seen."""
    step = max(1, side // 4)
    top, weight = _images(field, chart, without)
    if min(top.shape) < side:
        return np.zeros(0), np.zeros(0)
    sums = [_sums(x, side)[::step, ::step] for x in (top, weight, (weight > 0.0).astype(float))]
    enough = sums[2] >= COVERED * side**2
    return np.where(enough, sums[0], 0.0), np.where(enough, sums[1], 0.0)


def _sums(image: Floats, side: int) -> Floats:
    total = np.pad(image, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    sums: Floats = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    return sums


def _smoothed(field: Field, chart: int, side: int, without: Bools) -> tuple[Floats, Floats]:
    """Return sums of weighted deviations and of weights over the window about each cell."""
    mode = ("constant", "wrap" if field.surface.charts.kind[chart] == CYLINDER else "constant")
    top, weight = (ndimage.uniform_filter(x, side, mode=mode) * side**2 for x in _images(field, chart, without))
    return top, np.where(weight > 1e-9, weight, 0.0)


def _spread(hits: Floats, side: int, shape: tuple[int, ...]) -> tuple[Bools, Floats]:
    """Return the cells covered by windows, given by their values at their first corners, and the largest value."""
    step = max(1, side // 4)
    full = np.zeros(shape)
    full[: hits.shape[0] * step : step, : hits.shape[1] * step : step][: hits.shape[0], : hits.shape[1]] = hits
    # A window covers cells from its corner on: the largest value of corners up to ``side`` cells before.
    best = ndimage.maximum_filter(full, size=side, origin=(side - 1) // 2, mode="constant")
    return best > 0.0, best
