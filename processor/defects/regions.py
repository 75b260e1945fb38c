"""Regions: connected cells that deviate or are missing, and the grouping of regions to defects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from processor.defects import scan_statistic
from processor.defects.classification import CRACK_RATIO
from processor.defects.deviation_field import Field
from processor.defects.scan_statistic import EIGHT_NEIGHBOURS, Finding, Levels
from processor.defects.surface_charts import CYLINDER, Charts, DesignSurface
from processor.model import Bools, Floats, Ints

EMPTY_SHARE = 0.15  # of the points expected, up to which a cell is empty
LEAST_EXPECTED = 6.0  # points on cells that are judged together: with fewer, cells side by side are empty by chance
COUNTED_SHARE = 0.5  # of the points expected: scanners return fewer where a surface reflects badly
TOUCH_CELLS, TOUCHED = 2, 0.1  # about a place, and the share of it there, by which it borders on what is hidden
LINE_CELLS = 1.6  # distance of a crack's piece from its line
LINE_REACH = 3.0  # half lengths of a crack, within which further pieces lie


@dataclass(frozen=True)
class Region:
    """Cells of one face; ``sign`` -1 inward, 1 outward, 0 missing; ``z``: largest deviation by its sd.

    ``chance`` is the expected number of false alarms as strong on one mm2.
    """

    chart: int
    cells: Ints  # rows of all cells
    sign: int
    z: float
    chance: float


def of_finding(finding: Finding, surface: DesignSurface) -> list[Region]:
    """Return connected cells that deviate to one side."""
    charts = surface.charts
    regions = []
    for chart in range(len(charts.kind)):
        if not finding.sign[charts.cells(chart)].any():
            continue
        signs, z, chance = (charts.image(x, chart) for x in (finding.sign.astype(float), finding.z, finding.chance))
        for sign in (-1, 1):
            closed = ndimage.binary_closing(np.pad(signs == sign, 2), EIGHT_NEIGHBOURS)[2:-2, 2:-2] & (signs != -sign)
            for cells in _connected(closed, charts, chart):
                rows = cells - charts.first[chart]
                strongest = float(np.abs(z.flat[rows]).max()), float(chance.flat[rows].min())
                regions.append(Region(chart, cells, sign, *strongest))
    return regions


def missing(field: Field, expected: Floats, alarms_per_mm2: float) -> list[Region]:
    """Return connected cells with far fewer points than ``expected`` (cells,), at the given rate of false alarms.

    Of the points expected, COUNTED_SHARE are counted on; so many must be improbable to be missing by a Poisson
    distribution, on the cells that are not at the face's border.
    """
    charts = field.surface.charts
    count = field.count + field.stray
    inner = field.inner > 0.0  # cells that could be examined: beams there hit the face alone
    threshold = -np.log(alarms_per_mm2 * charts.cell_mm**2)
    regions = []
    for chart in range(len(charts.kind)):
        rows = charts.cells(chart)
        empty = _empty(charts.image(count.astype(float), chart), charts.image(expected, chart))
        if not (empty.ravel() & inner[rows]).any():
            continue
        for cells in _connected(empty, charts, chart):
            core = cells[inner[cells]]
            mean = COUNTED_SHARE * expected[core].sum()
            number = float(count[core].sum())
            strength = chernoff(mean, number, more=False)
            if strength > threshold:
                chance = float(np.exp(-strength)) / charts.cell_mm**2
                regions.append(Region(chart, cells, 0, float(np.sqrt(2.0 * strength)), chance))
    return regions


def _empty(count: Floats, expected: Floats) -> npt.NDArray[np.bool_]:
    """Return which cells of a face are empty, with those about them where few points are expected on one cell."""
    possible = expected > 0.0
    if not possible.any():
        return possible
    side = int(np.ceil(np.sqrt(LEAST_EXPECTED / float(np.median(expected[possible])))))
    about = [ndimage.uniform_filter(np.where(possible, x, 0.0), side, mode="constant") for x in (count, expected)]
    empty: npt.NDArray[np.bool_] = possible & (about[0] <= EMPTY_SHARE * about[1])
    return empty


def hidden(behind: Bools, shaded: list[Region], missing: list[Region], field: Field) -> Bools:
    """Return the cells (cells,) that could be examined if nothing stood before them.

    That are cells without points of the structure ``behind`` (cells,) something, and those that seemed missing
    (``shaded``) and are not, as rays to them ended before.
    """
    cells = behind.copy()
    for way, part in ((True, shaded), (False, missing)):
        for region in part:
            cells[region.cells] = way
    found: Bools = cells & (field.inner > 0.0) & (field.count == 0)
    return found


def touches(rows: Ints, cells: Bools, charts: Charts, chart: int) -> bool:
    """Return whether a place, ``rows`` of cells of one face, borders on ``cells`` (cells,) by TOUCHED of it or more."""
    place = np.zeros(tuple(charts.shape[chart]), np.bool_)
    place.flat[rows - charts.first[chart]] = True
    about = ndimage.binary_dilation(place, EIGHT_NEIGHBOURS, TOUCH_CELLS)
    return bool(cells[charts.cells(chart)].reshape(about.shape)[about].mean() >= TOUCHED)


def chernoff(mean: float, number: float, *, more: bool) -> float:
    """Return less the logarithm of Chernoff's bound of the probability of a Poisson ``number`` so far from its mean."""
    if mean <= 0.0 or (number <= mean if more else number >= mean):
        return 0.0
    return float(mean - number + (number * np.log(number / mean) if number else 0.0))


