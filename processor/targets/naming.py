"""Names of targets: which control point each target of a scan is, by its place or by the distances between targets.

In a scan with a pose a target is the control point nearest to it, if one rigid motion brings those that are named to
their control points: three targets or more; of two the distance has to agree. In a scan without a pose the rigid motion
is sought that brings most targets to control points: three targets that have the distances of three control points
propose one, and a motion holds if it places three targets or more, and no other motion that names them otherwise places
as many.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Floats, Ints

NEAR_MM = 100.0  # of a posed target from its control point
SAME_MM = 10.0  # of a distance, and of a target moved to its control point
LEAST = 3  # three points determine a motion
MOST = 40  # targets of a scan that motions are proposed from
SPREAD_MM = 300.0  # least height of a triangle that proposes a motion

Proposal = tuple[tuple[int, ...], list[list[int]]]  # three places, and the control points that they may be


def nearest(places: Floats, known: Floats) -> Ints:
    """Return the control point (k,) near each place (k, 3), both in the project's frame; -1 = none, or not unique."""
    return _mutual(places, known, NEAR_MM)


def by_pose(places: Floats, known: Floats) -> Ints:
    """Return the control point (k,) of each place (k, 3), both in the project's frame; -1 = none.

    Those near a control point, but not where the others put it, have none either.
    """
    rows = nearest(places, known)
    near = np.flatnonzero(rows >= 0)
    triples = combinations(near[:MOST].tolist(), 3)
    named = _of_common_motion(places, known, ((one, [rows[list(one)].tolist()]) for one in triples))
    if named is not None:
        return named
    # Too few for a motion, or nearly on a line: the distances between them have to agree.
    of_places, of_known = (
        np.linalg.norm(one[:, None] - one[None], axis=2) for one in (places[near], known[rows[near]])
    )
    rows[near[(np.abs(of_places - of_known) > SAME_MM).any(axis=1)]] = -1
    return rows


def by_pattern(places: Floats, known: Floats) -> Ints:
    """Return the control point (k,) of each place (k, 3) in a frame of its own; -1 = none, or not unique."""
    apart = np.linalg.norm(known[:, None] - known[None], axis=2)
    triples = combinations(range(min(len(places), MOST)), 3)
    named = _of_common_motion(places, known, ((one, _alike(places[list(one)], apart)) for one in triples))
    return np.full(len(places), -1, np.int64) if named is None else named


def _of_common_motion(places: Floats, known: Floats, proposals: Iterable[Proposal]) -> Ints | None:
    """Return the control points (k,) by the motion that brings most places to them; None if no triple proposes one.

    All are -1 if fewer than LEAST fit, or if another motion that names them otherwise fits as many.
    """
    fits: list[tuple[int, float, Ints]] = []
    proposed = False
    for triple, names in proposals:
        some = places[list(triple)]
        if _height(some) < SPREAD_MM:
            continue
        for named in names:
            proposed = True
            T = rigid.fit(some, known[named])
            moved = rigid.apply(T, places)
            if np.abs(moved[list(triple)] - known[named]).max() > SAME_MM:
                continue
            rows = _mutual(moved, known, SAME_MM)
            off = float(np.linalg.norm(moved[rows >= 0] - known[rows[rows >= 0]], axis=1).sum())
            fits.append((int((rows >= 0).sum()), -off, rows))
        if fits and max(count for count, _, _ in fits) == len(places):
            break  # all are named
    if not fits:
        return np.full(len(places), -1, np.int64) if proposed else None
    fits.sort(key=lambda fit: fit[:2])
    count, _, rows = fits[-1]
    rival = any(fit[0] == count and (fit[2] != rows).any() for fit in fits)
    return np.full(len(places), -1, np.int64) if count < LEAST or rival else rows


def _height(triangle: Floats) -> float:
    """Return the least height of a triangle (3, 3)."""
    u, v = triangle[1] - triangle[0], triangle[2] - triangle[0]
    longest = max(np.linalg.norm(u), np.linalg.norm(v), np.linalg.norm(u - v))
    return float(np.linalg.norm(np.cross(u, v)) / max(longest, 1e-12))


def _alike(some: Floats, apart: Floats) -> list[list[int]]:
    """Return the triples of control points, ``apart`` (m, m), that have the distances of three places (3, 3)."""
    a, b, c = (float(np.linalg.norm(some[i] - some[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
    found = []
    for i, j in zip(*np.nonzero(np.abs(apart - a) < SAME_MM), strict=True):
        fits = (np.abs(apart[i] - b) < SAME_MM) & (np.abs(apart[j] - c) < SAME_MM)
        found += [[int(i), int(j), int(k)] for k in np.flatnonzero(fits)]
    return found


def _mutual(places: Floats, known: Floats, reach: float) -> Ints:
    """Return for each place (k,) the control point that is nearest to it and that it is nearest to, within a reach."""
    rows = np.full(len(places), -1, np.int64)
    if not len(places) or not len(known):
        return rows
    away, nearest = cKDTree(known).query(places)
    _, back = cKDTree(places).query(known)
    mutual = (back[nearest] == np.arange(len(places))) & (away <= reach)
    rows[mutual] = nearest[mutual]
    return rows
