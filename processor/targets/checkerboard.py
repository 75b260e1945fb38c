"""Checkerboard targets: two by two fields on a plane, two of them dark, across from one another.

Candidates are cells of space whose intensities scatter far more than is usual in the scan. About each the points of one
plane are drawn as an image, and the pattern is sought in it at all places and turns by normalised correlation. The
centre is then fitted to the intensities of the points themselves: with distances d1 and d2 from the two lines where the
fields meet, the intensity is a + b erf(d1 / w) erf(d2 / w), w the width over which the footprint mixes two fields. What
is no target is recognised by the share of the variance that the pattern explains, by fields that differ, and by a
pattern that goes on beyond its border.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.special import erf

from processor.model import Bools, Floats, Ints
from processor.progress import tracked

Spectrum = npt.NDArray[np.complex128]

CELL_SHARE = 0.4  # edge of a cell of the search, in sides of the target
CONTRAST = 0.25  # scatter of the intensities of a cell over their mean, above which it is looked at
MOST_SEEDS = 5000  # places of a view that are looked at, those of most contrast
LEAST_POINTS, LEAST_OF_A_FIELD = 80, 12  # on a target, and on each of its fields
NEAR = 1.0  # radius about a candidate, in sides, whose points make the image
CENTRES = 0.45  # a centre is sought within this distance of the candidate
IMAGE_CELLS = 18  # of the image along a side of the target
TURNS = 12  # of the pattern, over a quarter turn
LIKELY = 0.6  # correlation of an image with the pattern
PLANE_MM, PLANE_SDS = 3.0, 3.0  # chosen: of a target's points off its plane: at least, and in standard deviations
FLAT_MM = 4.0  # rms of the points from their plane
WITHIN = 0.47  # half of the window that is fitted, in sides: not the border
LEAST_WIDTH = 0.4  # of w, in spacings: the sides of a step between two points are not known better
EXPLAINED = 0.75  # of the variance of the intensities
LEAST_STEP = 0.3  # bright less dark field, over the bright one
ALIKE = 0.3  # difference of two fields of one colour, over the step
BEYOND = (0.56, 0.8)  # strip beyond a side, in sides from the centre's lines
GOES_ON = 0.4  # step beyond a side, in steps of the pattern
LEAST_BESIDE = 4  # points of half a side
SHARP = 1.05  # times the least width: a step whose blur is not seen
PERIODS = (0.4, 2.5, 85)  # of the scanner's lines across a step, in spacings: from, to, number
# Rayleigh test: the squared mean resultant length of n angles at random exceeds K / n with probability exp(-K).
BY_CHANCE = float(np.log(1000.0))
FILLED = 0.5  # share of the cells of a field that have points, at least


@dataclass(frozen=True)
class Checkerboard:
    """A target as found: centre (3,), its covariance (3, 3), points used, and the share of variance explained."""

    centre: Floats
    covariance: Floats
    points: int
    fit: float

    @property
    def sd(self) -> float:
        """The largest standard deviation along any direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


@dataclass(frozen=True)
class _Plane:
    """Points of a plane: rows (m,) of the cloud, coordinates (m, 2) and distances (m,) from it."""

    middle: Floats
    axes: Floats  # (3, 3) two directions in the plane, and its normal
    rows: Ints
    at: Floats
    off: Floats


def search(points: Floats, intensity: Floats, side_mm: float) -> tuple[list[Checkerboard], int]:
    """Find targets whose square of four fields has sides of ``side_mm``, among points (n, 3), by intensity (n,).

    Points without an intensity (NaN) are left out. The order is that of the points' own coordinates; it does not depend
    on the order of the points. Also returns the number of places with contrast that were not looked at, beyond
    MOST_SEEDS: those of least contrast.
    """
    if len(intensity) != len(points):
        return [], 0
    bright = np.isfinite(intensity)
    points, intensity = points[bright], intensity[bright]
    if len(points) < LEAST_POINTS:
        return [], 0
    order = np.lexsort(points.T)
    points, intensity = points[order], intensity[order]
    tree = cKDTree(points)
    found: list[Checkerboard] = []
    seeds = list(_seeds(points, intensity, side_mm))
    for seed in tracked(seeds[:MOST_SEEDS]):
        if any(np.linalg.norm(seed - one.centre) < 0.7 * side_mm for one in found):
            continue
        plane = _plane(points, tree, seed, side_mm)
        start = None if plane is None else _start(plane, intensity[plane.rows], side_mm)
        if plane is None or start is None:
            continue
        one = _fitted(plane, intensity[plane.rows], start, side_mm)
        one = None if one is None else _again(points, intensity, tree, one, side_mm)
        if one is not None and all(np.linalg.norm(one.centre - other.centre) > 0.5 * side_mm for other in found):
            found.append(one)
    return sorted(found, key=lambda one: tuple(one.centre)), max(len(seeds) - MOST_SEEDS, 0)


