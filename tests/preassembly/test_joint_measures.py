"""Measures and verdicts of a joint against closed forms, numbers by hand and draws of the errors."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.limits import project_limits, standards
from processor.model import Tolerance, reason
from processor.preassembly.chain import joint_measures
from processor.preassembly.chain.joint_measures import measure
from processor.preassembly.ends.joint_frame import joint_frame
from processor.preassembly.verdicts.joints import judge

ROUNDING = 1e-9  # float64 at tens of metres, of mm and mrad
DRAWS = 200_000  # determine a mean to 0.2 % of a standard deviation, and that to 0.2 %: 1 % is not exceeded by chance
B, H = 700.0, 900.0  # half the width and the height of a section of 1400 x 1800
# P1..P8: corners bottom-left, bottom-right, top-right, top-left; middles of bottom, right, top, left. y left, z up.
POINTS = np.array(
    [[0, B, -H], [0, -B, -H], [0, -B, H], [0, B, H], [0, 0, -H], [0, -B, 0], [0, 0, H], [0, B, 0]], np.float64
)
NONE = np.zeros((24, 24))
GB = standards.load("GB 50205-2020")


def at_rest(gaps, covariance=NONE):
    return measure(np.asarray(gaps, np.float64), covariance, np.eye(4), POINTS)


def tilted():
    """A joint somewhere on a bridge, its x axis 30 degrees up."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("yz", [-30.0, 7.0], degrees=True).as_matrix()
    T[:3, 3] = [12_000.0, -40.0, 9_000.0]
    return T


def some_covariance(seed, scale=0.3):
    A = np.random.default_rng(seed).normal(size=(24, 24)) * scale / np.sqrt(24)
    return A @ A.T


def only(**limits):
    base = Tolerance("by hand")
    return project_limits.override(
        base, {key: np.atleast_1d(np.float64(value)) for key, value in limits.items()}, "test"
    )


def test_the_joints_axes_are_those_of_its_frame():
    T = tilted()
    there = POINTS @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(joint_frame(there), T, atol=ROUNDING)
    gaps = np.random.default_rng(1).normal(size=(8, 3))
    covariance = some_covariance(2)
    local, spread = joint_measures.in_joint_axes(gaps, covariance, T)
    for k in range(8):
        np.testing.assert_allclose(T[:3, :3] @ local[k], gaps[k], atol=ROUNDING)
    # Against draws: errors turned one by one.
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(24), covariance, DRAWS).reshape(-1, 8, 3)
    turned = np.einsum("ji,nkj->nki", T[:3, :3], drawn).reshape(-1, 24)
    np.testing.assert_allclose(np.cov(turned.T), spread, atol=0.02 * np.diag(spread).max())


def test_a_turn_about_y_by_hand():
    """1 mrad about y at z = +-900: the top opens 0.9 mm, the bottom overlaps 0.9 mm, nothing is misaligned."""
    theta = 1e-3
    T = tilted()
    gaps = np.zeros((8, 3))
    gaps[:, 0] = theta * POINTS[:, 2]
    found = measure(gaps @ T[:3, :3].T, NONE, T, POINTS @ T[:3, :3].T + T[:3, 3])
    zero = ("misalignment", "eccentricity", "rotation_x", "rotation_z", "offset_x", "offset_y", "offset_z")
    expected = {"groove_gap_mean": 0.0, "groove_gap_least": -0.9, "groove_gap_greatest": 0.9, "rotation_y": 1.0}
    expected |= dict.fromkeys(zero, 0.0)
    rows = found.quantities
    assert set(rows.name) == set(expected)
    np.testing.assert_allclose(rows.value, [expected[str(name)] for name in rows.name], atol=ROUNDING)
    assert set(zip(map(str, rows.name), rows.unit, strict=True)) >= {("rotation_y", "mrad"), ("offset_x", "mm")}


