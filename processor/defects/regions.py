"""Cells that belong together: places that deviate and places that are missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from processor.defects.classes import CRACK_RATIO
from processor.defects.deviation_field import Field
from processor.defects.missing_material import Expected
from processor.defects.scan_statistic import Finding
from processor.defects.surface_charts import CYLINDER, Charts, DesignSurface
from processor.model import Floats, Ints

ROUND = np.ones((3, 3))
ABSENT_SHARE = 0.15  # of the points expected, below which a cell is empty
IN_LINE_CELLS = 1.6  # that a piece of a crack may be off its line
DOUBT = 0.5  # of the points expected that are counted on: scanners thin out where a surface reflects badly


@dataclass(frozen=True)
class Region:
    """Cells of one face; ``sign`` -1 inward, 1 outward, 0 missing; ``z`` the largest deviation by its noise.

    ``chance`` is how many as strong chance brings on one mm2.
    """

    chart: int
    cells: Ints  # rows of all cells
    sign: int
    z: float
    chance: float


def of_finding(finding: Finding, surface: DesignSurface) -> list[Region]:
    """Return connected cells that deviate to one side."""
    charts = surface.charts
    found = []
    for chart in range(len(charts.kind)):
        if not finding.sign[charts.cells(chart)].any():
            continue
        sign, z, chance = (charts.image(x, chart) for x in (finding.sign.astype(float), finding.z, finding.chance))
        for way in (-1, 1):
            whole = ndimage.binary_closing(np.pad(sign == way, 2), ROUND)[2:-2, 2:-2] & (sign != -way)
            for rows in _connected(whole, charts, chart):
                own = rows - charts.first[chart]
                found.append(Region(chart, rows, way, float(np.abs(z.flat[own]).max()), float(chance.flat[own].min())))
    return found


def missing(field: Field, hoped: Expected, surface: DesignSurface, alarms_per_mm2: float) -> list[Region]:
    """Return connected cells without points where points should be, unless chance or bad reflection may do it.

    Points expected count by half; that many must be improbable to be missing (Poisson) as often as alarms are allowed,
    on a core of cells that are not at the face's border.
    """
    charts = surface.charts
    count = field.count + field.stray
    # The border is told from cells that could be examined: those a beam sees the face alone from.
    inner = field.inner > 0.0
    empty = (hoped.points > 0.0) & (count <= ABSENT_SHARE * hoped.points)
    needed = -np.log(alarms_per_mm2 * charts.cell_mm**2)
    found = []
    for chart in range(len(charts.kind)):
        rows = charts.cells(chart)
        if not (empty[rows] & inner[rows]).any():
            continue
        for own in _connected(charts.image(empty.astype(float), chart) > 0.0, charts, chart):
            core = own[inner[own]]
            lost = DOUBT * hoped.points[core].sum()
            got = float(count[core].sum())
            # Chernoff's bound of a Poisson number far below what is expected.
            strength = lost - got + (got * np.log(got / lost) if got else 0.0) if lost > got else 0.0
            if strength > needed:
                chance = float(np.exp(-strength)) / charts.cell_mm**2
                found.append(Region(chart, own, 0, float(np.sqrt(2.0 * strength)), chance))
    return found


def _connected(mask: np.ndarray, charts: Charts, chart: int) -> list[Ints]:
    label, count = ndimage.label(mask, ROUND)
    if charts.kind[chart] == CYLINDER and count:  # across the seam
        for i in range(label.shape[0]):
            one, two = label[i, 0], label[i, -1]
            if one and two and one != two:
                label[label == max(one, two)] = min(one, two)
    flat = label.ravel()
    order = np.argsort(flat, kind="stable")
    at = np.searchsorted(flat[order], np.arange(1, count + 2))
    rows = [order[at[k] : at[k + 1]] for k in range(count)]
    return [charts.first[chart] + own.astype(np.int64) for own in rows if len(own)]


def united(regions: list[Region], surface: DesignSurface, near_mm: float) -> list[list[Region]]:
    """Put together the parts of one defect: of one component, near each other, and missing or to the same side.

    What deviates right beside something missing is part of that: beams that hit its edge.
    """
    groups: list[list[Region]] = []
    trees: list[cKDTree] = []
    for region in sorted(regions, key=lambda one: (one.sign != 0, -len(one.cells), int(one.cells[0]))):
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
    return _in_line([_joined(group) for group in groups], surface)


def _in_line(groups: list[list[Region]], surface: DesignSurface) -> list[list[Region]]:
    """Put the pieces of a crack together, for a scan sees one as a dashed line.

    A piece is what lies in line with a slim place, within it or as far from its end as that is long at most.
    """
    left = groups
    found: list[list[Region]] = []
    while left:
        group, *left = left
        line = _line_of(group[0], surface)
        others = left + found
        piece = line and next((one for one in others if _is_on(line, one[0], group[0], surface)), None)
        if not piece:
            found.append(group)
            continue
        # A longer line may reach one that it did not reach before.
        left, found = [_joined([*group, *piece]), *(one for one in others if one is not piece)], []
    return found


def _line_of(region: Region, surface: DesignSurface) -> tuple[Floats, Floats, float] | None:
    """Return middle (2,), direction (2,) and half the length of a slim place on its face; None of any other."""
    uv, cell = flat(surface, region), surface.charts.cell_mm
    middle = uv.mean(axis=0)
    direction = np.linalg.eigh((uv - middle).T @ (uv - middle))[1][:, 1]
    along = (uv - middle) @ direction
    length = float(np.ptp(along)) + cell
    width = len(uv) * cell**2 / length
    if region.sign > 0 or length < CRACK_RATIO * width or width > 2.0 * IN_LINE_CELLS * cell:
        return None
    return middle + 0.5 * (along.min() + along.max()) * direction, direction, 0.5 * length


def _is_on(line: tuple[Floats, Floats, float], region: Region, slim: Region, surface: DesignSurface) -> bool:
    if region.chart != slim.chart or region.sign > 0:
        return False
    middle, direction, half = line
    uv = flat(surface, region) - middle
    along, across = np.abs(uv @ direction), np.abs(uv @ [-direction[1], direction[0]])
    return bool(across.max() < IN_LINE_CELLS * surface.charts.cell_mm and along.min() < 3.0 * half)


def _joined(group: list[Region]) -> list[Region]:
    """Make one region of those on the first one's face and to its side; the others stay beside it."""
    first = group[0]
    alike = [one for one in group if one.chart == first.chart and one.sign == first.sign]
    if len(alike) == 1:
        return group
    cells = np.unique(np.concatenate([one.cells for one in alike]))
    strongest = max(one.z for one in alike), min(one.chance for one in alike)
    whole = Region(first.chart, cells, first.sign, *strongest)
    return [whole, *(one for one in group if not any(one is other for other in alike))]


def flat(surface: DesignSurface, region: Region) -> Floats:
    """Return u, v (n, 2) of the middles of a region's cells on its face; of a cylinder unrolled from the region."""
    charts = surface.charts
    at = region.cells - charts.first[region.chart]
    grid = np.stack([at // charts.shape[region.chart, 1], at % charts.shape[region.chart, 1]], axis=1) + 0.5
    uv: Floats = charts.low[region.chart] + grid * charts.cell_mm
    if charts.kind[region.chart] == CYLINDER:
        turn = 2.0 * np.pi * charts.radius[region.chart]
        uv[:, 1] -= turn * np.round((uv[:, 1] - uv[0, 1]) / turn)
    return uv
