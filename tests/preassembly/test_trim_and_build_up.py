"""Trim and build-up of a joint: amounts by hand, optima by another solver, probabilities by independent draws."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm

from processor.language.messages import messages
from processor.limits import project_limits, standards
from processor.model import Checked, StepRun, Tolerance, UsageError, reason
from processor.preassembly.chain import joint_measures
from processor.preassembly.params import TrimParams
from processor.preassembly.verdicts import joints, trim_and_build_up
from processor.preassembly.verdicts.trim_and_build_up import propose
from processor.store import store

B, H = 700.0, 900.0  # half the width and the height of the section; y left, z up
POINTS = np.array(
    [[0, B, -H], [0, -B, -H], [0, -B, H], [0, B, H], [0, 0, -H], [0, -B, 0], [0, 0, H], [0, B, 0]], np.float64
)
GB = standards.load("GB 50205-2020")  # groove gap -1 to +2, misalignment 2
EXACT = TrimParams(cut_sd_mm=0.0)


ROUNDING_MM = 1e-9  # float64 of planes at a metre


def along(x):
    gaps = np.zeros((8, 3))
    gaps[:, 0] = x
    return gaps


def codes(found):
    return [one.code.removeprefix("preassemble.") for one in found.reasons]


def values(found, code):
    """The values of a reason, numbers rounded to 0.1."""
    (one,) = (one for one in found.reasons if one.code == f"preassemble.{code}")
    return {key: round(value, 1) if isinstance(value, float) else value for key, value in one.values.items()}


def proposed(gaps, covariance=None, limits=GB, params=EXACT):
    covariance = np.zeros((24, 24)) if covariance is None else covariance
    return propose(joint_measures.measure(gaps, covariance, np.eye(4), POINTS), limits, params)


def test_a_joint_that_fits_is_left_alone():
    found = proposed(along(0.3), 0.01 * np.eye(24))
    assert (found.action, found.probability, found.probability_as_is) == ("nothing", 1.0, 1.0)
    assert not found.cut.any()
    assert not found.build_up.any()
    assert codes(found) == ["nothing-to-do", "all-limits"]
    assert messages("en").sentences(found.reasons) == "Nothing to do. All limits are kept with a probability of 100%."


@pytest.mark.parametrize("root", [0.0, 4.0])
def test_an_overlap_is_cut_by_itself_and_the_root_gap(root):
    found = proposed(along(-3.0), limits=dataclasses.replace(GB, root_gap_mm=root))
    assert found.action == "trim"
    np.testing.assert_allclose(found.cut, 3.0 + root, atol=ROUNDING_MM)
    np.testing.assert_allclose(found.plane, [3.0 + root, 0.0, 0.0], atol=ROUNDING_MM)
    np.testing.assert_allclose(found.gap_after, root, atol=ROUNDING_MM)
    assert not found.build_up.any()
    assert (found.probability, found.probability_as_is) == (1.0, 0.0)
    assert messages("en").sentences(found.reasons) == (
        f"Cut the right part's end by {3.0 + root:.1f} mm all round. Done to 0 mm (one sd), all limits are then kept "
        "with a probability of 100% (groove gap 100%), as it is with 0%."
    )


def test_a_gap_too_wide_is_filled():
    found = proposed(along(5.0))
    assert found.action == "build up"
    np.testing.assert_allclose(found.build_up, 5.0)
    assert not found.cut.any()
    assert values(found, "amount-even") == {"work": "fill by shims or weld build-up", "amount": 5.0}


def test_a_tilted_end_is_cut_parallel():
    """The right part turned by 2 mrad about y and 4 mm too long: 5.8 mm at the bottom, 2.2 mm at the top."""
    found = proposed(along(-4.0 + 2e-3 * POINTS[:, 2]))
    np.testing.assert_allclose(found.cut, [5.8, 5.8, 2.2, 2.2, 5.8, 4.0, 2.2, 4.0], atol=ROUNDING_MM)
    np.testing.assert_allclose(found.plane, [4.0, 0.0, -2.0], atol=ROUNDING_MM)
    np.testing.assert_allclose(found.gap_after, 0.0, atol=ROUNDING_MM)
    assert values(found, "amount-plane") == {
        "work": "cut the right part's end by", "most": 5.8, "most_at": "P1 bottom left", "least": 2.2,
        "least_at": "P3 top right",
    }  # fmt: skip
    # And about z: 1 mm per m more to the right (y < 0).
    turned = proposed(along(-4.0 + 1e-3 * POINTS[:, 1]))
    np.testing.assert_allclose(turned.plane, [4.0, -1.0, 0.0], atol=ROUNDING_MM)
    np.testing.assert_allclose(turned.cut[[5, 7]], [4.7, 3.3], atol=ROUNDING_MM)


def test_a_wedge_is_cut_where_it_is_narrow_and_filled_where_it_is_wide():
    """From -1.5 at the bottom to 5.5 at the top: a cut of 1.5 mm, tapering to 0, leaves 0 to 5.5, which is filled."""
    found = proposed(along(2.0 + 3.5 * POINTS[:, 2] / H))
    assert found.action == "trim and build up"
    np.testing.assert_allclose(found.cut, [1.5, 1.5, 0, 0, 1.5, 0.75, 0, 0.75], atol=ROUNDING_MM)
    np.testing.assert_allclose(found.build_up, [0, 0, 5.5, 5.5, 0, 2.75, 5.5, 2.75], atol=ROUNDING_MM)
    np.testing.assert_allclose(found.gap_after, 0.0, atol=ROUNDING_MM)


@pytest.mark.parametrize("seed", range(4))
def test_cut_plane_is_the_nearest_one_that_never_adds_material(seed):
    rng = np.random.default_rng(seed)
    A = np.column_stack([np.ones(8), POINTS[:, 1:] / 1000.0])
    lacking = rng.normal(1.0, 2.0, 8) + A[:, 1:] @ rng.normal(0.0, 3.0, 2)
    nearest = A @ trim_and_build_up._nearest(A, lacking)
    assert nearest.min() > -1e-8  # rounding, also below
    solved = minimize(
        lambda p: ((A @ p - lacking) ** 2).sum(),
        [10.0, 0.0, 0.0],
        constraints={"type": "ineq", "fun": lambda p: A @ p},
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    np.testing.assert_allclose(nearest, A @ solved.x, atol=1e-4)  # of a square by 1e-12 relative: 1e-5
    even = A @ trim_and_build_up._even(A, lacking)
    assert even.min() > -1e-9
    rest = even - lacking
    np.testing.assert_allclose(A[:, 1:].T @ rest, 0.0, atol=ROUNDING_MM)  # the residual has no tilt
    covering = A @ trim_and_build_up._covering(A, lacking)
    assert (covering - np.maximum(lacking, 0.0)).min() > -1e-9
    assert covering.sum() <= 8.0 * max(lacking.max(), 0.0) + 1e-9  # no more than a straight cut of that depth
    found = proposed(along(-lacking), 0.01 * np.eye(24), params=TrimParams())
    assert found.cut.min() >= 0.0
    assert found.build_up.min() >= 0.0
    if np.isfinite(found.plane).all():
        np.testing.assert_allclose(A @ (found.plane * [1.0, 1.0, 1.0]), found.cut, atol=ROUNDING_MM)
    else:
        np.testing.assert_allclose(found.cut[4:], 0.5 * (found.cut[:4] + np.roll(found.cut[:4], -1)))
    assert (np.minimum(found.cut[:4], found.build_up[:4]) <= 0.1).all()  # least_mm: no less is worked on
    np.testing.assert_allclose(found.gap_after, -lacking + found.cut - found.build_up)


def test_the_probability_after_a_cut_against_draws():
    """Errors after the work: those of the gaps, and 0.6 mm at a corner by a plane's depth and tilts."""
    covariance = 0.09 * np.eye(24)
    found = proposed(along(-3.0), covariance, params=TrimParams(cut_sd_mm=0.6))
    rng = np.random.default_rng(77)
    depth, left, up = rng.normal(0.0, 0.6 / np.sqrt(3.0), (3, 400_000))
    gap = depth[:, None] + left[:, None] * np.sign(POINTS[:, 1]) + up[:, None] * np.sign(POINTS[:, 2])
    assert gap[:, :4].std(axis=0) == pytest.approx(np.full(4, 0.6), rel=0.01)  # of 400,000
    gap += rng.normal(0.0, 0.3, gap.shape)
    expected = ((gap >= -1.0) & (gap <= 2.0)).all(axis=1).mean()
    assert found.groove_probability == pytest.approx(expected, abs=0.03)  # 4,000 draws: 0.008
    # Twelve misalignments of sd 0.3 against 2: 6.7 sd, all but certain.
    assert found.misalignment_probability == 1.0
    assert found.probability == found.groove_probability
    better = proposed(along(-3.0), covariance, params=TrimParams(cut_sd_mm=0.6, aim_mm=0.5))
    assert better.probability > found.probability
    np.testing.assert_allclose(better.cut, 3.5, atol=ROUNDING_MM)


