"""Assemblies whose joints form any graph: rings, branches, parts without bottom edges."""

import json

import h5py
import numpy as np
import pytest

from designgen.designs import girder_assemblies, prismatic_parts
from designgen.scenes.make import make
from processor.evaluation import preassembly as evaluation
from processor.geometry import rigid
from processor.language.messages import text
from processor.model import ArchDesign, DesignPart, InputError
from processor.preassembly import step, topology
from processor.preassembly.chain import adjustment, loop_closure
from processor.preassembly.params import Params
from processor.preassembly.parts import attitude
from processor.preassembly.result import Adjustment, Loops, Result
from processor.report.preassembly import adjustment_tables
from processor.results.fields_to_json import as_object
from processor.scan_folder import folder
from processor.store import codec
from processor.writers import project
from tests.support.made import made
from tests.support.results import measured_parts
from tests.support.scenes import known_attitudes

WEIGHT = 0.1


def pairs(*joined):
    return np.array(joined, np.int64)


def test_loops_of_a_graph_are_found():
    assert topology.loops(topology.row(5), 5) == []
    (ring,) = topology.loops(pairs((0, 1), (1, 2), (2, 3), (3, 0)), 4)
    assert sorted((ring.closing, *ring.joints)) == [0, 1, 2, 3]
    two = topology.loops(pairs((0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 2), (5, 6)), 7)
    assert [sorted((loop.closing, *loop.joints)) for loop in two] == [[0, 1, 2], [3, 4, 5]]


def test_the_joints_of_a_loop_lead_from_right_to_left():
    joined = pairs((0, 1), (1, 2), (4, 2), (4, 3), (3, 0), (2, 5))
    (loop,) = topology.loops(joined, 6)
    left, right = joined[loop.closing]
    at = right
    for j in loop.joints:
        assert at in joined[j]
        at = joined[j].sum() - at
    assert at == left


def test_parts_have_two_ends_and_branches_one_per_joint():
    joined = pairs((0, 1), (1, 2), (1, 3))
    assert topology.ends_of(joined, 0) == ((None, -1.0), (0, 1.0))
    assert topology.ends_of(joined, 2) == ((1, -1.0), (None, 1.0))
    assert topology.ends_of(joined, 1) == ((0, -1.0), (1, 1.0), (2, 1.0))
    assert [topology.is_branch(topology.ends_of(joined, part)) for part in range(4)] == [False, True, False, False]
    assert topology.is_branch(topology.ends_of(pairs((0, 1), (2, 1)), 1))


# --- the adjustment against a general minimiser


def graph(kind):
    """An assembly's design, and the frames of its joints."""
    built = girder_assemblies.build(girder_assemblies.Params(type=kind, stub_mm=1500.0))
    parts = tuple(DesignPart(part.name, *part.mesh()) for part in built.parts)
    key_points = {end.joint: end.key_points() for part in built.parts for end in part.ends}
    names, left, right = zip(*((joint.name, joint.left, joint.right) for joint in built.joints), strict=True)
    design = ArchDesign(parts, names, left, right, np.array([key_points[name] for name in names]))
    return design, measured_parts.frames(design)


def exact_ends(design, rng, size_mm):
    """True key points (e, 8, 3) of each part's ends, some millimetres off the design's."""
    joined, points = design.joined, design.joint_points
    none = np.full((8, 3), np.nan)
    return [
        np.array([none if end.joint is None else points[end.joint] + rng.normal(0.0, size_mm, (8, 3))
                  for end in topology.ends_of(joined, i)])
        for i in range(len(design.parts))
    ]  # fmt: skip


def members_of(design, frames, key_points, noise_mm=0.01, rng=None):
    """Members that know their ends to ``noise_mm``; with ``rng`` off by such noise."""

    def departure(part, end, joint):
        noise = 0.0 if rng is None else rng.normal(0.0, noise_mm, (8, 3))
        return (key_points[part][end] - design.joint_points[joint]) @ frames[joint][:3, :3] + noise

    return measured_parts.members(design, departure, noise_mm)


