"""Variance between viewpoints: from the two sides of plates, by draws of known size."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm, t

from processor.adjustment import scanner_class_errors
from processor.preassembly.ends import view_variance

# Points a side. Noise of 1 mm on FEW makes 0.11 mm of a thickness: less than views that differ by 0.3 mm do. Of 0.1 mm
# it is as much as is to be seen, which half of all draws show then: ENOUGH make 0.04 mm.
FEW, ENOUGH = 600, 1_500


def plate(rng, apart, thick=24.0, waves=0.0, off=None, count=ENOUGH):
    """Points on both sides of a plate of 500 by 900 mm; each side is ``off``, or by a draw of ``apart`` mm."""
    heights, places, inner = [], [], []
    off = apart * rng.standard_normal(2) if off is None else off
    for side, level in ((False, off[0]), (True, off[1] - thick)):
        at = rng.uniform((-500.0, -450.0), (0.0, 450.0), (count, 2))
        shape = waves * np.sin(2.0 * np.pi * at[:, 0] / 700.0)
        heights.append(level + shape + rng.standard_normal(len(at)))
        places.append(at)
        inner.append(np.full(len(at), side))
    at = np.vstack(places)
    terms = np.stack([np.ones(len(at)), at[:, 0] / 500.0, at[:, 1] / 450.0], axis=1)
    return view_variance.thickness(terms, at, np.concatenate(heights), np.concatenate(inner))


def test_waves_of_a_plate_do_not_change_its_thickness():
    rng = np.random.default_rng(0)
    found = np.array([plate(rng, 0.0, waves=3.0).value for _ in range(20)])
    # 1 mm by 1,500 points on either side and three terms: 0.04 each, 0.01 of twenty; waves of 3 mm alone make 0.5.
    assert np.abs(found[:, 0].mean() - 24.0) < 0.03
    assert found[:, 0].std() < 0.1


def pair(rng, apart, thick=24.0, count=FEW):
    """Two opposite plates of an end, seen from the same two sides: shifts of views point outward on one alone."""
    off = apart * rng.standard_normal(2)
    return [plate(rng, apart, thick, off=one, count=count) for one in (off, -off[::-1])]


# Of 12 pairs of opposite plates less 3 means of equal thickness 9 are left. By Student's t they are widened by
# 1.33 = (2.26 / 1.96)^2. The class counts for 2 more: (9 * 1.33 * 0.3^2 + 2 * 0.5^2) / 11 = 1.59 * 0.3^2. Of 0.1 mm
# the 95 % limit is less than that: 9 / 3.33 = 2.71, by the 5 % quantile of chi-square.
@pytest.mark.parametrize(
    ("apart", "count", "wider"), [pytest.param(0.1, ENOUGH, 2.71, marks=pytest.mark.slow), (0.3, FEW, 1.59)]
)
def test_variance_between_viewpoints_by_plates_of_several_thicknesses(apart, count, wider):
    rng = np.random.default_rng(1)
    found = [
        view_variance.variances(
            [one for thick in (14.0, 20.0, 30.0) for _ in range(4) for one in pair(rng, apart, thick, count)]
        )
        for _ in range(60)
    ]
    # By 9 degrees of freedom a variance is known to 47 %, the mean of 60 to 6 %.
    assert np.mean([one.level for one in found]) == pytest.approx(wider * apart**2, rel=0.2)
    # Noise may make as much once in a thousand; chi-square of 9 is a ninth of its mean, which is less, in 6 of 10,000.
    assert sum(one.evident for one in found) >= 59


def box(rng, apart, rolled, one_outer):
    """Plates of both ends of a box of two nominal thicknesses, and rows of the same plates; ``rolled``: sd by plate."""
    thick = np.array([24.0, 24.0, 30.0, 30.0]) + rolled * rng.standard_normal(4)
    outer, ends = apart * rng.standard_normal(4), []
    for _ in range(2):
        outer = outer if one_outer else apart * rng.standard_normal(4)
        inner = apart * rng.standard_normal(4)
        ends += [
            plate(rng, apart, t, off=off, count=FEW if apart else ENOUGH)
            for t, *off in zip(thick, outer, inner, strict=True)
        ]
    return ends, [(k, 4 + k) for k in range(4)]


def of_boxes(rng, apart, rolled, one_outer):
    """Variances of the plates of three boxes."""
    plates, same = [], []
    for _ in range(3):
        ends, rows = box(rng, apart, rolled, one_outer)
        same += [(a + len(plates), b + len(plates)) for a, b in rows]
        plates += ends
    return view_variance.variances(plates, same=same)


def test_plates_that_were_rolled_differently_are_no_difference_between_views():
    """Of 0.3 mm by plate the variance is less than a tenth where each plate is as thick at one end as at the other."""
    rng = np.random.default_rng(6)
    found = [of_boxes(rng, 0.0, 0.3, one_outer=False) for _ in range(10)]
    assert not any(one.evident for one in found)
    assert np.mean([one.level for one in found]) < 0.1 * 0.5 * 0.3**2


@pytest.mark.parametrize("one_outer", [pytest.param(False, marks=pytest.mark.slow), True])
def test_views_that_differ_are_not_taken_for_rolling(one_outer):
    """Also where the outer sides at both ends were seen from one place, nineteen in twenty limits hold the truth."""
    rng = np.random.default_rng(7)
    found = [of_boxes(rng, 0.3, 0.0, one_outer) for _ in range(30)]
    assert np.mean([one.level for one in found]) > 0.3**2  # a limit is above the variance of that sd
    assert np.mean([one.evident for one in found]) > 0.9  # of 30


def test_plates_of_two_designed_thicknesses_are_compared_with_their_like_alone():
    """Webs of 20 and flanges of 22 mm: their difference is none between views, though rolling spreads as far."""
    rng = np.random.default_rng(6)
    thick = np.tile([20.0, 20.0, 22.0, 22.0], 8)
    plates = [one for t in thick[::2] for one in pair(rng, 0.3, t)]
    apart = view_variance.variances([replace(one, designed=t) for one, t in zip(plates, thick, strict=True)])
    together = view_variance.variances(plates)
    # Of 14 pairs a variance has the relative standard deviation sqrt(2 / 14); it is widened, by the class as well.
    assert 0.3**2 * (1.0 - 2.0 * np.sqrt(2.0 / 14.0)) < apart.level < 2.0 * 0.3**2
    assert together.level > 0.5  # half of the variance of 1 mm about the mean of both


def test_opposite_plates_of_one_end_show_no_difference_between_views():
    """Whatever views differ by, the two plates differ from each other by noise alone."""
    rng = np.random.default_rng(4)
    found = view_variance.variances([one for thick in (24.0, 30.0) for one in pair(rng, 0.3, thick)])
    assert (found.known, found.evident, found.level) == (False, False, 0.0)


def test_ends_that_differ_as_others_do_contradict_as_rarely_as_stated():
    """Tails of plates that differ as their model has it are uniform, also of few ends."""
    rng = np.random.default_rng(5)
    tails = [view_variance.tails([pair(rng, 0.3) + pair(rng, 0.3, 30.0) for _ in range(4)]) for _ in range(40)]
    assert np.isfinite(tails).all()
    assert np.mean(np.array(tails) < 0.05) < 0.08  # of 160, correlated: 0.05 + 2 standard deviations of 0.017


def test_noise_alone_is_no_difference_between_viewpoints():
    rng = np.random.default_rng(2)
    found = [view_variance.variances([plate(rng, 0.0) for _ in range(16)]) for _ in range(10)]
    assert not any(one.evident for one in found)
    assert np.sqrt(np.mean([one.level for one in found])) < 0.03  # less than the noise of a thickness: 0.04


def test_three_plates_alike_have_the_variance_of_one_difference():
    """By hand: levels of 20.0, 20.3 and 20.9 mm are 0.42 mm^2 about their mean, of which noise makes 2 * 0.05 mm^2."""
    values = [(20.0, 0.3, -0.2), (20.3, -0.5, 0.6), (20.9, 0.4, 0.1)]
    found = view_variance.variances(
        [view_variance.Thickness(np.array(value), np.array([0.05, 0.02, 0.03]), (1.5, 0.5)) for value in values]
    )
    factor = (t.ppf(0.975, [1.0, 1.5]) / norm.ppf(0.975)) ** 2  # one difference counts as one, half as many of pairs
    assert (found.known, found.evident) == (True, False)
    assert found.level == pytest.approx(1.5 * factor[0] * (0.42 - 0.10) / 2.0)
    assert found.ring == pytest.approx(found.level)
    assert found.along == pytest.approx(factor[1] * (0.50 - 0.06) / 6.0)
    assert found.across == pytest.approx(factor[1] * (0.41 - 0.09) / 6.0)


def test_a_plate_of_which_one_side_was_seen_has_no_thickness():
    at = np.random.default_rng(3).uniform(0.0, 500.0, (1_000, 2))
    terms = np.stack([np.ones(1_000), *(at / 500.0).T], axis=1)
    assert view_variance.thickness(terms, at, np.zeros(1_000), np.zeros(1_000, bool)) is None
    assert view_variance.variances([]) == view_variance.NONE


def test_view_variances_unknown_from_plates_are_those_of_the_scanner_class():
    term = scanner_class_errors.known().view_mm ** 2
    assert view_variance.variances([]).or_of_class() == view_variance.NONE._replace(level=term, ring=term)
    one = view_variance.variances([plate(np.random.default_rng(1), 0.3)])
    assert (one.level, one.or_of_class().level, one.or_of_class().ring) == (0.0, term, term)
    shown = view_variance.variances([plate(np.random.default_rng(k), 0.0) for k in range(4)])
    assert shown.or_of_class() == shown
