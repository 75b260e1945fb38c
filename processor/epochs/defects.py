"""Epochs of step ``defects``: the depth of each defect.

Defects of two epochs are one defect if they are of one component and the centre of either lies within the extent of the
other. At an epoch that did not find a defect but saw its place its depth is zero, with the least depth that is found
there for half-width; at one that did not see the place it is not known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.defects.result import Defects, Result
from processor.epochs.series import Series
from processor.language.messages import text
from processor.model import Floats, Reason, Status, reason

BY_DESIGN = True
Found = list[tuple[int, int]]  # epoch and row of one defect


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the greatest depth of each defect, inward positive."""
    for same in _same_defects(results):
        e, row = same[-1]
        newest = results[e]
        assert newest is not None
        table = newest.defects
        values = [_depth(result, dict(same).get(k), table, row) for k, result in enumerate(results)]
        value, half, doubt = np.array(values).T
        x, y, z = table.centre[row].tolist()
        quantity = text(
            "{defect_class} at {x:.0f}, {y:.0f}, {z:.0f}, depth", defect_class=table.defect_class[row], x=x, y=y, z=z
        )
        yield Series(
            component=table.component[row] or "surface", quantity=quantity, value=value, ci95=half, doubtful=doubt > 0.0
        )


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say how a defect that an epoch did not find counts."""
    if sum(result is not None for result in results) > 1:
        yield reason("epochs.defects-not-found")


def _same_defects(results: Sequence[Result | None]) -> list[Found]:
    """Group the defects of all epochs that are one; each group has one an epoch at most."""
    groups: list[Found] = []
    for e, result in enumerate(results):
        for row in range(0 if result is None else len(result.defects)):
            assert result is not None
            group = next((one for one in groups if _is_same(results, one[-1], (e, row))), None)
            if group is None:
                groups.append([(e, row)])
            else:
                group.append((e, row))
    return groups


def _is_same(results: Sequence[Result | None], earlier: tuple[int, int], later: tuple[int, int]) -> bool:
    a, b = results[earlier[0]], results[later[0]]
    if a is None or b is None or earlier[0] == later[0]:
        return False
    i, j = earlier[1], later[1]
    if a.defects.component[i] != b.defects.component[j]:
        return False
    between = b.defects.centre[j] - a.defects.centre[i]
    return _covers(a.defects, i, between) or _covers(b.defects, j, -between)


def _covers(defects: Defects, row: int, away: Floats) -> bool:
    """Whether a place so far ``away`` from a defect's centre lies within its extent, and as near to its face."""
    along = np.abs(defects.axes[row] @ away)
    half = 0.5 * defects.extent[row]
    return bool((along[:2] <= half).all() and along[2] <= max(float(half.max()), abs(float(defects.depth_max[row]))))


def _depth(result: Result | None, row: int | None, like: Defects, at: int) -> tuple[float, float, float]:
    """Return depth and half-width of a defect in an epoch, ``row`` None if it did not find it, and 1 for doubtful."""
    if result is None or result.status is Status.FAILED:
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
