"""The adjustment of a field check: targets, poses, offset and scale of ranges, and variance components.

A sighting is a target's centre in the frame of a scan, the scanner at its origin and upright. Its differences from the
adjusted places are taken along the ray, horizontally and vertically across it. Their covariance is that of the target's
fit, plus components times known matrices, estimated by restricted maximum likelihood (Patterson and Thompson 1971,
Biometrika 58(3):545) with Fisher's scoring. Intervals of a component are those of Satterthwaite (1946): the sum of
component and mean fit variance is distributed as chi-square with 2 T^2 / var(T) degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq
from scipy.special import chdtr, chdtrc, chdtri

from processor.geometry import rigid
from processor.model import NORMAL_95, Floats, Ints
from processor.robust_statistics import student_factor

ROUNDS = 60  # of scoring; it settles within ten
SETTLED = 1e-4  # relative change of the components: far below their own intervals
# Standard deviations of the first pose's start, where known coordinates set the frame: whatever motion of the whole
# they leave free changes no length.
FREE = np.array([0.1] * 3 + [1000.0] * 3)


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """Targets as seen: ``places`` (m, 3), mm, about the scanner, z up, each with its fit's ``covariance`` (m, 3, 3).

    ``scan``, ``station`` and ``target`` (m,) are row numbers. ``known`` (t, 3) are coordinates of targets in a frame of
    their own and ``known_sd`` (t,) their standard deviations, NaN where there are none.
    """

    places: Floats
    covariance: Floats
    scan: Ints
    station: Ints
    target: Ints
    known: Floats
    known_sd: Floats

    @property
    def ranges(self) -> Floats:
        """Distances (m,) from the scanner."""
        found: Floats = np.linalg.norm(self.places, axis=1)
        return found

    @property
    def axes(self) -> Floats:
        """Unit vectors (m, 3, 3) along the ray, across it horizontally, and across both."""
        ray = self.places / self.ranges[:, None]
        across = np.cross([0.0, 0.0, 1.0], ray)
        across /= np.linalg.norm(across, axis=1)[:, None]
        return np.stack([ray, across, np.cross(ray, across)], axis=1)


@dataclass(frozen=True)
class Estimate:
    """A number with half its 95 % interval, and the degrees of freedom that determine it.

    Of a standard deviation ``chance`` is the probability that one of the class looks as large, and ``power`` that of
    the test at 95 % to see one of twice the class.
    """

    value: float
    ci95: float
    dof: float
    chance: float = float("nan")
    power: float = float("nan")


@dataclass(frozen=True)
class Adjusted:
    """The outcome: places (t, 3), residuals (m, 3) along the axes, mm, and the estimates by their names.

    ``chi2`` and ``dof`` are those of all sightings against the class.
    """

    places: Floats
    residuals: Floats
    estimates: Mapping[str, Estimate]
    chi2: float
    dof: int


def components(seen: Sightings) -> dict[str, Floats]:
    """Return factors (3m, k) of the components by the names of their terms; a matrix is F times its transpose.

    The range of a view, a target from a station, is off by the same in each of its repeats; beside it repeats scatter.
    """
    m, ranges = len(seen.places), seen.ranges
    rows = 3 * np.arange(m)

    def along(axis: int, factor: Floats) -> Floats:
        placed = np.zeros((3 * m, factor.shape[1]))
        placed[rows + axis] = factor
        return placed

    view = np.unique(np.column_stack([seen.station, seen.target]), axis=0, return_inverse=True)[1].reshape(-1)
    found = {"range_view": along(0, (view[:, None] == np.arange(view.max() + 1)).astype(np.float64))}
    if view.max() + 1 < m:
        found["range_repeat"] = along(0, np.eye(m))
    level = np.linalg.norm(seen.places[:, :2], axis=1)
    return found | {"angle_horizontal": along(1, np.diag(level)), "angle_vertical": along(2, np.diag(ranges))}


class _State(NamedTuple):
    """Places (t, 3), poses (s, 4, 4), offset (mm) and scale of ranges."""

    places: Floats
    poses: Floats
    offset: float
    scale: float


class _System(NamedTuple):
    """Derivatives (n, u) of observations, their differences (n,) from the model, and the fits' covariance (n, n)."""

    A: Floats
    y: Floats
    U: Floats


