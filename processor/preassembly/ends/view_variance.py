"""Variance between the unnamed views of a merged cloud, from the two sides of plates.

A cloud merged from several stations has errors of range, place and turn of each station in it, and each face is seen
from some of them only. On one face they look like form. But the two sides of a plate are never seen from one place, and
plates of one thickness are as thick at one end as at another: the variance of their thickness, as measured, is that
between viewpoints of its two sides together. Waves and bends of a plate are the same on both of its sides and cancel.
Rolling tolerances are in it as well. One plate of a box that was seen at both of its ends limits them: there the inner
side is never seen from one place, and half of the variance or more is in the difference of the ends.

The sides do not share it equally. Errors of range act along the ray, on a face that is seen obliquely by the cosine,
and the inner sides at an end are seen through its opening, obliquely, while the end's ring is seen from ahead. Noise
of range acts along the ray as well. So a face has a share of the variance as of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from processor.adjustment import global_test, scanner_class_errors
from processor.adjustment.point_groups import patch_numbers
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import robust_sd, student_factor

TERMS = 3  # of a plate's thickness: its mean, its changes along and across
ALIKE_MM = 2.0  # plates that differ by less may be of one nominal thickness: rolling and viewpoints differ by less
DESIGNED_MM = 0.5  # plates are rolled in steps of 1 mm or more: those of one nominal thickness differ by less in a mesh
PATCH_MM, FEWEST_OF_PATCH = 50.0, 4  # size of a patch, and points on either side of it
FLOOR_MM = 0.004  # of the design's mesh and of rounding
RISK = 1e-3  # that noise alone is taken for a difference between viewpoints
OF_CLASS = 2  # observations that the variance by the scanner's class counts for, beside those of the plates
OF_PAIR = 2  # opposite plates of an end are seen from the same two sides: their differences are the same


@dataclass(frozen=True)
class Thickness:
    """Thickness (3,) of a plate at an end, mm: mean, changes along and across; variances (3,) by noise.

    ``sides`` are the variances of single points on its outer and on its inner side. ``designed`` is the thickness that
    it has in the design, mm; 0 = unknown.
    """

    value: Floats
    noise: Floats
    sides: tuple[float, float]
    designed: float = 0.0


class Variances(NamedTuple):
    """Variances between viewpoints, mm^2: of a face's level, its tilt along and across, and the level of an end's ring.

    The registration takes some of a face's share. ``evident``: the levels differ by more than noise, with a risk of
    RISK. ``known``: two plates or more were compared.
    """

    level: float = 0.0
    along: float = 0.0
    across: float = 0.0
    ring: float = 0.0
    evident: bool = False
    known: bool = False

    def or_of_class(self) -> Variances:
        """Return the variances with the levels of the scanner's class where the plates do not show them."""
        return (
            self
            if self.known
            else self._replace(
                level=scanner_class_errors.known().view_mm ** 2, ring=scanner_class_errors.known().view_mm ** 2
            )
        )


NONE = Variances()


def thickness(trend: Floats, at: Floats, height: Floats, inner: Bools, designed: float = 0.0) -> Thickness | None:
    """Measure a plate by points (n,) at ``height`` above the design's outer side; None without an inner side.

    The two sides are compared patch by patch: ``at`` (n, 2) is the place of the points along and across the plate, mm,
    ``trend`` (n, 3) are the terms there, and ``inner`` (n,) marks the points behind the outer side. ``designed`` is its
    thickness in the design; 0 = unknown.
    """
    patch = patch_numbers(at, PATCH_MM)
    count = int(patch.max(initial=-1)) + 1
    difference, variance = np.zeros(count), np.zeros(count)
    enough = np.ones(count, bool)
    sides = []
    for side, sense in ((~inner, 1.0), (inner, -1.0)):
        number = np.bincount(patch[side], minlength=count)
        mean = np.bincount(patch[side], height[side], count) / np.maximum(number, 1)
        rest = height[side] - mean[patch[side]]
        noise = float(rest @ rest) / max(int(side.sum()) - int((number > 0).sum()), 1)
        difference += sense * mean
        variance += noise / np.maximum(number, 1)
        enough &= number >= FEWEST_OF_PATCH
        sides.append(robust_sd(rest) ** 2)
    if enough.sum() < 2 * TERMS:
        return None
    total = np.bincount(patch, minlength=count)
    terms = np.stack([np.bincount(patch, column, count) / total for column in trend.T], axis=1)[enough]
    terms[:, 1:] -= terms[:, 1:].mean(axis=0)
    root = np.sqrt(1.0 / np.maximum(variance[enough], FLOOR_MM**2))[:, None]
    if np.linalg.cond(terms * root) > 1e4:
        return None
    solve = np.linalg.pinv(terms * root) * root.T
    of_terms = np.diag(solve @ np.diag(variance[enough]) @ solve.T)
    return Thickness(solve @ difference[enough], of_terms, (sides[0], sides[1]), designed)


