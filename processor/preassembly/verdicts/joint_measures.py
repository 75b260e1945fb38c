"""What the eight gaps of a joint mean: groove gap, misalignment, rotation and offset, each with its 95 % interval.

All is said in the joint's axes, x along the bridge, y left, z up. A gap is right part minus left part: along x
positive is open and negative an overlap. Plates meet across their faces: bottom and top (P5, P7) along z, the webs
(P6, P8) along y, the corners (P1..P4) along both; a shift along a plate is no misalignment of it.

The least and the greatest of several values with errors are biased, and the interval of whichever point came out
extreme is too short: of eight it may miss in one case of five. So extremes take a band over all points at once, its
factor k from draws of their joint errors: with 95 % all errors stay within k sd, and then the true extreme lies between
the extremes of the band's two sides, whichever point has it. Points that cannot be the extreme are left out, so where
one stands clear of the others k is 1.96, as for any single value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import NORMAL_95, Checked, Floats, Ints, column, names

RAYLEIGH_95 = 2.447747  # radius that holds 95 % of a round normal distribution in the plane, in sd
DRAWS = 4000
SEED = 20
CLEAR_SD = 4.0  # a point this many sd of their difference from the extreme one is not it
EXACT_MM = 1e-9

# What counts as misalignment: rows of (point, axis), corners along both.
ACROSS = ((0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2), (4, 2), (5, 1), (6, 2), (7, 1))
_ROWS: Ints = np.array([3 * point + axis for point, axis in ACROSS])
_ALONG: Ints = np.arange(0, 24, 3)


@dataclass(frozen=True)
class Measures(Checked):
    """Measures of one joint, a row each, NaN where the gaps are not known; ``ci95`` is the wider side of low..high.

    Rows: groove_gap_mean, groove_gap_least, groove_gap_greatest, misalignment (greatest across any plate, at least 0),
    eccentricity (of the offset across the bridge), rotation_x, _y, _z of the right part against the left,
    offset_x, _y, _z at the joint's middle.
    """

    name: tuple[str, ...] = names("m")
    value: Floats = column("m")
    ci95: Floats = column("m")
    low: Floats = column("m")  # of the 95 % interval
    high: Floats = column("m")
    unit: tuple[str, ...] = names("m")  # mm | mrad
    # in joint axes
    points: Floats = column(8, 3)
    gaps: Floats = column(8, 3)
    covariance: Floats = column(24, 24)
    # per point: root of the sum of squares of what counts as misalignment there
    misalignment_at: Floats = column(8)
    misalignment_at_ci95: Floats = column(8)

    def of(self, name: str) -> tuple[float, float]:
        """Value and 95 % half-width of a row. Raises ValueError for a name there is none of."""
        row = self.name.index(name)
        return float(self.value[row]), float(self.ci95[row])

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a row. Raises ValueError for a name there is none of."""
        row = self.name.index(name)
        return float(self.low[row]), float(self.high[row])


def in_joint_axes(gaps: Floats, covariance: Floats, T_bridge_joint: Floats) -> tuple[Floats, Floats]:
    """Turn gaps (8, 3) and their covariance (24, 24) from bridge axes to the joint's."""
    R = T_bridge_joint[:3, :3]
    turn = np.kron(np.eye(8), R.T)
    return gaps @ R, turn @ covariance @ turn.T


def measure(gaps: Floats, covariance: Floats, T_bridge_joint: Floats, points: Floats) -> Measures:
    """Measure a joint from gaps (8, 3) with covariance (24, 24) at its key points (8, 3), all in bridge axes, mm."""
    local, spread = in_joint_axes(gaps, covariance, T_bridge_joint)
    at = rigid.apply(rigid.invert(T_bridge_joint), points)
    rows = [*_groove_rows(local, spread), _misalignment_row(local, spread), *_motion_rows(local, spread, at)]
    low, high = (np.array([row[k] for row in rows]) for k in (3, 4))
    value = np.array([row[1] for row in rows])
    misaligned, half = _misalignment_at(local, spread)
    return Measures(
        tuple(row[0] for row in rows),
        value,
        np.maximum(high - value, value - low),
        low,
        high,
        tuple(row[2] for row in rows),
        at,
        local,
        spread,
        misaligned,
        half,
    )


_Row = tuple[str, float, str, float, float]


def _row(name: str, value: float, unit: str, half: float) -> _Row:
    return name, value, unit, value - half, value + half


def _groove_rows(gaps: Floats, covariance: Floats) -> list[_Row]:
    x, spread = gaps[:, 0], covariance[np.ix_(_ALONG, _ALONG)]
    found = [_row("groove_gap_mean", float(x.mean()), "mm", NORMAL_95 * float(np.sqrt(max(spread.mean(), 0.0))))]
    for name, sign in (("least", -1.0), ("greatest", 1.0)):
        value, low, high = _greatest(sign * x, spread)
        if sign < 0.0:
            low, high = -high, -low
        found.append((f"groove_gap_{name}", sign * value, "mm", low, high))
    return found


