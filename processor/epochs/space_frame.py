"""Epochs of step ``spheres``: where each ball is, and its radius.

Balls of a design are the same ones by their ids, and their movements are compared. Without a design ids are counted
anew in each run; then balls are the same ones if each is the other's nearest, nearer than a radius, and their centres
are compared, which must be in one frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.epochs.series import Series
from processor.language.messages import Message, text
from processor.model import NORMAL_95, Flags, Floats, Ints, Reason, reason
from processor.space_frame.result import Flag, MovementGauge, Result

BY_DESIGN = True
NO_ROW = -1


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield place or movement along x, y and z, and the radius of each ball."""
    gauge = _gauge(results)
    names, rows = _same_balls(results)
    places, half, radii, radius_half, doubtful = (np.stack(columns, axis=1) for columns in zip(
        *(_columns(result, rows[:, e], gauge is not None) for e, result in enumerate(results)), strict=True
    ))  # fmt: skip
    for k, name in enumerate(names):
        for axis, letter in enumerate("xyz"):
            quantity: Message = text("movement {axis}", axis=letter) if gauge else text("centre {axis}", axis=letter)
            yield Series(
                component=name, quantity=quantity, value=places[k, :, axis], ci95=half[k, :, axis], doubtful=doubtful[k]
            )
        yield Series(component=name, quantity=text("radius"), value=radii[k], ci95=radius_half[k], doubtful=doubtful[k])


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what the places of two epochs have in common."""
    gauge = _gauge(results)
    if sum(result is not None for result in results) < 2:
        return
    if gauge is MovementGauge.BEST_FIT:
        yield reason("epochs.gauge-best-fit")
    elif gauge is MovementGauge.DESIGN_FRAME:
        yield reason("epochs.gauge-design-frame")
    else:
        yield reason("epochs.balls-by-place")


def _gauge(results: Sequence[Result | None]) -> MovementGauge | None:
    """Return the datum of all movements; None where some epoch has none, or another."""
    references = [one.movement_reference for one in results if one is not None]
    found = {None if one is None else one.gauge for one in references}
    return found.pop() if len(found) == 1 else None


def _same_balls(results: Sequence[Result | None]) -> tuple[list[str], Ints]:
    """Return the names of the balls, and the row (k, e) of each at each epoch; NO_ROW = none."""
    if all(result is None or result.matching is not None for result in results):
        tables = [{} if one is None else {ball: i for i, ball in enumerate(one.balls.ids.tolist())} for one in results]
        ids = list(dict.fromkeys(ball for table in tables for ball in table))
        rows = [[table.get(ball, NO_ROW) for table in tables] for ball in ids]
        return [str(ball) for ball in ids], np.array(rows, np.int64).reshape(-1, len(results))
    return _by_place(results)


def _by_place(results: Sequence[Result | None]) -> tuple[list[str], Ints]:
    """Match the balls of each epoch to those of the first one that has any."""
    first = next((e for e, result in enumerate(results) if result is not None and result.balls.placed.any()), 0)
    base = results[first]
    if base is None:
        return [], np.empty((0, len(results)), np.int64)
    known = np.flatnonzero(base.balls.placed)
    rows = np.full((len(known), len(results)), NO_ROW, np.int64)
    rows[:, first] = known
    tree = cKDTree(base.balls.centres[known])
    for e, result in enumerate(results):
        if result is None or e == first or not result.balls.placed.any():
            continue
        others = np.flatnonzero(result.balls.placed)
        back = cKDTree(result.balls.centres[others])
        away, mine = back.query(base.balls.centres[known])
        _, theirs = tree.query(result.balls.centres[others])
        mutual = theirs[mine] == np.arange(len(known))
        near = away < np.nan_to_num(base.balls.radii[known])
        rows[mutual & near, e] = others[mine[mutual & near]]
    return [str(one) for one in base.balls.ids[known].tolist()], rows


def _columns(result: Result | None, rows: Ints, moved: bool) -> tuple[Floats, Floats, Floats, Floats, Flags]:
    """Return places (k, 3), radii (k,), their half-widths, and which (k,) are doubtful, of rows (k,) of the balls."""
    k = len(rows)
    if result is None or not len(result.balls):
        nothing = np.full((k, 3), np.nan)
        return nothing, nothing, nothing[:, 0], nothing[:, 0], np.zeros(k, np.bool_)
    balls, there = result.balls, rows >= 0
    variance = np.einsum("kii->ki", balls.covariance)
    half = NORMAL_95 * np.sqrt(np.where(variance >= 0.0, variance, np.nan))
    place, place_half = (balls.movement, balls.movement_ci95) if moved else (balls.centres, half[:, :3])
    doubtful = ~np.array([flag is Flag.OK for flag in balls.flag], np.bool_)
    found = [np.where(there[:, None], column[rows], np.nan) for column in (place, place_half)]
    sizes = [np.where(there, column[rows], np.nan) for column in (balls.radii, half[:, 3])]
    return found[0], found[1], sizes[0], sizes[1], there & doubtful[rows]
