"""Places where deviations are more than chance, at every size of place, with a bound on how often chance does it.

Square windows of many sizes are moved over every face in quarters of their side. Of each the weighted mean is held
against its noise; the threshold of a size follows from the number of windows of that size on the surface by the bound
of Bonferroni, so that all sizes together bring the false alarms that were asked for. Noise that is not independent from
point to point shows in the spread of the windows' means, and widens the thresholds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.special import ndtr, ndtri

from processor.defects.deviation_field import Field
from processor.defects.surface_charts import CYLINDER, Charts, DesignSurface
from processor.model import Floats

Bools = npt.NDArray[np.bool_]
SIDES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # of windows, in cells
COVERED = 0.5  # share of a window that must have been seen
FEWEST_WINDOWS = 60  # by which a spread is told
GROWTH = 2.5  # standard deviations of a window of half the size that cells about a finding exceed
PIECE_SHARE = 0.3  # of the largest piece that is found in the same windows
LINES_AFTER = 4  # the side of windows, after which lines are looked for
LINE_CELLS, LINE_TURNS = (10, 25), 8
LINE_GROWTH = 0.7  # standard deviations of a cell on such a line


@dataclass(frozen=True)
class Levels:
    """Of each size of window (k,): its side in cells, by how much noise is larger than formal, and the threshold.

    ``common_mm`` is the standard deviation that means of the largest windows keep, however many points they hold;
    ``per_mm2`` how many windows of all sizes chance may draw from on one mm2, were all of them of this one.
    """

    sides: tuple[int, ...]
    inflation: Floats
    threshold: Floats
    per_mm2: Floats
    common_mm: float
    line_threshold: float
    line_per_mm2: float
    line_inflation: float
    systematic_mm: float


@dataclass(frozen=True)
class Finding:
    """Cells (cells,) that a significant window lies on, inward -1 and outward 1, and the largest |z| there.

    ``chance`` is how many windows as strong as the strongest there chance brings on one mm2.
    """

    sign: npt.NDArray[np.int8]
    z: Floats
    chance: Floats


def levels_of(field: Field, surface: DesignSurface, alarms_per_mm2: float, systematic_mm: float) -> Levels:
    """Find the thresholds for a field, and how much its noise exceeds what is formal."""
    charts = surface.charts
    used = _used(field, charts)
    sides = tuple(side for side in SIDES if any(side <= charts.shape[k].min() for k in used)) or (1,)
    spread: list[float] = []
    common = 0.0
    for side in sides:
        z, formal = [np.empty(0)], [np.empty(0)]
        for chart in used:
            top, weight = _window_sums(field, charts, chart, side, None)
            z.append((top / np.sqrt(np.maximum(weight, 1e-30)))[weight > 0.0])
            formal.append(1.0 / np.sqrt(weight[weight > 0.0]))
        all_z, sd = np.concatenate(z), np.concatenate(formal)
        if len(all_z) < FEWEST_WINDOWS:
            spread.append(spread[-1] if spread else 1.0)
            continue
        own = 1.4826 * float(np.median(np.abs(all_z - np.median(all_z))))
        spread.append(max(1.0, own))
        common = float(np.sqrt(max(own**2 - 1.0, 0.0)) * np.median(sd))
    inflation = np.maximum.accumulate(spread)
    cell = charts.cell_mm
    kinds = len(sides) + len(LINE_CELLS)
    windows = kinds / np.array([max(1, side // 4) * cell for side in sides]) ** 2
    lines = kinds * LINE_TURNS / cell**2
    threshold = -ndtri(0.5 * np.minimum(alarms_per_mm2 / windows, 0.5))
    line_threshold = -float(ndtri(0.5 * min(alarms_per_mm2 / lines, 0.5)))
    return Levels(sides, np.asarray(inflation, float), threshold, windows, common, line_threshold, lines,
                  _line_inflation(field, charts, used), systematic_mm)  # fmt: skip


def search(field: Field, surface: DesignSurface, levels: Levels) -> Finding:
    """Find the cells that deviate, from small windows to large; what is found does not count in larger ones."""
    charts = surface.charts
    count = len(surface.share)
    finding = Finding(np.zeros(count, np.int8), np.zeros(count), np.full(count, np.inf))
    for chart in _used(field, charts):
        rows = charts.cells(chart)
        own = _search_chart(field, charts, chart, levels)
        finding.sign[rows], finding.z[rows], finding.chance[rows] = own.sign.ravel(), own.z.ravel(), own.chance.ravel()
    return finding


def _used(field: Field, charts: Charts) -> list[int]:
    return [k for k in range(len(charts.kind)) if field.seen[charts.cells(k)].any()]


def _search_chart(field: Field, charts: Charts, chart: int, levels: Levels) -> Finding:
    """Search a face; the arrays of what is found are of its shape."""
    shape = tuple(charts.shape[chart])
    found = Finding(np.zeros(shape, np.int8), np.zeros(shape), np.full(shape, np.inf))
    sign = found.sign
    for side, inflation, threshold, per_mm2 in zip(
        levels.sides, levels.inflation, levels.threshold, levels.per_mm2, strict=True
    ):
        if side > min(shape):
            break
        top, weight = _window_sums(field, charts, chart, side, sign != 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(weight > 0.0, top / weight / np.hypot(inflation / np.sqrt(weight), levels.systematic_mm), 0.0)
        if side == LINES_AFTER:
            _search_lines(field, charts, chart, levels, found)
        if not (np.abs(z) > threshold).any():
            continue
        small_top, small_weight = _smoothed(field, charts, chart, max(1, side // 2), sign != 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            near = np.where(small_weight > 0.0, small_top / np.sqrt(small_weight), 0.0) / inflation
        for way in (-1, 1):
            hit = way * z > threshold
            if not hit.any():
                continue
            covered, best = _spread(np.where(hit, way * z, 0.0), side, shape)
            grown = _whole_pieces(covered & (way * near > GROWTH) & (sign == 0), covered)
            sign[grown] = way
            found.z[grown] = best[grown]
            found.chance[grown] = 2.0 * ndtr(-best[grown]) * per_mm2
    return found


def _search_lines(field: Field, charts: Charts, chart: int, levels: Levels, found: Finding) -> None:
    """Find what is narrower than a window and long, in lines of cells in eight directions; adds it to ``found``."""
    sign, score = found.sign, found.z
    top, weight = _images(field, charts, chart, sign != 0)
    for length in LINE_CELLS:
        if length > max(top.shape):
            continue
        for turn in range(LINE_TURNS):
            offsets = _line(length, np.pi * turn / LINE_TURNS)
            sums = [sum(_shifted(x, i, j) for i, j in offsets) for x in (top, weight, (weight > 0.0).astype(float))]
            with np.errstate(invalid="ignore", divide="ignore"):
                z = sums[0] / sums[1] / np.hypot(levels.line_inflation / np.sqrt(sums[1]), levels.systematic_mm)
                z = np.where(sums[2] >= COVERED * length, z, 0.0)
            for way in (-1, 1):
                for i, j in np.argwhere(way * z > levels.line_threshold):
                    for di, dj in offsets:
                        a, b = i + di, j + dj
                        inside = 0 <= a < sign.shape[0] and 0 <= b < sign.shape[1] and weight[a, b] > 0.0
                        if inside and way * top[a, b] > LINE_GROWTH * np.sqrt(weight[a, b]):
                            sign[a, b] = way
                            score[a, b] = max(score[a, b], way * z[i, j])
                            chance = 2.0 * ndtr(-way * z[i, j]) * levels.line_per_mm2
                            found.chance[a, b] = min(found.chance[a, b], chance)


def _line_inflation(field: Field, charts: Charts, used: list[int]) -> float:
    """Return by how much the means of lines along the grid vary more than noise says."""
    found = []
    for chart in used:
        top, weight = _images(field, charts, chart, None)
        for axis in (0, 1):
            length = min(LINE_CELLS[-1], top.shape[axis])
            sums = [ndimage.uniform_filter1d(x, length, axis=axis, mode="constant") * length
                    for x in (top, weight, (weight > 0.0).astype(float))]  # fmt: skip
            enough = sums[2] >= COVERED * length
            found.append(sums[0][enough] / np.sqrt(sums[1][enough]))
    z = np.concatenate([np.empty(0), *found])
    return max(1.0, 1.4826 * float(np.median(np.abs(z - np.median(z))))) if len(z) >= FEWEST_WINDOWS else 1.0


def _line(length: int, angle: float) -> list[tuple[int, int]]:
    """Return the cells of a line through a cell, as steps from it."""
    at = np.arange(length) - length // 2
    steep = max(abs(np.cos(angle)), abs(np.sin(angle)))
    steps = np.stack([np.round(at * np.cos(angle) / steep), np.round(at * np.sin(angle) / steep)], axis=1)
    return [(int(i), int(j)) for i, j in steps]


def _shifted(image: Floats, i: int, j: int) -> Floats:
    """Return the image whose cell (a, b) is the given one's (a + i, b + j); 0 beyond its border."""
    found = np.zeros_like(image)
    n, m = image.shape
    if abs(i) < n and abs(j) < m:
        found[max(0, -i) : n - max(0, i), max(0, -j) : m - max(0, j)] = image[
            max(0, i) : n - max(0, -i), max(0, j) : m - max(0, -j)
        ]
    return found