def _again(points: Floats, intensity: Floats, tree: cKDTree, found: Checkerboard, side: float) -> Checkerboard | None:
    """Return a target that was found, fitted to the points about its own centre; None if these show no target."""
    plane = _plane(points, tree, found.centre, side)
    start = None if plane is None else _start(plane, intensity[plane.rows], side)
    return None if plane is None or start is None else _fitted(plane, intensity[plane.rows], start, side)


def _seeds(points: Floats, intensity: Floats, side: float) -> Iterator[Floats]:
    """Yield middles (3,) of cells with contrast, the strongest first; those near one that was yielded are left out.

    The cells are those of two grids, half a cell apart: fields that fill four cells of one leave contrast in the other.
    """
    of_grids = [_cells(points, intensity, side, shift) for shift in (0.0, 0.5)]
    middle = np.concatenate([one for one, _ in of_grids])
    contrast = np.concatenate([one for _, one in of_grids])
    left = np.ones(len(middle), bool)
    around = cKDTree(middle) if len(middle) else None
    for i in np.argsort(-contrast, kind="stable").tolist():
        if left[i] and around is not None:
            left[around.query_ball_point(middle[i], 0.5 * CENTRES * side)] = False
            yield middle[i]


def _cells(points: Floats, intensity: Floats, side: float, shift: float) -> tuple[Floats, Floats]:
    """Return middles (k, 3) and contrasts (k,) of the cells of a grid that have contrast."""
    cell = np.floor(points / (CELL_SHARE * side) + shift).astype(np.int64)
    cell -= cell.min(axis=0)
    extent = cell.max(axis=0) + 1
    _, inverse = np.unique((cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2], return_inverse=True)
    count = np.bincount(inverse)
    mean = np.bincount(inverse, intensity) / count
    variance = np.bincount(inverse, intensity**2) / count - mean**2
    contrast = np.sqrt(np.maximum(variance, 0.0)) / np.maximum(np.abs(mean), 1e-12)
    likely = (contrast > CONTRAST) & (count >= LEAST_POINTS * CELL_SHARE**2)
    middle = np.stack([np.bincount(inverse, points[:, axis]) / count for axis in range(3)], axis=1)
    return middle[likely], contrast[likely]


def _plane(points: Floats, tree: cKDTree, seed: Floats, side: float) -> _Plane | None:
    """Fit a plane to the points near a seed, then to all of it in the neighbourhood; None where there is none."""
    near = np.array(sorted(tree.query_ball_point(seed, 0.5 * side)), np.int64)
    if len(near) < LEAST_OF_A_FIELD:
        return None
    everything = np.array(sorted(tree.query_ball_point(seed, NEAR * side)), np.int64)
    some, tolerance = points[near], 0.1 * side
    for _ in range(4):
        middle = some.mean(axis=0)
        _, spread, axes = np.linalg.svd(some - middle, full_matrices=False)
        off = (points[everything] - middle) @ axes[2]
        tolerance = min(tolerance, max(PLANE_MM, PLANE_SDS * float(spread[2] / np.sqrt(len(some)))))
        some = points[everything[np.abs(off) <= tolerance]]
        if len(some) < LEAST_POINTS:
            return None
    on = np.abs(off) <= tolerance
    at = (points[everything[on]] - middle) @ axes[:2].T
    return _Plane(middle=middle, axes=axes, rows=everything[on], at=at, off=off[on])


