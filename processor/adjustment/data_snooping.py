"""Data snooping: tests for gross errors in control points, sightings and scans (Baarda 1968).

Two forms of the test serve two kinds of adjustment. :func:`strongest` tests the misfits of one adjustment for an error
in some directions: a common shift of all sightings of a point, of a single one, or a motion of all that a scan saw. By
chance, the part of the squares that such an error explains is chi-square distributed with as many degrees of freedom.
:func:`leave_out` predicts each sighting from an adjustment without it, where an adjustment is one linear step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import chdtri

from processor.geometry.linalg_small import cholesky, solve
from processor.geometry.rigid import LEAST_POINTS
from processor.model import Bools, Floats, Ints

# --- Tests of the misfits of one adjustment

BY_CHANCE = 1e-3  # probability that a network without a blunder raises any suspicion
DISTINCT = 9.2  # of squares: a suspicion explains 100 times better than its rivals (twice the logarithm)
LEAST_SHARE = 1e-6  # of an error that is visible in the misfits
SINGULAR = 1e-9


class Misfits(Protocol):
    """Misfits of an adjustment; see :class:`processor.stitching.fine.control_points.Fit`."""

    @property
    def misfit(self) -> Floats:
        """Known less seen places (3m,)."""

    @property
    def weight(self) -> Floats:
        """Inverse (3m, 3m) of their covariance."""

    @property
    def cofactor(self) -> Floats:
        """The same less the part that the common motion absorbs."""

    @property
    def by_scans(self) -> Floats:
        """Derivative (3m, 6k) of the placed points by the scans' motions."""


@dataclass(frozen=True)
class Suspicion:
    """The strongest suspicion: an error of ``number``, a point, a sighting or a scan, in the sightings ``rows``.

    ``rivals`` are all suspicions that explain the misfits as well, this one first.
    """

    kind: str  # point | sighting | scan
    number: int
    rows: Ints
    size_mm: float
    rivals: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class _Tested:
    """A suspicion, how far the squares it explains are beyond chance, and the size of the error, mm."""

    kind: str
    number: int
    rows: Ints
    beyond: float
    size_mm: float


def beyond_chance(square: float, dof: int) -> bool:
    """Overall test of the model: whether the weighted sum of squared misfits exceeds its quantile of chi-square."""
    return dof > 0 and square > float(chdtri(dof, BY_CHANCE))


def strongest(fit: Misfits, point: Ints, scan: Ints) -> Suspicion | None:
    """Return the strongest suspicion beyond chance among sightings of ``point`` (m,) in ``scan`` (m,), or None."""
    every = list(_suspicions(fit, point, scan))
    level = BY_CHANCE / len(every)
    tested = [_Tested(kind, number, rows, *_beyond(fit, G, level)) for kind, number, rows, G in every]
    tested = sorted((test for test in tested if test.beyond > 0.0), key=lambda test: -test.beyond)
    if not tested:
        return None
    best = tested[0]
    near = [test for test in tested if test.beyond > best.beyond - DISTINCT]
    points = {int(point[test.rows[0]]) if test.kind != "scan" else -1 for test in near}
    if len(near) > 1 and len(points) == 1 and -1 not in points:
        # A wrong coordinate and a wrong sighting of the point are not distinguishable: the whole point is suspected.
        number = points.pop()
        rows = np.flatnonzero(point == number)
        return Suspicion("point", number, rows, best.size_mm, (("point", number),))
    return Suspicion(best.kind, best.number, best.rows, best.size_mm, tuple((test.kind, test.number) for test in near))


def _suspicions(fit: Misfits, point: Ints, scan: Ints) -> Iterator[tuple[str, int, Ints, Floats]]:
    """Yield kind, number, sightings, and the derivative (3m, 3 or 6) of the misfits by the suspected error."""
    m = len(point)
    unit = np.eye(3 * m).reshape(3 * m, m, 3)
    for number in np.unique(point).tolist():
        rows = np.flatnonzero(point == number)
        yield "point", number, rows, unit[:, rows].sum(axis=1)
        if len(rows) > 1:
            for i in rows.tolist():
                yield "sighting", i, np.array([i]), unit[:, i]
    for number in np.unique(scan).tolist():
        rows = np.flatnonzero(scan == number)
        if len(np.unique(point[rows])) >= LEAST_POINTS:
            yield "scan", number, rows, fit.by_scans[:, 6 * number : 6 * number + 6]


