"""What software has done to the points of a scanner, recognised from the points, and what it does to their statistics.

Points of a scanner have noise that neighbours do not share, and lie where its rays went. Software leaves traces:

- rounding: coordinates are multiples of a step;
- thinning to one point in each cell, the centroid or the point nearest to the centre: coordinates repeat with the
  edge of a cell in a periodogram, and cells hold one point each, but cells of that size elsewhere hold several;
- copies beside the points, as of a merge: the nearest neighbour is far nearer than the fourth (Clark and Evans 1954);
- smoothing: residuals of neighbours differ by less than those of a surface scatter (von Neumann 1941);
- sampling of a mesh: a point and its nearest neighbours lie in one plane, to the last digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import coincident_points
from processor.model import Floats, Reason, reason

FEWEST = 100  # points that show a trace: the ratio of variances of as many is known to 15 %
LEAST_STEP_MM = 0.05  # of rounding: an sd of 0.014 mm is far below the noise of any scanner
PLACES, PLACE_POINTS = 4, 2000  # of a cloud where its cells are searched for, 45 cells wide
FREQUENCIES = (0.25, 1.3)  # of cells, by the median distance of neighbours
BIN, LEAST_PEAK = 0.125, 4.0  # width of bins in distances of neighbours; power, of which chance has 4 once in 1e5
PEAKS, STEPS = 3, 7  # frequencies that are tried, and the steps of each about it
# Shares of points beside others in their cells, and of the same cells half an edge further. Of 600 crops of scanners
# the second was below 0.04, or the first above 0.9 of it; of thinned ones to two thirds it is above 0.1.
LEAST_BESIDE, MOST_WITHIN = 0.08, 0.5
COPY_RATIO, LEAST_COPIES = 0.05, 0.05  # of distances to the first and fourth neighbour; 0.8 % of chance points are so
SAMPLE = 1000  # points whose neighbours are looked at
NEIGHBOURS = 48  # of a point: wider than what filters take, 8 to 30
RANKS = np.array([2, 4, 8, 16, 32, NEIGHBOURS])  # of neighbours; those to twice the rank before are about as far
# Squared differences of the two nearest neighbours over those of white noise. Of 240 balls with tubes the least was
# 0.67, of 120 scanned caps 0.93; means of 8 had 0.38 (95 %: 0.57), of 20 0.35 (0.54), samples of meshes at most 0.62.
SMOOTH, TOUCHED = 0.65, 2.0
REACHED, REACH = 0.8, 1.4  # share of the variance, and where means over a disc reach it, in radii of the disc
IN_PLANE, LEAST_IN_PLANE = 0.02, 0.1  # thickness of five neighbours in sd of residuals; by chance 2e-4 are so thin


@dataclass(frozen=True)
class Processing:
    """Traces of software in a cloud, mm; 0 = none.

    ``step`` of rounding, ``cell`` that holds one point, ``copies`` = share of points that are beside their copies,
    ``kernel`` = radius of the means that smoothed the points, and whether they were sampled from a ``mesh``.
    """

    step: float = 0.0
    cell: float = 0.0
    copies: float = 0.0
    kernel: float = 0.0
    mesh: bool = False

    def reasons(self, cloud: str) -> tuple[Reason, ...]:
        """Return what each trace of a cloud of this name is, and what to do."""
        names = []
        if self.step >= LEAST_STEP_MM:
            names.append(reason("points.rounded", cloud=cloud, step=self.step))
        if self.cell > 0.0:
            names.append(reason("points.thinned", cloud=cloud, cell=self.cell))
        if self.copies > 0.0:
            names.append(reason("points.copied", cloud=cloud, share=100.0 * self.copies))
        if self.mesh:
            names.append(reason("points.from-mesh", cloud=cloud))
        elif self.kernel > 0.0:
            names.append(reason("points.smoothed", cloud=cloud, radius=self.kernel))
        return tuple(names)


def recognised(points: Floats, errors: Floats | None = None, normals: Floats | None = None) -> Processing:
    """Recognise what software has done to points (n, 3), mm, of one frame as their file has them, less any origin.

    ``errors`` (n,) are their residuals to a surface that fits them, and ``normals`` (n, 3) that surface's: smoothing
    is not recognised without.
    """
    step = float(coincident_points.lattice_of(points).step.max()) if len(points) else 0.0
    step = step if step >= LEAST_STEP_MM else 0.0
    if len(points) < FEWEST:
        return Processing(step=step)
    tree = cKDTree(points)
    away, near = tree.query(points, k=5)
    copied = away[:, 1] < COPY_RATIO * away[:, 4]
    copies = float(np.mean(copied))
    if copies < LEAST_COPIES or step > 0.1 * float(np.median(away[:, 4])):
        copies, copied = 0.0, np.zeros(len(points), bool)
    kernel, mesh = 0.0, False
    # Errors of rounding are alike of neighbours by themselves.
    if errors is not None and normals is not None and step <= (sd := float(np.std(errors))):
        first = ~copied | (near[:, 1] > np.arange(len(points)))
        kernel = _kernel(points[first], errors[first], normals[first])
        # Means of the same neighbours are equal: no copies.
        copies = copies if kernel == 0.0 else 0.0
        off = points[near[:SAMPLE]] - points[near[:SAMPLE]].mean(axis=1, keepdims=True)
        thickness = np.sqrt(np.maximum(np.linalg.eigvalsh(np.swapaxes(off, 1, 2) @ off)[:, 0], 0.0))
        mesh = kernel > 0.0 and bool(np.mean(thickness < IN_PLANE * sd) > LEAST_IN_PLANE)
    # The fourth neighbour of chance points is about twice as far as the first, which may be a copy.
    cell = 0.0 if kernel > 0.0 else _cell(points, tree, 0.5 * float(np.median(away[:, 4])))
    return Processing(step=step, cell=cell, copies=copies, kernel=kernel, mesh=mesh)


def some_places(points: Floats) -> Floats:
    """Return points (m, 3) of some places of a cloud (n, 3), all that lie there: enough to recognise its processing."""
    if len(points) <= PLACES * PLACE_POINTS:
        return points
    seeds = ((np.arange(PLACES) + 0.5) * len(points) / PLACES).astype(np.int64)
    rows = [
        np.argpartition(np.sum((points - points[seed]) ** 2, axis=1), PLACE_POINTS)[:PLACE_POINTS] for seed in seeds
    ]
    chosen: Floats = points[np.unique(np.concatenate(rows))]
    return chosen


# --- smoothing -------------------------------------------------------------------------------------------------------


def _kernel(points: Floats, errors: Floats, normals: Floats) -> float:
    """Return the radius, mm, of means that make the errors (n,) of neighbours alike; 0 where they differ as noise.

    Neighbours are those along the surface: in space the nearest of several is that of the most similar error.
    """
    foot = points - errors[:, None] * normals
    sample = np.linspace(0, len(points) - 1, min(SAMPLE, len(points))).astype(np.int64)
    away, near = cKDTree(foot).query(foot[sample], k=min(NEIGHBOURS + 1, len(foot)))
    square = 0.5 * (errors[near] - errors[sample][:, None]) ** 2
    variances = np.var(errors[near], axis=1, ddof=1)
    # Without places where another surface touches: points of it have like errors.
    inner = variances <= TOUCHED * float(np.median(variances))
    variance, away, square = float(np.mean(variances[inner])), away[inner], square[inner]
    if not variance > 0.0 or float(np.mean(square[:, 1:3])) >= SMOOTH * variance:
        return 0.0
    last = 1
    for last in RANKS[near.shape[1] > RANKS].tolist():
        if float(np.mean(square[:, last // 2 + 1 : last + 1])) >= REACHED * variance:
            break
    # The mean square: where a filter takes a number of neighbours it reaches farther at grazing incidence
    return float(np.sqrt(np.mean(away[:, last] ** 2))) / REACH


# --- thinning --------------------------------------------------------------------------------------------------------


def _cell(points: Floats, tree: cKDTree, spacing: float) -> float:
    """Return the edge, mm, of cells that hold one point each; 0 without such cells."""
    if not spacing > 0.0:
        return 0.0
    count = min(PLACE_POINTS, len(points))
    number = max(1, min(PLACES, len(points) // count))
    seeds = ((np.arange(number) + 0.5) * len(points) / number).astype(np.int64)
    places = [points[tree.query(points[seed], k=count)[1]] for seed in seeds]
    places = [place - place.min(axis=0) for place in places]
    extent = max(float(np.ptp(place, axis=0).max()) for place in places)
    frequency, power = _periodogram(places, spacing, extent)
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    inner = inner[power[inner] > LEAST_PEAK]
    edge, most = 0.0, 0.0
    for row in inner[np.argsort(-power[inner], kind="stable")[:PEAKS]]:
        tried = frequency[row] + np.linspace(-0.25, 0.25, STEPS) / extent
        phases = [np.angle(_transform(place, tried)) / (2.0 * np.pi) for place in places]
        for step, f in enumerate(tried.tolist()):
            of_cells = [place * f - phase[step] for place, phase in zip(places, phases, strict=True)]
            within = float(np.mean([_beside(one) for one in of_cells]))
            further = float(np.mean([_beside(one + shift) for one in of_cells for shift in 0.5 * (1.0 - np.eye(3))]))
            if further >= LEAST_BESIDE and within <= MOST_WITHIN * further and further - within > most:
                edge, most = 1.0 / f, further - within
    return edge


def _periodogram(places: list[Floats], spacing: float, extent: float) -> tuple[Floats, Floats]:
    """Return frequencies (f,) and the power (f,) of coordinates at them, mean over places and axes; 1 of chance."""
    width = BIN * spacing
    bins = int(extent / width) + 1
    total = np.zeros(0)
    for place in places:
        for column in place.T:
            counts = np.bincount((column / width).astype(np.int64), minlength=bins)
            power = np.abs(np.fft.rfft(counts, 4 * bins)) ** 2 / len(place)
            total = power if not len(total) else total + power
    frequency = np.arange(len(total)) / (4 * bins * width)
    looked = (frequency >= FREQUENCIES[0] / spacing) & (frequency <= FREQUENCIES[1] / spacing)
    return frequency[looked], total[looked] / (3 * len(places))


def _transform(points: Floats, frequency: Floats) -> Floats:
    """Return means (f, 3) of waves of some frequencies (f,) along the axes, at points (n, 3); complex."""
    waves: Floats = np.exp(2j * np.pi * frequency[:, None, None] * points[None]).mean(axis=1)
    return waves


def _beside(places: Floats) -> float:
    """Return the share of points (n, 3), in cells of edge 1 about whole numbers, that are not the first in theirs."""
    cells = np.rint(places).astype(np.int64)
    cells -= cells.min(axis=0)
    i, j, k = cells.T
    return 1.0 - len(np.unique((i << 42) | (j << 21) | k)) / len(places)
