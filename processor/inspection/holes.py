"""Holes of the bodies of a structure: places within their group, pitches and diameters.

A group is the holes of one body that go through the same plate. Places within it are relative to the group's own best
fit: where the body was moved to or turned is no part of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from processor.adjustment import scanner_class_errors, thermal
from processor.geometry import rigid
from processor.inspection import bore_fit, characteristic
from processor.inspection.bore_fit import BorePoints, Fitted
from processor.inspection.design_holes import Hole
from processor.inspection.points_in_design_frame import DesignCloud
from processor.inspection.result import Quantity
from processor.limits.judging import Measured
from processor.model import Bools, Floats, Ints, reason

REACH_MM, PITCH_SHARE = 25.0, 0.4  # of a hole from its designed place, and at most this share of the way to the next
RING_MM = 15.0  # width of the ring of the face around a hole whose points give the height of its plate
FEWEST_LEVEL = 20  # points: a median of them is known to 0.3 of the noise
UNDER_MM = 1.0  # of a gauge pin below a hole's nominal diameter: a convention, see part_pass_through_ratio of limits
SEED, DRAWS = 21, 2000  # of the errors, for the share of holes that a pin passes
PARALLEL, SAME_PLATE_MM = 0.9999, 1.0  # of holes of one group: cosine of axes, plates' height and thickness
ROW_MM = 1.0  # across a row, from one hole to the next of it
FEWEST_PLACED = 3  # holes of a group whose best fit is taken off


class Group(NamedTuple):
    """Holes through one plate of a body, row by row, with the axes (2, 3) that their places are stated along."""

    holes: tuple[Hole, ...]
    axes: Floats

    @property
    def places(self) -> Floats:
        """The designed places (h, 2) along the axes."""
        return np.array([self.axes @ hole.middle for hole in self.holes])


def groups(holes: list[Hole], axes: list[Floats]) -> Iterator[Group]:
    """Yield the holes of a body by the plate that they go through; ``axes`` are directions of the body, if known."""
    left = list(holes)
    while left:
        first = left[0]
        same = [
            hole
            for hole in left
            if abs(hole.axis @ first.axis) > PARALLEL
            and abs((hole.middle - first.middle) @ first.axis) < SAME_PLATE_MM
            and abs(hole.depth - first.depth) < SAME_PLATE_MM
        ]
        left = [hole for hole in left if all(hole is not one for one in same)]
        across = _group_axes(first.axis, axes)
        places = np.array([across @ hole.middle for hole in same])
        order = np.lexsort((places[:, 0], _rows(places[:, 1])))
        yield Group(tuple(same[k] for k in order), across)


def _group_axes(normal: Floats, axes: list[Floats]) -> Floats:
    """Return the directions (2, 3) of a group: that of the body's longest axis across the holes, and square to it."""
    for axis in axes:
        flat = axis - (axis @ normal) * normal
        if np.linalg.norm(flat) > 0.9:
            first = flat / np.linalg.norm(flat)
            return np.stack([first, rigid.forwards(np.cross(normal, first))])
    return np.array([rigid.forwards(axis) for axis in rigid.axes_across(normal)])


def _rows(across: Floats) -> Ints:
    """Return the row (h,) of each hole by coordinates (h,) across the rows: wider gaps of them divide two rows."""
    order = np.argsort(across, kind="stable")
    row = np.zeros(len(across), np.int64)
    row[order[1:]] = np.cumsum(np.diff(across[order]) > ROW_MM)
    return row


def fitted(cloud: DesignCloud, group: Group, temperature_C: float = float("nan")) -> Fitted:
    """Return the holes of a group as measured.

    Lengths are those at the reference temperature, if that of the steel is known.
    """
    places = group.places
    between = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
    reach = np.minimum(REACH_MM, PITCH_SHARE * between.min(axis=1))
    bores = [_bore(cloud, group, hole) for hole in group.holes]
    radius = np.array([hole.radius for hole in group.holes])
    return _referred(bore_fit.fit(bores, radius, reach, len(cloud.scanners)), places, radius, temperature_C)


def _referred(fitted: Fitted, places: Floats, radius: Floats, temperature_C: float) -> Fitted:
    """Bring holes to the reference temperature, and add the error of the scanner's scale to their covariance."""
    size = np.column_stack([places - places.mean(axis=0), radius])
    expansion, by_scale = thermal.expansion(temperature_C), scanner_class_errors.known().scale * size.ravel()
    return fitted._replace(
        departure=(size + fitted.departure) / expansion - size,
        covariance=fitted.covariance / expansion**2 + np.outer(by_scale, by_scale),
    )