def test_probability_as_is_is_one_half_for_a_value_on_its_limit():
    covariance = np.zeros((24, 24))
    covariance[3 * 6 + 2, 3 * 6 + 2] = 0.25
    gaps = along(0.0)
    gaps[6, 2] = 2.0
    found = proposed(gaps, covariance)
    assert (found.probability, found.probability_as_is, found.misalignment_probability) == (0.5, 0.5, 0.5)
    assert found.groove_probability == 1.0
    assert codes(found) == ["nothing-to-cut", "all-limits", "misalignment-near-limit"]
    assert values(found, "all-limits") == {"probability": 0.5}
    gaps[6, 2] = 1.5
    assert proposed(gaps, covariance).probability == pytest.approx(norm.cdf(1.0), abs=0.01)  # draws, as above


def test_corner_overlap_is_cut_alone_where_a_plane_would_cut_open_points():
    """One corner overlaps by 45.9 mm, its neighbours are open: a plane through it would cut these as well."""
    x = _between([13.0, 10.3, -45.9, 16.0])
    found = proposed(along(x))
    assert found.action == "trim and build up"
    np.testing.assert_allclose(found.cut, _between([0.0, 0.0, 45.9, 0.0]), atol=ROUNDING_MM)
    assert np.isnan(found.plane).all()
    assert found.build_up[2] == 0.0
    np.testing.assert_allclose(found.gap_after, 0.0, atol=ROUNDING_MM)
    sentences = messages("en").sentences(found.reasons)
    assert (
        "ut the right part's end by 0.0 / 0.0 / 45.9 / 0.0 mm at P1 / P2 / P3 / P4, straight between them" in sentences
    )
    assert "ill by shims or weld build-up 13.0 / 10.3 / 0.0 / 16.0 mm at P1 / P2 / P3 / P4" in sentences