def variances(
    plates: Sequence[Thickness], rings: Sequence[float] = (), same: Sequence[tuple[int, int]] = ()
) -> Variances:
    """Variances between viewpoints by the plates at all ends of a bridge; ``rings`` are the variances of their points.

    They are widened for the number of differences they come from, so that 1.96 standard deviations cover what Student's
    t covers; where levels differ evidently, they include the scanner's class. 0 where no two plates are alike. ``same``
    are rows of one plate at both ends of a box.
    """
    if not plates:
        return NONE
    value, noise = np.array([one.value for one in plates]), np.array([one.noise for one in plates])
    group = _alike(plates)
    count = np.bincount(group)
    level = value[:, 0] - (np.bincount(group, value[:, 0]) / count)[group]
    # The mean of a group takes its share of the noise out of the differences.
    differences = len(plates) - len(count)
    by_noise = float(noise[:, 0].mean()) * differences
    dof = int(_dof(count).sum())
    squares = float((level**2).sum())
    evident = dof > 0 and squares > float(chdtri(differences, RISK)) * float(noise[:, 0].mean())
    between = _variance(squares, by_noise, dof)
    if evident:
        between = max(between, _with_class(between, squares, by_noise, dof))
    most = _limit(value[:, 0], noise[:, 0], same)
    if most < between:
        between, evident = most, False
    of_points = np.maximum(np.mean([one.sides for one in plates], axis=0), FLOOR_MM**2)
    outer = of_points[0] / of_points.mean()
    return Variances(
        level=between * outer,
        ring=between * (max(float(np.mean(rings)), FLOOR_MM**2) / of_points.mean() if len(rings) else outer),
        along=_variance(float((value[:, 1] ** 2).sum()), float(noise[:, 1].sum()), len(plates)),
        across=_variance(float((value[:, 2] ** 2).sum()), float(noise[:, 2].sum()), len(plates)),
        known=dof > 0,
        evident=evident,
    )


def tails(ends: Sequence[Sequence[Thickness]]) -> Floats:
    """Probabilities (e,) that the plates of each end differ as much from plates of other ends; NaN without such.

    Other ends show the variance of a plate's thickness. Opposite plates of an end count as one observation.
    """
    plates = [plate for end in ends for plate in end]
    value = np.array([plate.value[0] for plate in plates])
    noise = np.array([max(plate.noise[0], FLOOR_MM**2) for plate in plates])
    of_end = np.repeat(np.arange(len(ends)), [len(end) for end in ends])
    group = _alike(plates)
    found = np.full(len(ends), np.nan)
    for number in np.unique(of_end):
        own, others = of_end == number, of_end != number
        count = np.bincount(group[others], minlength=int(group.max()) + 1)
        dof = int(_dof(count).sum())
        own &= count[group] > 0
        if not own.any() or dof < 1:
            continue
        mean = np.bincount(group[others], value[others], len(count)) / np.maximum(count, 1)
        by_noise = np.bincount(group[others], noise[others], len(count)) / np.maximum(count, 1)
        squares = float(((value - mean[group])[others] ** 2).sum())
        between = max(squares - float((by_noise * (count - 1))[count > 0].sum()), 0.0) / dof
        share = 1.0 / count[group[own]]
        variance = noise[own] + by_noise[group[own]] * share + between * (1.0 + np.minimum(OF_PAIR * share, 1.0))
        independent = own.sum() / OF_PAIR
        mean_square = float(np.mean((value[own] - mean[group[own]]) ** 2 / variance))
        found[number] = global_test.tail(mean_square * independent, independent, dof / OF_PAIR)
    return found


def _alike(plates: Sequence[Thickness]) -> Ints:
    """Return the number (n,) of each plate's group: of one thickness in the design, and about as thick."""
    level, designed = np.array([(plate.value[0], plate.designed) for plate in plates]).reshape(-1, 2).T
    order = np.lexsort((level, designed))
    apart = np.diff(designed[order], prepend=designed[order[:1]]) > DESIGNED_MM
    apart |= np.abs(np.diff(level[order], prepend=level[order[:1]])) > ALIKE_MM
    group = np.zeros(len(level), np.int64)
    group[order] = np.cumsum(apart)
    return group


def _dof(count: Ints) -> Ints:
    """Plates (g,) of groups of ``count`` (g,) less those that a group's mean takes: two, as opposite plates are one."""
    free: Ints = np.maximum(count - OF_PAIR, 0)
    return free


def _with_class(between: float, squares: float, by_noise: float, dof: int) -> float:
    """Variance on one side of a plate by the plates and by the scanner's class together.

    A few stations may by chance agree better than they are right. The class counts for OF_CLASS observations, up to the
    95 % confidence limit of what the plates show: a network may be better than its class.
    """
    pairs = dof / OF_PAIR
    both = (between * pairs + scanner_class_errors.known().view_mm ** 2 * OF_CLASS) / (pairs + OF_CLASS)
    return min(both, _estimate(squares, by_noise, dof) * pairs / float(chdtri(pairs, 0.95)))


def _limit(value: Floats, noise: Floats, same: Sequence[tuple[int, int]]) -> float:
    """Return the 95 % limit of the variance on one side of a plate, by plates that were measured at two ends.

    The outer sides at both ends may be seen from one place: the difference has the variance of two sides, not of four.
    """
    rows = np.array([pair for pair in same if abs(value[pair[0]] - value[pair[1]]) < ALIKE_MM], np.int64).reshape(-1, 2)
    if not len(rows):
        return np.inf
    squares, independent = float((np.diff(value[rows], axis=1) ** 2).sum()), len(rows) / OF_PAIR
    largest = squares * independent / float(chdtri(independent, 0.95))
    return max(largest - float(noise[rows].sum()), 0.0) / (2.0 * len(rows))


def _variance(squares: float, by_noise: float, dof: int) -> float:
    """Variance on one side of a plate, widened for the number of differences it comes from."""
    return float(student_factor(dof / OF_PAIR)) ** 2 * _estimate(squares, by_noise, dof) if dof >= 1 else 0.0


def _estimate(squares: float, by_noise: float, dof: int) -> float:
    """Variance on one side of a plate by the sum of squares of differences of its two sides."""
    return max(squares - by_noise, 0.0) / (2.0 * dof)