@pytest.mark.parametrize("seed", range(2))
def test_any_small_motion_is_found_again(seed):
    """The right part moved by a rotation of scipy, to first order."""
    rng = np.random.default_rng(seed)
    turn, offset = rng.normal(size=3) * 1e-6, rng.normal(size=3)
    gaps = Rotation.from_rotvec(turn).apply(POINTS) + offset - POINTS
    found = at_rest(gaps)
    # To second order of a turn of 1e-6 at a metre: 1e-9 mm.
    np.testing.assert_allclose([found.of(f"rotation_{a}")[0] for a in "xyz"], turn * 1e3, atol=1e-8)
    np.testing.assert_allclose([found.of(f"offset_{a}")[0] for a in "xyz"], offset, atol=1e-8)
    assert found.of("eccentricity")[0] == pytest.approx(np.hypot(offset[1], offset[2]))


def test_misalignment_is_across_the_plates():
    gaps = np.zeros((8, 3))
    gaps[4] = [0.0, 9.0, 0.4]  # bottom plate slid along itself: only the 0.4 up counts
    gaps[5] = [0.0, -0.7, 8.0]  # right web, likewise
    gaps[2] = [5.0, 0.3, -0.4]  # a corner: 0.5 by both
    found = at_rest(gaps)
    assert found.of("misalignment")[0] == 0.7
    np.testing.assert_allclose(found.misalignment_at, [0, 0, 0.5, 0, 0.4, 0.7, 0, 0])


def test_half_widths_against_draws():
    covariance = some_covariance(5)
    gaps = np.zeros((8, 3))
    gaps[:, 0] = np.linspace(0.0, 28.0, 8)  # P1 and P8 stand clear: no other point can be the extreme
    gaps[6, 2] = -9.0
    found = at_rest(gaps, covariance)
    drawn = np.random.default_rng(6).multivariate_normal(gaps.ravel(), covariance, DRAWS).reshape(-1, 8, 3)
    turns = np.stack([np.cross(axis, POINTS) for axis in np.eye(3)], axis=-1)
    A = np.concatenate([turns, np.tile(np.eye(3), (8, 1, 1))], axis=-1)
    motion = np.linalg.lstsq(A.reshape(24, 6), drawn.reshape(-1, 24).T, rcond=None)[0]
    by_draws = {
        "groove_gap_mean": drawn[:, :, 0].mean(axis=1),
        "groove_gap_least": drawn[:, :, 0].min(axis=1),
        "groove_gap_greatest": drawn[:, :, 0].max(axis=1),
        "misalignment": np.abs(drawn[:, 6, 2]),
        **{f"rotation_{a}": 1e3 * motion[k] for k, a in enumerate("xyz")},
        **{f"offset_{a}": motion[3 + k] for k, a in enumerate("xyz")},
    }
    for name, values in by_draws.items():
        value, half = found.of(name)
        assert values.mean() == pytest.approx(value, abs=0.01), name
        assert half == pytest.approx(1.959964 * values.std(), rel=0.01), name


SLOW_SHAPES = [pytest.param(shape, marks=pytest.mark.slow) for shape in ("wedge", "zero")]


@pytest.mark.parametrize("shape", [pytest.param("level", marks=pytest.mark.slow), "two alike", *SLOW_SHAPES])
def test_intervals_of_extremes_cover(shape):
    """True extremes lie within the intervals in at least 95 % of measurements, however many points are alike."""
    true = np.zeros((8, 3))
    if shape == "two alike":
        true[:, 0], true[2:4, 0] = 0.0, 3.0
        true[2:4, 1] = 3.0
    elif shape == "wedge":
        true[:, 0] = 5e-4 * POINTS[:, 2]
        true[:, 2] = 5e-4 * POINTS[:, 1]
    elif shape == "level":
        true += 1.0
    covariance = some_covariance(8) + 0.05 * np.eye(24)
    truth = {
        "groove_gap_least": true[:, 0].min(),
        "groove_gap_greatest": true[:, 0].max(),
        "misalignment": max(np.abs(true[[0, 1, 2, 3, 5, 7], 1]).max(), np.abs(true[[0, 1, 2, 3, 4, 6], 2]).max()),
    }
    drawn = np.random.default_rng(9).multivariate_normal(true.ravel(), covariance, 250).reshape(-1, 8, 3)
    measured = [at_rest(gaps, covariance) for gaps in drawn]
    for name, value in truth.items():
        intervals = [joint.measured(name) for joint in measured]
        within = np.mean([one.low <= value <= one.high for one in intervals])
        assert within >= 0.93, name  # 0.95 less 1.4 sd of 250
    at = np.array([one.misalignment_at for one in measured])
    half = measured[0].misalignment_at_ci95
    sizes = np.hypot(true[0, 1], true[0, 2])
    assert np.mean(np.abs(at[:, 0] - sizes) <= half[0]) >= 0.93  # as above
    assert at.shape == (250, 8)


