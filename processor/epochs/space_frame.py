"""Epochs of step ``spheres``: where each ball is, and its radius.

Balls of a design are the same ones by their ids, and their movements are compared. Where an epoch has none, ids are of
no use; then balls are the same ones if each is the other's nearest, nearer than a radius, and their centres are
compared, which must be in one frame. A ball is followed from the last epoch that has it; one without a ball of an
earlier epoch near it is a ball of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from processor.epochs.quantity_series import Kind, Series
from processor.language.messages import Message, text
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, Status, reason
from processor.space_frame.result import Flag, MovementGauge, Result

BY_DESIGN = True
NO_ROW = -1


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield place or movement along x, y and z, and the radius of each ball."""
    gauges = _gauges(results)
    names, rows = _by_id(results) if gauges else _by_place(results)
    fitted = len(gauges) > 1 and _all_fitted(results)
    places, half, radii, radius_half, doubtful = (np.stack(columns, axis=1) for columns in zip(
        *(_columns(result, rows[:, e], bool(gauges), fitted) for e, result in enumerate(results)), strict=True
    ))  # fmt: skip
    # A movement against another datum is another quantity.
    unsure = doubtful | (len(gauges) > 1 and not fitted)
    for k, name in enumerate(names):
        for axis, letter in enumerate("xyz"):
            quantity: Message = text("movement {axis}", axis=letter) if gauges else text("centre {axis}", axis=letter)
            yield Series(
                component=name, kind=Kind.BALL, quantity=quantity, value=places[k, :, axis], ci95=half[k, :, axis],
                doubtful=unsure[k],
            )  # fmt: skip
        yield Series(
            component=name, kind=Kind.BALL, quantity=text("radius"), value=radii[k], ci95=radius_half[k],
            doubtful=doubtful[k],
        )  # fmt: skip


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what the places of two epochs have in common."""
    gauges = _gauges(results)
    if sum(result is not None for result in results) < 2:
        return
    if len(gauges) > 1 and _all_fitted(results):
        yield reason("epochs.gauges-differ-fitted")
    elif len(gauges) > 1:
        yield reason("epochs.gauges-differ")
    elif MovementGauge.BEST_FIT in gauges:
        yield reason("epochs.gauge-best-fit")
    elif gauges:
        yield reason("epochs.gauge-design-frame")
    else:
        yield reason("epochs.balls-by-place")
        _, rows = _by_place(results)
        seen = sum(result is not None and bool(result.balls.placed.any()) for result in results)
        if alone := int(((rows != NO_ROW).sum(axis=1) < seen).sum()):
            yield reason("epochs.balls-not-everywhere", count=alone, total=len(rows))


def _gauges(results: Sequence[Result | None]) -> set[MovementGauge]:
    """Return the datums that the movements are against; empty where some epoch has no movements."""
    references = [one.movement_reference for one in results if one is not None]
    found = {one.gauge for one in references if one is not None}
    return set() if None in references else found


def _all_fitted(results: Sequence[Result | None]) -> bool:
    """Whether all epochs with movements have those by a best fit too, which are comparable."""
    return all(one is None or len(one.balls.best_fit_movement) > 0 for one in results)


def _by_id(results: Sequence[Result | None]) -> tuple[list[str], Ints]:
    """Return the names of the balls of a design, and the row (k, e) of each at each epoch; NO_ROW = none."""
    tables = [{} if one is None else {ball: i for i, ball in enumerate(one.balls.names)} for one in results]
    ids = list(dict.fromkeys(ball for table in tables for ball in table))
    rows = [[table.get(ball, NO_ROW) for table in tables] for ball in ids]
    return [str(ball) for ball in ids], np.array(rows, np.int64).reshape(-1, len(results))


def _by_place(results: Sequence[Result | None]) -> tuple[list[str], Ints]:
    """Follow balls from epoch to epoch by their places; names and rows as above.

    A name that another ball has had before is marked with the number of its own first epoch.
    """
    names: list[str] = []
    rows = np.empty((0, len(results)), np.int64)
    last, radii = np.empty((0, 3)), np.empty(0)
    for e, result in enumerate(results):
        if result is None or not result.balls.placed.any():
            continue
        balls, here = result.balls, np.flatnonzero(result.balls.placed)
        known, found = _nearest_of_both(last, radii, balls.centres[here])
        rows[known, e] = here[found]
        last[known] = balls.centres[here[found]]
        new = np.setdiff1d(here, here[found])
        for ball in (balls.names[row] for row in new.tolist()):
            names.append(str(ball) if str(ball) not in names else f"{ball} ({e + 1})")
        first = np.full((len(new), len(results)), NO_ROW, np.int64)
        first[:, e] = new
        rows, last = np.vstack([rows, first]), np.vstack([last, balls.centres[new]])
        radii = np.append(radii, np.nan_to_num(balls.radii[new]))
    return names, rows


def _nearest_of_both(known: Floats, radii: Floats, found: Floats) -> tuple[Ints, Ints]:
    """Return the rows (m,) of known (k, 3) and found places (n, 3) that are each other's nearest, nearer than radii."""
    if not len(known):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    away, theirs = cKDTree(found).query(known)
    _, mine = cKDTree(known).query(found)
    rows = np.flatnonzero((mine[theirs] == np.arange(len(known))) & (away < radii))
    return rows, theirs[rows]


def _columns(
    result: Result | None, rows: Ints, moved: bool, fitted: bool
) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Return places (k, 3), radii (k,), their half-widths, and which (k,) are doubtful, of rows (k,) of the balls.

    Places are movements where balls ``moved``, relative to a best fit where all are ``fitted``.
    """
    k = len(rows)
    if result is None or not len(result.balls):
        nothing = np.full((k, 3), np.nan)
        return nothing, nothing, nothing[:, 0], nothing[:, 0], np.zeros(k, np.bool_)
    balls, there = result.balls, rows >= 0
    variance = np.einsum("kii->ki", balls.covariance)
    half = NORMAL_95 * np.sqrt(np.where(variance >= 0.0, variance, np.nan))
    place, place_half = (balls.movement, balls.movement_ci95) if moved else (balls.centres, half[:, :3])
    if fitted:
        place, place_half = balls.best_fit_movement, balls.best_fit_ci95
    doubtful = ~np.array([flag is Flag.OK for flag in balls.flag], np.bool_)
    if moved and result.matching is not None and result.matching.status is not Status.OK:
        doubtful[:] = True  # a movement is against the pose of the design
    found = [np.where(there[:, None], column[rows], np.nan) for column in (place, place_half)]
    sizes = [np.where(there, column[rows], np.nan) for column in (balls.radii, half[:, 3])]
    return found[0], found[1], sizes[0], sizes[1], there & doubtful[rows]
