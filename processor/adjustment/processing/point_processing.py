"""What software has done to the points of a scanner, recognised from the points, and what it does to their statistics.

Points of a scanner have noise that neighbours do not share, and lie where its rays went. Software leaves traces:

- rounding: coordinates are multiples of a step;
- thinning to one point in each cell, the centroid or the point nearest to the centre: coordinates repeat with the
  edge of a cell in a periodogram, and cells hold one point each, but cells of that size elsewhere hold several;
- smoothing: residuals of neighbours differ by less than those of a surface scatter (von Neumann 1941), also across the
  lines of a scanner, the points of which may share errors;
- sampling of a mesh: a point and its nearest neighbours lie in one plane, to the last digits.

Copies of points count once (:mod:`processor.geometry.coincident_points`), and what rounding and thinning leave has
errors of its own, as the points of a scanner have: no noise law changes. What smoothing and sampling did no residual
shows: neighbours share their errors, edges are rounded and curved surfaces lie deeper. No interval holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.adjustment.processing import sphere_smoothness
from processor.geometry import coincident_points
from processor.model import Floats, Ints, Reason, reason

FEWEST = 100  # points that show a trace: the ratio of variances of as many is known to 15 %
LEAST_STEP_MM = 0.05  # of rounding: an sd of 0.014 mm is far below the noise of any scanner
# A face along an axis lies off by up to half a step, which more than 1 mm of no interval holds: the class of scanners
# gives as much as a limit of 95 %. Of bridges whose points are 7 mm apart key points and gaps of cells of 10 mm were
# within their intervals in 99 and 98 %, of 14 mm in 77 and 58 %: centroids round the edges.
LARGEST_STEP_MM, LARGEST_CELL_MM = 2.0, 12.0
FREQUENCIES = (0.25, 1.3)  # of cells, by the median distance of neighbours
BIN, LEAST_PEAK = 0.125, 4.0  # width of bins in distances of neighbours; power, of which chance has 4 once in 1e5
PEAKS, STEPS = 3, 7  # frequencies that are tried, and the steps of each about it
# Shares of points beside others in their cells, and of the same cells half an edge further. Of 600 crops of scanners
# the second was below 0.04, or the first above 0.9 of it; of thinned ones to two thirds it is above 0.1.
LEAST_BESIDE, MOST_WITHIN = 0.08, 0.5
LEAST_AGREE = 0.3  # of the places
SAME_CELL, HALF = 0.01, 0.5  # relative difference of cells of two scans, and share of the scans that have the same
HALF_AN_EDGE = 0.5 * (1.0 - np.eye(3))  # along two axes each: where cells that hold one point hold none or two
WIDE = 8.0  # extent along an axis, in distances of neighbours, from which it holds cells: noise of a plane is below it
# Patches of a place, where a surface is fitted, and their points. The fit takes up what lines of a scanner have in
# common from the smaller ones, and leaves form in the larger ones: the mean of both counts, but of the smaller ones
# alone where residuals of the larger are BENT times theirs, as at edges and on small balls.
PATCHES, PATCH_POINTS, FEWER_POINTS, BENT = 100, 160, 64, 2.0
FLATTEST, LEAST_FLAT = 8, 25  # of the patches one in as many counts, those without edges and other surfaces
# Median squared difference of nearest neighbours over that of white noise, in the smaller patches: after means of 6 to
# 50 neighbours, moving least squares and of samples of meshes it was 0.1 to 0.72; of scanners, whose lines may share
# errors, 0.3 to 1.4.
SMOOTH = 0.78
# The greater of two: the same of the second greatest of the nearest four, and of the nearest across lines. Lines share
# no errors: of 90 scans (merged, of lines with correlations of 0 to 0.9 that were 1 to 8 times as far apart as their
# points, real ones) the mean of both patches was 0.89 or more, and of 60 smoothed clouds 0.77 or less; of the 84
# smoothed clouds and samples of meshes that SMOOTH was set by it was 0.83 or less in the larger patches.
# Of plates 150 mm wide, of which the smaller patches alone count, the sound ones had 0.95, smoothed ones 0.86.
ABOUT, ACROSS, ACROSS_BENT = 4, 0.85, 0.9
CHANCE = 5.5  # over the root of the number of points: 3.7 standard deviations of that median of white noise
IN_PLANE, LEAST_IN_PLANE = 0.02, 0.1  # thickness of five neighbours in sd of residuals; by chance 2e-4 are so thin


@dataclass(frozen=True)
class Processing:
    """Traces of software in a cloud, mm; 0 = none.

    ``step`` of rounding, ``cell`` that holds one point; whether the points were ``smoothed``, also as samples of a
    ``mesh``.
    """

    step: float = 0.0
    cell: float = 0.0
    smoothed: bool = False
    mesh: bool = False

    @property
    def unbounded(self) -> bool:
        """Whether it moved surfaces by more than intervals hold."""
        return self.smoothed or self.cell > LARGEST_CELL_MM or self.step > LARGEST_STEP_MM

    def reasons(self, cloud: str) -> tuple[Reason, ...]:
        """Return what each trace of a cloud of this name is, and what to do."""
        names = []
        if self.step >= LEAST_STEP_MM:
            names.append(reason("points.rounded", cloud=cloud, step=self.step))
        if self.cell > 0.0:
            names.append(reason("points.thinned", cloud=cloud, cell=self.cell))
        if self.mesh:
            names.append(reason("points.from-mesh", cloud=cloud))
        elif self.smoothed:
            names.append(reason("points.smoothed", cloud=cloud))
        return tuple(names)


def recognised(points: Floats, of_sphere: tuple[Floats, Floats] | None = None) -> Processing:
    """Recognise what software has done to points (n, 3), mm, of one frame as their file has them, less any origin.

    ``of_sphere``: directions (n, 3) from its centre, and residuals (n,). Without, patches are fitted by bent ones, from
    which a ball seen by few points departs: smoothing of fewer than a place's is not recognised. Copies are no trace
    here: leave them out first.
    """
    step = coincident_points.rounding_of(points) if len(points) else 0.0
    step = step if step >= LEAST_STEP_MM else 0.0
    rows = [rows for rows in coincident_points.some_places(points) if len(rows) >= FEWEST] if len(points) else []
    # Errors of rounding are alike of neighbours by themselves.
    smoothed = of_sphere is not None and step <= float(np.std(of_sphere[1])) and sphere_smoothness.smooth(*of_sphere)
    if not rows:
        return Processing(step=step, smoothed=smoothed)
    by_patches, mesh = smoothed or (of_sphere is None and len(points) >= coincident_points.PLACE_POINTS), False
    size = min(PATCH_POINTS if by_patches else coincident_points.BESIDE, *map(len, rows))
    near = np.concatenate([of_place[_patches(points[of_place], size)] for of_place in rows])
    patches = points[near] - points[near[:, :1]]
    if by_patches:
        alike, mesh = _smoothed(patches, step, len(points))
        smoothed |= alike
    # The fourth neighbour of chance points is about twice as far as the first, which may be a copy.
    spacing = 0.5 * float(np.median(np.linalg.norm(patches[:, 4], axis=1)))
    places = [points[of_place] - large_arrays.corners(points[of_place])[0] for of_place in rows]
    return Processing(step=step, cell=0.0 if smoothed else _cell(places, spacing), smoothed=smoothed, mesh=mesh)


def agreed(traces: Sequence[Processing]) -> list[Processing]:
    """Return the traces of scans without cells that less than half of the scans have.

    Software thins all scans alike. The angular grid of a scanner looks so on the faces that it meets squarely.
    """
    cells = np.array([trace.cell for trace in traces])
    alike = np.abs(cells[:, None] - cells) <= SAME_CELL * cells
    rare = np.sum(alike, axis=0) < HALF * len(cells)
    return [replace(trace, cell=0.0) if alone else trace for trace, alone in zip(traces, rare, strict=True)]


# --- smoothing -------------------------------------------------------------------------------------------------------


def _patches(place: Floats, size: int) -> Ints:
    """Return some points of a place and their nearest neighbours, ascending, as rows (m, size)."""
    sample = np.linspace(0, len(place) - 1, min(PATCHES, len(place))).astype(np.int64)
    near: Ints = cKDTree(place, **coincident_points.FEW).query(place[sample], k=size)[1]
    return near


def _smoothed(near: Floats, step: float, count: int) -> tuple[bool, bool]:
    """Whether errors of neighbours are alike, and whether these also lie in one plane, as samples of a mesh.

    ``near`` (m, k, 3) are patches of a cloud of ``count`` points.
    """
    fewer, larger = (_alike(near[:, :size]) for size in (FEWER_POINTS, PATCH_POINTS))
    # Errors of rounding are alike of neighbours by themselves.
    if not fewer.sd > step:
        return False, False
    bent = larger.sd > BENT * fewer.sd
    across = fewer.others if bent else 0.5 * (fewer.others + larger.others)
    if fewer.nearest >= min(SMOOTH, 1.0 - CHANCE / np.sqrt(count)) or across >= (ACROSS_BENT if bent else ACROSS):
        return False, False
    five = near[fewer.flat, :5] - near[fewer.flat, :5].mean(axis=1, keepdims=True)
    thickness = np.sqrt(np.maximum(np.linalg.eigvalsh(np.swapaxes(five, 1, 2) @ five)[:, 0], 0.0))
    return True, bool(np.mean(thickness < IN_PLANE * fewer.sd) > LEAST_IN_PLANE)


class _Alike(NamedTuple):
    """How alike errors of the nearest and of other neighbours are, 1 = not; their sd; the patches (f,) that count."""

    nearest: float
    others: float
    sd: float
    flat: Ints


def _alike(near: Floats) -> _Alike:
    """Compare the errors of neighbours in patches (m, k, 3), off a surface of second order.

    Neighbours are those along the surface: in space the nearest of several is that of the most similar error. The sd is
    0 where a patch has no errors.
    """
    off = near - near.mean(axis=1, keepdims=True)
    squares, axes = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)
    size = np.sqrt(np.maximum(squares[:, -1:], np.finfo(float).tiny))
    height, u, v = np.moveaxis(off @ axes / size[:, None], 2, 0)
    errors = sphere_smoothness.off_second_order(height, u, v) * size
    variance = np.sum(errors**2, axis=1) / (near.shape[1] - sphere_smoothness.TERMS)
    flat = np.argsort(variance, kind="stable")[: max(len(variance) // FLATTEST, LEAST_FLAT)]
    if not variance[flat[0]] > 0.0:
        return _Alike(1.0, 1.0, 0.0, flat)
    place = u[flat] + 1j * v[flat]
    step = place[:, None] - place[:, :, None]
    away = np.abs(step)
    away[:, range(away.shape[1]), range(away.shape[1])] = np.inf
    nearest = np.argsort(away, axis=2)[:, :, :ABOUT]
    # Lines run the way of most of the nearest neighbours.
    way = np.angle(np.mean(np.sign(np.take_along_axis(step, nearest[:, :, :1], axis=2)) ** 2, axis=1))
    turned = step * np.exp(-0.5j * way)[:, None]
    away[np.abs(turned.imag) <= np.abs(turned.real)] = np.inf
    other = np.concatenate([nearest, np.argmin(away, axis=2)[..., None]], axis=2)
    seen = np.ones(other.shape)
    seen[..., ABOUT] = np.isfinite(np.min(away, axis=2))
    of_other = np.take_along_axis(errors[flat], other.reshape(len(flat), -1), axis=1).reshape(other.shape)
    square = np.sum(seen * (errors[flat][:, :, None] - of_other) ** 2, axis=1) / np.maximum(np.sum(seen, axis=1), 1.0)
    alike = np.median(np.where(seen.any(axis=1), 0.5 * square / variance[flat, None], 1.0), axis=0)
    others = max(float(alike[ABOUT]), float(np.sort(alike[:ABOUT])[-2]))
    return _Alike(float(alike[0]), others, float(np.sqrt(np.median(variance[flat]))), flat)


# --- thinning --------------------------------------------------------------------------------------------------------


def _cell(places: list[Floats], spacing: float) -> float:
    """Return the edge, mm, of cells that hold one point each; 0 without such cells."""
    if not spacing > 0.0:
        return 0.0
    # A plane along two axes says nothing along the third, and where it lies between two cells both have points.
    places = [np.where(large_arrays.span(place) >= WIDE * spacing, place, 0.0) for place in places]
    extent = max(float(large_arrays.span(place).max()) for place in places)
    if not extent > 0.0:
        return 0.0
    frequency, power = _periodogram(places, spacing, extent)
    inner = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    inner = inner[power[inner] > LEAST_PEAK]
    edge, most = 0.0, 0.0
    for row in inner[np.argsort(-power[inner], kind="stable")[:PEAKS]]:
        tried = frequency[row] + np.linspace(-0.25, 0.25, STEPS) / extent
        waves = (np.exp(2j * np.pi * tried[:, None, None] * place[None]).mean(axis=1) for place in places)
        phases = [np.angle(wave) / (2.0 * np.pi) for wave in waves]
        for step, f in enumerate(tried.tolist()):
            of_cells = [place * f - phase[step] for place, phase in zip(places, phases, strict=True)]
            within = np.array([_beside(one) for one in of_cells])
            further = np.array([np.mean([_beside(one + shift) for shift in HALF_AN_EDGE]) for one in of_cells])
            agree = (further >= LEAST_BESIDE) & (within <= MOST_WITHIN * further)
            clear = float(np.sum((further - within)[agree]))
            if np.mean(agree) >= LEAST_AGREE and clear > most:
                edge, most = 1.0 / f, clear
    return edge


def _periodogram(places: list[Floats], spacing: float, extent: float) -> tuple[Floats, Floats]:
    """Return frequencies (f,) and the power (f,) of coordinates at them, mean over places and axes; 1 of chance."""
    width = BIN * spacing
    bins = int(extent / width) + 1
    total, columns = np.zeros(0), 0
    for place in places:
        for column in place.T[large_arrays.span(place) > 0.0]:
            columns += 1
            counts = np.bincount((column / width).astype(np.int64), minlength=bins)
            power = np.abs(np.fft.rfft(counts, 4 * bins)) ** 2 / len(place)
            total = power if not len(total) else total + power
    frequency = np.arange(len(total)) / (4 * bins * width)
    looked = (frequency >= FREQUENCIES[0] / spacing) & (frequency <= FREQUENCIES[1] / spacing)
    return frequency[looked], total[looked] / columns


def _beside(places: Floats) -> float:
    """Return the share of points (n, 3), in cells of edge 1 about whole numbers, that are not the first in theirs."""
    cells = np.rint(places).astype(np.int64)
    cells -= cells.min(axis=0)
    i, j, k = cells.T
    return 1.0 - len(np.unique((i << 42) | (j << 21) | k)) / len(places)
