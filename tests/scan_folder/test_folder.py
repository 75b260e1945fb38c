"""Scan folders: units, designs and paths; each mistake is named."""

import json

import numpy as np
import pytest

from processor.model import InputError, Truth, UsageError, reason
from processor.plain_text import decoded
from processor.scan_folder import folder
from processor.store import store
from tests.support.files.scan_folders import BOX, TRIANGLES, surface, write_ply, write_xyz


def project(place, text):
    (place / "project.toml").write_text(text, encoding="utf-8")


# --- what is read --------------------------------------------------------------------------------------------------


def test_a_bridge_without_a_project_file(bridge):
    scene = folder.read_input(bridge)
    assert (scene.name, scene.kind, scene.units) == ("bridge", "arch-bridge", "m")
    assert [one.code for one in scene.units_reason] == ["units.as-scanners-write"]
    assert [(scan.name, scan.component) for scan in scene.scans] == [("foot1", "foot1"), ("rib1", "rib1")]
    assert np.allclose(scene.scans[0].points, surface(0) * 1000.0, rtol=0, atol=0.001)  # mm, the digits of the file
    arch = scene.arch
    assert [one.name for one in arch.parts] == ["foot1", "rib1"]
    assert np.array_equal(arch.parts[1].vertices, (BOX + np.array([4, 0, 0])) * 1000.0)
    assert arch.parts[1].faces.tolist() == TRIANGLES
    assert arch.parts[1].bottom_edge_left.tolist() == [[4000, 400, 0], [8000, 400, 0]]
    assert (arch.joint_names, arch.joint_left, arch.joint_right) == (("J1",), ("foot1",), ("rib1",))
    assert arch.joint_points[0, 7].tolist() == [4000, 80, 5]


def test_all_keys_of_a_project_file_are_read(bridge):
    write_xyz(bridge / "scans/扫描.xyz", surface(0) * 100.0)
    write_xyz(bridge / "more.xyz", surface(1) * 100.0)
    project(
        bridge,
        """
        name = "东桥"
        kind = "arch-bridge"
        units = "cm"
        design = "design.json"
        temperature_C = 31.5
        [[scan]]
        file = "scans/扫描.xyz"
        component = "foot1"
        station = "S1"
        sigma_mm = 2.5
        position = [1.0, 2.0, 3.0]
        pose = [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]
        [[scan]]
        file = "more.xyz"
        component = "rib1"
        [tolerance]
        standard = "GB 50205-2020"
        """,
    )
    scene = folder.read_input(bridge)
    assert (scene.name, scene.units, scene.temperature_C) == ("东桥", "cm", 31.5)
    assert scene.units_reason == (reason("units.by-project", file="project.toml"),)
    first = scene.scans[0]
    assert (first.name, first.component, first.station, first.sigma_mm) == ("扫描", "foot1", "S1", 2.5)
    assert first.position.tolist() == [10, 20, 30]
    assert first.T_project_scan[:3, 3].tolist() == [100, 200, 300]
    # By hand: the position (10, 20, 30) turned by a quarter about z is (-20, 10, 30), moved (80, 210, 330).
    assert scene.stations.ids == ("S1",)
    assert scene.stations.positions.tolist() == [[80, 210, 330]]
    assert len(scene.scans) == 2


def test_a_scan_named_like_a_station_was_seen_from_there(tmp_path):
    """Of files a station, stations.json states the scanners' places: in the project's frame, also of a posed scan."""
    for name in ("S1", "S2", "S3"):
        write_xyz(tmp_path / f"{name}.xyz", surface(0))
    stations = {"S1": {"position": [1.0, 2.0, 3.0]}, "east": {"position": [7.0, 22.0, 33.0]}}
    (tmp_path / "stations.json").write_text(json.dumps(stations))
    posed = '[[scan]]\nfile = "S2.xyz"\nstation = "east"\npose = [[0,-1,0,10], [1,0,0,20], [0,0,1,30], [0,0,0,1]]\n'
    files = '[[scan]]\nfile = "S1.xyz"\n[[scan]]\nfile = "S3.xyz"\n'
    project(tmp_path, 'kind = "structure"\nunits = "m"\n' + files + posed)
    scans = {scan.name: scan for scan in folder.read_input(tmp_path).scans}
    assert scans["S1"].position.tolist() == [1000.0, 2000.0, 3000.0]
    # The pose maps (2, 3, 3) to (10 - 3, 20 + 2, 30 + 3); float64 has steps of 1e-12 there.
    assert np.allclose(scans["S2"].position, [2000.0, 3000.0, 3000.0], rtol=0, atol=1e-9)
    assert not scans["S3"].position.size