def united(regions: list[Region], surface: DesignSurface, near_mm: float) -> list[list[Region]]:
    """Group the parts of one defect: of one component, near each other, and missing or to the same side.

    Deviations right beside a missing region belong to it: beams that hit its edge.
    """
    groups: list[list[Region]] = []
    trees: list[cKDTree] = []
    for region in sorted(regions, key=lambda region: (region.sign != 0, -len(region.cells), int(region.cells[0]))):
        places = surface.centres[region.cells]
        component = surface.charts.component[region.chart]
        for group, tree in zip(groups, trees, strict=True):
            first = group[0]
            same = first.sign in (0, region.sign) and surface.charts.component[first.chart] == component
            if same and float(tree.query(places)[0].min()) < near_mm:
                group.append(region)
                break
        else:
            groups.append([region])
            trees.append(cKDTree(places))
    return _lines_united([_joined(group) for group in groups], surface)


def is_significant(region: Region, field: Field, levels: Levels) -> bool:
    """Whether the mean of a region's cells is significant by itself; what is missing always is.

    Cells that are left of a line or a window may be few: the rest was of another region, or lay all about. ``field`` is
    the one that was searched.
    """
    if region.sign == 0:
        return True
    weight = field.seen[region.cells] / field.variance[region.cells]
    total = max(float(weight.sum()), 1e-30)
    size = max(0, int(np.searchsorted(levels.sides, np.sqrt(len(region.cells)), side="right")) - 1)
    sd = float(scan_statistic.mean_sd(total, levels.inflation[size], levels.common[size], field, levels))
    return abs(float(weight @ field.deviation[region.cells])) / total > float(levels.threshold[size]) * sd


def unrolled(surface: DesignSurface, region: Region) -> Floats:
    """Return u, v (n, 2) of the middles of a region's cells on its face; on a cylinder unrolled from the region."""
    charts, chart = surface.charts, region.chart
    grid = np.stack(np.divmod(region.cells - charts.first[chart], charts.shape[chart, 1]), axis=1) + 0.5
    uv: Floats = charts.low[chart] + grid * charts.cell_mm
    if charts.kind[chart] == CYLINDER:
        turn = 2.0 * np.pi * charts.radius[chart]
        uv[:, 1] -= turn * np.round((uv[:, 1] - uv[0, 1]) / turn)
    return uv


def _connected(mask: np.ndarray, charts: Charts, chart: int) -> list[Ints]:
    """Return the cells of each connected piece of a mask of a face."""
    label, count = ndimage.label(mask, EIGHT_NEIGHBOURS)
    if charts.kind[chart] == CYLINDER and count:  # across the seam
        for i in range(label.shape[0]):
            a, b = label[i, 0], label[i, -1]
            if a and b and a != b:
                label[label == max(a, b)] = min(a, b)
    labels = label.ravel()
    order = np.argsort(labels, kind="stable")
    at = np.searchsorted(labels[order], np.arange(1, count + 2))
    pieces = [order[at[k] : at[k + 1]] for k in range(count)]
    return [charts.first[chart] + rows.astype(np.int64) for rows in pieces if len(rows)]


def _joined(group: list[Region]) -> list[Region]:
    """Join the regions on the first one's face and to its side; the others remain beside it."""
    first = group[0]
    alike = [region for region in group if region.chart == first.chart and region.sign == first.sign]
    if len(alike) == 1:
        return group
    joined = Region(
        chart=first.chart,
        cells=np.unique(np.concatenate([region.cells for region in alike])),
        sign=first.sign,
        z=max(region.z for region in alike),
        chance=min(region.chance for region in alike),
    )
    return [joined, *(region for region in group if region.chart != first.chart or region.sign != first.sign)]


# --- Cracks, which scans show as dashed lines


def _lines_united(groups: list[list[Region]], surface: DesignSurface) -> list[list[Region]]:
    """Unite the pieces of each crack: regions in line with a slim region, within it or not far beyond its ends."""
    left = groups
    united_groups: list[list[Region]] = []
    while left:
        group, *left = left
        line = _line_of(group[0], surface)
        others = left + united_groups
        piece = line and next((other for other in others if _is_on(line, other[0], group[0], surface)), None)
        if not piece:
            united_groups.append(group)
            continue
        # The longer line may reach a region that it did not reach before: start again.
        left = [_joined([*group, *piece]), *(other for other in others if other is not piece)]
        united_groups = []
    return united_groups


def _line_of(region: Region, surface: DesignSurface) -> tuple[Floats, Floats, float] | None:
    """Return middle (2,), direction (2,) and half length of a slim region on its face; None if it is not slim."""
    uv, cell = unrolled(surface, region), surface.charts.cell_mm
    middle = uv.mean(axis=0)
    direction = np.linalg.eigh((uv - middle).T @ (uv - middle))[1][:, 1]
    along = (uv - middle) @ direction
    length = float(np.ptp(along)) + cell
    width = len(uv) * cell**2 / length
    if region.sign > 0 or length < CRACK_RATIO * width or width > 2.0 * LINE_CELLS * cell:
        return None
    return middle + 0.5 * (along.min() + along.max()) * direction, direction, 0.5 * length


def _is_on(line: tuple[Floats, Floats, float], region: Region, slim: Region, surface: DesignSurface) -> bool:
    """Return whether a region lies on the line of a slim region, within LINE_REACH of its middle."""
    if region.chart != slim.chart or region.sign > 0:
        return False
    middle, direction, half = line
    uv = unrolled(surface, region) - middle
    along, across = np.abs(uv @ direction), np.abs(uv @ [-direction[1], direction[0]])
    return bool(across.max() < LINE_CELLS * surface.charts.cell_mm and along.min() < LINE_REACH * half)