def _bore(cloud: DesignCloud, group: Group, hole: Hole) -> BorePoints:
    """Return the points that lie in a hole's bore, between its rims."""
    far = float(np.hypot(hole.radius + REACH_MM, 0.5 * hole.depth + REACH_MM))
    seen = cloud.near(hole.middle[None], far)
    off = seen.points - hole.middle
    height, flat = off @ hole.axis, off @ group.axes.T
    beyond = np.linalg.norm(flat, axis=1) - hole.radius
    height = height - _level(height, beyond, hole)
    rim = min(bore_fit.RIM_MM, bore_fit.RIM_SHARE * hole.depth)
    inside = (np.abs(height) < 0.5 * hole.depth - rim) & (beyond < REACH_MM)
    return BorePoints(flat[inside], seen.view[inside], seen.ray[inside] @ group.axes.T)


def _level(height: Floats, beyond: Floats, hole: Hole) -> float:
    """Return how far the plate lies from its designed place, by its faces around the hole."""
    ring = (beyond > bore_fit.RIM_MM) & (beyond < RING_MM)
    found = []
    for sense in (-1.0, 1.0):
        off = height[ring] - 0.5 * sense * hole.depth
        near = np.abs(off) < 0.5 * hole.depth
        if near.sum() >= FEWEST_LEVEL:
            found.append(float(np.median(off[near])))
    return float(np.mean(found)) if found else 0.0


def characteristics(group: Group, fitted: Fitted, first: int) -> Iterator[Measured]:
    """Yield the characteristics of a group whose holes are numbered from ``first``."""
    places = group.places
    known = np.flatnonzero(np.isfinite(fitted.departure).all(axis=1))
    why = reason("inspect.hole-not-seen")
    if len(places) >= FEWEST_PLACED:
        within = _within(places, fitted, known) if len(known) >= FEWEST_PLACED else None
        yield from _places(places, within, known, first)
        yield _passing(fitted, within, known, (first, first + len(places) - 1))
    for a, b in _neighbours(places):
        id_, nominal = f"pitch-{first + a}-{first + b}", float(np.linalg.norm(places[b] - places[a]))
        if a in known and b in known:
            deviation, variance = _pitch(places, fitted, a, b)
            yield characteristic.normal(id_, Quantity.HOLE_PITCH, nominal, deviation, variance)
        else:
            yield characteristic.absent(id_, Quantity.HOLE_PITCH, nominal, why)
    for k, r in enumerate(hole.radius for hole in group.holes):
        id_ = f"hole-{first + k}-diameter"
        if k in known:
            variance = 4.0 * float(fitted.covariance[3 * k + 2, 3 * k + 2])
            deviation = 2.0 * float(fitted.departure[k, 2])
            yield characteristic.normal(id_, Quantity.HOLE_DIAMETER, 2.0 * r, deviation, variance)
        else:
            yield characteristic.absent(id_, Quantity.HOLE_DIAMETER, 2.0 * r, why)


def _within(places: Floats, fitted: Fitted, known: Ints) -> tuple[Floats, Floats]:
    """Departures (2k,) of holes from the best fit of their group as a rigid body, and their covariance with radii.

    The covariance (3k, 3k) is of these and of the departures of the k radii.
    """
    off = places[known] - places[known].mean(axis=0)
    rows = (3 * known[:, None] + [0, 1]).ravel()
    motions = np.zeros((len(rows), 3))
    motions[0::2, 0] = motions[1::2, 1] = 1.0
    motions[0::2, 2], motions[1::2, 2] = -off[:, 1], off[:, 0]
    off_the_fit = np.eye(len(rows)) - motions @ np.linalg.pinv(motions)
    radii = 3 * known + 2
    both = np.concatenate([rows, radii])
    change = np.zeros((len(both), len(both)))
    change[: len(rows), : len(rows)] = off_the_fit
    change[len(rows) :, len(rows) :] = np.eye(len(radii))
    return (
        off_the_fit @ fitted.departure[known, :2].ravel(),
        change @ fitted.covariance[np.ix_(both, both)] @ change.T,
    )


