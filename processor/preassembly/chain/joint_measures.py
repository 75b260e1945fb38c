"""Measures of a joint by its eight gaps: groove gap, misalignment, rotation and offset, each with its 95 % interval.

All are in the joint's axes, x along the bridge, y left, z up. A gap is right part minus left part: along x positive is
open and negative an overlap. Plates meet across their faces: bottom and top (P5, P7) along z, the webs (P6, P8) along
y, the corners (P1..P4) along both. A shift along a plate is no misalignment of it. Least and greatest of several gaps
have intervals by :mod:`processor.adjustment.maximum_interval`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from processor.adjustment import maximum_interval
from processor.geometry import rigid
from processor.limits.judging import Measured
from processor.model import (
    AMOUNT,
    COORDINATE,
    COVARIANCE,
    KEY_POINTS,
    NORMAL_95,
    NUMBER,
    Checked,
    Floats,
    Ints,
    Rows,
    Word,
    column,
    names,
    words,
)

RAYLEIGH_95 = 2.447747  # radius that holds 95 % of a round normal distribution in the plane, in standard deviations

# What counts as misalignment: rows of (point, axis), corners along both.
ACROSS = ((0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2), (4, 2), (5, 1), (6, 2), (7, 1))
_ROWS: Ints = np.array([3 * point + axis for point, axis in ACROSS])  # of the 24 gaps, three a point
_ALONG: Ints = np.arange(0, 24, 3)  # x of each of the eight points


class JointQuantity(Word):
    """A measure of a joint.

    The misalignment is the greatest across any plate, at least 0; the eccentricity is of the offset across the bridge;
    rotation and offset are of the right part against the left, the offset at the joint's middle.
    """

    GROOVE_GAP_MEAN = "groove_gap_mean"
    GROOVE_GAP_LEAST = "groove_gap_least"
    GROOVE_GAP_GREATEST = "groove_gap_greatest"
    MISALIGNMENT = "misalignment"
    ECCENTRICITY = "eccentricity"
    ROTATION_X = "rotation_x"
    ROTATION_Y = "rotation_y"
    ROTATION_Z = "rotation_z"
    OFFSET_X = "offset_x"
    OFFSET_Y = "offset_y"
    OFFSET_Z = "offset_z"


@dataclass(frozen=True)
class MeasuredQuantities(Rows):
    """Values with their 95 % intervals ``low`` to ``high``, NaN where the gaps are not known."""

    name: tuple[JointQuantity, ...] = words("m", JointQuantity)
    value: Floats = column("m", means=NUMBER)
    ci95: Floats = column("m", means=AMOUNT)  # the wider side of low..high
    low: Floats = column("m", means=NUMBER)
    high: Floats = column("m", means=NUMBER)
    unit: tuple[str, ...] = names("m")  # mm | mrad


@dataclass(frozen=True)
class Measures(Checked):
    """Measures of one joint, and its gaps with their covariance, in joint axes, mm.

    ``misalignment_at`` is, per point, the root of the sum of squares of what counts as misalignment there.
    """

    quantities: MeasuredQuantities = field(
        default_factory=MeasuredQuantities, metadata={"json": "measures", "by": "name"}
    )
    points: Floats = column(8, 3, json="", means=COORDINATE)
    gaps: Floats = column(8, 3, json="gaps_joint_axes.*", keys=KEY_POINTS, means=COORDINATE)
    gaps_ci95: Floats = column(8, 3, json="gaps_joint_axes_ci95.*", keys=KEY_POINTS, means=AMOUNT)
    covariance: Floats = column(24, 24, json="", means=COVARIANCE)
    misalignment_at: Floats = column(8, json="", means=AMOUNT)
    misalignment_at_ci95: Floats = column(8, json="", means=AMOUNT)

    @property
    def known(self) -> bool:
        """Whether all gaps and their covariance are known."""
        return bool(np.isfinite(self.gaps).all() and np.isfinite(self.covariance).all())

    def of(self, name: str) -> tuple[float, float]:
        """Value and 95 % half-width of a quantity. Raises ValueError for an unknown name."""
        one = self.measured(name)
        return one.value, one.ci95

    def measured(self, name: str) -> Measured:
        """Return a quantity with its 95 % interval. Raises ValueError for an unknown name."""
        row = self.quantities.name.index(JointQuantity(name))
        (found,) = self.quantities.take(slice(row, row + 1)).items()
        return Measured(found.pop("name"), **found)


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
    misalignment, half_width = _misalignment_at(local, spread)
    return Measures(
        quantities=MeasuredQuantities.from_items(
            rows, name=tuple(row.of for row in rows), ci95=tuple(row.wider_side for row in rows)
        ),
        points=at,
        gaps=local,
        gaps_ci95=NORMAL_95 * np.sqrt(np.maximum(np.diag(spread), 0.0)).reshape(8, 3),
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


def _groove_rows(gaps: Floats, covariance: Floats) -> list[Measured]:
    x, spread = gaps[:, 0], covariance[np.ix_(_ALONG, _ALONG)]
    mean_sd = float(np.sqrt(max(spread.mean(), 0.0)))
    negative, below, above = maximum_interval.of_correlated(-x, spread)
    greatest, low, high = maximum_interval.of_correlated(x, spread)
    return [
        Measured.within(JointQuantity.GROOVE_GAP_MEAN, float(x.mean()), NORMAL_95 * mean_sd),
        Measured(JointQuantity.GROOVE_GAP_LEAST, -negative, -above, -below),
        Measured(JointQuantity.GROOVE_GAP_GREATEST, greatest, low, high),
    ]


def _misalignment_row(gaps: Floats, covariance: Floats) -> Measured:
    across, spread = gaps.ravel()[_ROWS], covariance[np.ix_(_ROWS, _ROWS)]
    sign = np.where(across < 0.0, -1.0, 1.0)
    greatest, low, high = maximum_interval.of_correlated(sign * across, spread * np.outer(sign, sign), folded=True)
    return Measured(JointQuantity.MISALIGNMENT, greatest, low, high)


def _motion_rows(gaps: Floats, covariance: Floats, points: Floats) -> list[Measured]:
    solve = motion_of(points)
    motion, spread = solve @ gaps.ravel(), solve @ covariance @ solve.T
    half_width = NORMAL_95 * np.sqrt(np.maximum(np.diag(spread), 0.0))
    # The length of the offset is off by no more than the length of the offset's error.
    offset = float(np.hypot(motion[4], motion[5]))
    reach = RAYLEIGH_95 * _largest_sd(spread[4:, 4:])
    low = max(offset - reach, 0.0) if np.isfinite(offset) else offset
    rows = [Measured(JointQuantity.ECCENTRICITY, offset, low, offset + reach)]
    for k, (kind, axis) in enumerate(product(("rotation", "offset"), "xyz")):
        unit, scale = ("mrad", 1e3) if kind == "rotation" else ("mm", 1.0)
        value, half = scale * float(motion[k]), scale * float(half_width[k])
        rows.append(Measured.within(JointQuantity(f"{kind}_{axis}"), value, half, unit=unit))
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