@pytest.mark.parametrize("kind", ["row", "node", "ribs"])
def test_the_adjustment_of_a_graph_finds_the_minimum_of_its_objective(kind):
    design, frames = graph(kind)
    ends = exact_ends(design, np.random.default_rng(3), 0.03)
    sides = topology.sides_of(design.joined)
    adjusted = adjustment.adjust(members_of(design, frames, ends), design.joint_points, frames, WEIGHT, sides)
    least = evaluation.by_objective(design, ends, np.full((len(design.parts), 2, 1, 3), np.nan), WEIGHT)
    np.testing.assert_allclose(adjusted.gaps, least.gaps, atol=2e-5)  # to second order: turns of 0.1 mrad of 0.05 mm
    assert np.abs(adjusted.gaps).max() > 0.03  # the size of what the ends depart by: it is not trivial


def test_the_closure_of_a_loop_is_that_of_its_parts():
    """A part that is 3 mm longer and turned opens the loop by just that; noise opens it within the interval."""
    design, frames = graph("ribs")
    perfect = exact_ends(design, np.random.default_rng(3), 0.0)
    number = [part.name for part in design.parts].index("left3")
    perfect[number][1] += np.array([3.0, 0.0, 0.0])
    found = loop_closure.measure(members_of(design, frames, perfect), design, frames)
    assert len(found) == 1
    assert {*found.joint, *found.joints[0]} == {"J2", "J3", "J6", "J7", "J9", "J10", "J11", "J12"}
    closing = design.joint_names.index(found.joint[0])
    in_bridge = found.closure[0, 0] @ frames[closing][:3, :3].T
    # Exact ends, to second order of 3 mm over the metres of a loop.
    np.testing.assert_allclose(np.abs(in_bridge), [3.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(found.closure[0, 1], 0.0, atol=1e-5)


def test_the_interval_of_a_closure_covers_it():
    design, frames = graph("ribs")
    rng, held = np.random.default_rng(11), []
    perfect = exact_ends(design, rng, 0.0)
    for _ in range(40):
        found = loop_closure.measure(members_of(design, frames, perfect, 0.5, rng), design, frames)
        held.append(np.abs(found.closure[0]) <= found.closure_ci95[0])
    share = np.mean(held)
    assert 0.89 <= share <= 0.99  # of 240: 95 % less 4.3 standard deviations of a share


def test_weight_trades_fit_of_key_points_for_closure_of_joints():
    """With much weight the parts stay where their key points fit the design, with none the joints close."""
    design, frames = graph("node")
    ends = exact_ends(design, np.random.default_rng(5), 2.0)
    sides = topology.sides_of(design.joined)
    members = members_of(design, frames, ends)
    sizes = [
        np.abs(adjustment.adjust(members, design.joint_points, frames, weight, sides).gaps).mean()
        for weight in (1e-3, 1.0, 1e3)
    ]
    assert sizes[0] < sizes[1] < sizes[2]


def test_the_covariance_of_motions_is_that_of_repeated_measurements():
    """Gaps and the line of key points come of the same ends: their errors are not independent."""
    design, frames = graph("node")
    rng, sides = np.random.default_rng(17), topology.sides_of(design.joined)
    perfect = exact_ends(design, rng, 0.0)
    shifts = []
    for _ in range(300):
        members = members_of(design, frames, perfect, 0.5, rng)
        adjusted = adjustment.adjust(members, design.joint_points, frames, 1.0, sides)
        shifts.append([rigid.apply(T, one.centre[None])[0] - one.centre
                       for T, one in zip(adjusted.motions, members, strict=True)])  # fmt: skip
    stated = np.diag(adjusted.motion_covariance).reshape(-1, 6)[:, 3:]
    ratio = np.var(shifts, axis=0) / stated
    assert ratio.min() > 0.7  # a variance of 300 draws is off by 8 %
    assert ratio.max() < 1.3
    assert ratio.mean() == pytest.approx(1.0, abs=0.08)


# --- as built: corners in closed form


def test_corners_as_built_are_those_of_the_errors():
    """Corner P1 of an end: length, skews and its own displacement, in the joint's axes; without the other end."""
    (first, second, _) = girder_assemblies.build(girder_assemblies.Params()).parts
    errors = prismatic_parts.EndErrors(np.array([2.0, 1e-3, -2e-3]), np.arange(12.0).reshape(4, 3))
    none = prismatic_parts.EndErrors(np.zeros(3), np.zeros((4, 3)))
    built = second.with_errors([none, errors])
    corners = built.ends[1].key_points()
    moved = corners + built.displacement(corners)
    x, b, h = corners[0, 0], 250.0, 350.0
    for k, (y, z) in enumerate(((b, -h), (-b, -h), (-b, h), (b, h))):
        along = 2.0 + 1e-3 * y - 2e-3 * z
        # float64 at metres, here and below
        np.testing.assert_allclose(moved[k], np.array([x + along, y, z]) + errors.corners[k], atol=1e-9)
    np.testing.assert_allclose(moved[4], 0.5 * (moved[0] + moved[1]), atol=1e-9)
    np.testing.assert_allclose(built.displacement(built.ends[0].key_points()), 0.0, atol=1e-12)
    assert first.ends[0].outward == 1.0


# --- design.json


def written(tmp_path, design, content=None, **changes):
    """Write a scan folder of a design, and return its path."""
    (tmp_path / "design").mkdir()
    of_meshes = project._arch_design(design, tmp_path)
    content = (
        of_meshes
        if content is None
        else content | {"components": {name: of_meshes["components"][name] for name in content["components"]}}
    )
    content |= changes
    (tmp_path / "design.json").write_text(json.dumps(content))
    (tmp_path / "project.toml").write_text('kind = "arch-bridge"\nunits = "mm"\n')
    (tmp_path / f"{design.parts[0].name}.xyz").write_text(
        "".join(f"{x} {y} {z}\n" for x, y, z in design.parts[0].vertices)
    )
    return tmp_path


def test_a_graph_is_read_as_it_was_written(tmp_path):
    design, _ = graph("ribs")
    again = folder.read_input(written(tmp_path, design)).arch
    assert [part.name for part in again.parts] == [part.name for part in design.parts]
    assert (again.joint_names, again.joint_left, again.joint_right) == (
        design.joint_names, design.joint_left, design.joint_right,
    )  # fmt: skip
    assert not again.in_row
    assert len(again.parts[0].bottom_edge_left) == 0


@pytest.mark.parametrize("order", [None, [0, 1, 2], [0, 1]], ids=["none", "whole", "partly"])
def test_a_row_needs_no_order_and_some_may_be_given(tmp_path, order):
    design, _ = graph("row")
    content, names = project._arch_design(design, None), [part.name for part in design.parts]
    del content["order"]
    content |= {} if order is None else {"order": [names[k] for k in order]}
    content |= {"components": dict(reversed(content["components"].items())), "joints": content["joints"][::-1]}
    read = folder.read_input(written(tmp_path, design, content)).arch
    assert [part.name for part in read.parts] == names
    assert read.in_row


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda joints: joints[2].update(left="arm3", right="node"), "is not on the left"),
        (lambda joints: joints.pop(1), "no chain of joints joins 'arm2' to"),
        (lambda joints: joints[1].update(name="J1"), "expected a name of its own for each joint"),
        (lambda joints: joints[1].update(right="arm9"), "joint of 'arm9', which is not in 'components'"),
        (lambda joints: joints[1].update(right="node"), "found 'node' joined to itself"),
    ],
)
def test_joints_that_make_no_assembly_are_refused(tmp_path, change, said):
    design, _ = graph("node")
    joints = project._arch_design(design, None)["joints"]
    change(joints)
    with pytest.raises(InputError, match=said):
        folder.read_input(written(tmp_path, design, joints=joints))


