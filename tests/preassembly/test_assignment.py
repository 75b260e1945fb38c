"""Scans assigned to parts that they are not of: found before the costly registration, named, and matched."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from processor.geometry import rigid
from processor.language.messages import messages
from processor.model import Scene, reason
from processor.preassembly import assemble
from processor.preassembly import step as preassembly_step
from processor.preassembly.parts import assignment, attitude
from processor.preassembly.parts.assignment import ScanParts
from processor.preassembly.parts.attitude import Shapes
from processor.preassembly.result import Result
from processor.preassembly.verdicts import reasons
from processor.registration import pose_search
from processor.scan_folder import folder
from tests.support.clouds import arch_clouds
from tests.support.scenes.foreign_scenes import foreign_scene

NAMES = arch_clouds.NAMES


@pytest.fixture(scope="module")
def shapes():
    return Shapes(arch_clouds.design())


def scanned(part, seed=1, spacing_mm=50.0):
    rng = np.random.default_rng(seed)
    points = arch_clouds.scan_points(part, spacing_mm, 1.0, rng)
    return rigid.apply(arch_clouds.random_pose(rng), points)


@pytest.mark.slow
@pytest.mark.parametrize(("came", "asked", "found"), [(0, 2, 0), (1, 2, 1), (2, 1, 2), (3, 0, 1)])
def test_scan_of_another_size_is_assigned_to_the_parts_of_that_size(shapes, came, asked, found):
    """Ribs 1 and 3, and the feet, differ by their marks alone: any of them stands for both."""
    assert assignment.rather(scanned(came), asked, shapes) == found


@pytest.mark.parametrize("part", [0, 1, pytest.param(2, marks=pytest.mark.slow)])  # the two others have their shapes
def test_scan_of_its_own_part_gets_no_other_assignment(shapes, part):
    assert assignment.rather(scanned(part), part, shapes) is None


@pytest.mark.slow
def test_scan_of_half_a_part_gets_no_other_assignment(shapes):
    points = scanned(1)
    along = (points - points.mean(axis=0)) @ np.linalg.svd(points[::10] - points[::10].mean(axis=0))[2][0]
    assert assignment.rather(points[along < 0.0], 1, shapes) is None


@pytest.mark.parametrize("attitude_of_rough", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_scan_whose_rough_pose_is_turned_half_round_gets_no_other_assignment(shapes, attitude_of_rough, monkeypatch):
    """All attitudes of the part itself are tried before its scan is called another part's."""
    rng = np.random.default_rng(1)
    points = arch_clouds.scan_points(1, 50.0, 1.0, rng)
    points = points[(along := points @ shapes[1].axes[:, 0]) < np.quantile(along, 0.85)]  # of no part's size
    T, turn, rough = arch_clouds.random_pose(rng), pose_search.symmetries(shapes[1])[attitude_of_rough], attitude.rough

    def turned(some, surface, **options):
        return turn @ rigid.invert(T) if surface is shapes[1] else rough(some, surface, **options)

    monkeypatch.setattr(attitude, "rough", turned)
    assert assignment.rather(rigid.apply(T, points), 1, shapes) is None


def scans_of(assigned, *parts):
    return [ScanParts(f"Scan_{i:03d}", name, one) for i, (name, one) in enumerate(zip(assigned, parts, strict=True), 1)]


# A swap, a ring of three, two swaps, a ring of four.
@pytest.mark.parametrize("order", [(1, 0, 2, 3), (0, 2, 3, 1), (1, 0, 3, 2), (3, 0, 1, 2)])
def test_every_wrong_assignment_is_named_with_the_matching(order):
    """Scan i is of part i."""
    names = NAMES[:4]
    solved = assignment.solve(scans_of([names[k] for k in order], *((name,) for name in names)))
    parts = [SimpleNamespace(identities=(scan,)) for scan in solved]
    (headline,) = reasons.of_assignment(parts)
    wrong = [i for i, k in enumerate(order) if i != k]
    written = messages("en").sentences([headline])
    for i in wrong:
        assert f"Scan_{i + 1:03d} is {names[i]}, not {names[order[i]]}" in written
    assert len(headline.values["scans"]) == len(wrong)
    assert headline.values["matching"] == tuple(f"Scan_{i + 1:03d} = {name}" for i, name in enumerate(names))


def test_scans_of_indistinguishable_parts_stay_unassigned():
    """Two scans without a mark, each of rib 1 or rib 3: neither is named, and neither is wrong."""
    either = ("rib1", "rib3")
    solved = assignment.solve(scans_of(("rib3", "foot1", "rib1"), either, ("foot1",), either))
    assert [scan.parts for scan in solved] == [either, ("foot1",), either]
    assert not any(scan.wrong for scan in solved)
    (wrong,) = ScanParts("S", "foot1", either).wrong
    assert wrong.code == "preassemble.scan-of-others"