def _between(corners):
    corners = np.array(corners)
    return np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1))])


def test_no_cut_is_proposed_with_a_reason_where_none_meets_the_limits():
    """Plates bent by 20 mm between the corners: no cut from corner to corner follows them."""
    x = _between([-5.0, -5.0, -5.0, -5.0])
    x[4:] += [20.0, -20.0, 20.0, -20.0]
    found = proposed(along(x), 0.01 * np.eye(24), params=TrimParams(cut_sd_mm=3.0))
    assert found.action == "nothing"
    assert codes(found)[:2] == ["no-work-holds", "as-is-not-all-limits"]
    assert "0%" not in messages("en").sentences(found.reasons)


def test_ambiguous_parts_get_no_proposal_and_weak_parts_a_remark():
    gaps = joint_measures.measure(along(-3.0), np.zeros((24, 24)), np.eye(4), POINTS)
    doubt = reason("preassemble.ambiguous-part", part="rib1")
    unsure = propose(gaps, GB, EXACT, doubts=(doubt,))
    assert unsure.action == "unknown"
    assert np.isnan(unsure.cut).all()
    assert np.isnan(unsure.probability_as_is)
    assert unsure.reasons == (reason("preassemble.doubtful-gaps", reasons=(doubt,)),)
    part = reason("preassemble.at", place="rib1", reasons=())
    weak = propose(gaps, GB, EXACT, weak_parts=(part,))
    assert weak.action == "trim"
    assert codes(weak)[:2] == ["weak-parts", "amount-even"]
    assert weak.reasons[0].values["parts"] == (part,)