def _start(plane: _Plane, intensity: Floats, side: float) -> Floats | None:
    """Return centre and turn (3,) of the pattern where it correlates best with a plane's image; None for nowhere."""
    cell = side / IMAGE_CELLS
    reach = NEAR * side
    width = int(2.0 * reach / cell) + 1
    index = np.floor((plane.at + reach) / cell).astype(np.int64)
    inside = ((index >= 0) & (index < width)).all(axis=1)
    key = index[inside, 0] * width + index[inside, 1]
    count = np.bincount(key, minlength=width**2).reshape(width, width)
    total = np.bincount(key, intensity[inside], minlength=width**2).reshape(width, width)
    there = (count > 0).astype(np.float64)
    image = np.where(count > 0, total / np.maximum(count, 1), 0.0)
    image = np.where(count > 0, image - image[count > 0].mean(), 0.0)
    where = np.indices(image.shape).reshape(2, -1).T * cell + 0.5 * cell - reach
    close = (np.linalg.norm(where, axis=1) <= CENTRES * side).reshape(image.shape)
    patterns = _patterns(side, width)
    fields = {"there": there, "image": image, "square": image**2}
    spectra = {name: rfftn(values, patterns[0].extent) for name, values in fields.items()}
    best, found = LIKELY, None
    for pattern in patterns:
        score = np.where(close, np.abs(_correlation(spectra, pattern, width)), 0.0)
        k = int(score.argmax())
        if score.ravel()[k] > best:
            best, found = float(score.ravel()[k]), np.array([*where[k], pattern.turn])
    return found


@dataclass(frozen=True)
class _Pattern:
    """The pattern at a turn: transforms, padded to ``extent``, of it, its window, and its magnitude."""

    turn: float
    cells: int  # along a side of its image
    window: float  # number of cells
    extent: tuple[int, int]
    of_pattern: Spectrum
    of_window: Spectrum
    of_size: Spectrum


@lru_cache(maxsize=4)
def _patterns(side: float, width: int) -> tuple[_Pattern, ...]:
    """Return the pattern at all turns, for images of ``width`` cells along a side."""
    cell = side / IMAGE_CELLS
    half = int(0.5 * side * np.sqrt(2.0) / cell) + 1
    grid = np.arange(-half, half + 1) * cell
    x, y = np.meshgrid(grid, grid, indexing="ij")
    extent = (next_fast_len(width + len(grid) - 1, True),) * 2  # real
    patterns = []
    for turn in np.arange(TURNS) * (0.5 * np.pi / TURNS):
        u, v = np.cos(turn) * x + np.sin(turn) * y, -np.sin(turn) * x + np.cos(turn) * y
        window = ((np.abs(u) <= WITHIN * side) & (np.abs(v) <= WITHIN * side)).astype(np.float64)
        pattern = np.sign(u) * np.sign(v) * window
        transforms = [rfftn(one[::-1, ::-1], extent) for one in (pattern, window, np.abs(pattern))]
        patterns.append(_Pattern(float(turn), len(grid), float(window.sum()), extent, *transforms))
    return tuple(patterns)


def _correlation(spectra: Mapping[str, Spectrum], pattern: _Pattern, width: int) -> Floats:
    """Normalised correlation (width, width) of an image with a pattern about each of its cells.

    ``spectra`` are of where the image is ``there``, of the ``image``, 0 where it is not, and of its ``square``.
    """
    first = (pattern.cells - 1) // 2
    middle = slice(first, first + width)

    def slid(name: str, weights: Spectrum) -> Floats:
        summed: Floats = irfftn(spectra[name] * weights, pattern.extent)[middle, middle]
        return summed

    n = np.maximum(slid("there", pattern.of_window), 0.0)
    mean = slid("image", pattern.of_window) / np.maximum(n, 1.0)
    covariance = slid("image", pattern.of_pattern) - mean * slid("there", pattern.of_pattern)
    spread = np.maximum(slid("square", pattern.of_window) - n * mean**2, 0.0)
    size = np.sqrt(spread * np.maximum(slid("there", pattern.of_size), 1.0))
    full = n > FILLED * pattern.window
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(full & (size > 0.0), covariance / size, 0.0)


def _lines(at: Floats, centre_turn: Floats) -> tuple[Floats, Floats]:
    """Return signed distances (m,) of places (m, 2) from the two lines through a centre, at a turn."""
    x, y, turn = centre_turn[:3]
    dx, dy = at[:, 0] - x, at[:, 1] - y
    c, s = np.cos(turn), np.sin(turn)
    return c * dx + s * dy, -s * dx + c * dy


