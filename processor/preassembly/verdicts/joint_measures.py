"""Measures of a joint by its eight gaps: groove gap, misalignment, rotation and offset, each with its 95 % interval.

All are in the joint's axes, x along the bridge, y left, z up. A gap is right part minus left part: along x positive is
open and negative an overlap. Plates meet across their faces: bottom and top (P5, P7) along z, the webs (P6, P8) along
y, the corners (P1..P4) along both. A shift along a plate is no misalignment of it. Least and greatest of several gaps
have intervals by :mod:`processor.adjustment.extremes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from processor.adjustment import extremes
from processor.geometry import rigid
from processor.model import NORMAL_95, Checked, Floats, Ints, column, names

RAYLEIGH_95 = 2.447747  # radius that holds 95 % of a round normal distribution in the plane, in standard deviations

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

    @property
    def known(self) -> bool:
        """Whether all gaps and their covariance are known."""
        return bool(np.isfinite(self.gaps).all() and np.isfinite(self.covariance).all())

    def of(self, name: str) -> tuple[float, float]:
        """Value and 95 % half-width of a row. Raises ValueError for an unknown name."""
        row = self.name.index(name)
        return float(self.value[row]), float(self.ci95[row])

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a row. Raises ValueError for an unknown name."""
        row = self.name.index(name)
        return float(self.low[row]), float(self.high[row])


class _Row(NamedTuple):
    """One measure with its 95 % interval."""

    name: str
    value: float
    unit: str
    low: float
    high: float


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
    low, high = np.array([row.low for row in rows]), np.array([row.high for row in rows])
    value = np.array([row.value for row in rows])
    misalignment, half_width = _misalignment_at(local, spread)
    return Measures(
        name=tuple(row.name for row in rows),
        value=value,
        ci95=np.maximum(high - value, value - low),
        low=low,
        high=high,
        unit=tuple(row.unit for row in rows),
        points=at,
        gaps=local,
        covariance=spread,
        misalignment_at=misalignment,
        misalignment_at_ci95=half_width,
    )


def motion_of(points: Floats) -> Floats:
    """Least-squares map (6, 24) from gaps to the turn (rad) and offset (mm) of the right part against the left.

    ``points`` (8, 3) and gaps in the joint's axes. A turn w and an offset t open the gap w x r + t at r.
    """
    flat = rigid.motion(points).reshape(24, 6)
    size = np.linalg.norm(flat, axis=0)
    solve: Floats = np.linalg.pinv(flat / size) / size[:, None]
    return solve


def _row(name: str, value: float, unit: str, half_width: float) -> _Row:
    return _Row(name, value, unit, value - half_width, value + half_width)


def _groove_rows(gaps: Floats, covariance: Floats) -> list[_Row]:
    x, spread = gaps[:, 0], covariance[np.ix_(_ALONG, _ALONG)]
    mean_sd = float(np.sqrt(max(spread.mean(), 0.0)))
    negative, below, above = extremes.of_correlated(-x, spread)
    greatest, low, high = extremes.of_correlated(x, spread)
    return [
        _row("groove_gap_mean", float(x.mean()), "mm", NORMAL_95 * mean_sd),
        _Row("groove_gap_least", -negative, "mm", -above, -below),
        _Row("groove_gap_greatest", greatest, "mm", low, high),
    ]


def _misalignment_row(gaps: Floats, covariance: Floats) -> _Row:
    across, spread = gaps.ravel()[_ROWS], covariance[np.ix_(_ROWS, _ROWS)]
    sign = np.where(across < 0.0, -1.0, 1.0)
    greatest, low, high = extremes.of_correlated(sign * across, spread * np.outer(sign, sign), folded=True)
    return _Row("misalignment", greatest, "mm", low, high)


def _motion_rows(gaps: Floats, covariance: Floats, points: Floats) -> list[_Row]:
    solve = motion_of(points)
    motion, spread = solve @ gaps.ravel(), solve @ covariance @ solve.T
    half_width = NORMAL_95 * np.sqrt(np.maximum(np.diag(spread), 0.0))
    # The length of the offset is off by no more than the length of the offset's error.
    offset = float(np.hypot(motion[4], motion[5]))
    reach = RAYLEIGH_95 * _largest_sd(spread[4:, 4:])
    low = max(offset - reach, 0.0) if np.isfinite(offset) else offset
    rows = [_Row("eccentricity", offset, "mm", low, offset + reach)]
    for k, axis in enumerate("xyz"):
        rows.append(_row(f"rotation_{axis}", 1e3 * float(motion[k]), "mrad", 1e3 * float(half_width[k])))
    for k, axis in enumerate("xyz"):
        rows.append(_row(f"offset_{axis}", float(motion[3 + k]), "mm", float(half_width[3 + k])))
    return rows


def _largest_sd(covariance: Floats) -> float:
    if not np.isfinite(covariance).all():
        return float("nan")
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _misalignment_at(gaps: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Root of the sum of squares of the misalignment at each point (8,), with a half-width (8,) of 95 % or more."""
    value, half_width = np.zeros(8), np.zeros(8)
    for point in range(8):
        axes: Sequence[int] = [axis for at, axis in ACROSS if at == point]
        rows = [3 * point + axis for axis in axes]
        value[point] = np.linalg.norm(gaps[point, axes])
        factor = RAYLEIGH_95 if len(axes) == 2 else NORMAL_95
        half_width[point] = factor * _largest_sd(covariance[np.ix_(rows, rows)])
    return value, half_width