def _beyond(fit: Misfits, G: Floats, level: float) -> tuple[float, float]:
    """Square that an error along G (3m, n) explains less its quantile of chance, and the size of the error, mm."""
    length = np.linalg.norm(G, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    G = G / length
    value, V = np.linalg.eigh(G.T @ fit.weight @ G)
    regular = value > SINGULAR * value[-1]
    V = V[:, regular] / np.sqrt(value[regular])
    share, turn = np.linalg.eigh(V.T @ (G.T @ fit.cofactor @ G) @ V)
    visible = share > LEAST_SHARE
    if not visible.any():
        return -np.inf, 0.0
    V = V @ turn[:, visible] / np.sqrt(share[visible])
    z = V.T @ (G.T @ (fit.cofactor @ fit.misfit))
    error = (V @ z) / length
    return float(z @ z) - float(chdtri(int(visible.sum()), level)), float(np.linalg.norm(error[-3:]))


# --- Predictions of each sighting from an adjustment without it

UNLIKELY = 1e-4  # probability that a point without a blunder is suspected

# Of sightings (m,) marked first and others (m,) marked second: how far (3n,) the first are from their prediction by the
# second, mm, and the covariance (3n, 3n) of that.
Prediction = Callable[[Bools, Bools], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Rejection:
    """A sighting in ``row``, or with None all of point ``number``, that is ``off_mm`` from what the others predict."""

    number: int
    row: int | None
    off_mm: float


@dataclass(frozen=True)
class Snooped:
    """Sightings (m,) accepted, those rejected in turn, and a point that contradicts the others by ``off`` (3,) mm.

    ``contradiction`` is that point where it cannot be decided which one is wrong, else None; ``alone`` if it is the
    only one.
    """

    accepted: Bools
    rejected: tuple[Rejection, ...]
    contradiction: int | None
    off: Floats
    alone: bool


def leave_out(point: Ints, predicted: Prediction) -> Snooped:
    """Test each point against the prediction by all others, and leave out the one that must be wrong, repeatedly.

    ``point`` (m,) numbers the point of each sighting. Of a point with several sightings single ones are left out where
    that is enough, at most half of them. Where it cannot be decided which point is wrong, all are accepted.
    """
    accepted, rejected = np.ones(len(point), bool), list[Rejection]()
    while accepted.any():
        worst, ratio, off = _worst(point, accepted, predicted)
        if ratio <= 1.0:
            break
        stray = _stray(point, accepted, worst, predicted)
        if stray:
            rejected += stray
            accepted[[sighting.row for sighting in stray if sighting.row is not None]] = False
            continue
        numbers = np.unique(point[accepted])
        without = [n for n in numbers.tolist() if _worst(point, accepted & (point != n), predicted)[1] <= 1.0]
        remain = len(numbers) - 1
        # One point alone explains the contradiction, or several are wrong and enough points remain to find the next.
        is_decided = len(without) == 1 or (not without and remain > LEAST_POINTS)
        if remain < LEAST_POINTS or not is_decided:
            return Snooped(accepted, tuple(rejected), worst, off, remain == 0)
        number = without[0] if without else worst
        size = _ratio(predicted, accepted & (point == number), accepted & (point != number))[1]
        rejected.append(Rejection(number, None, float(np.linalg.norm(size))))
        accepted = accepted & (point != number)
    return Snooped(accepted, tuple(rejected), None, np.zeros(3), False)


def _worst(point: Ints, accepted: Bools, predicted: Prediction) -> tuple[int, float, Floats]:
    """Return the least likely point by what the others predict, the ratio of :func:`_ratio`, and how far off (3,)."""
    worst: tuple[int, float, Floats] = (-1, 0.0, np.zeros(3))
    for number in np.unique(point[accepted]).tolist():
        ratio, off = _ratio(predicted, accepted & (point == number), accepted & (point != number))
        if ratio > worst[1]:
            worst = (number, ratio, off)
    return worst


def _stray(point: Ints, accepted: Bools, number: int, predicted: Prediction) -> list[Rejection]:
    """Sightings of a point without which its others agree with all points; none where more than half would have to go.

    The one with the largest normalised residual goes first. If more than half had to go, the point itself may as well
    be wrong.
    """
    of_point, left = point == number, accepted.copy()
    stray: list[Rejection] = []
    count = int((accepted & of_point).sum())
    while 2 * (len(stray) + 1) <= count:
        tests = []
        for row in np.flatnonzero(left & of_point).tolist():
            single = np.arange(len(left)) == row
            tests.append((*_ratio(predicted, left & single, left & ~single), row))
        ratio, off, row = max(tests, key=lambda test: test[0])
        if ratio <= 1.0:
            return []
        stray.append(Rejection(number, row, float(np.linalg.norm(off))))
        left[row] = False
        if _ratio(predicted, left & of_point, left & ~of_point)[0] <= 1.0:
            return stray
    return []


def _ratio(predicted: Prediction, which: Bools, others: Bools) -> tuple[float, Floats]:
    """Square of what sightings are off their prediction over its quantile of chance, and the mean of that (3,)."""
    off, covariance = predicted(which, others)
    square = float(off @ solve(cholesky(covariance), off[:, None])[:, 0])
    return square / float(chdtri(len(off), UNLIKELY)), off.reshape(-1, 3).mean(axis=0)
