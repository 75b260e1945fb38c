"""Limits of the whole chain: guard bands by hand, extremes by draws, unused limits, and doubtful chains."""

from types import SimpleNamespace

import numpy as np
import pytest

from processor.adjustment import maximum_interval
from processor.limits import project_limits, standards
from processor.model import ArchDesign, DesignPart, Tolerance, reason
from processor.preassembly import to_result
from processor.preassembly.chain import span_and_closure
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.result import JudgedJoints
from processor.preassembly.verdicts import chain, joints
from tests.support.results import measured_parts

GB, JTG = standards.load("GB 50205-2020"), standards.load("JTG arch rib")
NAN = float("nan")


def own(**limits):
    return project_limits.override(Tolerance(), {key: np.array(value) for key, value in limits.items()}, "project.toml")


def chord(value, sd):
    return {name: (np.array([value]), np.array([sd])) for name in ("span", "unit_length")}


@pytest.mark.parametrize(
    ("value", "sd", "verdict"),
    [
        (0.0, 0.4, "pass"),
        (0.5, 0.4, "indeterminate"),
        (1.5, 0.4, "indeterminate"),
        (-2.0, 0.4, "fail"),
        (2, 0.1, "fail"),
    ],
)
def test_span_is_judged_by_the_limit_of_the_project(value, sd, verdict):
    found = chain.judge(chord(value, sd), own(span_mm=[-1.0, 1.0]), 24_000.0)
    assert (found.verdict, found.limits.verdict) == (verdict, (verdict,))
    limits = found.limits
    assert (limits.key, limits.clause, limits.source, limits.edition) == (
        ("span_mm",), ("project.toml",), ("project.toml",), ("",),
    )  # fmt: skip
    np.testing.assert_allclose([limits.value[0], limits.ci95[0]], [value, 1.959964 * sd], rtol=1e-5)  # its figures
    np.testing.assert_allclose([limits.low[0], limits.high[0]], [-1.0, 1.0])
    draws = np.random.default_rng(1).normal(value, sd, 400_000)
    # A share of 400,000 draws is known to 0.0008.
    assert limits.probability[0] == pytest.approx((np.abs(draws) <= 1.0).mean(), abs=0.003)


def test_a_standard_is_cited():
    found = chain.judge(chord(-30.0, 0.5), GB, 24_000.0).limits
    assert found.key == ("unit_length_mm", "span_mm")
    assert found.verdict == ("fail", "fail")
    assert set(found.clause) == {"GB 50205-2020 table 9.2.3"}
    assert (set(found.edition), set(found.source), set(found.verified)) == ({"2020"}, {"from memory"}, {False})


def test_edges_are_judged_along_their_length_by_limits_of_the_span():
    rng = np.random.default_rng(2)
    values, sd = rng.uniform(-2.0, 2.0, 300), np.full(300, 0.1)
    values[17] = 4.5  # 30 m / 6000 = 5 mm
    quantities = dict.fromkeys(("inner_arc", "lateral_axis", "elevation"), (values, sd))
    found = chain.judge(quantities, JTG, 30_000.0).limits
    by_key = dict(zip(found.key, found.verdict, strict=True))
    assert by_key == {"inner_arc_mm": "pass", "lateral_axis_mm": "pass", "elevation_mm": "pass"}
    np.testing.assert_allclose(found.high, [8.0, 5.0, 10.0])
    np.testing.assert_allclose(found.value, 4.5)
    np.testing.assert_allclose(found.ci95, 1.96 * 0.1, rtol=1e-3)  # no other place can be the extreme
    values[17] = 4.9
    assert chain.judge(quantities, JTG, 30_000.0).limits.verdict[1] == "indeterminate"
    values[17] = -5.4
    assert chain.judge(quantities, JTG, 30_000.0).limits.verdict[1] == "fail"
    # Where many can be the extreme, the band covers all of them.
    low, high = [], []
    for _ in range(400):
        _, bottom, top = maximum_interval.of_independent(rng.normal(0.0, 0.1, 50), np.full(50, 0.1))
        low.append(bottom)
        high.append(top)
    # Or more: by the sum over all that can be the extreme.
    assert np.mean((np.array(low) <= 0.0) & (np.array(high) >= 0.0)) >= 0.95


