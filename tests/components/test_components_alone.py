"""Parts of bridges and balls and tubes of frames as structures: where they are compared, and without false defects."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from processor import scene_cloud
from processor.components import bridge_parts, frame_members
from processor.defects import step as defects
from processor.defects.bridges import parts
from processor.deviation import step as deviation
from processor.model import ArchDesign, DesignPart, FrameDesign, Scan, Scene, Stations, Status, StepRun, UsageError
from processor.pipeline import result_classes
from processor.preassembly.result import Components, ScanPoses
from processor.results import to_json
from processor.store import store
from processor.store.json_values import json_ready

SIZE = np.array([2000.0, 600.0, 400.0])
JOINT = np.array([[0, 300, 0], [0, -300, 0], [0, -300, 400], [0, 300, 400],
                  [0, 0, 0], [0, -300, 200], [0, 0, 400], [0, 300, 200]], float)  # fmt: skip
DENT_MM, DENT_RADIUS = 8.0, 120.0


def box(x):
    """A box from x on, its section about the x axis."""
    mesh = trimesh.creation.box(SIZE)
    mesh.apply_translation([x + 0.5 * SIZE[0], 0.0, 0.5 * SIZE[2]])
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def design():
    parts = tuple(DesignPart(name, *box(x)) for name, x in (("left", -SIZE[0]), ("right", 0.0)))
    return ArchDesign(parts, ("J1",), ("left",), ("right",), JOINT[None])


def scanned(part, rng, dent):
    """Points on a part's faces, 20 mm apart, with a dent in the middle of its top."""
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, int(mesh.area / 20.0**2), seed=int(rng.integers(1 << 30)))
    top = mesh.face_normals[face][:, 2] > 0.9
    off = np.linalg.norm(points[:, :2] - part.vertices.mean(axis=0)[:2], axis=1)
    points[top, 2] -= dent * np.exp(-((off[top] / DENT_RADIUS) ** 2))
    return points + 0.5 * rng.normal(size=points.shape)