def adjust(seen: Sightings, places: Floats, poses: Floats, of_class: Mapping[str, float]) -> Adjusted:
    """Adjust sightings, from places (t, 3) of the targets and poses (s, 4, 4) that map scans to their frame.

    ``of_class`` gives the standard deviation of each component by the class: mm, rad. Where targets have known
    coordinates ``places`` are in their frame, and the scale of ranges is estimated.
    """
    factors = components(seen)
    state, first = _State(places, poses, 0.0, 0.0), _State(places, poses, 0.0, 0.0)
    system = _linearised(seen, state, first)
    Q = []
    for factor in factors.values():
        padded = np.zeros((len(system.y), factor.shape[1]))
        padded[: len(factor)] = factor
        Q.append(padded @ padded.T)
    by_class = np.array([of_class[name] ** 2 for name in factors])
    theta = by_class
    for _ in range(ROUNDS):
        W = np.linalg.inv(system.U + np.tensordot(theta, Q, 1))
        N = np.linalg.inv(system.A.T @ W @ system.A)
        P = W - W @ system.A @ N @ system.A.T @ W
        state = _moved(state, N @ (system.A.T @ (W @ system.y)), len(poses), bool(np.isfinite(seen.known_sd).any()))
        system = _linearised(seen, state, first)
        scored = _scored(theta, Q, P, system)
        step, theta = np.abs(scored - theta) / (theta + by_class), scored
        if step.max() < SETTLED:
            break
    known = len(system.y) > 3 * len(seen.places)
    V = np.linalg.inv(system.U + np.tensordot(by_class, Q, 1))
    VA = V @ system.A
    of_class_P = V - VA @ np.linalg.solve(system.A.T @ VA, VA.T)
    rest = of_class_P @ system.y
    tests = [_test(limit, q, of_class_P, rest) for limit, q in zip(by_class, Q, strict=True)]
    PQ, shared = _products(P, Q)
    estimates = dict(zip(factors, _intervals(theta, PQ, shared, P @ system.U, tests), strict=True))
    for name, row in {"range_offset": -1 - known, **({"scale": -1} if known else {})}.items():
        dof = _dof(W @ system.A @ N[:, row], float(N[row, row]), Q, shared)
        half = NORMAL_95 * float(np.sqrt(N[row, row]) * student_factor(dof))
        estimates[name] = Estimate(state.scale if name == "scale" else state.offset, half, dof)
    residuals = system.y[: 3 * len(seen.places)].reshape(-1, 3)
    return Adjusted(state.places, residuals, estimates, float(system.y @ rest), len(system.y) - system.A.shape[1])


def _linearised(seen: Sightings, state: _State, first: _State) -> _System:
    """Return the observation equations of sightings about a state: targets, poses, offset, scale.

    Without known coordinates the first pose is held and there is no scale. With them these are observed, too, and the
    pose is at its ``first`` state within FREE.
    """
    m, t, s = len(seen.places), len(state.places), len(state.poses)
    A = np.zeros((3 * m, 3 * t + 6 * s + 2))
    y = np.zeros(3 * m)
    for i, (scan, target, axes) in enumerate(zip(seen.scan.tolist(), seen.target.tolist(), seen.axes, strict=True)):
        T, rows = state.poses[scan], slice(3 * i, 3 * i + 3)
        turn, arm = axes @ T[:3, :3].T, state.places[target] - T[:3, 3]
        place = T[:3, :3].T @ arm
        length = float(np.linalg.norm(place))
        y[rows] = axes @ (seen.places[i] - place * (1.0 + state.offset / length + state.scale))
        A[rows, 3 * target : 3 * target + 3] = turn
        A[rows, 3 * t + 6 * scan : 3 * t + 6 * scan + 6] = np.column_stack([turn @ rigid.cross_matrix(arm), -turn])
        A[3 * i, -2:] = 1.0, length
    U = block_diag(*np.einsum("iab,ibc,idc->iad", seen.axes, seen.covariance, seen.axes))
    given = np.flatnonzero(np.isfinite(seen.known_sd))
    if not len(given):
        return _System(np.delete(A[:, :-1], np.arange(3 * t, 3 * t + 6), axis=1), y, U)
    further = np.zeros((3 * len(given) + 6, A.shape[1]))
    columns = np.concatenate([(3 * given[:, None] + np.arange(3)).ravel(), 3 * t + np.arange(6)])
    further[np.arange(len(columns)), columns] = 1.0
    motion = first.poses[0] @ rigid.invert(state.poses[0])
    off = np.concatenate([rigid.vector_from_rotation(motion[:3, :3]), first.poses[0][:3, 3] - state.poses[0][:3, 3]])
    y = np.concatenate([y, (seen.known - state.places)[given].ravel(), off])
    U = block_diag(U, np.diag(np.concatenate([np.repeat(seen.known_sd[given] ** 2, 3), FREE**2])))
    return _System(np.vstack([A, further]), y, U)