def _fitted(plane: _Plane, intensity: Floats, start: Floats, side: float) -> Checkerboard | None:
    """Fit the pattern to the intensities; None where it is no target."""
    found = start
    for window in (0.9 * WITHIN, WITHIN):
        rows = _inside(plane.at, found, window * side)
        if rows.sum() < LEAST_POINTS:
            return None
        at, bright = plane.at[rows], intensity[rows]
        spacing = (2.0 * window * side) / np.sqrt(len(at))
        fit = _least_squares(at, bright, found, spacing, side)
        found = fit.x[:3]
    u, v = _lines(plane.at, found)
    residual = fit.fun
    explained = 1.0 - float((residual**2).mean() / bright.var())
    if explained < EXPLAINED or not _has_fields(u[rows], v[rows], bright, WITHIN * side, spacing):
        return None
    if _goes_on(u, v, intensity, abs(float(fit.x[4])), side) or float(np.sqrt((plane.off[rows] ** 2).mean())) > FLAT_MM:
        return None
    sampling = [_sampling_sd(d, other, spacing, float(fit.x[5])) for d, other in ((u, v), (v, u))]
    # Many scanners measure other ranges to dark fields than to bright ones. The plane lies midway, and which colour
    # is right is not known: half of the difference, as far as it exceeds the noise, counts as a standard deviation.
    first = u[rows] * v[rows] > 0.0
    off = plane.off[rows]
    mean_variance = float((off**2).mean()) / len(off)
    fields = (off[first], off[~first])
    noise = sum(float(one.var()) / len(one) for one in fields)
    difference = float(fields[0].mean() - fields[1].mean())
    across = float(np.sqrt(mean_variance + max(difference**2 - noise, 0.0) / 4.0))
    return _placed(plane, plane.off[rows], fit, np.array([*sampling, across]), explained)


def _inside(at: Floats, centre_turn: Floats, reach: float) -> Bools:
    u, v = _lines(at, centre_turn)
    inside: Bools = (np.abs(u) < reach) & (np.abs(v) < reach)
    return inside


def _model(at: Floats, x: Floats) -> Floats:
    """Return the pattern's intensities (m,) at (m, 2) for centre, turn, mean, half step and width ``x`` (6,)."""
    u, v = _lines(at, x)
    return np.asarray(x[3] + x[4] * erf(u / x[5]) * erf(v / x[5]))


def _slopes(at: Floats, x: Floats) -> Floats:
    """Return the derivatives (m, 6) of the model: finite differences take the time of six more models."""
    u, v = _lines(at, x)
    c, s, half, width = np.cos(x[2]), np.sin(x[2]), x[4], x[5]
    along_u, along_v = erf(u / width), erf(v / width)
    slope = 2.0 / (np.sqrt(np.pi) * width)
    by_u = half * slope * np.exp(-((u / width) ** 2)) * along_v
    by_v = half * slope * np.exp(-((v / width) ** 2)) * along_u
    of_pose = (s * by_v - c * by_u, -s * by_u - c * by_v, v * by_u - u * by_v)
    return np.stack([*of_pose, np.ones(len(at)), along_u * along_v, -(u * by_u + v * by_v) / width], axis=1)


def _least_squares(at: Floats, bright: Floats, start: Floats, spacing: float, side: float) -> Any:
    """Fit centre, turn, mean, half step and width of the pattern to the intensities ``bright`` (m,) at (m, 2)."""

    def residuals(x: Floats) -> Floats:
        return _model(at, x) - bright

    u, v = _lines(at, start)
    step = float(np.mean(np.sign(u * v) * (bright - bright.mean())))
    least = LEAST_WIDTH * spacing
    begin = np.array([*start[:3], bright.mean(), step, 1.5 * spacing])
    low = np.array([*(start[:2] - 0.2 * side), start[2] - 0.3, -np.inf, -np.inf, least])
    high = np.array([*(start[:2] + 0.2 * side), start[2] + 0.3, np.inf, np.inf, 0.2 * side])
    scale = np.array([spacing, spacing, 0.05, abs(step) + 1e-12, abs(step) + 1e-12, spacing])
    begin = np.clip(begin, low, high)
    return least_squares(residuals, begin, partial(_slopes, at), bounds=(low, high), x_scale=scale, xtol=1e-10)