# --- what is written of loops


def test_the_closure_of_each_loop_has_rows_and_keys_of_its_own():
    closure = np.arange(12.0).reshape(2, 2, 3)
    loops = Loops(
        joint=("J3", "J8"), joints=(("J1", "J2"), ("J7",)), closure=closure, closure_ci95=np.full((2, 2, 3), 2.5)
    )
    (table,) = adjustment_tables._loops(Adjustment(loops=loops), "adjustment")
    assert [row[:2] for row in table.rows] == [("J3", "J1 > J2")] * 6 + [("J8", "J7")] * 6
    assert [row[3] for row in table.rows] == list(range(12))
    assert [row[5] for row in table.rows] == (["mm"] * 3 + ["mrad"] * 3) * 2
    assert [row[6] for row in table.rows[:4]] == [text("no")] * 3 + [text("yes")]
    assert adjustment_tables._loops(Adjustment(), "adjustment") == []
    keys = as_object(Adjustment(loops=loops))["loops"][1]
    assert keys["joint"] == "J8"
    assert keys["closure"].keys() == {"mm", "mrad", "ci95_mm", "ci95_mrad"}
    np.testing.assert_array_equal(keys["closure"]["mrad"], [9.0, 10.0, 11.0])


# --- from scans to key points


def test_a_node_with_three_branches_is_measured_at_each_joint(monkeypatch):
    recipe = {
        "kind": "assembly", "assembly": {"type": "node"}, "scan": {"spacing_mm": 22.0},
        "asbuilt": {"length_mm": 2.0, "skew_mrad": 1.0, "corner_mm": 1.0},
    }  # fmt: skip
    scene, truth = made(make, "node", recipe, 4)
    monkeypatch.setattr(attitude, "find", known_attitudes.find_by(truth))
    result = step.run(scene, Params())
    assert [str(status) for status in result.components.status] == ["ok"] * 4
    assert np.isnan(result.components.key_points_scan[0]).all()
    at_node = result.components.at_joints[0]
    assert at_node.joint == ("J1", "J2", "J3")
    checks = {(one.quantity, str(one.statistic)): one.value for one in evaluation.check(scene, result, truth)}
    error = at_node.key_points_scan - truth.arch.branch_scan
    assert np.sqrt((error**2).sum(axis=2).mean()) < 1.0  # points 22 mm apart with 1 mm of noise; as built it is 2 mm
    # Of three ends with some eight independent coordinates: 95 % less 2 standard deviations of 4.4 %.
    assert (np.abs(error) <= 1.96 * at_node.key_points_sd).mean() > 0.85
    assert checks["wrong poses called ok", "count"] == 0.0
    # The right part's start less the left part's end, at the poses found.
    T, at = result.components.T_bridge_scan, result.components.at_joints
    start = rigid.apply(T[2], at[2].key_points_scan[0])
    end = rigid.apply(T[0], at[0].key_points_scan[1])
    np.testing.assert_allclose(result.joints.gaps[1], start - end, atol=1e-9)  # float64 at metres
    written = as_object(result)["components"][0]
    assert written["key_points_scan"] == {"start": {}, "end": {}}
    assert list(written["joints"]) == ["J1", "J2", "J3"]
    np.testing.assert_array_equal(written["joints"]["J2"]["key_points_scan"]["P3"], at_node.key_points_scan[1, 2])
    with h5py.File("memory", "w", driver="core", backing_store=False) as file:
        codec.write_record(file, result)
        again = codec.read_record(file, Result)
    assert [one.joint for one in again.components.at_joints] == [one.joint for one in result.components.at_joints]
    np.testing.assert_array_equal(again.components.at_joints[0].key_points_sd, at_node.key_points_sd)


def test_methods_of_the_paper_refuse_branched_assemblies():
    recipe = {"kind": "assembly", "assembly": {"type": "node"}, "scan": {"spacing_mm": 200.0}}
    scene, _ = made(make, "node", recipe, 4)
    with pytest.raises(InputError, match="takes components in a row"):
        step.run(scene, Params(method="corner"))
