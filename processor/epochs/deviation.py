"""Epochs of step ``deviation``: how far the surface of each component moved: on average, as a body, and at most.

Only places measured at all epochs are used, because means over different parts of a surface are not comparable: core
points nearer than their spacing, on the same side. The movement of a body is that part of its deviations that a rigid
motion explains, at its middle; opposite faces cancel in the mean, and not in the movement. Intervals are as if the
errors of all core points were the same, with the worst signs, which no correlation can exceed.

The core point that changed most, by its levels of detection, stands for all, its interval widened for their number. It
is found only where the epochs have the same core points, as the design's surface was sampled alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.deviation.result import ErrorSource, Result
from processor.deviation.verdicts import WHOLE
from processor.epochs.quantity_series import Kind, Series, strongest
from processor.language.messages import text
from processor.model import Bools, Floats, Ints, Reason, Status, reason

BY_DESIGN = True
NAN = float("nan")
SAME_MM = 0.01  # core points of one place
LEAST_DETERMINED = 0.1  # singular value by the greatest, below which a direction of a rigid motion is not determined
DETERMINED_SHARE = 0.99  # of an axis, within the directions that are


@dataclass(frozen=True)
class _Core:
    """Core points of a component at one epoch: places and normals (r, 3), distances (r,), levels of detection (r,)."""

    places: Floats
    normals: Floats
    distance: Floats
    lod95: Floats

    @classmethod
    def of(cls, result: Result | None, rows: Ints | None) -> _Core:
        if result is None or rows is None:
            return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))
        core = result.core
        return cls(core.points[rows] + result.origin, core.normals[rows], core.distance[rows], core.lod95[rows])

    @property
    def spacing(self) -> float:
        """Median distance of a core point from its nearest; 0 of one alone."""
        return float(np.median(cKDTree(self.places).query(self.places, 2)[0][:, 1])) if len(self.places) > 1 else 0.0

    def sided(self, reach: float) -> Floats:
        """Places with normals as further coordinates (r, 6), such that what faces away is farther than ``reach``."""
        return np.hstack([self.places, reach * self.normals])

    def at(self, rows: Ints) -> tuple[Floats, Floats]:
        """Return distances and levels of detection (c,) of core points by their rows (c,)."""
        return self.distance[rows], self.lod95[rows]


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield the mean deviation of each component, the movement of each body, and the core point that changed most."""
    doubtful = np.array(
        [
            one is not None and (one.status is Status.AMBIGUOUS or one.registration_error_from is ErrorSource.UNKNOWN)
            for one in results
        ],
        np.bool_,
    )
    with_bodies = all(one is None or len(one.bodies) for one in results)
    for name in _names(results):
        cores = _cores(results, name)
        common = _in_common(cores, _reach(cores))
        values = [core.at(rows) for core, rows in zip(cores, common, strict=True)]
        value, half = np.array([(np.mean(d), np.mean(lod95)) if len(d) else (NAN, NAN) for d, lod95 in values]).T
        yield Series(
            component=name, kind=Kind.SURFACE, quantity=text("mean deviation"), value=value, ci95=half,
            doubtful=doubtful,
        )  # fmt: skip
        if with_bodies:
            yield from _movement(name, cores, common, doubtful)
        yield from _strongest(name, cores, doubtful)


def remarks(results: Sequence[Result | None]) -> Iterator[Reason]:
    """Say what deviations of two epochs have in common, and whether their core points are the same."""
    if sum(result is not None for result in results) < 2:
        return
    yield reason("epochs.registered-to-design")
    compared = [_cores(results, name) for name in _names(results)]
    elsewhere = sum(_epochs(_sampled_alike(cores)) < _epochs(cores) for cores in compared)
    if elsewhere:
        yield reason("epochs.core-points-elsewhere", count=elsewhere, total=len(compared))


def _names(results: Sequence[Result | None]) -> list[str]:
    return list(dict.fromkeys(name for one in results if one is not None for name in one.bodies or (WHOLE,)))


def _cores(results: Sequence[Result | None], name: str) -> list[_Core]:
    return [_Core.of(result, None if result is None else _of_body(result, name)) for result in results]


def _of_body(result: Result, name: str) -> Ints:
    """Return the rows (r,) of the core points of a component that have a distance and a level of detection."""
    core = result.core
    known = np.isfinite(core.distance) & np.isfinite(core.lod95)
    if result.bodies:
        known &= core.body == (result.bodies.index(name) if name in result.bodies else -2)
    elif name != WHOLE:
        known[:] = False
    return np.flatnonzero(known)


def _epochs(cores: Sequence[_Core]) -> int:
    """Count the epochs that have core points."""
    return sum(len(core.places) > 0 for core in cores)