def _places(places: Floats, within: tuple[Floats, Floats] | None, known: Ints, first: int) -> Iterator[Measured]:
    """Yield the places of holes within their group, along and across; None: too few holes of it were seen."""
    middle = places.mean(axis=0)
    at = {int(k): i for i, k in enumerate(known)}
    for k in range(len(places)):
        for a, name in enumerate(("along", "across")):
            id_, nominal = f"hole-{first + k}-{name}", float(places[k, a] - middle[a])
            if within is not None and k in at:
                row = 2 * at[k] + a
                deviation, variance = float(within[0][row]), float(within[1][row, row])
                yield characteristic.normal(id_, Quantity.HOLE_POSITION, nominal, deviation, variance)
            else:
                why = reason("inspect.few-holes-seen" if k in at else "inspect.hole-not-seen")
                yield characteristic.absent(id_, Quantity.HOLE_POSITION, nominal, why)


def _passing(fitted: Fitted, within: tuple[Floats, Floats] | None, known: Ints, numbers: tuple[int, int]) -> Measured:
    """Return the share of a group's holes that a gauge pin passes together with a splice plate drilled as designed."""
    id_ = f"holes-{numbers[0]}-{numbers[1]}-pass-through"
    if within is None:
        why = (reason("inspect.few-holes-seen"),)
        return Measured(id_, what=Quantity.PASS_THROUGH, nominal=1.0, unit="1", reasons=why)
    return share_of(id_, passes(within[0], fitted.departure[known, 2], within[1]), numbers[1] - numbers[0] + 1)


def passes(off: Floats, wider: Floats, covariance: Floats) -> Bools:
    """Return for draws of the errors (d, n) whether a gauge pin passes a hole together with that of its splice plate.

    Holes are ``off`` those of the plate (2n,) and ``wider`` (n,) than designed, with their covariance (3n, 3n). The pin
    is thinner than the nominal hole by UNDER_MM. It passes a hole of radius r, off the plate's hole of radius R by e,
    if e <= r + R - d for the pin's diameter d: r + R - e is the width that both leave open.
    """
    mean, count = np.concatenate([off, wider]), len(wider)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = mean + np.random.default_rng(SEED).standard_normal((DRAWS, len(mean))) @ root.T
    passed: Bools = (
        np.hypot(drawn[:, 0 : 2 * count : 2], drawn[:, 1 : 2 * count : 2]) <= UNDER_MM + drawn[:, 2 * count :]
    )
    return passed


def share_of(id_: str, passed: Bools, holes: int) -> Measured:
    """Return the share of ``holes`` holes that a pin passes, by draws (d, n) of those seen.

    It is the mean of the probabilities of the holes seen, its interval that of draws of all errors together. It is of
    all holes: of those not seen none passes at its lower end, and all do at its upper end.
    """
    unseen = holes - passed.shape[1]
    low, high = np.quantile(passed.sum(axis=1), [0.025, 0.975])
    return Measured(
        id_,
        float(passed.mean()) - 1.0,
        low=float(low) / holes - 1.0,
        high=float(high + unseen) / holes - 1.0,
        what=Quantity.PASS_THROUGH,
        unit="1",
        nominal=1.0,
        reasons=(reason("inspect.holes-unseen", unseen=unseen, holes=holes),) if unseen else (),
    )


def _neighbours(places: Floats) -> Iterator[tuple[int, int]]:
    """Yield the pairs of holes that are next to each other in a row along or across."""
    for a in range(2):
        line = _rows(places[:, 1 - a])
        for value in np.unique(line):
            rows = np.flatnonzero(line == value)
            rows = rows[np.argsort(places[rows, a], kind="stable")]
            yield from zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True)


def _pitch(places: Floats, fitted: Fitted, a: int, b: int) -> tuple[float, float]:
    """Deviation of the distance of two holes and its variance."""
    toward = (places[b] - places[a]) / np.linalg.norm(places[b] - places[a])
    gradient = np.concatenate([-toward, toward])
    rows = [3 * a, 3 * a + 1, 3 * b, 3 * b + 1]
    change = places[b] - places[a] + fitted.departure[b, :2] - fitted.departure[a, :2]
    deviation = float(np.linalg.norm(change) - np.linalg.norm(places[b] - places[a]))
    return deviation, float(gradient @ fitted.covariance[np.ix_(rows, rows)] @ gradient)