def _misalignment_row(gaps: Floats, covariance: Floats) -> _Row:
    across, spread = gaps.ravel()[_ROWS], covariance[np.ix_(_ROWS, _ROWS)]
    sign = np.where(across < 0.0, -1.0, 1.0)
    value, low, high = _greatest(sign * across, spread * np.outer(sign, sign), folded=True)
    return "misalignment", value, "mm", low, high


def _greatest(values: Floats, covariance: Floats, folded: bool = False) -> tuple[float, float, float]:
    """Greatest of values (n,) with errors of covariance (n, n), and its 95 % interval; ``folded``: of magnitudes."""
    if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
        return float(values.max()), float("nan"), float("nan")
    top = int(np.argmax(values))
    var = np.maximum(np.diag(covariance), 0.0)
    apart = np.sqrt(np.maximum(var + var[top] - 2.0 * covariance[top], 0.0))
    if folded:  # the other sign of a value can be the greatest magnitude as well
        apart = np.maximum(apart, np.sqrt(np.maximum(var + var[top] + 2.0 * covariance[top], 0.0)))
    near = values >= values[top] - CLEAR_SD * apart - EXACT_MM
    sd = np.sqrt(var[near])
    reach = _factor(covariance[np.ix_(near, near)]) * sd
    low, high = float((values[near] - reach).max()), float((values[near] + reach).max())
    return float(values[top]), max(low, 0.0) if folded else low, high


def _factor(covariance: Floats) -> float:
    """Sd (k) within which 95 % of joint draws have all their errors."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    noisy = sd > 0.0
    if noisy.sum() < 2:
        return NORMAL_95
    errors = draws(np.zeros(int(noisy.sum())), covariance[np.ix_(noisy, noisy)], count=20_000)[:10_000]
    return max(NORMAL_95, float(np.quantile(np.abs(errors / sd[noisy]).max(axis=1), 0.95)))


def draws(mean: Floats, covariance: Floats, count: int = DRAWS, seed: int = SEED) -> Floats:
    """Draw (count, n) from a normal distribution, the same ones every time; each comes with its mirror image.

    The mirror images make what is linear in the draws exact: a value on its limit is within it in just half of them.
    """
    rng = np.random.default_rng(seed)
    scale, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    errors = (rng.standard_normal((count // 2, len(mean))) * np.sqrt(np.maximum(scale, 0.0))) @ axes.T
    found: Floats = mean + np.concatenate([errors, -errors])
    return found


def motion_of(points: Floats) -> Floats:
    """Least-squares map (6, 24) from gaps to the turn (rad) and offset (mm) of the right part against the left.

    ``points`` (8, 3) and gaps in the joint's axes. A turn w and an offset t open the gap w x r + t at r.
    """
    flat = rigid.motion(points).reshape(24, 6)
    size = np.linalg.norm(flat, axis=0)
    found: Floats = np.linalg.pinv(flat / size) / size[:, None]
    return found


def _motion_rows(gaps: Floats, covariance: Floats, points: Floats) -> list[_Row]:
    solve = motion_of(points)
    motion, spread = solve @ gaps.ravel(), solve @ covariance @ solve.T
    half = NORMAL_95 * np.sqrt(np.maximum(np.diag(spread), 0.0))
    # Reaching no farther than the error of the offset does, the size of the offset is within it.
    off = float(np.hypot(motion[4], motion[5]))
    reach = RAYLEIGH_95 * _largest_sd(spread[4:, 4:])
    found: list[_Row] = [("eccentricity", off, "mm", max(off - reach, 0.0) if np.isfinite(off) else off, off + reach)]
    for k, axis in enumerate("xyz"):
        found.append(_row(f"rotation_{axis}", 1e3 * float(motion[k]), "mrad", 1e3 * float(half[k])))
    for k, axis in enumerate("xyz"):
        found.append(_row(f"offset_{axis}", float(motion[3 + k]), "mm", float(half[3 + k])))
    return found


def _largest_sd(covariance: Floats) -> float:
    if not np.isfinite(covariance).all():
        return float("nan")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _misalignment_at(gaps: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Root-sum of what is misaligned at each point (8,), with a half-width that holds in 95 % or more."""
    value, half = np.zeros(8), np.zeros(8)
    for point in range(8):
        axes: Sequence[int] = [axis for at, axis in ACROSS if at == point]
        rows = [3 * point + axis for axis in axes]
        value[point] = np.linalg.norm(gaps[point, axes])
        factor = RAYLEIGH_95 if len(axes) == 2 else NORMAL_95
        half[point] = factor * _largest_sd(covariance[np.ix_(rows, rows)])
    return value, half