def test_misalignment_is_reported_as_not_removable_by_trimming():
    gaps = along(-2.0)
    gaps[6, 2], gaps[5, 1] = 3.1, -2.4
    found = proposed(gaps)
    assert found.action == "trim"
    assert (found.probability, found.groove_probability, found.misalignment_probability) == (0.0, 1.0, 0.0)
    np.testing.assert_allclose(found.misaligned_by, [0, 0, 0, 0, 0, 0.4, 1.1, 0], atol=ROUNDING_MM)
    sentences = messages("en").sentences(found.reasons)
    assert sentences.endswith(
        "No trim removes the misalignment, 2 mm at most, of the right part at P7 top 3.1 mm up (1.1 too much); "
        "P6 right 2.4 mm to the right (0.4 too much)."
    )
    # A work that holds with 0 % is not proposed.
    assert codes(found) == ["not-all-limits", "groove-gap-alone", "then-groove-gap", "misaligned"]
    assert values(found, "then-groove-gap")["probability"] == 1.0
    assert " 0%" not in sentences


def test_a_cut_that_gains_too_little_is_not_proposed():
    # A gap of -0.8 with errors of 0.2 keeps -1 with 0.84; a cut with errors of 2 mm would lower it.
    covariance = np.zeros((24, 24))
    covariance[0, 0] = 0.04
    gaps = along(0.0)
    gaps[0, 0] = -0.8
    found = proposed(gaps, covariance, params=TrimParams(cut_sd_mm=2.0))
    assert found.action == "nothing"
    assert found.probability == pytest.approx(norm.cdf(1.0), abs=0.01)  # of 4,000 draws: 0.006
    assert codes(found)[0] == "no-work-gains"


def test_unknown_gaps_and_missing_limits_are_reported():
    unknown = proposed(np.full((8, 3), np.nan), np.full((24, 24), np.nan))
    assert unknown.action == "unknown"
    assert np.isnan(unknown.cut).all()
    assert codes(unknown) == ["gaps-unknown"]
    no_groove = proposed(
        along(-3.0), limits=project_limits.override(Tolerance(), {"misalignment_mm": np.array([2.0])}, "x")
    )
    assert (no_groove.action, no_groove.probability) == ("nothing", 1.0)
    assert codes(no_groove)[0] == "no-groove-limit"
    by_thickness = proposed(along(-3.0), limits=standards.load("JTG arch rib"))
    assert np.isnan(by_thickness.probability)
    assert np.isnan(by_thickness.misaligned_by).all()
    bare = proposed(along(-3.0), limits=Tolerance())
    assert np.isnan(bare.probability)
    assert "probability-unknown" in codes(bare)


def test_parameters_that_make_no_sense():
    for bad in (-1.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="cut_sd_mm"):
            TrimParams(cut_sd_mm=bad)


@dataclasses.dataclass(frozen=True)
class Judged(Checked):
    measures: tuple[joint_measures.Measures, ...]
    verdicts: tuple[joints.Conformity, ...]
    trim_and_shim: tuple[trim_and_build_up.Proposal, ...]


def test_the_records_go_through_the_store(tmp_path):
    gaps = (along(-3.0), np.full((8, 3), np.nan))
    measured = tuple(joint_measures.measure(one, one[:1, 0] * np.eye(24) * 0.0, np.eye(4), POINTS) for one in gaps)
    verdicts = tuple(joints.judge(one, GB) for one in measured)
    result = Judged(measured, verdicts, tuple(propose(one, GB) for one in measured))
    store.write_results(tmp_path / "r.h5", [StepRun("x", "m", "{}", result)], {})
    (back,) = store.read_results(tmp_path / "r.h5", {"x": Judged})
    assert repr(back.result) == repr(result)
    assert store.problems(tmp_path / "r.h5") == []
