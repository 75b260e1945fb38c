"""Joints of which an end was not measured: pieces that nothing measured ties together, their status and reasons."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.geometry import rigid
from processor.inspection.result import Characteristics, InspectedComponent, Quantity
from processor.inspection.result import Result as Inspection
from processor.language.messages import CODES, messages
from processor.model import Status, Verdict, reason
from processor.preassembly import assemble, step, topology
from processor.preassembly.chain import adjustment, design_places, span_and_closure
from processor.preassembly.ends import bottom_edges
from processor.preassembly.parts.part_in_chain import Member
from processor.preassembly.verdicts import reasons, trim_and_build_up
from processor.report import terminal
from processor.report.preassembly import section
from tests.support.clouds import arch_clouds
from tests.support.results import bridge_results, measured_parts

DESIGN = arch_clouds.design()
FRAMES = measured_parts.frames(DESIGN)
PARTS = len(DESIGN.parts)
SD_MM = 10.0
NOISE_MM = 0.1
WHY = reason("preassemble.few-points-at-joint")


def members(departure=lambda part, end, joint: np.zeros((8, 3)), unmeasured=()):
    """Members without bottom edges; the ends (part, 0 or 1) ``unmeasured`` have a reason instead."""

    def of_end(part, end, joint):
        return (WHY,) if (part, end) in unmeasured else departure(part, end, joint)

    return measured_parts.members(DESIGN, of_end, NOISE_MM)


def adjusted(of_members):
    return adjustment.adjust(of_members, DESIGN.joint_points, FRAMES, 0.1, place_sd_mm=SD_MM)


def as_built(seed):
    """Departures of all ends: lengths off by 3 mm and cuts by 1.5 mrad, one standard deviation each."""
    rng = np.random.default_rng(seed)

    def departure(part, end, joint):
        local = rigid.apply(rigid.invert(FRAMES[joint]), DESIGN.joint_points[joint])
        off = rng.normal(0.0, NOISE_MM, (8, 3))
        off[:, 0] += rng.normal(0.0, 3.0) + local[:, 1:] @ rng.normal(0.0, 1.5e-3, 2)
        return off

    return departure


@pytest.fixture(scope="module")
def inspected():
    """Part rib1 whose sweep fails its limit."""
    found = Characteristics(
        id=("sweep",), quantity=(Quantity.SWEEP,), nominal=[0.0], actual=[-2.0], deviation=[-2.0], ci95=[0.3],
        lower=[-1.0], upper=[1.0], unit=("mm",), verdict=(Verdict.FAIL,), limit=("part_sweep_mm",), clause=("GB",),
        verified=[False], reasons=((),),
    )  # fmt: skip
    component = InspectedComponent(name="rib1", characteristics=found)
    return Inspection(status="ok", method="default", components=(component,))


@pytest.mark.parametrize(
    ("measured", "pieces"),
    [([1, 1, 1, 1], [0, 0, 0, 0, 0]), ([0, 1, 1, 1], [0, 1, 1, 1, 1]), ([1, 0, 1, 0], [0, 0, 1, 1, 2])],
)
def test_measured_joints_leave_pieces(measured, pieces):
    assert topology.pieces(topology.row(5), np.array(measured, bool), 5).tolist() == pieces


def test_a_ring_with_one_unmeasured_joint_is_one_piece():
    ring = np.array([[0, 1], [1, 2], [2, 0]])
    assert topology.pieces(ring, np.array([True, False, True]), 3).tolist() == [0, 0, 0]


def test_a_piece_as_designed_stays_and_is_as_sure_as_its_place_in_the_design():
    """A rod of 2 m, and two of 1 m in a row: translations by the stated amount, turns by it over the radius."""
    rod = np.array([[-1000.0, 0.0, 0.0], [1000.0, 0.0, 0.0]])
    halves = [rod / 2 + [5000.0, 0.0, 0.0], rod / 2 + [7000.0, 0.0, 0.0]]
    at = [Member((), bottom_edges.NONE, points.mean(axis=0), np.zeros((6, 6))) for points in (rod, *halves)]
    found = design_places.covariances(np.zeros((3, 6)), [rod, *halves], at, np.array([0, 1, 1]), SD_MM)
    np.testing.assert_allclose(found[0], np.diag([1e-4] * 3 + [100.0] * 3), atol=1e-12)  # float64
    turn = 100.0 / (1000.0**2 + 500.0**2)  # mean square of -1500, -500, 500, 1500
    # Rounding of float64.
    np.testing.assert_allclose(np.diag(found[1]), [turn] * 3 + [100.0] + [100.0 + turn * 1000.0**2] * 2, rtol=1e-9)


def test_what_moves_a_part_from_its_place_is_in_its_covariance():
    motion = np.array([[0.0, 1e-3, 0.0, 5.0, 0.0, 0.0]])
    rod = np.array([[-1000.0, 0.0, 0.0], [1000.0, 0.0, 0.0]])
    member = Member((), bottom_edges.NONE, np.zeros(3), np.zeros((6, 6)))
    (found,) = design_places.covariances(motion, [rod], [member], np.array([0]), SD_MM)
    placed = np.diag([1e-4] * 3 + [100.0] * 3)  # of 100 in float64
    np.testing.assert_allclose(found - placed, np.outer(motion, motion), atol=1e-12)


def test_gaps_have_the_standard_deviations_of_both_ends():
    """Those of independent errors; none where a side was not measured."""
    variance = np.einsum("jkk->jk", adjusted(members(unmeasured={(0, 1)})).gap_covariance)
    found = np.sqrt(variance).reshape(-1, 8, 3)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1:], np.sqrt(2.0) * NOISE_MM, rtol=1e-9)  # float64


def test_a_complete_chain_has_no_uncertainty_of_the_design():
    found = adjusted(members(as_built(1)))
    assert not found.in_pieces
    assert not found.placing_covariance.any()
    again = adjustment.adjust(members(as_built(1)), DESIGN.joint_points, FRAMES, 0.1)
    np.testing.assert_array_equal(found.motions, again.motions)


@pytest.mark.parametrize(("joint", "side"), [(0, 0), (1, 1), (2, 0), (3, 1)])
def test_beside_an_unmeasured_joint_no_pose_is_surer_than_it_is(joint, side):
    """Each part's true place is the design's: it lies within the interval of every coordinate, in 10 assemblies."""
    unmeasured = {(joint + side, 1 - side)}
    held, largest = [], 0.0
    for seed in range(10):
        found = adjusted(members(as_built(seed), unmeasured))
        assert np.isnan(found.gaps[joint]).all()
        assert len(set(found.piece)) == 2
        for i, member in enumerate(members()):
            T = found.motions[i]
            off = np.concatenate(
                [rigid.vector_from_rotation(T[:3, :3]), rigid.apply(T, member.centre[None])[0] - member.centre]
            )
            rows = slice(6 * i, 6 * i + 6)
            sd = np.sqrt(np.diag(found.motion_covariance[rows, rows] + found.placing_covariance[i]))
            held.append(np.abs(off) <= 1.96 * sd)
            largest = max(largest, float(np.linalg.norm(off[3:])))
    assert np.all(held)
    # Ends off by 3 mm and 1.5 mrad (4 mm over the 2.5 m of a part) move it by a few times as much, not by 100 mm.
    assert largest < 50.0


def test_two_of_eight_key_points_are_no_measurement():
    def departure(part, end, _):
        off = np.zeros((8, 3))
        if (part, end) == (2, 1):
            off[2:] = np.nan
        return off

    found = adjusted(members(departure))
    assert found.piece.tolist() == [0, 0, 0, 1, 1]


def test_the_reasons_name_joints_pieces_and_what_was_assumed():
    found = adjusted(members(unmeasured={(0, 1), (4, 0)}))
    (why,) = reasons.of_pieces(found, DESIGN, SD_MM)
    names = [part.name for part in DESIGN.parts]
    assert why.values["joints"] == (DESIGN.joint_names[0], DESIGN.joint_names[3])
    assert why.values["pieces"] == (names[0], " + ".join(names[1:4]), names[4])
    assert why.values["ci95"] == pytest.approx(1.96 * SD_MM, abs=0.01)  # the figures of 1.96
    assert "± 20 mm" in messages("en").text(why)
    assert reasons.of_pieces(adjusted(members()), DESIGN, SD_MM) == ()


def part(name, status, of_member):
    return dataclasses.make_dataclass("Part", ["name", "status", "reasons", "member", "of_others"], frozen=True)(
        name, status, (), of_member, ()
    )


def test_placed_by_design_is_weak_and_failed_stays_failed():
    why = (reason("preassemble.in-pieces", joints=("J1",), pieces=("a", "b"), ci95=19.6),)
    states = (Status.OK, Status.AMBIGUOUS, Status.FAILED)
    found = reasons.placed_by_design([part("a", status, None) for status in states], why)
    assert [one.status for one in found] == [Status.WEAK, Status.AMBIGUOUS, Status.FAILED]
    assert [bool(one.reasons) for one in found] == [True, True, False]


def test_the_to_do_names_the_side_that_was_not_measured():
    of_members = members(unmeasured={(0, 1)})
    parts = [part(one.name, Status.OK, member) for one, member in zip(DESIGN.parts, of_members, strict=True)]
    sides = topology.sides_of(DESIGN.joined)
    (doubt,) = reasons.of_joint(parts, sides[0])
    assert doubt == reason("preassemble.end-not-measured", part=DESIGN.parts[0].name, reasons=(WHY,))
    assert reasons.of_joint(parts, sides[1]) == ()
    (advice,) = span_and_closure._missing(parts, adjusted(of_members), DESIGN)
    assert advice.code == "preassemble.scan-end"
    assert advice.values["parts"] == (DESIGN.parts[0].name,)


def test_a_joint_that_closes_by_moving_is_not_nothing_to_do():
    (measures, *_) = bridge_results.adjusted().adjustment.joints.measures
    moved = (reason("preassemble.closes-by-moving", move=6.0, gap=3.0),)
    closed = dataclasses.replace(measures, gaps=np.zeros((8, 3)), covariance=1e-4 * np.eye(24))
    plain, by_moving = (trim_and_build_up.propose(closed, bridge_results.LIMITS, moved=one) for one in ((), moved))
    assert "preassemble.nothing-to-do" in [one.code for one in plain.reasons]
    assert "preassemble.nothing-to-do" not in [one.code for one in by_moving.reasons]
    assert moved[0] in by_moving.reasons


def test_a_joint_closes_by_moving_where_the_gap_at_the_parts_places_is_beyond_its_limits():
    """An inclined joint, 1.5 mm wide along its own axis: in its limits, which 1.5 mm in the bridge's axes are not."""
    joint = int(np.abs(FRAMES[:, 2, 0]).argmax())
    limits = dataclasses.replace(
        bridge_results.LIMITS,
        limits=(dataclasses.replace(bridge_results.LIMITS.limits[0], high=0.7), bridge_results.LIMITS.limits[1]),
    )

    def closing(gap):
        of_members = members(lambda part, end, at: np.tile(gap, (8, 1)) * (at == joint) * (end == 0))
        parts = [SimpleNamespace(member=one) for one in of_members]
        return assemble._closes_by_moving(parts, adjusted(of_members), DESIGN, FRAMES, limits, joint)

    assert closing([1.5, 0.0, 0.0]) == ()
    (why,) = closing([0.0, 0.0, 1.5])
    assert why.values["gap"] == pytest.approx(1.5 * np.abs(FRAMES[joint, :3, 2]).max())