def test_quantities_of_the_edges_by_hand():
    """Both edges 3 mm to the left and 2 mm up from an arch with slope 3 : 4: the elevation is 2.5 mm."""
    axes = np.tile(np.array([[0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]), (4, 1, 1))
    edges = measured_parts.edges(np.zeros(4), np.zeros((4, 3)), axes, np.zeros((4, 2)))
    member = Member((None, None), edges, np.zeros(3), np.zeros((6, 6)))
    adjusted = SimpleNamespace(
        departures=(np.tile([3.0, 2.0], (4, 1)),), departure_variance=(np.tile([0.04, 0.01], (4, 1)),)
    )
    found = chain.quantities([member], adjusted, -1.0, 0.196)
    expected = {"span": (-1.0, 0.1), "unit_length": (-1.0, 0.1), "inner_arc": (2.0, 0.1), "lateral_axis": (3.0, 0.2),
                "elevation": (2.5, 0.125)}  # fmt: skip
    for name, (value, sd) in expected.items():
        np.testing.assert_allclose(found[name][0], value)
        np.testing.assert_allclose(found[name][1], sd, rtol=3e-5)  # 1.96 for 1.959964
    assert [len(found[name][0]) for name in ("inner_arc", "lateral_axis")] == [4, 2]


def test_unused_limits_are_reported():
    assert chain.unused_limits(GB) == []
    mixed = project_limits.override(GB, {"bow_mm": np.array([4.0]), "span_mm": np.array([-1.0, 1.0])}, "project.toml")
    assert [limit.key for limit in chain.unused_limits(mixed)] == ["bow_mm"]
    systematic = SimpleNamespace(known=True, temperature_C=1.0)
    params = SimpleNamespace(adjust=SimpleNamespace(weight=0.1), systematic=systematic)
    assembly = SimpleNamespace(
        params=params,
        limits=mixed,
        temperature_corrected=False,
        parts=(),
        in_pieces=(),
        of_bends=(),
        joints=JudgedJoints(),
        chain=joints.Conformity(),
    )
    assert reason("preassemble.unused-limits", limits=("bow_mm",)) in to_result._reasons(assembly)


def test_doubtful_chain_is_indeterminate():
    doubt = reason("preassemble.joint-unknown", joint="J4")
    found = chain.judge(chord(-30.0, 0.5), GB, 24_000.0, (doubt,))
    assert (found.verdict, found.limits.verdict) == ("indeterminate", ("indeterminate", "indeterminate"))
    assert np.isnan(found.limits.probability).all()
    assert found.reasons == (doubt,)
    none = chain.judge(chord(0.0, 0.1), own(misalignment_mm=[2.0]), 24_000.0)
    assert (none.verdict, len(none.limits)) == ("indeterminate", 0)
    assert [one.code for one in none.reasons] == ["preassemble.no-chain-limit"]


def test_span_is_nan_if_a_joint_is_not_measured():
    """Without gaps the distance between the parts beside a joint is not measured."""
    line = np.array([[0.0, 0.0, 0.0], [1e3, 0.0, 0.0]])
    parts = tuple(DesignPart(str(i), bottom_edge_left=line, bottom_edge_right=line) for i in range(2))
    design = ArchDesign(parts, ("J1",), ("0",), ("1",), np.zeros((1, 8, 3)))
    adjusted = SimpleNamespace(gaps=np.full((1, 8, 3), NAN))
    assert np.isnan(span_and_closure.span([], adjusted, design)).all()


def test_mean_and_largest_of_correlated_values_have_the_interval_of_one():
    """1.96 sd for one value, and for the mean of a hundred values that may be fully correlated."""
    of = span_and_closure.mean_max_ci95
    np.testing.assert_allclose(of(np.array([[3.0]]), np.array([[0.04]])), 0.392, rtol=1e-3)  # 1.96 * 0.2 by its figures
    assert of(np.zeros((100, 1)), np.full((100, 1), 0.04))[0] == pytest.approx(0.392, rel=1e-3)
    half = of(np.array([[3.0, 4.0], [1.0, 0.0], [np.nan, 0.0]]), np.full((3, 2), 0.04))
    np.testing.assert_allclose(half, [0.392 * np.sqrt(2.0), 0.2 * 2.4477], rtol=1e-3)  # the second is not the largest
    assert np.isnan(of(np.zeros((2, 1)), np.full((2, 1), np.nan))).all()