def test_single_extreme_has_the_interval_of_one_value():
    covariance = np.diag(np.full(24, 0.04))
    gaps = np.zeros((8, 3))
    gaps[3, 0] = 5.0
    assert at_rest(gaps, covariance).of("groove_gap_greatest") == pytest.approx((5.0, 1.959964 * 0.2))
    # Seven alike: of independent errors 95 % are all within k sd where (2 Phi(k) - 1)^7 = 0.95, so k = 2.68.
    least = at_rest(gaps, covariance).measured("groove_gap_least")
    assert (least.low, least.high) == pytest.approx((-0.536, 0.536), abs=0.01)  # the figures of k


def lone(value, sd, point=5, axis=1):
    """Gaps of which all but one are known exactly."""
    gaps, covariance = np.zeros((8, 3)), np.zeros((24, 24))
    gaps[point, axis] = value
    covariance[3 * point + axis, 3 * point + axis] = sd**2
    return at_rest(gaps, covariance)


@pytest.mark.parametrize(
    ("value", "verdict", "probability"),
    [
        (2.0, "indeterminate", 0.5),
        (1.0, "pass", 0.97725),  # 2 sd below: Phi(2)
        (2.5, "indeterminate", 0.15866),  # 1 sd above
        (-3.0, "fail", 0.02275),
        (2.9, "indeterminate", 0.03593),  # 1.8 sd above, 1.96 would fail
    ],
)
def test_misalignment_against_its_limit(value, verdict, probability):
    found = judge(lone(value, 0.5), only(misalignment_mm=2.0))
    assert (found.verdict, found.limits.verdict) == (verdict, (verdict,))
    # 4,000 draws of the rule: 0.008 at a half without their symmetry, which makes a half exact
    assert found.probability == pytest.approx(probability, abs=0.008 if value != 2.0 else 0.0)
    assert found.limits.probability[0] == found.probability
    assert found.limits.value[0] == abs(value)
    assert found.limits.ci95[0] == pytest.approx(1.959964 * 0.5)


@pytest.mark.parametrize("limits", [{"misalignment_mm": 2.0}, {}])
def test_limits_of_an_undecided_joint_are_indeterminate(limits):
    doubts = (reason("preassemble.ambiguous-part", part="rib1"),)
    found = judge(lone(-3.0, 0.5), only(**limits), doubts)
    assert (found.verdict, found.limits.verdict, found.reasons) == (
        "indeterminate",
        ("indeterminate",) * len(limits),
        doubts,
    )
    assert np.isnan([found.probability, *found.limits.probability]).all()
    assert found.limits.value.tolist() == [3.0] * len(limits)


def test_two_limits_and_the_root_gap():
    gaps = np.zeros((8, 3))
    gaps[:, 0] = 6.5
    held = only(misalignment_mm=2.0, groove_gap_mm=(-1.0, 2.0))
    wide = judge(at_rest(gaps), held)
    assert wide.verdict == "fail"
    assert dict(zip(wide.limits.key, wide.limits.verdict, strict=True)) == {
        "misalignment_mm": "pass",
        "groove_gap_mm": "fail",
    }
    assert wide.limits.value[wide.limits.key.index("groove_gap_mm")] == 6.5
    as_designed = dataclasses.replace(held, root_gap_mm=6.0)
    found = judge(at_rest(gaps), as_designed)
    assert (found.verdict, found.probability) == ("pass", 1.0)
    assert found.limits.value[found.limits.key.index("groove_gap_mm")] == 0.5
    # Independent errors of 1 mm at one x and one y, each on its limit: a quarter keeps both.
    covariance = np.zeros((24, 24))
    covariance[0, 0] = covariance[16, 16] = 1.0
    gaps = np.zeros((8, 3))
    gaps[0, 0], gaps[5, 1] = 4.0, 4.0
    both = only(misalignment_mm=4.0, groove_gap_mm=(-90.0, 4.0))
    assert judge(at_rest(gaps, covariance), both).probability == pytest.approx(0.25, abs=0.02)  # 4,000 draws: 0.008