def components(names, poses):
    """Components of one scan each, of the same name."""
    c = len(names)
    return Components(
        name=names, status=(Status.OK,) * c, reasons=((),) * c, scans=names, T_bridge_scan=np.array(poses),
        covariance=np.zeros((c, 6, 6)), key_points_scan=np.zeros((c, 2, 8, 3)), key_points_sd=np.zeros((c, 2, 8, 3)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def bridge():
    """Two boxes; the right one is dented, and lies 25 mm off in the assembly. Each is in a scan frame of its own."""
    rng, made = np.random.default_rng(4), design()
    scans, poses = [], []
    for part, dent, off in zip(made.parts, (0.0, DENT_MM), (0.0, 25.0), strict=True):
        points = scanned(part, rng, dent) + np.array([0.0, off, 0.0])
        T = trimesh.transformations.rotation_matrix(0.7, [0.2, 0.3, 0.9], [1e3, 2e3, 3e3])
        scans.append(Scan(part.name, points @ T[:3, :3].T + T[:3, 3], component=part.name, sigma_mm=0.5))
        # As preassembly fits the part: to its design, a little off.
        back = np.linalg.inv(T)
        back[:3, 3] += [2.0, -1.5 - off, 1.0]
        poses.append(back)
    scene = Scene("two", "arch-bridge", tuple(scans), arch=made)
    table = components(("left", "right"), poses)
    return scene, SimpleNamespace(components=table, method="adjustment")


@pytest.fixture(scope="module")
def compared(bridge):
    scene, assembled = bridge
    found = deviation.run(scene, deviation.Params(), {"preassemble": assembled})
    return found, defects.run(scene, defects.Params(), {"preassemble": assembled, "deviation": found})


def test_each_part_is_compared_at_its_own_best_fit(compared):
    found, _ = compared
    assert found.parts.name == ("left", "right")
    assert [str(status) for status in found.parts.status] == ["ok", "ok"]
    assert len(found.core) == found.parts.core_points.sum()
    assert np.abs(found.parts.mean).max() < 0.2  # a dent of 8 mm moves the mean of 5 m2 by less
    left = found.core.distance[: found.parts.core_points[0]]
    assert np.nanmax(np.abs(left)) < 2.0  # four sd of a point


def test_dent_is_found_on_its_part_without_false_defects(compared):
    _, result = compared
    found = result.defects
    assert found.component == ("right",)
    assert str(found.defect_class[0]) in ("dent", "pit")  # a block has no other side that tells them apart
    assert abs(found.depth_max[0] - DENT_MM) < found.depth_ci95[0]
    middle = np.array([0.5 * SIZE[0], 0.0, SIZE[2]])  # of the top of the right part, as designed
    assert np.linalg.norm(found.centre[0] - middle) < 0.5 * DENT_RADIUS  # the dent, not a neighbour
    assert result.parts.defects.tolist() == [0, 1]


def test_defects_of_parts_are_numbered_one_after_another(compared):
    _, result = compared
    first, second = parts._numbered([result, result])
    assert (first.defects.id.tolist(), second.defects.id.tolist()) == ([0], [1])
    np.testing.assert_array_equal(first.surface.defect, result.surface.defect)
    assert set(second.surface.defect - first.surface.defect) == {0, 1}
    assert (second.surface.defect[first.surface.defect < 0] < 0).all()


def test_a_part_that_was_not_registered_fails_alone(bridge):
    scene, assembled = bridge
    table = dataclasses.replace(assembled.components, status=(Status.FAILED, Status.OK))
    broken = SimpleNamespace(components=table, method="adjustment")
    found = deviation.run(scene, deviation.Params(), {"preassemble": broken})
    assert found.status is Status.PARTIAL
    assert [str(status) for status in found.parts.status] == ["failed", "ok"]


def test_parts_need_preassembly(bridge):
    with pytest.raises(UsageError, match="preassemble"):
        deviation.run(bridge[0], deviation.Params(), {})
    assert deviation.needed(bridge[0]) == ("preassemble",)
    assert defects.needed(bridge[0]) == ("preassemble", "deviation")
    assert not deviation.applies(bridge[0])  # by itself a bridge is assembled alone


def test_every_scan_of_a_part_lies_where_preassembly_placed_it():
    """Warm steel, three scans with frames and far origins of their own, of which one was not used."""
    rng, made, grown = np.random.default_rng(8), design(), 1.0 + 12e-6 * 30.0
    on_part = [scanned(made.parts[0], rng, 0.0) for _ in range(3)]
    scans, poses = [], []
    for k, points in enumerate(on_part):
        T = trimesh.transformations.rotation_matrix(0.4 + k, [0.3, k, 0.7], [1e6, 2e3 * k, -5e5])
        in_scan = grown * (points @ T[:3, :3].T + T[:3, 3])
        seen = grown * (T[:3, :3] @ [-900.0, 4e3, 1.5e3] + T[:3, 3])  # a scanner beside the part
        origin = np.round(in_scan.mean(axis=0))
        scans.append(Scan(f"s{k}", in_scan - origin, origin=origin, position=seen, component="left"))
        poses.append(np.linalg.inv(T))
    scene = Scene("warm", "arch-bridge", tuple(scans), arch=made, temperature_C=50.0)
    used = ScanPoses(name=("s2", "s0"), T_bridge_scan=np.array([poses[2], poses[0]]))
    table = dataclasses.replace(components(("left",), poses[2:]), scans=("s2, s0",), scan_poses=(used,))
    assembled = SimpleNamespace(components=table, method="adjustment")
    part = next(bridge_parts.of_bridge(scene, assembled, "deviation"))
    assert [scan.name for scan in part.scene.scans] == ["s0", "s2"]
    assert [(one.code, one.values["scans"]) for one in part.reasons] == [("parts.scans-not-used", ("s1",))]
    cloud = scene_cloud.merged(part.scene, with_scanner=True)
    # Float64 at 1 km, twice turned.
    np.testing.assert_allclose(cloud.points + cloud.origin, np.vstack([on_part[0], on_part[2]]), atol=1e-5)
    np.testing.assert_allclose(cloud.scanner + cloud.origin, np.tile([-900.0, 4e3, 1.5e3], (len(cloud.points), 1)),
                               atol=1e-5)  # fmt: skip


def test_stations_of_two_scans_of_a_part_lie_where_each_scan_was_placed():
    made, places = design(), np.array([[-900.0, 4e3, 1.5e3], [-900.0, -4e3, 1.5e3]])
    stations = Stations(ids=("S1", "S2"), positions=places)
    points = scanned(made.parts[0], np.random.default_rng(9), 0.0)
    seen = np.arange(len(points)) % 2
    lifts = np.eye(4)[None].repeat(2, axis=0)
    lifts[:, 2, 3] = [3.0, 5.0]  # preassembly lifts either scan by another amount
    scans = [Scan(f"s{k}", points, point_station=seen, component="left") for k in range(2)]
    scene = Scene("two", "arch-bridge", tuple(scans), arch=made, stations=stations)
    table = dataclasses.replace(
        components(("left",), lifts[:1]), scans=("s0, s1",), scan_poses=(ScanPoses(("s0", "s1"), lifts),)
    )
    part = next(bridge_parts.of_bridge(scene, SimpleNamespace(components=table, method="adjustment"), "defects"))
    assert part.scene.stations.ids == ("S1", "S2", "S1, s1", "S2, s1")
    lifted = np.vstack([places + lift[:3, 3] for lift in lifts])
    np.testing.assert_allclose(part.scene.stations.positions, lifted, atol=1e-9)  # float64
    cloud = scene_cloud.merged(part.scene, with_scanner=True)
    lift = np.repeat([3.0, 5.0], len(points))[:, None] * [0, 0, 1.0]
    np.testing.assert_allclose(cloud.scanner + cloud.origin, np.tile(places[seen], (2, 1)) + lift, atol=1e-9)  # float64


def test_balls_and_tubes_lie_where_they_were_measured():
    frame = FrameDesign(
        ids=np.array([1, 2]), centres=np.array([[0.0, 0, 0], [2000.0, 0, 0]]), radii=np.array([60.0, 60.0]),
        member_a=np.array([1]), member_b=np.array([2]), tube_diameters=np.array([80.0]),
    )  # fmt: skip
    moved = np.array([[5.0, -3.0, 8.0], [2004.0, 6.0, -2.0]])
    balls = SimpleNamespace(ids=np.array([1, 2]), evidence=("ball", "fused"), placed=np.ones(2, bool), centres=moved)

    class Found(SimpleNamespace):
        def __len__(self):
            return 1

    axis = (moved[1] - moved[0]) / np.linalg.norm(moved[1] - moved[0])
    tubes = Found(
        a=np.array([1]), b=np.array([2]), start=(moved[0] + 150 * axis)[None], end=(moved[1] - 150 * axis)[None],
        radii=np.array([40.0]),
    )  # fmt: skip
    found = SimpleNamespace(balls=balls, tubes=tubes, stations=SimpleNamespace(names=(), T=np.empty((0, 4, 4))))
    made = frame_members.of_frame(Scene("f", "space-frame", frame=frame), found, "deviation").structure
    assert made.bodies.names == ("node 1", "node 2", "1-2")
    corners = made.vertices[made.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for row, (centre, radius) in enumerate(((moved[0], 60.0), (moved[1], 60.0), (None, 40.0))):
        own = made.bodies.of_facet == row
        off = corners[own].reshape(-1, 3) - (moved[0] if centre is None else centre)
        if centre is None:
            off = off - (off @ axis)[:, None] * axis
        np.testing.assert_allclose(np.linalg.norm(off, axis=1), radius, atol=1e-9)  # float64
        assert (np.einsum("fi,fi->f", normal[own], off.reshape(-1, 3, 3).mean(axis=1)) > 0.0).all()
    # The ball is open where the member's sleeve hides it.
    own = corners[made.bodies.of_facet == 0].mean(axis=1) - moved[0]
    assert np.linalg.norm(own - 60.0 * axis, axis=1).min() > 40.0


def test_results_of_parts_are_stored_and_written(compared, tmp_path):
    runs = [StepRun(step, "default", "{}", made) for step, made in zip(("deviation", "defects"), compared, strict=True)]
    store.write_results(tmp_path / "results.h5", runs, {})
    for run, back in zip(runs, store.read_results(tmp_path / "results.h5", result_classes()), strict=True):
        assert back.result.parts.name == ("left", "right")
        written = json.loads(json.dumps(json_ready(to_json.step_json(back))))["parts"]
        assert [part["name"] for part in written] == ["left", "right"]
        assert all(part["status"] == "ok" for part in written)
        np.testing.assert_array_equal(back.result.parts.covariance, run.result.parts.covariance)


def test_points_of_a_merged_scan_are_corrected_station_by_station():
    """Two stations of one cloud, each 4 mm off another way; points without a station stay."""
    rng = np.random.default_rng(3)
    true = rng.uniform(-3e3, 3e3, (30, 3)) + np.array([5e5, 4e6, 0.0])
    station = np.repeat([0, 1, -1], 10)
    corrections = np.stack([trimesh.transformations.rotation_matrix(a, [0.2, 0.9, a]) for a in (2e-6, -3e-6)])
    corrections[:, :3, 3] = [[4.0, 0.0, -1.0], [0.0, -4.0, 2.0]]
    pose = trimesh.transformations.rotation_matrix(0.6, [0.1, 0.2, 1.0], [5e5, 4e6, 0.0])
    seen = true.copy()
    for row, T in enumerate(corrections):
        back = np.linalg.inv(T)
        seen[station == row] = seen[station == row] @ back[:3, :3].T + back[:3, 3]
    origin = np.array([1200.0, -700.0, 30.0])
    points = (seen - pose[:3, 3]) @ pose[:3, :3] - origin
    scan = Scan("all", points, origin=origin, point_station=station, T_project_scan=pose)
    scene = Scene("frame", "space-frame", (scan,), stations=Stations(ids=("S1", "S2"), positions=np.zeros((2, 3))))
    found = SimpleNamespace(stations=SimpleNamespace(names=("S1", "S2"), T=corrections))
    cloud = scene_cloud.merged(frame_members._corrected(scene, found), with_scanner=False)
    np.testing.assert_allclose(cloud.points + cloud.origin, true, atol=1e-6)  # float64 at 4 km, twice turned