def test_stations_may_be_a_list_with_ids(tmp_path):
    write_xyz(tmp_path / "scan.xyz", surface(0))
    listed = [{"id": "S2", "position": [1.0, 2.0, 3.0]}, {"id": "S1", "position": [4.0, 5.0, 6.0]}]
    (tmp_path / "stations.json").write_text(json.dumps(listed))
    stations = folder.read_input(tmp_path, units="m").stations
    assert stations.ids == ("S2", "S1")
    assert stations.positions.tolist() == [[1000.0, 2000.0, 3000.0], [4000.0, 5000.0, 6000.0]]
    for wrong in ([*listed, listed[0]], [{"position": [1.0, 2.0, 3.0]}], [{**listed[0], "pose": 1}]):
        (tmp_path / "stations.json").write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=r"stations\.json: \d"):
            folder.read_input(tmp_path, units="m")


def test_unknown_keys_of_nodes_and_members_are_ignored_with_one_line(tmp_path, caplog):
    write_xyz(tmp_path / "scan.xyz", surface(0))
    nodes = [{"id": i, "centre": [1000.0 * i, 0, 0], "radius": 60.0, "suport": "perimeter"} for i in range(3)]
    members = [{"a": 0, "b": 1, "tube_diameter": 60.0, "colour": "red"}]
    design = {"units": "mm", "kind": "space-frame", "nodes": nodes, "members": members}
    (tmp_path / "design.json").write_text(json.dumps(design))
    (tmp_path / "project.toml").write_text('kind = "space-frame"\nunits = "mm"\ndesign = "design.json"\n')
    assert len(folder.read_input(tmp_path).frame.ids) == 3
    assert [record.args[1] for record in caplog.records] == ["'suport'", "'colour'"]
    assert "support" in caplog.records[0].message


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "gb18030", "cp1252", "latin-1"])
@pytest.mark.parametrize("name", ["Träger größte Höhe", "'poutre précontrainte'", "B1", "钢梁 N001", "东桥 A-镕 拱脚"])
def test_a_name_is_decoded_in_the_encoding_that_it_looks_like(name, coding):
    try:
        data = name.encode(coding)
    except UnicodeEncodeError:
        return  # no such letters in it
    if name[0] == "T" and coding == "gb18030":
        return  # nobody writes German in it
    assert decoded(data) == name


def test_a_chinese_project_file_in_gb18030(bridge):
    (bridge / "project.toml").write_bytes('name = "东桥"\n'.encode("gb18030"))
    assert folder.read_input(bridge).name == "东桥"


def test_a_single_file_and_a_scene(tmp_path):
    write_xyz(tmp_path / "lone.xyz", surface() + np.array([512_345.0, 4_400_000.0, 0.0]))
    scene = folder.read_input(tmp_path / "lone.xyz")
    assert (scene.name, scene.kind, len(scene.scans)) == ("lone", "structure", 1)
    assert scene.scans[0].origin.tolist() == [512e6, 4400e6, 0]
    path = tmp_path / "scene.h5"
    store.write_scene(path, scene, None, {})
    assert store.scene_hash(folder.read_input(path)) == store.scene_hash(store.read_scene(path))


def test_truth_file_is_found_beside_a_folder_of_scans(bridge):
    assert folder.truth_file(bridge) is None
    assert folder.truth_file(bridge / "scans/foot1.xyz") is None
    store.write_truth(bridge / "truth.h5", Truth())
    assert folder.truth_file(bridge) == bridge / "truth.h5"
    assert folder.truth_file(bridge / "truth.h5") == bridge / "truth.h5"
    assert [scan.name for scan in folder.read_input(bridge).scans] == ["foot1", "rib1"]


# --- units ---------------------------------------------------------------------------------------------------------


def test_units_of_the_command_precede_those_of_project_and_file(tmp_path):
    write_xyz(tmp_path / "a.xyz", np.eye(3, 3).repeat(2, axis=0))
    np.savetxt(tmp_path / "b.csv", np.eye(3, 3).repeat(2, axis=0), delimiter=",", header="x_cm,y_cm,z_cm")

    def largest(units=None):
        scene = folder.read_input(tmp_path, units)
        return [float(scan.points.max()) for scan in scene.scans], scene.units

    assert largest() == ([1000.0, 10.0], "m, cm")
    project(tmp_path, 'units = "inch"')
    assert largest() == ([25.4, 10.0], "inch, cm")
    assert largest("ft") == ([304.8, 304.8], "ft")
    with pytest.raises(UsageError, match="unknown unit 'parsec'; expected one of mm, "):
        largest("parsec")