def test_verdict_states_clause_value_and_probability_of_its_limits():
    found = judge(lone(0.5, 0.1), GB)
    assert found.verdict == "pass"
    assert found.limits.key == ("misalignment_mm", "groove_gap_mm")
    assert found.limits.clause == ("GB 50205-2020 table 9.2.3",) * 2
    assert found.limits.verified.tolist() == [False, False]
    first = (found.limits.value[0], found.limits.high[0], found.limits.verdict[0], found.limits.probability[0])
    assert first == (0.5, 2.0, "pass", 1.0)
    assert found.limits.ci95[0] == pytest.approx(0.196, abs=1e-3)  # its figures
    assert found.reasons == ()


def test_unknown_gaps_and_unknown_sizes_are_indeterminate():
    found = judge(at_rest(np.full((8, 3), np.nan), np.full((24, 24), np.nan)), GB)
    assert found.verdict == "indeterminate"
    assert found.limits.verdict == ("indeterminate",) * 2
    assert np.isnan(found.probability)
    jtg = standards.load("JTG arch rib")
    assert judge(lone(0.5, 0.1), jtg).verdict == "indeterminate"
    assert not judge(lone(0.5, 0.1), jtg).limits.bounds_known.any()
    # A project that knows the thickness gives the number: 0.2 x 24 = 4.8 but 2 at most, and 0.2 x 8 = 1.6.
    (key,) = (limit.key for limit in jtg.limits if limit.measure == "misalignment")
    assert judge(lone(0.5, 0.1), project_limits.override(jtg, {key: np.array([2.0])}, "x")).verdict == "pass"
    assert judge(lone(1.7, 0.01), project_limits.override(jtg, {key: np.array([1.6])}, "x")).verdict == "fail"
    nothing = judge(lone(0.5, 0.1), standards.load("JGJ 7-2010"))
    assert (nothing.verdict, len(nothing.limits)) == ("indeterminate", 0)
    assert nothing.reasons == (reason("preassemble.no-joint-limit", standard="JGJ 7-2010"),)


def test_gaps_without_a_covariance_are_measured_and_not_judged():
    gaps = np.zeros((8, 3))
    gaps[:, 0], gaps[5, 1] = np.arange(8.0), -9.0
    found = at_rest(gaps, np.full((24, 24), np.nan))
    assert found.quantities.value[:4].tolist() == [3.5, 0.0, 7.0, 9.0]
    assert np.isfinite(found.quantities.value).all()
    assert np.isnan(found.quantities.ci95).all()
    verdict = judge(found, GB)
    assert (verdict.verdict, verdict.limits.verdict) == ("indeterminate", ("indeterminate",) * 2)
    assert (verdict.limits.value[0], verdict.limits.high[0]) == (9.0, 2.0)
    assert np.isnan(verdict.limits.ci95[0])


def test_eccentricity():
    gaps = np.tile([0.0, 3.0, 4.0], (8, 1))  # 5 mm off
    en = standards.load("EN 1090-2")
    assert judge(at_rest(gaps), en).verdict == "pass"
    assert judge(at_rest(gaps * 1.01), en).verdict == "fail"
    assert judge(at_rest(gaps), standards.load("EN 1090-2 class 2")).verdict == "fail"
    # The mean of eight is known to 0.35 mm: a little more than half of the true ones are beyond the circle of 5 mm.
    assert judge(at_rest(gaps, np.eye(24)), en).probability == pytest.approx(0.45, abs=0.06)
