"""`processor init`: kinds, units and components guessed from files; uncertain guesses are marked."""

import json
from unittest import mock

import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli import main
from processor.language.messages import messages
from processor.model import InputError, UsageError, reason
from processor.registration import located_part
from processor.scan_folder import component_names, folder, guess
from tests.support.pages.pages import latin
from tests.support.results.reasons import codes, values

ORDER = ("foot1", "rib1", "rib2", "foot2")
SIZES = {"foot1": (4.0, 0.8, 0.9), "rib1": (9.0, 0.8, 0.9), "rib2": (12.0, 0.8, 0.9), "foot2": (4.0, 0.8, 0.9)}
FACES = ((0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4))


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("foot1", ["foot1"]),
        ("Foot_02", ["foot2"]),
        ("bridge-east RIB-1 scan", ["rib1"]),
        ("foot", ["foot1", "foot2"]),
        ("拱脚1", ["foot1"]),
        ("二号拱脚", ["foot2"]),
        ("拱肋第2段", ["rib2"]),
        ("东桥_2＃拱肋", ["rib2"]),
        ("左拱座一", ["foot1"]),
        ("ribbon1", []),
        ("football", []),
        ("rib12", ["rib1", "rib2"]),  # the word alone: there is no twelfth
        ("03", []),  # scans are numbered as they were made
        ("part 4", []),
        ("2024", []),
        ("扫描", []),
    ],
)
def test_file_names_are_mapped_to_components(stem, expected):
    assert component_names.components(stem, ORDER) == expected


def test_names_of_a_chinese_design():
    order = ["拱脚一", "拱肋一", "拱肋十二"]
    assert component_names.components("rib12", order) == ["拱肋十二"]
    assert component_names.components("拱肋1", order) == ["拱肋一"]
    assert component_names.components("foot", order) == ["拱脚一"]


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("S03", "S3"),
        ("bridge_station 2", "S2"),
        ("测站5", "S5"),
        ("第三站", "S3"),
        ("第十二站", "S12"),
        ("二十一号测站", "S21"),
        ("站十二", "S12"),
        ("roof", ""),
        ("is2", ""),
    ],
)
def test_file_names_are_mapped_to_stations(stem, expected):
    assert component_names.station(stem) == expected


