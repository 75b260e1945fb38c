"""Lists of a frame's nodes as surveyors have them: columns by the names of the trade, ids as texts, sizes in mm."""

import json

import numpy as np
import pytest

from processor.model import InputError
from processor.scan_folder import folder, guess, node_list
from processor.store import store
from processor.writers import project
from tests.support.files.scan_folders import surface, write_xyz

SURVEYED = """PointNo,Easting,Northing,Height,Diameter
N001,512345.678,3391234.567,38.850,160
N002,512348.059,3391235.612,38.932,160
N003,512350.439,3391236.657,38.983,130
"""
PLACES = [
    [512345678.0, 3391234567.0, 38850.0],
    [512348059.0, 3391235612.0, 38932.0],
    [512350439.0, 3391236657.0, 38983.0],
]
RADII = [80.0, 80.0, 65.0]


def listed(tmp_path, text, name="nodes.csv"):
    (tmp_path / name).write_text(text, "utf-8")
    return node_list.read_node_list(tmp_path / name, "m")


@pytest.mark.parametrize(
    ("header", "row", "separator"),
    [
        ("PointNo,Easting,Northing,Height,Diameter", "{id},{x},{y},{z},{d}", ","),
        ("Node;Northing (m);Easting (m);Elevation (m);Radius [mm]", "{id};{y};{x};{z};{r}", ";"),
        ("Pkt-Nr\tRechtswert\tHochwert\tHöhe\tDurchmesser_mm", "{id}\t{x}\t{y}\t{z}\t{d}", "\t"),
        ("序号,节点编号,北坐标(X),东坐标(Y),高程,直径", "9{d},{id},{y},{x},{z},{d}", ","),
        ("No,X,Y,Z,Ø (m),remark", "{id},{x},{y},{z},{dm},steel", ","),
        ("id,x_mm,y_mm,z_mm,radius_m", "{id},{xm},{ym},{zm},{rm}", ","),
    ],
)
def test_columns_of_a_list_are_known_by_the_names_of_the_trade(tmp_path, header, row, separator):
    rows = []
    for k, ((x, y, z), r) in enumerate(zip(PLACES, RADII, strict=True), 1):
        metres = {"x": x / 1e3, "y": y / 1e3, "z": z / 1e3, "dm": 2e-3 * r, "rm": 1e-3 * r}
        rows.append(row.format(id=f"N{k:03}", xm=x, ym=y, zm=z, r=r, d=2 * r, **metres))
    design = listed(tmp_path, "\n".join([header, *rows]) + "\n")[0]
    assert design.labels == ("N001", "N002", "N003")
    np.testing.assert_allclose(design.centres, PLACES, atol=1e-6)  # of 3e9 mm: two steps
    np.testing.assert_allclose(design.radii, RADII)


def test_a_size_in_another_unit_than_the_coordinates_is_said(tmp_path):
    remarks = {one.code: one.values for one in listed(tmp_path, SURVEYED)[1]}
    assert remarks["units.node-sizes"] == {"column": "Diameter", "units": "mm", "other": "m"}
    assert remarks["units.node-list"]["columns"] == ("Easting", "Northing", "Height")
    plain = "id,x,y,z,radius\n1,0,0,0,0.075\n2,2,0,0,0.075\n"
    assert listed(tmp_path, plain)[1] == ()


@pytest.mark.parametrize(
    ("names", "ids", "labels"),
    [
        (["4", "2", "-7"], [4, 2, -7], ()),
        (["04", "2", "7"], [1, 2, 3], ("04", "2", "7")),
        (["1", "2", "99999999999999999"], [1, 2, 3], ("1", "2", "99999999999999999")),
    ],
)
def test_ids_that_are_whole_numbers_stay_numbers_and_all_others_are_texts(names, ids, labels):
    numbers, texts = node_list.numbered_names(names)
    assert (numbers.tolist(), texts) == (ids, labels)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("PointNo,Easting,Northing,Height\nN1,1,2,3\n", "correct the headings"),
        (SURVEYED.replace("N002", "N001"), "id N001 is given more than once"),
        (SURVEYED.replace("N002", ""), "expected a printable id of each node, found ''"),
        (SURVEYED.replace("N002", "a\x1bb"), "expected a printable id"),
        (SURVEYED.replace(",160", ",16000").replace(",130", ",13000"), r"usual for balls in none of m, mm and inch"),
        ("id,x,y,z,easting,northing,radius\n1,2,3,4,5,6,7\n", "one column each of x, y, z"),
    ],
)
def test_mistakes_in_a_list_are_named(tmp_path, text, why):
    with pytest.raises(InputError, match=rf"nodes\.csv: .*{why}"):
        listed(tmp_path, text)


def test_a_list_beside_a_scan_is_the_design_of_a_space_frame(tmp_path):
    write_xyz(tmp_path / "hall.xyz", surface())
    table = "Point,X,Y,Z,D\nA1,0,0,0.5,150\nA2,4,8,0.5,150\nB1,7,14,0.5,150\n"
    (tmp_path / "list of nodes.csv").write_text(table)
    scene = folder.read_input(tmp_path)
    assert (scene.kind, scene.frame.labels) == ("space-frame", ("A1", "A2", "B1"))
    assert [scan.name for scan in scene.scans] == ["hall"]
    assert "units.node-sizes" in {one.code for one in scene.units_reason}
    guessed = guess.guess(tmp_path)
    assert (guessed.kind, guessed.design) == ("space-frame", "list of nodes.csv")
    store.write_scene(tmp_path / "a.h5", scene, None, {})
    assert store.read_scene(tmp_path / "a.h5").frame.labels == scene.frame.labels
    again = tmp_path / "again"
    again.mkdir()
    project.write_design(scene, again, 1.0, with_meshes=False)
    assert [node["id"] for node in json.loads((again / "design.json").read_text())["nodes"]] == ["A1", "A2", "B1"]
    (tmp_path / "second.csv").write_text(table)
    with pytest.raises(InputError, match=r"list of nodes\.csv and second\.csv are lists of a frame's nodes; state the"):
        folder.read_input(tmp_path)


def test_a_table_of_points_with_sizes_of_no_balls_is_still_a_scan(tmp_path):
    write_xyz(tmp_path / "hall.csv", surface())
    assert not node_list.is_node_list(tmp_path / "hall.csv")
    (tmp_path / "cloud.csv").write_text("x,y,z,intensity,r\n1,2,3,4,5\n")
    assert not node_list.is_node_list(tmp_path / "cloud.csv")


def test_ids_of_members_in_a_design_may_be_texts(tmp_path):
    write_xyz(tmp_path / "hall.xyz", surface())
    nodes = [{"id": name, "centre": [4 * k, 8 * k, 0.5], "radius": 0.075} for k, name in enumerate(("N1", "N2", 3))]
    members = [{"a": "N1", "b": 3, "tube_diameter": 0.06}]
    design = {"units": "m", "kind": "space-frame", "nodes": nodes, "members": members}
    (tmp_path / "design.json").write_text(json.dumps(design))
    frame = folder.read_input(tmp_path).frame
    assert frame.names == ["N1", "N2", "3"]
    assert (frame.member_a.tolist(), frame.member_b.tolist()) == ([1], [3])