def _reach(cores: Sequence[_Core]) -> float:
    """Distance within which core points of two epochs are of one place: the spacing of the epoch that has fewest."""
    return max(core.spacing for core in cores)


def _sampled_alike(cores: Sequence[_Core]) -> list[_Core]:
    """Return the epochs' core points, without any where they are not those of the first epoch with the component.

    Of two samplings of one surface some points coincide by chance: most of the places in common have to.
    """
    first = next((core for core in cores if len(core.places)), None)
    if first is None:
        return list(cores)
    reach = _reach(cores)
    alike = [2 * _matched(core, first, SAME_MM) >= _matched(core, first, reach) for core in cores]
    return [core if same else _Core.of(None, None) for core, same in zip(cores, alike, strict=True)]


def _matched(core: _Core, first: _Core, reach: float) -> int:
    """Count the core points of the first epoch that have one of another within ``reach``."""
    if not len(core.places):
        return 0
    away, _ = cKDTree(core.sided(reach)).query(first.sided(reach), distance_upper_bound=reach)
    return int(np.isfinite(away).sum())


def _in_common(cores: Sequence[_Core], reach: float) -> list[Ints]:
    """Return the rows (c,) of the core points, epoch by epoch, at the places that the epochs have in common.

    Places are core points of the first epoch with the component, and those of the others are the nearest within
    ``reach``. The epochs that have most of them are taken first; one that shares none with all of these has no rows.
    """
    rows = [np.empty(0, np.int64) for _ in cores]
    known = [e for e, core in enumerate(cores) if len(core.places)]
    if not known:
        return rows
    first = cores[known[0]].sided(reach)
    nearest = {e: cKDTree(cores[e].sided(reach)).query(first, distance_upper_bound=reach) for e in known}
    places, taken = np.arange(len(first)), []
    for e in sorted(known, key=lambda e: -int(np.isfinite(nearest[e][0]).sum())):
        shared = places[np.isfinite(nearest[e][0][places])]
        if len(shared):
            places = shared
            taken.append(e)
    for e in taken:
        rows[e] = nearest[e][1][places]
    return rows


def _movement(name: str, cores: Sequence[_Core], common: Sequence[Ints], doubtful: Bools) -> Iterator[Series]:
    """Yield the movement of a body from its design along x, y and z, as far as its surface seen determines them."""
    first = next((e for e, rows in enumerate(common) if len(rows)), None)
    if first is None:
        return
    core, rows = cores[first], common[first]
    # The matrix (3, c) from distances along normals to the shift of the middle, and its axes determined (3,). A place
    # p with normal n moves along it by n t + (p x n) w. Directions that the normals do not determine are taken out by
    # their singular values; lengths are in units of the body's size, so that turns compare with shifts.
    places = core.places[rows]
    normals = core.normals[rows]
    arm = places - places.mean(axis=0)
    size = max(float(np.linalg.norm(arm, axis=1).max()), 1e-9)
    A = np.hstack([normals, np.cross(arm, normals) / size])
    inverse = np.linalg.pinv(A, rcond=LEAST_DETERMINED)
    solve, determined = inverse[:3], np.diag(inverse @ A)[:3] > DETERMINED_SHARE
    values, half = np.full((2, len(cores), 3), np.nan)
    for e, (one, own) in enumerate(zip(cores, common, strict=True)):
        if len(own):
            distance, lod95 = one.at(own)
            values[e], half[e] = solve @ distance, np.abs(solve) @ lod95
    for axis in np.flatnonzero(determined).tolist():
        yield Series(
            component=name, kind=Kind.SURFACE, quantity=text("movement {axis}", axis="xyz"[axis]),
            value=values[:, axis], ci95=half[:, axis], doubtful=doubtful,
        )  # fmt: skip


def _strongest(name: str, cores: Sequence[_Core], doubtful: Bools) -> Iterator[Series]:
    """Yield the deviation at the core point that changed most of those that the epochs have in common."""
    cores = _sampled_alike(cores)
    common = _in_common(cores, SAME_MM)
    known = [e for e, rows in enumerate(common) if len(rows)]
    if len(known) < 2:
        return
    n = len(common[known[0]])
    distance, lod95 = np.full((2, len(cores), n), np.nan)
    for e in known:
        distance[e], lod95[e] = cores[e].at(common[e])
    k = strongest(distance[known], lod95[known])
    x, y, z = cores[known[0]].places[common[known[0]][k]].tolist()
    quantity = text("deviation at {x:.0f}, {y:.0f}, {z:.0f}", x=x, y=y, z=z)
    yield Series(
        component=name, kind=Kind.SURFACE, quantity=quantity, value=distance[:, k], ci95=lod95[:, k],
        doubtful=doubtful, chosen_from=n,
    )  # fmt: skip
