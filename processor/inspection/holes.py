"""Holes of the bodies of a structure: places within their group, pitches and diameters.

A group is the holes of one body that go through the same plate. Places within it are relative to the group's own best
fit: where the body was moved to or turned is no part of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor import scene_cloud
from processor.geometry import rigid
from processor.inspection import bore_fit, characteristic
from processor.inspection.bore_fit import BorePoints, Fitted
from processor.inspection.characteristic import Characteristic
from processor.inspection.design_holes import Hole, plane_axes
from processor.inspection.result import Quantity
from processor.model import Floats, Ints, Scene, reason

REACH_MM, PITCH_SHARE = 25.0, 0.4  # of a hole from its designed place, and at most this share of the way to the next
RING_MM = 15.0  # around a hole, of the face that tells the height of its plate
FEWEST_LEVEL = 20
UNDER_MM = 1.0  # of a gauge pin below the nominal diameter of a hole, as steel is checked for high-strength bolts
SEED, DRAWS = 21, 2000  # of the errors, for the share of holes that a pin passes
PARALLEL, SAME_PLATE_MM, ROW_MM = 0.9999, 1.0, 1.0


class Cloud(NamedTuple):
    """Points (n, 3) in the design's frame, the unit ray (n, 3) to each if known, and the view (n,) of each.

    ``tree`` is of the points.
    """

    points: Floats
    ray: Floats
    source: Ints
    sources: int
    tree: cKDTree


class Group(NamedTuple):
    """Holes through one plate of a body, row by row, with the axes (2, 3) that their places are stated along."""

    holes: tuple[Hole, ...]
    axes: Floats


def cloud_of(scene: Scene, T: Floats, stitched: Any, origin: Floats) -> Cloud:
    """Return all points of a scene in the design's frame less ``origin``, by a pose (4, 4) of the scans as merged."""
    placed = scene_cloud.stitched(scene, stitched)
    cloud = scene_cloud.merged(placed, with_scanner=True)
    # The large offsets are subtracted from each other first: added to the points, either would cost them digits.
    points = cloud.points @ T[:3, :3].T + (T[:3, :3] @ cloud.origin + T[:3, 3] - origin)
    count = [len(scan.points) for scan in placed.scans]
    source = np.repeat(np.arange(len(count)), count)
    if cloud.scanner is None:
        return Cloud(points, np.full(points.shape, np.nan), source, max(len(count), 1), cKDTree(points))
    ray = points - rigid.apply(T, cloud.scanner + cloud.origin) + origin
    if len(placed.scans) == 1 and len(placed.scans[0].point_station):
        source = placed.scans[0].point_station.astype(np.int64)
    length = np.linalg.norm(ray, axis=1, keepdims=True)
    return Cloud(points, ray / np.maximum(length, 1e-9), source, int(source.max()) + 1, cKDTree(points))


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
        order = np.lexsort((places[:, 0], np.round(places[:, 1] / ROW_MM)))
        yield Group(tuple(same[k] for k in order), across)


def _group_axes(normal: Floats, axes: list[Floats]) -> Floats:
    """Return the directions (2, 3) of a group: that of the body's longest axis across the holes, and square to it."""
    for axis in axes:
        flat = axis - (axis @ normal) * normal
        if np.linalg.norm(flat) > 0.9:
            first = flat / np.linalg.norm(flat)
            return np.stack([first, _forwards(np.cross(normal, first))])
    return np.array([_forwards(axis) for axis in plane_axes(normal)])


def _forwards(direction: Floats) -> Floats:
    """Let a direction look the way of its largest component, so that its sense does not depend on the mesh."""
    return direction if direction[np.argmax(np.abs(direction))] > 0.0 else -direction


def measured(cloud: Cloud, group: Group, first: int) -> list[Characteristic]:
    """Return the characteristics of a group whose holes are numbered from ``first``."""
    places = np.array([group.axes @ hole.middle for hole in group.holes])
    between = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
    reach = np.minimum(REACH_MM, PITCH_SHARE * between.min(axis=1))
    bores = [_bore(cloud, group, hole) for hole in group.holes]
    radius = np.array([hole.radius for hole in group.holes])
    return list(_characteristics(places, radius, bore_fit.fit(bores, radius, reach, cloud.sources), first))