@pytest.mark.parametrize(
    ("units", "factor"), [("mm", "0.001"), ("inch", "0.03937"), ("cm", "0.01"), ("dm", "0.1"), ("km", "1000")]
)
def test_a_wrong_unit_is_noticed(bridge, units, factor):
    if factor == "0.03937":  # read as inches what are metres
        project(bridge, 'units = "mm"')
        write_xyz(bridge / "scans/foot1.xyz", surface() * 1000.0 / 25.4)
    else:
        project(bridge, f'units = "{units}"')
    with pytest.raises(InputError, match=rf"foot1\.xyz: .* close to {factor}: .*project\.toml.*seems wrong"):
        folder.read_input(bridge)


def on_a_wide_floor(part):
    size, rng = np.linalg.norm(np.ptp(part, axis=0)), np.random.default_rng(3)
    wide = np.column_stack([rng.uniform(-1.2, 1.2, (4 * len(part), 2)) * size, np.zeros(4 * len(part))])
    return np.vstack([part, part.mean(axis=0) + wide])


def turned(part):
    return part @ np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0].T + 50.0


@pytest.mark.parametrize("scanned", [on_a_wide_floor, turned])
def test_a_part_that_looks_larger_is_no_wrong_unit(bridge, scanned):
    write_xyz(bridge / "scans/foot1.xyz", scanned(surface()))
    assert len(folder.read_input(bridge).scans) == 2


def test_a_scan_larger_than_any_structure_has_a_wrong_unit(tmp_path):
    """Design and scan in mm, both read as metres: their ratio does not show the error."""
    write_ply(tmp_path / "design.ply", BOX * 10_000.0)
    write_ply(tmp_path / "scans/hall.ply", surface() * 10_000.0)
    text = 'kind = "structure"\nunits = "{}"\ndesign = "design.ply"\n[[scan]]\nfile = "scans/hall.ply"\n'
    project(tmp_path, text.format("m"))
    why = r"design\.ply: the design: .* km .*read as m \(given in project\.toml\).* m if it were mm: give"
    with pytest.raises(InputError, match=why):
        folder.read_input(tmp_path)
    project(tmp_path, text.format("mm"))
    assert len(folder.read_input(tmp_path).scans) == 1
    with pytest.raises(InputError, match=r"scan 'hall' .*read as m \(given by --units\)"):
        folder.read_input(tmp_path, "m")
    # The scan is right and of a piece only; the design alone is not.
    write_ply(tmp_path / "scans/hall.ply", surface() * 500.0)
    project(tmp_path, 'design_units = "m"\n' + text.format("mm"))
    with pytest.raises(InputError, match=r"design\.ply: the design: .* 40 km .*'design_units' or 'units'"):
        folder.read_input(tmp_path)


def test_a_place_on_the_map_and_a_stray_point_are_no_wrong_unit(tmp_path):
    points = surface() + np.array([512_345.0, 4_400_000.0, 0.0])
    points[7] += 50_000.0
    write_xyz(tmp_path / "lone.xyz", points)
    assert len(folder.read_input(tmp_path / "lone.xyz").scans[0].points) == len(points)