def _whole_pieces(cells: Bools, windows: Bools) -> Bools:
    """Leave out the small pieces of what is found in windows that hang together: they are not places of their own."""
    label, count = ndimage.label(cells, np.ones((3, 3)))
    if count < 2:
        return cells
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    cluster = ndimage.label(windows, np.ones((3, 3)))[0]
    first = np.zeros(count + 1, np.int64)
    first[label.ravel()] = cluster.ravel()
    largest = np.zeros(int(cluster.max()) + 1, np.int64)
    np.maximum.at(largest, first[1:], sizes[1:])
    kept = np.concatenate([[False], sizes[1:] >= PIECE_SHARE * largest[first[1:]]])
    found: Bools = kept[label]
    return found


def _images(field: Field, charts: Charts, chart: int, without: Bools | None) -> tuple[Floats, Floats]:
    weight = charts.image(field.seen / field.variance, chart)
    if without is not None:
        weight = np.where(without, 0.0, weight)
    return weight * charts.image(field.deviation, chart), weight


def _window_sums(field: Field, charts: Charts, chart: int, side: int, without: Bools | None) -> tuple[Floats, Floats]:
    """Return sums of weighted deviations and of weights over a face's windows; 0 where too little was seen."""
    step = max(1, side // 4)
    top, weight = _images(field, charts, chart, without)
    if min(top.shape) < side:
        return np.zeros(0), np.zeros(0)
    found = [_sums(x, side)[::step, ::step] for x in (top, weight, (weight > 0.0).astype(float))]
    enough = found[2] >= COVERED * side**2
    return np.where(enough, found[0], 0.0), np.where(enough, found[1], 0.0)


def _sums(image: Floats, side: int) -> Floats:
    total = np.pad(image, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    found: Floats = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    return found


def _smoothed(field: Field, charts: Charts, chart: int, side: int, without: Bools) -> tuple[Floats, Floats]:
    mode = ("constant", "wrap" if charts.kind[chart] == CYLINDER else "constant")
    top, weight = (ndimage.uniform_filter(x, side, mode=mode) * side**2 for x in _images(field, charts, chart, without))
    return top, np.where(weight > 1e-9, weight, 0.0)


def _spread(hits: Floats, side: int, shape: tuple[int, ...]) -> tuple[Bools, Floats]:
    """Lay windows, given by their values at their first corners in steps, over the cells of a face."""
    step = max(1, side // 4)
    full = np.zeros(shape)
    full[: hits.shape[0] * step : step, : hits.shape[1] * step : step][: hits.shape[0], : hits.shape[1]] = hits
    # A window covers cells from its corner on: the largest value of corners up to ``side`` cells before.
    best = ndimage.maximum_filter(full, size=side, origin=(side - 1) // 2, mode="constant")
    return best > 0.0, best