def _has_fields(u: Floats, v: Floats, bright: Floats, reach: float, spacing: float) -> bool:
    """Whether all four fields are there, and those of one colour alike."""
    inner = (np.abs(u) > spacing) & (np.abs(v) > spacing)
    means = []
    expected = FILLED * (reach - spacing) ** 2 / spacing**2
    for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        of_field = inner & (a * u > 0.0) & (b * v > 0.0)
        if of_field.sum() < max(LEAST_OF_A_FIELD, expected):
            return False
        means.append(float(np.median(bright[of_field])))
    first, second = means[:2], means[2:]
    step = abs(np.mean(first) - np.mean(second))
    if step < LEAST_STEP * max(map(abs, means)):
        return False
    return bool(max(abs(first[0] - first[1]), abs(second[0] - second[1])) <= ALIKE * step)


def _goes_on(u: Floats, v: Floats, intensity: Floats, half_step: float, side: float) -> bool:
    """Whether the pattern goes on beyond two or more of its sides: as a step like its own, of either sign."""
    strip = []
    for across, along in ((u, v), (-u, v), (v, u), (-v, u)):
        beside = (across > BEYOND[0] * side) & (across < BEYOND[1] * side) & (np.abs(along) < WITHIN * side)
        halves = [intensity[beside & (sign * along > 0.1 * side)] for sign in (1.0, -1.0)]
        if min(map(len, halves)) >= LEAST_BESIDE:
            strip.append(abs(float(halves[0].mean() - halves[1].mean())))
    return sum(one > GOES_ON * 2.0 * half_step for one in strip) >= 2


def _sampling_sd(d: Floats, other: Floats, spacing: float, width: float) -> float:
    """Return the sd of a line's place by the sampling of the step across it; distances ``d`` (m,) from the line.

    Where the lines of the scanner's grid run along the step, all rows sample it at the same places, and what lies
    between two of them is not seen. The place of a step is the sum of its samples times their period p. By Poisson's
    summation formula that of a step at x, blurred by a Gaussian of sd s, is off by the sum over k of p / (pi k)
    exp(-2 pi^2 k^2 s^2 / p^2) sin(2 pi k x / p), of which the first term counts. The resultant length of the distances
    as angles at the period is 1 for such a grid; where it is 0 the misplacements of the rows average out. A width at
    its least shows that the blur is not seen: the step may be sharp, anywhere between two rows.
    """
    near = (np.abs(d) < 4.0 * spacing) & (np.abs(other) > spacing)
    if not near.any():
        return spacing

    def misplaced(periods: Floats) -> Floats:
        alias: Floats = periods / np.pi * np.exp(-2.0 * (np.pi * width / np.sqrt(2.0) / periods) ** 2) / np.sqrt(2.0)
        return alias

    count = float(near.sum())
    periods = spacing * np.linspace(*PERIODS)
    aligned = np.abs(np.exp(2j * np.pi * d[near, None] / periods).mean(axis=0)) ** 2
    of_rows = periods / np.sqrt(12.0) if width < SHARP * LEAST_WIDTH * spacing else misplaced(periods)
    common = float((np.maximum(aligned - BY_CHANCE / count, 0.0) * of_rows**2).max())
    rows = max(np.sqrt(count), 1.0)
    return float(np.sqrt(common + misplaced(np.array([spacing]))[0] ** 2 / rows))


def _placed(plane: _Plane, off: Floats, fit: Any, sd: Floats, explained: float) -> Checkerboard | None:
    """Return the target in space; its covariance is that of fit and sampling in the plane, and of the plane across it.

    ``sd`` (3,) are standard deviations of the sampling across the two lines, and of the plane. Errors that all points
    of a view share are not contained.
    """
    J, residual, found = fit.jac, fit.fun, fit.x[:3]
    variance = float(residual @ residual) / max(len(residual) - J.shape[1], 1)
    try:
        in_plane = variance * np.linalg.inv(J.T @ J)[:2, :2]
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(in_plane).all() and (np.diag(in_plane) > 0.0).all()):
        return None
    c, s = np.cos(found[2]), np.sin(found[2])
    across = np.array([[c, s], [-s, c]])
    local = np.zeros((3, 3))
    local[:2, :2] = in_plane + across.T @ np.diag(sd[:2] ** 2) @ across
    local[2, 2] = sd[2] ** 2
    axes = plane.axes
    centre = plane.middle + found[:2] @ axes[:2] + off.mean() * axes[2]
    return Checkerboard(centre=centre, covariance=axes.T @ local @ axes, points=len(off), fit=explained)
