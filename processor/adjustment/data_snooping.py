"""Data snooping: tests for gross errors in control points, sightings and bodies, such as scans (Baarda 1968).

An adjustment leaves ``misfit`` (3m,), known less seen places of m sightings, of which ``weight`` (3m, 3m) is the
inverse of the covariance. A test explains misfits by an error in some directions: a common shift of all sightings of a
point, of a single one, or a motion of all that a body saw. By chance, the part of the squares that such an error
explains is chi-square distributed with as many degrees of freedom. A shift that explains the misfits of some sightings
freely is what they are off their prediction by all others: :func:`leave_out` goes by that alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from processor.geometry.linalg_small import cholesky, solve
from processor.geometry.rigid import LEAST_POINTS
from processor.model import Bools, Floats, Ints

# --- Tests of the misfits of one adjustment

BY_CHANCE = 1e-3  # probability that a network without a blunder raises any suspicion
DISTINCT = 9.2  # of squares: a suspicion explains 100 times better than its rivals (twice the logarithm)
LEAST_SHARE = 1e-6  # of an error that is visible in the misfits
SINGULAR = 1e-9  # relative eigenvalue: far above rounding (1e-15 n), far below that of any direction that is measured


@dataclass(frozen=True)
class Suspicion:
    """The strongest suspicion: an error of ``number``, a point, a sighting or a body, in the sightings ``rows``.

    ``rivals`` are all suspicions that explain the misfits as well, this one first.
    """

    kind: str  # point | sighting | body
    number: int
    rows: Ints
    size_mm: float
    rivals: tuple[tuple[str, int], ...]


def beyond_chance(square: float, dof: int) -> bool:
    """Overall test of the model: whether the weighted sum of squared misfits exceeds its quantile of chi-square."""
    return dof > 0 and square > float(chdtri(dof, BY_CHANCE))


def strongest(
    misfit: Floats, weight: Floats, cofactor: Floats, by_bodies: Floats, point: Ints, body: Ints
) -> Suspicion | None:
    """Return the strongest suspicion beyond chance among sightings of ``point`` (m,) by ``body`` (m,), or None.

    ``cofactor`` (3m, 3m) is ``weight`` less the part that unknowns without a prior absorb, such as a common motion,
    ``by_bodies`` (3m, 6k) the derivative of the seen places by motions of the bodies.
    """
    every = list(_suspicions(by_bodies, point, body))
    tested = []
    for kind, number, rows, G in every:
        square, dof, error = _explained(misfit, weight, cofactor, G)
        beyond = square - float(chdtri(dof, BY_CHANCE / len(every))) if dof else 0.0
        if beyond > 0.0:
            tested.append((beyond, Suspicion(kind, number, rows, float(np.linalg.norm(error[-3:])), ())))
    if not tested:
        return None
    tested.sort(key=lambda test: -test[0])
    most, best = tested[0]
    near = [suspicion for beyond, suspicion in tested if beyond > most - DISTINCT]
    points = {int(point[suspicion.rows[0]]) if suspicion.kind != "body" else -1 for suspicion in near}
    if len(near) > 1 and len(points) == 1 and -1 not in points:
        # A wrong coordinate and a wrong sighting of the point are not distinguishable: the whole point is suspected.
        number = points.pop()
        return Suspicion("point", number, np.flatnonzero(point == number), best.size_mm, (("point", number),))
    return replace(best, rivals=tuple((suspicion.kind, suspicion.number) for suspicion in near))


def _suspicions(by_bodies: Floats, point: Ints, body: Ints) -> Iterator[tuple[str, int, Ints, Floats]]:
    """Yield kind, number, sightings, and the derivative (3m, 3 or 6) of the misfits by the suspected error."""
    m = len(point)
    unit = np.eye(3 * m).reshape(3 * m, m, 3)
    for number in np.unique(point).tolist():
        rows = np.flatnonzero(point == number)
        yield "point", number, rows, unit[:, rows].sum(axis=1)
        if len(rows) > 1:
            for i in rows.tolist():
                yield "sighting", i, np.array([i]), unit[:, i]
    for number in np.unique(body).tolist():
        rows = np.flatnonzero(body == number)
        if len(np.unique(point[rows])) >= LEAST_POINTS:
            yield "body", number, rows, by_bodies[:, 6 * number : 6 * number + 6]


def _explained(misfit: Floats, weight: Floats, cofactor: Floats, G: Floats) -> tuple[float, int, Floats]:
    """Return the square that an error along G (3m, n) explains, its degrees of freedom, and the error (n,)."""
    length = np.linalg.norm(G, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    G = G / length
    value, V = np.linalg.eigh(G.T @ weight @ G)
    regular = value > SINGULAR * value[-1]
    V = V[:, regular] / np.sqrt(value[regular])
    share, turn = np.linalg.eigh(V.T @ (G.T @ cofactor @ G) @ V)
    visible = share > LEAST_SHARE
    V = V @ turn[:, visible] / np.sqrt(share[visible])
    z = V.T @ (G.T @ (cofactor @ misfit))
    return float(z @ z), int(visible.sum()), (V @ z) / length


# --- Predictions of each sighting from an adjustment without it

UNLIKELY = 1e-4  # probability that a point without a blunder is suspected


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


# Of sightings (m,) marked: the square of what they are off their prediction by the others over its quantile of chance,
# and the mean of that (3,), mm.
Ratio = Callable[[Bools], tuple[float, Floats]]


def leave_out(point: Ints, misfit: Floats, covariance: Floats) -> Snooped:
    """Test each point against the prediction by all others, and leave out the one that must be wrong, repeatedly.

    ``point`` (m,) numbers the point of each sighting; ``misfit`` (3m,), mm, and its ``covariance`` (3m, 3m) are those
    before any sighting is used. Of a point with several sightings single ones are left out where that is enough, at
    most half of them. Where it cannot be decided which point is wrong, all are accepted.
    """

    def ratios(kept: Bools) -> Ratio:
        rows = np.flatnonzero(np.repeat(kept, 3))
        L = cholesky(covariance[np.ix_(rows, rows)])
        both = solve(L, np.column_stack([misfit[rows], np.eye(len(rows))]))
        pull, weight = both[:, 0], both[:, 1:]

        def ratio(marked: Bools) -> tuple[float, Floats]:
            own = np.flatnonzero(np.repeat(marked[kept], 3))
            error = solve(cholesky(np.ascontiguousarray(weight[np.ix_(own, own)])), pull[own, None])[:, 0]
            return float(pull[own] @ error) / float(chdtri(len(own), UNLIKELY)), error.reshape(-1, 3).mean(axis=0)

        return ratio

    def worst_of(kept: Bools) -> tuple[int, float, Floats]:
        """Return the least likely point of the sightings kept, its ratio, and how far it is off (3,)."""
        worst: tuple[int, float, Floats] = (-1, 0.0, np.zeros(3))
        ratio = ratios(kept)
        for number in np.unique(point[kept]).tolist():
            size, off = ratio(kept & (point == number))
            if size > worst[1]:
                worst = (number, size, off)
        return worst

    accepted, rejected = np.ones(len(point), bool), list[Rejection]()
    while accepted.any():
        worst, size, off = worst_of(accepted)
        if size <= 1.0:
            break
        stray = _stray(point == worst, accepted, ratios)
        if stray:
            rejected += [Rejection(worst, row, size_mm) for row, size_mm in stray]
            accepted[[row for row, _ in stray]] = False
            continue
        numbers = np.unique(point[accepted])
        without = [n for n in numbers.tolist() if worst_of(accepted & (point != n))[1] <= 1.0]
        remain = len(numbers) - 1
        # One point alone explains the contradiction, or several are wrong and enough points remain to find the next.
        is_decided = len(without) == 1 or (not without and remain > LEAST_POINTS)
        if remain < LEAST_POINTS or not is_decided:
            return Snooped(accepted, tuple(rejected), worst, off, remain == 0)
        number = without[0] if without else worst
        off = ratios(accepted)(accepted & (point == number))[1]
        rejected.append(Rejection(number, None, float(np.linalg.norm(off))))
        accepted = accepted & (point != number)
    return Snooped(accepted, tuple(rejected), None, np.zeros(3), False)


def _stray(of_point: Bools, accepted: Bools, ratios: Callable[[Bools], Ratio]) -> list[tuple[int, float]]:
    """Rows of a point without which its others agree with all points, and how far off they are, mm.

    The one with the largest normalised residual goes first. None where more than half would have to go: then the point
    itself may as well be wrong.
    """
    left, stray = accepted.copy(), list[tuple[int, float]]()
    count = int((accepted & of_point).sum())
    while 2 * (len(stray) + 1) <= count:
        ratio = ratios(left)
        tests = [(*ratio(np.arange(len(left)) == row), row) for row in np.flatnonzero(left & of_point).tolist()]
        size, off, row = max(tests, key=lambda test: test[0])
        if size <= 1.0:
            return []
        stray.append((row, float(np.linalg.norm(off))))
        left[row] = False
        if ratios(left)(left & of_point)[0] <= 1.0:
            return stray
    return []
