"""Which control point, sighting or scan the others contradict beyond chance (Baarda 1968, tests of several freedoms).

Every suspicion is an error of some directions: one place for all sightings of a point, for a single one, or one motion
for all that a scan saw. What such an error would explain of the misfits is chi-square of as many freedoms by chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from processor.model import Floats, Ints

BY_CHANCE = 1e-3  # that any of all suspicions is raised against a network without a blunder
APART = 9.2  # of squares: a suspicion explains 100 times better than its rivals (twice the log), or it is not told
LEAST_POINTS = 3  # seen in a scan whose pose they may contradict
LEAST_SHARE = 1e-6  # of an error that shows in misfits
SINGULAR = 1e-9


class Misfits(Protocol):
    """What a fit leaves: see control.Fit."""

    @property
    def misfit(self) -> Floats:
        """Known less seen places (3m,)."""

    @property
    def weight(self) -> Floats:
        """Inverse (3m, 3m) of their covariance."""

    @property
    def cofactor(self) -> Floats:
        """The same less what the motion of all takes up."""

    @property
    def by_scans(self) -> Floats:
        """How placed points follow the scans' motions (3m, 6k)."""


@dataclass(frozen=True)
class Doubt:
    """The strongest suspicion: against ``number``, a point, a sighting or a scan; ``rows`` are the sightings it is of.

    ``rivals`` are all that explain the misfits as well, itself the first.
    """

    kind: str  # point | sighting | scan
    number: int
    rows: Ints
    size_mm: float
    rivals: tuple[tuple[str, int], ...]


def beyond_chance(square: float, free: int) -> bool:
    """Whether misfits as a whole are larger than their covariances let expect."""
    return free > 0 and square > float(chi2.isf(BY_CHANCE, free))


def strongest(fit: Misfits, point: Ints, scan: Ints) -> Doubt | None:
    """Return the strongest suspicion beyond chance among sightings of ``point`` (m,) in ``scan`` (m,), or None."""
    every = list(_suspicions(fit, point, scan))
    level = BY_CHANCE / len(every)
    tested = [(_beyond(fit, G, level), kind, number, rows) for kind, number, rows, G in every]
    tested = [one for one in tested if one[0][0] > 0.0]
    if not tested:
        return None
    tested.sort(key=lambda one: -one[0][0])
    (most, size), kind, number, rows = tested[0]
    near = [one for one in tested if one[0][0] > most - APART]
    points = {int(point[one[3][0]]) if one[1] != "scan" else -1 for one in near}
    if len(near) > 1 and len(points) == 1 and -1 not in points:
        # Whether a point's coordinates are wrong or one of its sightings is not known: the point goes as a whole.
        number = points.pop()
        rows = np.flatnonzero(point == number)
        return Doubt("point", number, rows, size, (("point", number),))
    return Doubt(kind, number, rows, size, tuple((one[1], one[2]) for one in near))


def _suspicions(fit: Misfits, point: Ints, scan: Ints) -> Iterator[tuple[str, int, Ints, Floats]]:
    """Yield kind, number, sightings, and how misfits follow the error suspected (3m, 3 or 6)."""
    m = len(point)
    one = np.eye(3 * m).reshape(3 * m, m, 3)
    for number in np.unique(point).tolist():
        rows = np.flatnonzero(point == number)
        yield "point", number, rows, one[:, rows].sum(axis=1)
        if len(rows) > 1:
            for i in rows.tolist():
                yield "sighting", i, np.array([i]), one[:, i]
    for number in np.unique(scan).tolist():
        rows = np.flatnonzero(scan == number)
        if len(np.unique(point[rows])) >= LEAST_POINTS:
            yield "scan", number, rows, fit.by_scans[:, 6 * number : 6 * number + 6]


def _beyond(fit: Misfits, G: Floats, level: float) -> tuple[float, float]:
    """By how much the square that an error along G (3m, n) explains is beyond chance, and its size, mm."""
    length = np.linalg.norm(G, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    G = G / length
    value, V = np.linalg.eigh(G.T @ fit.weight @ G)
    kept = value > SINGULAR * value[-1]
    V = V[:, kept] / np.sqrt(value[kept])
    share, turn = np.linalg.eigh(V.T @ (G.T @ fit.cofactor @ G) @ V)
    shows = share > LEAST_SHARE
    if not shows.any():
        return -np.inf, 0.0
    V = V @ turn[:, shows] / np.sqrt(share[shows])
    z = V.T @ (G.T @ (fit.cofactor @ fit.misfit))
    error = (V @ z) / length
    return float(z @ z) - float(chi2.isf(level, int(shows.sum()))), float(np.linalg.norm(error[-3:]))
