"""Detection of spheres in a whole cloud, without a design or a crop.

Patches of the cloud at every scale propose spheres: a patch about as wide as a ball holds most of its visible surface
and little else, however small a share of the cloud the ball is. Each scale uses the cloud thinned to a cell, so that
the lines of a scanner weigh no more than the space between them. A ball is accepted if the points within the noise of
its surface far outnumber those beside it, and the cloud's own normals are those of the ball.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor.geometry import point_grid
from processor.geometry.linalg_small import assign, eigen
from processor.geometry.sphere import Sphere, canonical_order
from processor.geometry.sphere_evidence import (
    BAND,
    EVIDENCE_CELLS,
    RADIUS_BAND,
    STANDS_OUT,
    Grade,
    Limits,
    denser,
    facing,
    grade,
    inlier_share,
    rows_of_cells,
)
from processor.geometry.sphere_fit import LEAST_SCALE, RobustFit, robust_fit
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Floats, Ints
from processor.robust_statistics import MAD_TO_SD

# Residuals of scanners are correlated.
LIMITS = Limits(facing=0.985, likely_facing=None, thinned=True, white=0.5, shape=0.01, small=0.005)
LEAST_POINTS = 40  # on a ball; with fewer, balls occur anywhere by chance
STEP = 1.5  # between scales
FINEST = 20  # neighbours of a point within the smallest scale
CELLS = 8.0  # of a thinned cloud, in a patch's radius
LEAST_CELLS = 24  # of a patch
MOST_PATCHES = 100_000  # of one scale
APART = 0.7  # of patches, in their radii
SETS = 48  # of four points, of each patch
SMALLEST, LARGEST = 0.6, 1.6  # radius of a proposal, in patch radii
FLAT = 0.04  # thickness of a patch, in its radii, below which it is a plane or an edge
REFINED = 40  # best proposals of each scale, which are tried
REFINEMENTS = 3  # work: of a proposal by the points near it, before the robust fit
ROUGHLY_FACING = 0.9  # median cosine between the cloud's own normals and those of a proposal
NEAR = 1.7  # radii of a proposal: points about its centre that a ball is fitted to
AROUND = 1.4  # radii of a ball: its surroundings
LIKELY_MM = 1500.0  # larger balls are searched for only where there is none below
LEAST_FLAT, MOST_FLAT = 8, 2000  # patches that the noise of a cloud rests on
LEAST_SPREAD = 0.15  # of such a patch across its longest side, in its width: not one line of a scanner


@dataclass(frozen=True)
class Ball:
    """A ball in the cloud, the share of the points around it that lie on it, and whether it passes every test."""

    fit: RobustFit
    inlier_share: float
    certain: bool = True


class Cloud(NamedTuple):
    """Points (n, 3) in canonical order, their tree, and the position each was seen from (n, 3), or None."""

    points: Floats
    tree: cKDTree
    scanner: Floats | None


def find_balls(
    points: Floats,
    rng: np.random.Generator,
    most: int,
    least_points: int = LEAST_POINTS,
    radius_mm: float | None = None,
    scanner: Floats | None = None,
) -> list[Ball]:
    """Find up to ``most`` balls among points (n, 3), mm, the clearest first; inliers are of all points (n,).

    ``radius_mm`` fixes the radius; ``scanner`` (n, 3) is the position each point was seen from. Balls never overlap, so
    that mixed pixels and mounts around a ball do not make a second one. Work is bounded: at most MOST_PATCHES patches
    of a scale are looked at. The result does not depend on the order of the points.
    """
    if len(points) < least_points:
        return []
    order = canonical_order(points)
    origin = points.mean(axis=0)
    cloud = points[order] - origin
    seen_from = None if scanner is None else scanner[order] - origin
    whole = Cloud(cloud, cKDTree(cloud), seen_from)
    scales = _scales(whole, radius_mm)
    balls: list[Ball] = []
    for some in (scales[scales <= LIKELY_MM], scales[scales > LIKELY_MM]):
        if not balls:
            proposals = [one for scale in some for one in _proposals(cloud, scale, rng, radius_mm)]
            balls = _clearest(whole, proposals, most, least_points, radius_mm)
    return [_in_place(ball, order, origin) for ball in balls]


def _clearest(
    cloud: Cloud, proposals: list[tuple[float, Sphere]], most: int, least_points: int, radius_mm: float | None
) -> list[Ball]:
    """Accept balls among proposals with scores, the best first."""
    balls: list[Ball] = []
    for _, start in sorted(proposals, key=lambda one: -one[0]):
        if len(balls) == most:
            break
        if any(_overlap(start, other.fit.sphere) for other in balls):
            continue
        ball = _accepted(cloud, start, least_points, radius_mm)
        if ball is not None and not any(_overlap(ball.fit.sphere, other.fit.sphere) for other in balls):
            balls.append(ball)
    return balls


def _overlap(a: Sphere, b: Sphere) -> bool:
    return bool(np.linalg.norm(a.centre - b.centre) < 0.9 * (a.radius + b.radius))


def _in_place(ball: Ball, order: Ints, origin: Floats) -> Ball:
    return Ball(ball.fit.in_place(len(order), order, origin), ball.inlier_share)


# --- proposals -------------------------------------------------------------------------------------------------------


def _scales(cloud: Cloud, radius_mm: float | None) -> Floats:
    """Radii of patches: a fixed radius alone, or all from the densest place's points to half of the cloud."""
    if radius_mm is not None:
        return np.array([radius_mm])
    points = cloud.points
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    some = points[:: max(1, len(points) // 2000)]
    away = cloud.tree.query(some, k=min(FINEST, len(points)))[0][:, -1]
    finest = max(float(np.quantile(away, 0.02)), 1e-4 * extent)
    if not finest < 0.5 * extent:
        return np.empty(0)
    count = int(np.log(0.5 * extent / finest) / np.log(STEP)) + 1
    scales: Floats = finest * np.power(STEP, np.arange(count, dtype=np.float64))
    return scales


def _proposals(
    cloud: Floats, scale: float, rng: np.random.Generator, radius_mm: float | None
) -> list[tuple[float, Sphere]]:
    """Spheres of one scale with their scores, the best of each place."""
    few = cloud[rows_of_cells(cloud, scale / CELLS)]
    seeds = few[rows_of_cells(few, APART * scale)]
    if len(seeds) > MOST_PATCHES:
        seeds = seeds[np.sort(rng.choice(len(seeds), MOST_PATCHES, replace=False))]
    cells = point_grid.of_points(few, scale).cells
    spheres, scores = np.zeros((len(seeds), 4)), np.zeros(len(seeds))
    band = (SMALLEST * scale, LARGEST * scale)
    if radius_mm is not None:
        band = ((1.0 - RADIUS_BAND) * radius_mm, (1.0 + RADIUS_BAND) * radius_mm)
    draws = rng.random((SETS, 4))
    over_ranges(partial(_propose, cells, seeds, scale, band, draws, spheres, scores), len(seeds), least=64)
    found: list[tuple[float, Sphere]] = []
    tree = cKDTree(few)
    for row in np.argsort(-scores, kind="stable")[: 4 * REFINED].tolist():
        if len(found) == REFINED or scores[row] < LEAST_CELLS / 3.0:
            break
        start = Sphere(spheres[row, :3], float(spheres[row, 3]), np.zeros((4, 4)))
        if any(np.linalg.norm(start.centre - other.centre) < 0.3 * start.radius for _, other in found):
            continue
        near = few[np.sort(np.array(tree.query_ball_point(start.centre, 1.5 * start.radius), np.int64))]
        if denser(near, start, 0.6 * STANDS_OUT):
            found.append((_score(near, start), start))
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _propose(cells, seeds, scale, band, draws, spheres, scores, first, last):  # type: ignore[no-untyped-def]
    """Fill the best sphere (4,) through four points of the patch about each seed, and its score; 0 = none."""
    rows = np.empty(4096, np.int64)
    for s in range(first, last):
        count = _patch(cells, seeds[s], scale, rows)
        if count < LEAST_CELLS:
            continue
        patch = np.empty((count, 3))
        for i in range(count):
            for a in range(3):
                patch[i, a] = cells.points[rows[i], a] - seeds[s, a]
        if _thickness(patch) < FLAT * scale:
            continue
        for q in range(len(draws)):
            sphere = _through(patch, draws[q], count)
            if not band[0] <= sphere[3] <= band[1]:
                continue
            score = 0.0
            width = BAND * sphere[3]
            for i in range(count):
                x, y, z = patch[i, 0] - sphere[0], patch[i, 1] - sphere[1], patch[i, 2] - sphere[2]
                off = abs(np.sqrt(x * x + y * y + z * z) - sphere[3]) / width
                score += 1.0 - off * off if off < 1.0 else -0.5 if off < 3.0 else 0.0
            if score > scores[s]:
                scores[s] = score
                assign(spheres[s], sphere)
        if scores[s] > 0.0:
            _refine(patch, spheres[s])
            for a in range(3):
                spheres[s, a] += seeds[s, a]


@inner_ieee
def _patch(cells, place, reach, rows):  # type: ignore[no-untyped-def]
    """Fill the rows of the points within ``reach`` of a place; returns their number."""
    n = 0
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        end = point_grid.SIDE * cells.extent[a] - 1
        low[a] = min(max(int((place[a] - reach - cells.lower[a]) / cells.size), 0), end)
        high[a] = min(max(int((place[a] + reach - cells.lower[a]) / cells.size), 0), end)
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            for k in range(low[2], high[2] + 1):
                block = point_grid.block_at(cells, i >> 2, j >> 2, k >> 2)
                if block < 0:
                    continue
                cell = (i & 3) * 16 + (j & 3) * 4 + (k & 3)
                for row in range(cells.starts[block, cell], cells.starts[block, cell + 1]):
                    x, y, z = (
                        cells.points[row, 0] - place[0],
                        cells.points[row, 1] - place[1],
                        cells.points[row, 2] - place[2],
                    )
                    if x * x + y * y + z * z <= reach * reach and n < len(rows):
                        rows[n] = row
                        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _thickness(patch):  # type: ignore[no-untyped-def]
    """Least standard deviation of points (n, 3) along any direction."""
    mean, C = np.zeros(3), np.zeros((3, 3))
    for i in range(len(patch)):
        for a in range(3):
            mean[a] += patch[i, a] / len(patch)
    for i in range(len(patch)):
        for a in range(3):
            for b in range(3):
                C[a, b] += (patch[i, a] - mean[a]) * (patch[i, b] - mean[b]) / len(patch)
    return np.sqrt(max(np.linalg.eigvalsh(C)[0], 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _through(patch, draw, count):  # type: ignore[no-untyped-def]
    """Sphere (x, y, z, r) through four points drawn from a patch; r = -1 where they lie in one plane."""
    p = np.empty((4, 3))
    for m in range(4):
        row = int(draw[m] * count)
        for a in range(3):
            p[m, a] = patch[row, a]
    M, right = np.empty((3, 3)), np.empty(3)
    size = 0.0
    for m in range(3):
        right[m] = 0.0
        for a in range(3):
            M[m, a] = p[m + 1, a] - p[0, a]
            right[m] += 0.5 * M[m, a] * M[m, a]
        size = max(size, np.sqrt(2.0 * right[m]))
    c = np.empty(3)
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        c[a] = 0.0
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            c[a] += right[m] * (M[n, b] * M[o, d] - M[n, d] * M[o, b])
    det = (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )
    sphere = np.full(4, -1.0)
    if abs(det) > 1e-9 * size**3:
        c /= det
        for a in range(3):
            sphere[a] = p[0, a] + c[a]
        sphere[3] = np.sqrt(c[0] ** 2 + c[1] ** 2 + c[2] ** 2)
    return sphere


@inner_ieee
def _refine(patch, sphere):  # type: ignore[no-untyped-def]
    """Algebraic fits to the points of a patch near a sphere (x, y, z, r), in place."""
    row = np.empty(4)
    for _ in range(REFINEMENTS):
        radius = sphere[3]
        H, right = np.zeros((4, 4)), np.zeros(4)
        for i in range(len(patch)):
            square, off2 = 0.0, 0.0
            for a in range(3):
                row[a] = -2.0 * patch[i, a] / radius
                square += (patch[i, a] / radius) ** 2
                off2 += (patch[i, a] - sphere[a]) ** 2
            row[3] = 1.0
            if abs(np.sqrt(off2) - radius) < BAND * radius:
                for a in range(4):
                    right[a] -= row[a] * square
                    for b in range(4):
                        H[a, b] += row[a] * row[b]
        for a in range(4):
            H[a, a] += 1e-9
        x = np.linalg.solve(H, right)
        under = x[0] * x[0] + x[1] * x[1] + x[2] * x[2] - x[3]
        if not under > 0.25 or under > 4.0:
            return
        for a in range(3):
            sphere[a] = x[a] * radius
        sphere[3] = np.sqrt(under) * radius


def _score(points: Floats, ball: Sphere) -> float:
    """Points at the surface less those beside it, weighted by the square of the distance."""
    off = np.abs(ball.residuals(points)) / (BAND * ball.radius)
    return float(np.sum(np.maximum(1.0 - off**2, 0.0)) - 0.5 * np.count_nonzero((off > 1.0) & (off <= 3.0)))


# --- evidence --------------------------------------------------------------------------------------------------------


def _accepted(cloud: Cloud, start: Sphere, least_points: int, radius_mm: float | None) -> Ball | None:
    """Fit a sphere to the points near a proposal, first thinned ones, and return it if it is a ball."""
    points, tree, scanner = cloud
    near, fit = np.empty(0, np.int64), None
    for least in (LEAST_CELLS, least_points):
        near = np.sort(np.array(tree.query_ball_point(start.centre, NEAR * start.radius), np.int64))
        if len(near) < least_points:
            return None
        if fit is None:
            near = near[rows_of_cells(points[near], start.radius / EVIDENCE_CELLS)]
        off = np.abs(start.residuals(points[near]))
        close = off < BAND * start.radius
        if np.count_nonzero(close) < least // 2 or facing(points[near], close, start) < ROUGHLY_FACING:
            return None
        scale = max(2.0 * MAD_TO_SD * float(np.median(off[close])), LEAST_SCALE * start.radius)
        fit = robust_fit(points[near], start, scale, radius_mm, None if scanner is None else scanner[near])
        if fit is None or grade(points[near], fit, least, radius_mm is not None, LIMITS) is not Grade.CERTAIN:
            return None
        moved = float(np.linalg.norm(fit.sphere.centre - start.centre))
        if moved + AROUND * fit.sphere.radius > NEAR * start.radius:
            return None  # its surroundings were not looked at
        start = fit.sphere
    if fit is None:
        return None
    return Ball(fit.in_place(len(points), near, np.zeros(3)), inlier_share(points[near], fit))


# --- noise of the cloud ----------------------------------------------------------------------------------------------


def flat_noise(points: Floats, width: float) -> float:
    """Median thickness (sd, mm) of flat patches of points (n, 3), ``width`` mm across; NaN with few patches.

    It is the scanner's noise where patches are flat, and more where they are not. The order of the points does not
    matter.
    """
    if len(rows_of_cells(points, width)) < LEAST_FLAT:
        return float("nan")
    cloud = points[canonical_order(points)]
    cloud = cloud - cloud.mean(axis=0)
    seeds = cloud[rows_of_cells(cloud, width)]
    seeds = seeds[:: len(seeds) // MOST_FLAT + 1]
    found = np.full(len(seeds), np.nan)
    _thicknesses(cloud, seeds, np.searchsorted(cloud[:, 0], seeds[:, 0] - 0.5 * width), 0.5 * width, found)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) >= LEAST_FLAT else float("nan")


@njit(cache=True, nogil=True, error_model="numpy")
def _thicknesses(points, places, first, reach, found):  # type: ignore[no-untyped-def]
    """Fill the thickness (m,) of the points (n, 3), ascending in x, about each place (m, 3), ``first`` (m,) of them on.

    NaN where they are few or lie in a line.
    """
    C, V, mean, off = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for q in range(len(places)):
        count = 0
        mean[:] = 0.0
        C[:] = 0.0
        for i in range(first[q], len(points)):
            off[0] = points[i, 0] - places[q, 0]
            if off[0] > reach:
                break
            off[1], off[2] = points[i, 1] - places[q, 1], points[i, 2] - places[q, 2]
            if off[0] ** 2 + off[1] ** 2 + off[2] ** 2 > reach * reach:
                continue
            count += 1
            for a in range(3):
                mean[a] += off[a]
                for b in range(a + 1):
                    C[a, b] += off[a] * off[b]
        if count < LEAST_CELLS:
            continue
        for a in range(3):
            for b in range(a + 1):
                C[a, b] = (C[a, b] - mean[a] * mean[b] / count) / (count - 3)
                C[b, a] = C[a, b]
        eigen(C, V)
        least, most = min(C[0, 0], C[1, 1], C[2, 2]), max(C[0, 0], C[1, 1], C[2, 2])
        if C[0, 0] + C[1, 1] + C[2, 2] - least - most > (2.0 * LEAST_SPREAD * reach) ** 2:
            found[q] = np.sqrt(max(least, 0.0))