def test_a_wrong_unit_of_a_frame_is_noticed(tmp_path):
    nodes = [{"id": i, "centre": [3 * (i % 5), 3 * (i // 5), 0], "radius": 0.1} for i in range(25)]
    (tmp_path / "design.json").write_text(json.dumps({"units": "m", "kind": "space-frame", "nodes": nodes}))
    whole = np.array([node["centre"] for node in nodes] * 4, float)
    write_xyz(tmp_path / "hall.xyz", whole * 1000.0)
    with pytest.raises(InputError, match="close to 1000"):
        folder.read_input(tmp_path)
    write_xyz(tmp_path / "hall.xyz", whole[:2].repeat(4, axis=0) / 10.0)  # a piece of it: nothing to compare
    assert folder.read_input(tmp_path).kind == "space-frame"


# --- mistakes ------------------------------------------------------------------------------------------------------

SCAN = '[[scan]]\nfile = "scans/foot1.xyz"\n'
# What impossible_texts has, values out of their range, is not repeated here.
PROJECTS = {
    "key": ("colour = 1", "unknown key 'colour'; known are name, kind, units"),
    "scan key": (SCAN + "weight = 1", r"scan 1: unknown key 'weight'; known are file, component"),
    "kind": ('kind = "tower"', "expected one of arch-bridge, space-frame, structure as 'kind', found 'tower'"),
    "other kind": ('kind = "space-frame"', "expected a design of kind space-frame by project.toml, found arch-bridge"),
    "unit": ('units = "furlong"', "unknown unit 'furlong'; expected one of mm"),
    "type": ("name = 3", "expected a text as 'name', found 3"),
    "TOML": ("name = ", "not readable TOML"),
    "scan list": ("scan = 3", "expected a list as 'scan', found 3"),
    "scan table": ("scan = [3]", "scan 1: expected a table"),
    "no file": ("[[scan]]\ncomponent = 'foot1'", "expected a text as 'file', found nothing"),
    "absent": ("[[scan]]\nfile = 'scans/foot9.xyz'", "there is no file 'scans/foot9.xyz'"),
    "component": (SCAN + "component = 'foot9'", "no component 'foot9'; it has foot1, rib1"),
    "twice": (SCAN + SCAN, "a second scan named 'foot1'"),
    "above": ("[[scan]]\nfile = '../a.xyz'", "'../a.xyz' leads out of the folder"),
    "above in the middle": ("[[scan]]\nfile = 'scans/../../a.xyz'", "leads out of the folder"),
    "windows": ("[[scan]]\nfile = 'C:\\\\a.xyz'", "leads out of the folder"),
    "windows above": ("[[scan]]\nfile = '..\\\\a.xyz'", "leads out of the folder"),
    "absolute": ("[[scan]]\nfile = '/etc/passwd'", "leads out of the folder"),
    "zero": ('design = "a\\u0000b"', "leads out of the folder"),
    "STEP": ('kind = "arch-bridge"\ndesign = "scans/a.step"', "alone is a design of kind structure"),
    "frame of a bridge": ('design = "design.json"\ndesign_frame = "own"', "is for the nodes of a space frame"),
    "unknown frame": ('design_frame = "projct"', r"one of project, own as 'design_frame', .* \(did you mean 'project'"),
    "other design": ('design = "scans/foot1.xyz"', "expected a design as .json or .csv"),
}


@pytest.mark.parametrize("case", PROJECTS)
def test_mistakes_in_a_project_file(bridge, case):
    text, why = PROJECTS[case]
    (bridge / "scans/a.step").touch()
    project(bridge, text)
    with pytest.raises(InputError, match=why):
        folder.read_input(bridge)


def test_links_stay_in_the_folder(bridge, tmp_path):
    outside = tmp_path / "outside.xyz"
    write_xyz(outside, surface())
    (bridge / "scans/linked.xyz").symlink_to(outside)
    with pytest.raises(InputError, match="a link that leads out of the folder"):
        folder.read_input(bridge)
    (bridge / "scans/linked.xyz").unlink()
    (bridge / "scans/foot3.xyz").symlink_to(bridge / "scans/foot1.xyz")
    assert len(folder.read_input(bridge).scans) == 3


def test_folders_without_scans(tmp_path):
    with pytest.raises(InputError, match=r"expected scans .* found none"):
        folder.read_input(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        folder.read_input(tmp_path / "absent")
    (tmp_path / "scan.fls").mkdir()
    for place in (tmp_path, tmp_path / "scan.fls"):
        with pytest.raises(InputError, match="export the scan to E57"):
            folder.read_input(place)


def test_too_few_points_and_one_pose_for_two_scans(tmp_path):
    write_xyz(tmp_path / "a.xyz", np.eye(3))
    with pytest.raises(InputError, match="has 3 points; expected 4 or more"):
        folder.read_input(tmp_path)
    (tmp_path / "a.xyz").unlink()
    grid = "2\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" + "1 2 3 4\n" * 4
    (tmp_path / "b.ptx").write_text(grid * 2)
    assert [scan.name for scan in folder.read_input(tmp_path).scans] == ["b-1", "b-2"]
    project(tmp_path, "[[scan]]\nfile = 'b.ptx'\nposition = [0, 0, 0]")
    with pytest.raises(InputError, match="holds 2 scans, so one 'pose' or 'position'"):
        folder.read_input(tmp_path)