def test_scan_without_a_mark_is_assigned_to_the_remaining_part():
    either = ("rib1", "rib3")
    solved = assignment.solve(scans_of(("rib1", "foot1", "rib3"), either, ("rib1",), ("foot1",)))
    assert [scan.parts for scan in solved] == [("rib3",), ("rib1",), ("foot1",)]
    every = ("foot1", "rib1", "rib3")  # a scan of which nothing is known is not named by exclusion
    solved = assignment.solve(scans_of(("rib1", "foot1", "rib3"), every, ("rib1",), ("foot1",)))
    assert solved[0].parts == every


def test_two_scans_may_be_assigned_to_one_part():
    solved = assignment.solve(scans_of(("rib1", "rib2"), ("rib2",), ("rib2",)))
    assert [scan.parts for scan in solved] == [("rib2",), ("rib2",)]
    assert [bool(scan.wrong) for scan in solved] == [True, False]
    assert [one.code for one in ScanParts("S", "rib1", ()).wrong] == ["preassemble.scan-of-none"]
    assert [one.code for one in ScanParts("rib1", "rib1", ("rib2",)).wrong] == ["preassemble.named-scan-of-other"]


def test_a_scan_that_is_assigned_to_no_part_is_named(monkeypatch):
    scene, _ = arch_clouds.bridge(spacing_mm=200.0, seed=1)
    spare = type(scene.scans[0])("spare", scene.scans[0].points, component="crane")
    monkeypatch.setattr(assemble, "assemble", lambda *_: Result("ok", "adjustment"))
    scene = Scene("b", "arch-bridge", (*scene.scans, spare), arch=scene.arch)
    result = preassembly_step.run(scene, preassembly_step.Params())
    assert result.reasons == (reason("preassemble.scans-without-part", scans=("spare",)),)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(1, 2, 3, 4, 0), (4, 3, 2, 1, 0), (2, 0, 1, 3, 4)])
def test_a_bridge_of_wrong_scans_is_not_assembled(order):
    scene, _ = arch_clouds.bridge(spacing_mm=24.0, sigma_mm=1.0, seed=3)
    scans = tuple(
        type(scan)(f"Scan_{i + 1:03d}", scan.points, component=NAMES[k])
        for i, (scan, k) in enumerate(zip(scene.scans, order, strict=True))
    )
    result = preassembly_step.run(Scene("b", "arch-bridge", scans, arch=scene.arch), preassembly_step.Params())
    assert result.reasons[0].code == "preassemble.wrong-assignment"
    matching = dict(one.split(" = ") for one in result.reasons[0].values["matching"])
    ribs = {"rib1", "rib3"}  # equal, their marks included, so that they stand for each other
    for i, (name, k) in enumerate(zip(NAMES, order, strict=True)):
        assert set(matching[f"Scan_{i + 1:03d}"].split(" / ")) == (ribs if name in ribs else {name})
        right = name == NAMES[k] or {name, NAMES[k]} == ribs
        # No joint to a wrong scan is measured: what is right is placed by the design alone.
        assert result.components.status[k] == ("weak" if right else "failed")
    assert [one.code for one in result.adjustment.advice] == ["preassemble.assign-scans"]


@pytest.mark.parametrize(("edge_mm", "count"), [(3_000.0, 60_000), (30.0, pose_search.SAMPLES[0])])
def test_a_part_has_one_sample_on_each_square_of_the_spacing(edge_mm, count):
    """A cube of 3 m has 54 m2: 60,000 squares of 30 mm. A small one has the fewest that a registration needs."""
    box = trimesh.creation.box(3 * [edge_mm])
    assert len(pose_search.samples_of(np.array(box.vertices), np.array(box.faces, np.int64)).points) == count


@pytest.mark.slow
@pytest.mark.parametrize(
    ("component", "seed", "more", "rather"),
    [
        # To 30 mm SEG-1 lies on either springing and on SEG-3: as much of it as of a piece of them with clutter.
        ("SEG-1", 1, (), {0: 1, 1: None, 2: 1, 3: 1, 4: 1}),
        # Both sides of its end plate of 40 mm are stable places: the scan passed for that of the other foot.
        ("SP-E", 5, (), {4: None}),
        # Of few points, the turned pose of SEG-1 has the least misfit: its scan passed for that of SEG-3.
        ("SEG-1", 3, ("raised=3700",), {1: None}),
    ],
)
def test_scan_of_a_part_is_not_assigned_to_one_like_it(tmp_path, component, seed, more, rather):
    scene = folder.read_input(foreign_scene("arch_bridge", tmp_path, "stations=4", "spacing=16", *more, seed=seed))
    scan = next(scan for scan in scene.scans if scan.component == component)
    shapes = attitude.Shapes(scene.arch)
    assert {k: assignment.rather(scan.points, k, shapes) for k in rather} == rather