def box_points(size, seed, turn=True, count=6000):
    """Points spread evenly on a box of this size, in a frame of their own."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 1.0, (count, 3))
    across = 1.0 / np.array(size)
    side = rng.choice(3, count, p=across / across.sum())
    points[np.arange(count), side] = rng.integers(0, 2, count)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return (points * size) @ Q.T + rng.uniform(-5, 5, 3) if turn else points * size


def write_scan(path, points):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, points, fmt="%.5f")


def write_mesh(path, size, shift):
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size + [shift, 0, 0]
    rows = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    path.write_text("\n".join(rows) + "\n")


@pytest.fixture
def bridge(tmp_path):
    """A design in mm of four boxes, no scans yet."""
    place, shift, components, joints = tmp_path / "东桥", 0.0, {}, []
    for name in ORDER:
        size = np.array(SIZES[name]) * 1000.0
        write_mesh(place / f"design/{name}.obj", size, shift)
        edge = [[shift, 0, 0], [shift + size[0], 0, 0]]
        components[name] = {"mesh": f"design/{name}.obj", "bottom_edge_left": edge, "bottom_edge_right": edge}
        shift += size[0]
        joints.append([[shift, i, 0.0] for i in range(8)])
    pairs = zip(ORDER, ORDER[1:], joints, strict=False)
    named = [
        {"name": f"J{i}", "left": a, "right": b, "points": {f"P{k}": p for k, p in enumerate(points, 1)}}
        for i, (a, b, points) in enumerate(pairs, 1)
    ]
    design = {"units": "mm", "kind": "arch-bridge", "order": ORDER, "components": components, "joints": named}
    (place / "design.json").write_text(json.dumps(design))
    return place


def init(place, *options):
    return CliRunner().invoke(main.commands, ["init", str(place), *options])


def english(code):
    return messages("en").text(reason(code))


def test_a_bridge_with_names_and_without(bridge):
    for i, (stem, name) in enumerate(
        {"拱脚1 '东'": "foot1", "A": "rib1", "2号拱肋_扫描": "rib2", "B": "foot2"}.items()
    ):
        write_scan(bridge / f"scans/{stem}.xyz", box_points(SIZES[name], i))
    done = init(bridge, "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.output)
    assert (said["kind"], said["units"], said["design"]) == ("arch-bridge", "m", "design.json")
    assert said["units_reason"] == english("init.units-by-design")
    scans = {one["file"]: one for one in said["scans"]}
    assert {file: one["component"] for file, one in scans.items()} == {
        "scans/拱脚1 '东'.xyz": "foot1",
        "scans/A.xyz": "rib1",
        "scans/2号拱肋_扫描.xyz": "rib2",
        "scans/B.xyz": "foot2",
    }
    assert [file for file, one in scans.items() if not one["sure"]] == ["scans/B.xyz"]  # both feet have its shape
    assert len(said["unsure"]) == 1
    assert english("init.only-one-left") in said["unsure"][0]
    scene = folder.read_input(bridge)
    assert (scene.name, scene.kind, scene.units) == ("东桥", "arch-bridge", "m")
    assert {scan.name: scan.component for scan in scene.scans}["A"] == "rib1"
    assert "# temperature_C" in (bridge / "project.toml").read_text("utf-8")


def test_name_contradicted_by_the_shape_is_marked_unsure(bridge):
    write_scan(bridge / "rib1.xyz", box_points(SIZES["rib2"], 1) * 1000.0)
    write_scan(bridge / "odd.xyz", box_points((6.0, 3.0, 3.0), 2) * 1000.0)
    found = guess.guess(bridge)
    assert found.units == "mm"
    one = next(one for one in found.scans if one.file == "rib1.xyz")
    assert (one.component, one.sure) == ("rib1", False)
    assert values(one.reasons, "init.extents-of-other")["component"] == "rib2"
    odd = next(one for one in found.scans if one.file == "odd.xyz")
    assert (odd.component, odd.sure) == ("", False)
    assert "foot1" in values(found.doubts, "init.components-without-scan")["components"]
    assert codes(odd.reasons) == ["init.name-of-none", "init.extents-of-none"]


def test_numbered_scans_are_assigned_by_their_shape(bridge):
    for i, name in enumerate(("rib2", "foot2", "rib1", "foot1"), 1):
        write_scan(bridge / f"scans/Scan_{i:03d}.xyz", box_points(SIZES[name], i))
    scans = guess.guess(bridge).scans
    assert [(one.component, one.sure) for one in scans if one.component.startswith("rib")] == [
        ("rib2", True),
        ("rib1", True),
    ]
    feet = [one for one in scans if one.component.startswith("foot")]
    assert {one.component for one in feet} == {"foot1", "foot2"}
    assert not any(one.sure for one in feet)
    assert all("init.any-of-them" in codes(one.reasons) for one in feet)


def test_the_shape_of_a_part_is_measured_without_the_ground_about_it(bridge):
    rng = np.random.default_rng(1)
    for i, name in enumerate(("rib2", "rib1"), 1):
        size = np.array(SIZES[name])
        ground = rng.uniform([-2.0, -2.0, -0.8], [size[0] + 2.0, size[1] + 2.0, -0.8], (18_000, 3))
        points = np.vstack([box_points(SIZES[name], i, turn=False), ground + rng.uniform(-0.001, 0.001, ground.shape)])
        write_scan(bridge / f"scans/Scan_{i:03d}.xyz", points)
    found = guess.guess(bridge)
    assert found.units == "m"
    assert [(one.component, one.sure) for one in found.scans] == [("rib2", True), ("rib1", True)]


def test_name_is_unsure_if_the_shape_matches_another_part(bridge):
    """The extents differ by 8 %: a scan with gaps might, but these are those of rib 2."""
    size = np.array(SIZES["rib1"]) * 1000.0 * np.array([1.08, 1.0, 1.0])
    write_mesh(bridge / "design/rib2.obj", size, 13_000.0)
    write_scan(bridge / "scans/rib1.xyz", box_points(size / 1000.0, 1))
    done = init(bridge)
    assert "kind arch-bridge, 1 file(s) of scans" in done.stdout
    assert done.stderr == ""
    (one,) = guess.guess(bridge).scans
    assert (one.component, one.sure) == ("rib1", False)
    assert values(one.reasons, "init.extents-of-other")["component"] == "rib2"


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("mm", 1000.0), ("inch", 1 / 0.0254)])
def test_units_come_from_the_design(bridge, unit, factor):
    write_scan(bridge / "scans/rib2.xyz", box_points(SIZES["rib2"], 1) * factor)
    assert guess.guess(bridge).units == unit


def test_no_design_and_a_scan_that_cannot_be_read(tmp_path):
    write_scan(tmp_path / "S1.xyz", box_points((30.0, 20.0, 5.0), 1))
    write_scan(tmp_path / "S2.xyz", box_points((30.0, 20.0, 5.0), 1))
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat")
    done = init(tmp_path)
    assert done.exit_code == 0, done.output
    assert f"? {english('init.no-design')}" in done.output.splitlines()
    assert values(guess.guess(tmp_path).doubts, "init.scan-unreadable")["file"] == "cut.ply"
    text = (tmp_path / "project.toml").read_text("utf-8")
    assert '# station = "S2"' in text
    scene = folder.read_input(tmp_path)
    assert [scan.name for scan in scene.scans] == ["S1", "S2"]
    assert (scene.kind, scene.units) == ("structure", "m")


def test_one_mesh_is_a_structure(tmp_path):
    write_mesh(tmp_path / "design/hall.obj", np.array([30_000.0, 20_000.0, 5_000.0]), 0.0)
    write_scan(tmp_path / "hall.xyz", box_points((30.0, 20.0, 5.0), 1, turn=False))
    found = guess.guess(tmp_path)
    assert (found.kind, found.design, found.design_units, found.units) == ("structure", "design/hall.obj", "mm", "m")
    (tmp_path / "project.toml").write_text(guess.to_toml(found), "utf-8")
    scene = folder.read_input(tmp_path)
    assert np.ptp(scene.structure.vertices, axis=0) == pytest.approx([30_000.0, 20_000.0, 5_000.0])
    (tmp_path / "project.toml").write_text('design = "design/hall.obj"\n', "utf-8")  # then the mesh is in m as well
    with pytest.raises(InputError, match=r"it would be 30 m if it were mm"):
        folder.read_input(tmp_path)


def test_chinese_init_has_chinese_comments_and_lines_and_english_json(bridge):
    write_scan(bridge / "rib1.xyz", box_points(SIZES["rib2"], 1))
    write_scan(bridge / "rib2.xyz", box_points(SIZES["rib2"], 2))
    write_scan(bridge / "scans/S1.xyz", box_points((6.0, 3.0, 3.0), 3))
    write_scan(bridge / "scans/S2.xyz", box_points(SIZES["foot1"], 4))
    (bridge / "stations.json").write_text("{}")
    done = init(bridge, "--lang", "zh")
    assert done.exit_code == 0, done.output
    lines = (bridge / "project.toml").read_text("utf-8").splitlines()
    comments = [line.rpartition("# ")[2] for line in lines if "# " in line]
    assert len(comments) > 10
    names = {*ORDER, "S1", "S2", "scans", "xyz", "stations", "station", "design", "project", "json", "toml"}
    keys = {"kind", "arch", "bridge", "units", "standard", "GB", "processor", "init", "tolerance"}
    printed = done.output.replace(str(bridge), "").splitlines()
    assert len(printed) > 4
    assert latin([*comments, *printed], names | keys) == []
    in_english = init(bridge, "--force", "--json").output
    assert init(bridge, "--force", "--json", "--lang", "zh").output == in_english


def test_existing_project_file_is_kept_and_names_are_quoted(tmp_path):
    place = tmp_path / 'a "b"\\\x7f 桥'
    write_scan(place / '"]\n[x.xyz', box_points((3.0, 2.0, 1.0), 1))
    assert init(place).exit_code == 0
    assert folder.read_input(place).name == place.name
    (place / "project.toml").write_text("mine")
    done = init(place)
    assert isinstance(done.exception, UsageError)
    assert "--force" in str(done.exception)
    assert (place / "project.toml").read_text() == "mine"
    assert init(place, "--force").exit_code == 0
    with pytest.raises(InputError, match="expected scans"):
        guess.guess(tmp_path)
    with pytest.raises(InputError, match="found nothing"):
        guess.guess(tmp_path / "none")


def test_one_scan_in_a_wrong_unit_does_not_end_the_bridge(bridge):
    entries = ""
    for i, name in enumerate(ORDER):
        scale = 304.8 if name == "rib1" else 1.0
        write_scan(bridge / f"{name}.xyz", box_points(SIZES[name], i) * scale)
        entries += f'[[scan]]\nfile = "{name}.xyz"\ncomponent = "{name}"\n'
    (bridge / "project.toml").write_text(f'units = "m"\ndesign = "design.json"\n{entries}')
    scene = folder.read_input(bridge)
    assert len(scene.scans) == len(ORDER)
    (doubt,) = [one for one in scene.units_reason if one.code == "units.doubted"]
    assert "scan 'rib1'" in doubt.values["error"]
    assert "project.toml" in doubt.values["error"]


def test_one_file_that_cannot_be_read_does_not_end_the_bridge(bridge):
    entries = '[[support]]\ncomponent = "rib1"\nchainage_mm = 300.0\n' * 2
    for i, name in enumerate(ORDER):
        write_scan(bridge / f"{name}.xyz", box_points(SIZES[name], i))
        entries += f'[[scan]]\nfile = "{name}.xyz"\ncomponent = "{name}"\n'
    (bridge / "rib1.xyz").write_bytes(b"\x00\xff" * 500)
    (bridge / "project.toml").write_text(f'units = "m"\ndesign = "design.json"\n{entries}')
    scene = folder.read_input(bridge)
    assert [scan.name for scan in scene.scans] == [name for name in ORDER if name != "rib1"]
    (refused,) = [one for one in scene.units_reason if one.code == "read.scan-refused"]
    assert "rib1.xyz" in refused.values["error"]
    for name in ORDER:
        (bridge / f"{name}.xyz").write_bytes(b"\x00\xff" * 500)
    with pytest.raises(InputError, match="xyz"):
        folder.read_input(bridge)


def test_a_raw_scan_has_the_unit_in_which_more_of_the_design_is_shown(monkeypatch):
    scans = [guess.ScanGuess(f"{k}.ply") for k in range(3)]
    shown = {"m": (0.33, 0.31, 0.6), "ft": (0.5, 0.6, 0.3)}
    shapes = mock.Mock(located={
        (scan.file, unit): [[located_part.Located(np.eye(4), share)], []]
        for unit, shares in shown.items()
        for scan, share in zip(scans, shares, strict=True)
    })  # fmt: skip
    found = lambda scan, unit, shapes: {"rib1": 0.0 if unit in shown else 0.5, "rib2": 0.2}  # noqa: E731
    monkeypatch.setattr(guess, "_differences", found)
    project = guess.Guess("f", "f", kind="arch-bridge", scans=scans)
    guess._guess_units(project, [1.0], shapes)
    assert (project.units, project.doubts) == ("ft", [])
    tried = []
    monkeypatch.setattr(guess, "_differences", lambda scan, unit, _: tried.append(unit) or found(scan, unit, _))
    shapes.located = {key: [[located_part.Located(np.eye(4), 0.5)]] for key in shapes.located}
    guess._guess_units(project, [1.0], shapes)
    assert (project.units, set(tried)) == ("m", {"m"})  # of the part surely shown no other unit is tried
