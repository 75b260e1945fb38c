"""Epochs of step ``defects``: the depth of each defect.

Defects of two epochs are one defect if they are of one component and the centre of either lies within the extent of the
other; of several the nearest. At an epoch that did not find a defect but saw its place its depth is zero, with the
least depth that is found there for half-width; at one that did not see the place it is not known. The zero is doubtful
where another defect of that epoch covers the place: what was one defect may be two pieces at another epoch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.defects.result import Defects, Result
from processor.epochs.quantity_series import Kind, Series
from processor.language.messages import text
from processor.model import Floats, Reason, reason

BY_DESIGN = True
Found = list[tuple[int, int]]  # epoch and row of one defect


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the greatest depth of each defect, inward positive."""
    tables = [Defects() if result is None else result.defects for result in results]
    for same in _same_defects(tables):
        e, row = same[-1]
        table = tables[e]
        found = dict(same)
        values = [_depth(result, found.get(k), table, row) for k, result in enumerate(results)]
        value, half, doubt = np.array(values).T
        covered = np.array([
            k not in found and any(_is_same(tables, (e, row), (k, other)) for other in range(len(one)))
            for k, one in enumerate(tables)
        ], np.bool_)  # fmt: skip
        x, y, z = table.centre[row].tolist()
        quantity = text(
            "{defect_class} at {x:.0f}, {y:.0f}, {z:.0f}, depth inward",
            defect_class=table.defect_class[row], x=x, y=y, z=z,
        )  # fmt: skip
        yield Series(
            component=table.component[row] or "surface",
            kind=Kind.WITH_DEFECTS,
            quantity=quantity,
            value=value,
            ci95=half,
            doubtful=(doubt > 0.0) | covered,
        )


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say how a defect that an epoch did not find counts."""
    if sum(result is not None for result in results) > 1:
        yield reason("epochs.defects-not-found")


def _same_defects(tables: Sequence[Defects]) -> list[Found]:
    """Group the defects of all epochs that are one; each group has one an epoch at most."""
    groups: list[Found] = []
    for e, table in enumerate(tables):
        new = [(e, row) for row in range(len(table))]
        pairs = [
            (float(np.linalg.norm(_between(tables, group[-1], one))), k, row)
            for k, group in enumerate(groups)
            for row, one in enumerate(new)
            if _is_same(tables, group[-1], one)
        ]
        known, placed = set(), set()
        for _, k, row in sorted(pairs):
            if k not in known and row not in placed:
                known.add(k)
                placed.add(row)
                groups[k].append(new[row])
        groups += [[one] for row, one in enumerate(new) if row not in placed]
    return groups


def _between(tables: Sequence[Defects], one: tuple[int, int], other: tuple[int, int]) -> Floats:
    """Return the vector (3,) from the centre of a defect to that of another, each an epoch and a row."""
    vector: Floats = tables[other[0]].centre[other[1]] - tables[one[0]].centre[one[1]]
    return vector


def _is_same(tables: Sequence[Defects], earlier: tuple[int, int], later: tuple[int, int]) -> bool:
    (a, i), (b, j) = earlier, later
    if a == b or tables[a].component[i] != tables[b].component[j]:
        return False
    between = _between(tables, earlier, later)
    return _covers(tables[a], i, between) or _covers(tables[b], j, -between)


def _covers(defects: Defects, row: int, away: Floats) -> bool:
    """Whether a place so far ``away`` from a defect's centre lies within its extent, and as near to its face."""
    along = np.abs(defects.axes[row] @ away)
    half = 0.5 * defects.extent[row]
    return bool((along[:2] <= half).all() and along[2] <= max(float(half.max()), abs(float(defects.depth_max[row]))))


def _depth(result: Result | None, row: int | None, like: Defects, at: int) -> tuple[float, float, float]:
    """Return depth and half-width of a defect in an epoch, ``row`` None if it did not find it, and 1 for doubtful."""
    if result is None:
        return np.nan, np.nan, 0.0
    if row is not None:
        defects = result.defects
        doubtful = bool(defects.doubtful[row]) or bool(defects.depth_is_bound[row])
        return float(defects.depth_max[row]), float(defects.depth_ci95[row]), float(doubtful)
    windows, places = result.least_depth, result.surface.points
    if not len(windows) or not len(places):
        return np.nan, np.nan, 0.0
    # Places are spread over what was seen: one within two spacings, or within the defect, means that its place was.
    spacing = float(np.sqrt(result.examined_mm2 / len(places))) if result.examined_mm2 > 0.0 else 0.0
    reach = max(2.0 * spacing, 0.5 * float(like.extent[at].max()))
    if not np.isfinite(cKDTree(places).query(like.centre[at], distance_upper_bound=reach)[0]):
        return np.nan, np.nan, 0.0
    window = int(np.abs(windows.side - float(like.extent[at].min())).argmin())
    return 0.0, float(windows.depth[window]), 0.0