@pytest.mark.parametrize("lang", CODES)
def test_the_headline_counts_no_part_placed_by_the_design(lang):
    result = bridge_results.adjusted()
    why = reason("preassemble.in-pieces", joints=("J1",), pieces=("foot1", "rib1 + foot2"), ci95=19.6)
    head = messages(lang).text(section.REPORT.summary(dataclasses.replace(result, reasons=(why,)))[0])
    assert ("0 of 3 parts placed by measured joints" in head) or ("3 个构件中 0 个已就位" in head)
    assert "J1" in head
    assert "± 20 mm" in head


def test_a_part_that_fails_a_limit_of_its_own_is_in_the_to_do_of_its_joints(inspected):
    result = bridge_results.adjusted()
    found = step.completed(result, {"inspect": inspected})
    for name, left, right, before, after in zip(
        result.joints.name, result.joints.left, result.joints.right,
        result.adjustment.joints.proposal, found.adjustment.joints.proposal, strict=True,
    ):  # fmt: skip
        codes = [one.code for one in after.reasons]
        assert ("preassemble.part-fails" in codes) == ("rib1" in (left, right)), name
        assert "preassemble.nothing-to-do" not in codes
        assert after.cut.tolist() == before.cut.tolist()
    lines = [messages("en").text(one) for one in section.REPORT.to_do(found)]
    assert any("rib1" in line and "sweep -2.0 ± 0.3 mm" in line for line in lines)
    assert step.completed(result, {}) is result


def test_the_terminal_names_the_part_that_fails(inspected):
    execution = bridge_results.of_bridge()
    first, *others = execution.runs
    run = dataclasses.replace(first, result=step.completed(first.result, {"inspect": inspected}))
    lines = terminal.lines(dataclasses.replace(execution, runs=(run, *others)), ErrorReport(), "page")
    assert any("Correct rib1" in line for line in lines)
