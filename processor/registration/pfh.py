"""Point feature histograms and coarse alignment by them (paper 000, section 2.6)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor import diagnostics
from processor.geometry import rigid
from processor.model import Floats, Ints

SAMPLE = 3  # pairs that determine a pose
BEFORE = np.roll(np.arange(SAMPLE), 1)
MOST_AT_ONCE = 1 << 16  # points that are moved by poses at once


def normals(points: Floats, radius_mm: float) -> Floats:
    """Estimate unit normals (n, 3) of points (n, 3): least principal direction of the neighbours, away from the mean.

    Along a straight line of points the normal is not unique; one of the possible ones is returned, as in the paper.
    """
    tree = cKDTree(points)
    outward = points - points.mean(axis=0)
    result = np.zeros_like(points)
    for i, neighbours in enumerate(tree.query_ball_point(points, radius_mm)):
        local = points[neighbours] - points[neighbours].mean(axis=0)
        normal = np.linalg.eigh(local.T @ local)[1][:, 0]
        result[i] = normal if normal @ outward[i] >= 0.0 else -normal
    return result


def pair_features(points: Floats, point_normals: Floats, i: Ints, j: Ints) -> Floats:
    """Angles alpha, beta (as cosines) and theta (rad) of point pairs (i, j), (k, 3); paper 000 eq. 3 and 4.

    The source of a pair is the point whose normal has the smaller angle to the line to the other (Rusu), so that the
    result does not depend on the order of the points. NaN for coincident points.
    """
    line = points[j] - points[i]
    distance = np.linalg.norm(line, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = line / distance[:, None]
    swap = np.abs(np.einsum("ki,ki->k", point_normals[i], unit)) < np.abs(np.einsum("ki,ki->k", point_normals[j], unit))
    unit = np.where(swap[:, None], -unit, unit)
    U = np.where(swap[:, None], point_normals[j], point_normals[i])
    N = np.where(swap[:, None], point_normals[i], point_normals[j])
    V = np.cross(U, unit)
    length = np.linalg.norm(V, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        V = V / length[:, None]
    W = np.cross(U, V)
    return np.stack(
        [
            np.einsum("ki,ki->k", V, N),
            np.einsum("ki,ki->k", U, unit),
            np.arctan2(np.einsum("ki,ki->k", W, N), np.einsum("ki,ki->k", U, N)),
        ],
        axis=1,
    )


def histograms(
    points: Floats, point_normals: Floats, radius_mm: float, bins: int = 5, rows: Ints | None = None
) -> Floats:
    """PFH (k, bins^3) at ``rows`` (k,) of points (n, 3), or at all: the shares of all pairs near each, itself included.

    Each angle's range is cut into ``bins`` equal parts; alpha varies fastest. Pairs without a frame (coincident, or a
    line along the normal) are left out; a point without pairs has a histogram of zeros.
    """
    tree, places = cKDTree(points), points if rows is None else points[rows]
    result = np.zeros((len(places), bins**3))
    low, span = np.array([-1.0, -1.0, -np.pi]), np.array([2.0, 2.0, 2.0 * np.pi])
    for query, near in enumerate(tree.query_ball_point(places, radius_mm)):
        neighbours = np.array(sorted(near))
        first, second = np.triu_indices(len(neighbours), 1)
        features = pair_features(points, point_normals, neighbours[first], neighbours[second])
        features = features[np.isfinite(features).all(axis=1)]
        if len(features) == 0:
            continue
        cell = np.clip(np.floor((features - low) / span * bins).astype(np.int64), 0, bins - 1)
        flat = cell @ np.array([1, bins, bins * bins])
        result[query] = np.bincount(flat, minlength=bins**3) / len(features)
    return result


@dataclass(frozen=True)
class Prior:
    """A first pose T_target_source (4, 4), and how far from it the coarse pose may be: in deg, and in mm at any point.

    A rectangle of points lies on itself when turned by 180 degrees about any of its three axes: its histograms are the
    same at four places, and nothing but a first pose can tell them apart.
    """

    T_target_source: Floats
    limit_deg: float
    limit_mm: float

    def allows(self, T: Floats, points: Floats) -> bool:
        """Whether a pose (4, 4) of points (n, 3) is within the limits."""
        turn = np.degrees(rigid.rotation_angle(T[:3, :3] @ self.T_target_source[:3, :3].T))
        moved = np.linalg.norm(rigid.apply(T, points) - rigid.apply(self.T_target_source, points), axis=1)
        return bool(turn <= self.limit_deg and moved.max() <= self.limit_mm)


def coarse_alignment(
    source: Floats,
    target: Floats,
    source_histograms: Floats,
    target_histograms: Floats,
    *,
    tolerance_mm: float,
    iterations: int,
    rng: np.random.Generator,
    prior: Prior | None = None,
) -> Floats | None:
    """T_target_source (4, 4) from pairs of nearest histograms: poses by three pairs; the one with most pairs is taken.

    A sample of three is skipped if its sides differ by more than the tolerance between the clouds. With a ``prior`` a
    point is paired only with points near its first place, and poses beyond the limits do not count; None where none is
    within them. Without, the result may be wrong on repeated or straight shapes, whatever share of the pairs agrees.
    """
    rows, match = _nearest_histograms(source, target, source_histograms, target_histograms, prior)
    best, best_count = None if prior else np.eye(4), -1
    if len(rows) < SAMPLE:
        return best
    points, paired = source[rows], target[match]
    scores = np.linalg.norm(target_histograms[match] - source_histograms[rows], axis=1)
    for T, count in _poses_of_samples(points, paired, iterations, tolerance_mm, rng):
        if count > best_count and (prior is None or prior.allows(T, source)):
            best, best_count = T, count
    diagnostics.note(
        "histograms", pairs=len(rows), score_median=float(np.median(scores)), trials=iterations, agreeing=best_count
    )
    if best is None:
        return None
    # A pose fitted to all pairs that agree with it is taken where that keeps within the limits.
    agree = np.linalg.norm(rigid.apply(best, points) - paired, axis=1) <= tolerance_mm
    if agree.sum() < SAMPLE:
        return best
    fitted = rigid.fit(points[agree], paired[agree])
    return fitted if prior is None or prior.allows(fitted, source) else best


def _poses_of_samples(
    points: Floats, paired: Floats, iterations: int, tolerance_mm: float, rng: np.random.Generator
) -> Iterator[tuple[Floats, int]]:
    """Yield the poses (4, 4) by samples of three pairs whose sides are alike, and how many pairs agree with each."""
    picks = np.array([rng.choice(len(points), SAMPLE, replace=False) for _ in range(iterations)]).reshape(-1, SAMPLE)
    for some in np.array_split(picks, max(1, iterations * len(points) // MOST_AT_ONCE)):
        a, b = points[some], paired[some]
        sides = np.linalg.norm(a - a[:, BEFORE], axis=2) - np.linalg.norm(b - b[:, BEFORE], axis=2)
        alike = np.abs(sides).max(axis=1) <= tolerance_mm
        T = rigid.fit(a[alike], b[alike])
        moved = points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        yield from zip(T, (np.linalg.norm(moved - paired, axis=2) <= tolerance_mm).sum(axis=1).tolist(), strict=True)


def _nearest_histograms(
    source: Floats, target: Floats, source_histograms: Floats, target_histograms: Floats, prior: Prior | None
) -> tuple[Ints, Ints]:
    """Rows (k,) of the source that have a pair, and of the target's points with the nearest histograms."""
    if prior is None:
        match: Ints = np.asarray(cKDTree(target_histograms).query(source_histograms)[1], np.int64)
        return np.arange(len(source)), match
    rows, matches = [], []
    placed = rigid.apply(prior.T_target_source, source)
    for i, near in enumerate(cKDTree(target).query_ball_point(placed, prior.limit_mm)):
        if near:
            at = np.array(sorted(near))
            rows.append(i)
            matches.append(at[np.argmin(np.linalg.norm(target_histograms[at] - source_histograms[i], axis=1))])
    return np.array(rows, np.int64), np.array(matches, np.int64)