def _bore(cloud: Cloud, group: Group, hole: Hole) -> BorePoints:
    """Return the points that lie in a hole's bore, between its rims."""
    far = float(np.hypot(hole.radius + REACH_MM, 0.5 * hole.depth + REACH_MM))
    rows = np.sort(np.array(cloud.tree.query_ball_point(hole.middle, far), np.int64))
    off = cloud.points[rows] - hole.middle
    height, flat = off @ hole.axis, off @ group.axes.T
    beyond = np.linalg.norm(flat, axis=1) - hole.radius
    height = height - _level(height, beyond, hole)
    rim = min(bore_fit.RIM_MM, bore_fit.RIM_SHARE * hole.depth)
    inside = (np.abs(height) < 0.5 * hole.depth - rim) & (beyond < REACH_MM)
    return BorePoints(flat[inside], cloud.source[rows][inside], cloud.ray[rows][inside] @ group.axes.T)


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


def _characteristics(places: Floats, radius: Floats, fitted: Fitted, first: int) -> Iterator[Characteristic]:
    known = np.flatnonzero(np.isfinite(fitted.departure).all(axis=1))
    why = reason("inspect.hole-not-seen")
    if len(known) > 2:
        departure, covariance = _within(places, fitted, known)
        yield from _places(places, (departure, covariance), known, first)
        yield _passing(radius[known], fitted, (departure, covariance), known, (first, first + len(places) - 1))
    for a, b in _neighbours(places):
        id_, nominal = f"pitch-{first + a}-{first + b}", float(np.linalg.norm(places[b] - places[a]))
        if a in known and b in known:
            deviation, variance = _pitch(places, fitted, a, b)
            yield characteristic.normal(id_, Quantity.HOLE_PITCH, nominal, deviation, variance)
        else:
            yield characteristic.absent(id_, Quantity.HOLE_PITCH, nominal, why)
    for k, r in enumerate(radius.tolist()):
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


def _places(places: Floats, within: tuple[Floats, Floats], known: Ints, first: int) -> Iterator[Characteristic]:
    """Yield the places of holes within their group, along and across."""
    middle = places.mean(axis=0)
    departure, variance = within[0], np.diag(within[1])
    at = {int(k): i for i, k in enumerate(known)}
    for k in range(len(places)):
        for a, name in enumerate(("along", "across")):
            id_, nominal = f"hole-{first + k}-{name}", float(places[k, a] - middle[a])
            if k in at:
                row = 2 * at[k] + a
                yield characteristic.normal(
                    id_, Quantity.HOLE_POSITION, nominal, float(departure[row]), float(variance[row])
                )
            else:
                yield characteristic.absent(id_, Quantity.HOLE_POSITION, nominal, reason("inspect.hole-not-seen"))


def _passing(
    radius: Floats, fitted: Fitted, within: tuple[Floats, Floats], known: Ints, numbers: tuple[int, int]
) -> Characteristic:
    """Return the share of a group's holes that a gauge pin passes together with a splice plate drilled as designed.

    The pin is thinner than the nominal hole by UNDER_MM. It passes a hole of radius r, off the plate's hole of radius R
    by e, if e <= r + R - d for the pin's diameter d. The share is the mean of the holes' probabilities, its interval
    that of draws of all errors together.
    """
    mean, covariance = np.concatenate([within[0], fitted.departure[known, 2]]), within[1]
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = mean + np.random.default_rng(SEED).standard_normal((DRAWS, len(mean))) @ root.T
    count = len(known)
    off = np.hypot(drawn[:, 0 : 2 * count : 2], drawn[:, 1 : 2 * count : 2])
    pin = 2.0 * radius - UNDER_MM
    passed = (off <= 2.0 * radius - pin + drawn[:, 2 * count :]).mean(axis=1)
    low, high = np.quantile(passed, [0.025, 0.975]) - 1.0
    return Characteristic(
        f"holes-{numbers[0]}-{numbers[1]}-pass-through",
        Quantity.PASS_THROUGH,
        1.0,
        deviation=float(passed.mean()) - 1.0,
        low=float(low),
        high=float(high),
        unit="1",
    )


def _neighbours(places: Floats) -> Iterator[tuple[int, int]]:
    """Yield the pairs of holes that are next to each other in a row along or across."""
    for a in range(2):
        line = np.round(places[:, 1 - a] / ROW_MM)
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