def _moved(state: _State, x: Floats, s: int, known: bool) -> _State:
    """Return the state moved by the unknowns (u,) of :func:`_linearised`."""
    t = 3 * len(state.places)
    of_poses = x[t : len(x) - 1 - known]
    if not known:
        of_poses = np.concatenate([np.zeros(6), of_poses])
    poses = state.poses.copy()
    for pose, (turn, shift) in zip(poses, of_poses.reshape(s, 2, 3), strict=True):
        pose[:3, :3] = rigid.rotation_from_vector(turn) @ pose[:3, :3]
        pose[:3, 3] += shift
    offset, scale = x[-1 - known], x[-1] if known else 0.0
    return _State(state.places + x[:t].reshape(-1, 3), poses, state.offset + float(offset), state.scale + float(scale))


def _products(P: Floats, Q: Sequence[Floats]) -> tuple[list[Floats], Floats]:
    """Return the products P Q of each matrix, and traces (c, c) of pairs of these: twice Fisher's information."""
    PQ = [P @ q for q in Q]
    return PQ, np.array([[float((a * b.T).sum()) for b in PQ] for a in PQ])


def _scored(theta: Floats, Q: Sequence[Floats], P: Floats, system: _System) -> Floats:
    """Return the components (c,) after a step of Fisher's scoring; none is negative."""
    PQ, information = _products(P, Q)
    Py = P @ system.y
    right = np.array([float(Py @ q @ Py) - float((pq * (P @ system.U).T).sum()) for q, pq in zip(Q, PQ, strict=True)])
    free = np.ones(len(Q), bool)
    found = np.zeros(len(Q))
    while free.any():  # those that become negative are 0, and the others are estimated without them
        found[:] = 0.0
        found[free] = np.linalg.solve(information[np.ix_(free, free)], right[free])
        if (found >= 0.0).all():
            break
        free &= found > 0.0
    return np.maximum(0.5 * (found + theta), 0.0) if (theta > 0.0).all() else found


def _dof(gain: Floats, variance: float, Q: Sequence[Floats], shared: Floats) -> float:
    """Return the degrees of freedom of a parameter's ``variance`` (Satterthwaite) by its ``gain`` (n,) of the data."""
    slope = np.array([float(gain @ q @ gain) for q in Q])
    return max(2.0 * variance**2 / float(slope @ np.linalg.solve(0.5 * shared, slope)), 1.0)


def _test(limit: float, q: Floats, P: Floats, rest: Floats) -> tuple[float, float]:
    """Return the chance that a scanner of the class shows as much of a component, and the power to see twice of it.

    The score of the component where all are those of the class, which would not change with better ones: a scaled
    chi-square. ``P`` (n, n) is the projector by the class, ``rest`` (n,) what it leaves of the observations.
    """
    Pq = P @ q
    expected, square = float(np.trace(Pq)), float((Pq * Pq.T).sum())
    dof = expected**2 / square
    chance = chdtrc(dof, dof * float(rest @ q @ rest) / expected)
    twice = expected + 3.0 * limit * square
    return float(chance), float(chdtrc(dof, chdtri(dof, 0.05) * expected / twice))


def _intervals(
    theta: Floats, PQ: Sequence[Floats], shared: Floats, PU: Floats, tests: Sequence[tuple[float, float]]
) -> list[Estimate]:
    """Return the standard deviations of the components, with intervals, and their ``tests`` against the class."""
    variance = np.diag(np.linalg.inv(0.5 * shared))
    own = np.array([float((pq * PU.T).sum()) for pq in PQ]) / np.diag(shared)
    found = []
    for component, u, v, (chance, power) in zip(theta, own, variance, tests, strict=True):
        dof, value = max(float(2.0 * (component + u) ** 2 / v), 1.0), float(np.sqrt(component))
        found.append(Estimate(value, _half_width(value, float(u), dof), dof, chance, power))
    return found


def _half_width(value: float, own: float, dof: float) -> float:
    """Return half the interval about a standard deviation that holds it in 95 %, ``own`` the fit's variance."""
    total = dof * (value**2 + own)

    def missed(half: float) -> float:
        low = max(value - half, 0.0) ** 2 + (own if half < value else 0.0)
        above = 1.0 if low == 0.0 else float(chdtr(dof, total / low))
        return above - float(chdtr(dof, total / ((value + half) ** 2 + own))) - 0.95

    top = max(value, float(np.sqrt(own)), 1e-12)
    while missed(top) < 0.0:
        top *= 2.0
    return float(brentq(missed, 0.0, top))
