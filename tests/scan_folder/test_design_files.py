"""Designs of arch bridges and space frames, and meshes: what is read, and each mistake named."""

import dataclasses
import json

import numpy as np
import pytest

from processor.model import InputError
from processor.scan_folder import folder
from processor.store import store
from tests.support.files.scan_folders import BOX, TRIANGLES, arch_design, part, surface, write_ply, write_xyz


def test_joints_come_in_the_order_of_the_parts(bridge):
    design = arch_design()
    design["order"].append("foot2")
    design["components"]["foot2"] = part("rib1", 8000)
    design["joints"].insert(0, dict(design["joints"][0], name="J2", left="rib1", right="foot2"))
    (bridge / "design.json").write_text(json.dumps(design))
    arch = folder.read_input(bridge).arch
    assert (arch.joint_names, arch.joint_right) == (("J1", "J2"), ("rib1", "foot2"))


FRAME = {
    "units": "m",
    "kind": "space-frame",
    "nodes": [{"id": i, "centre": [i, 2 * i, 0.5], "radius": 0.075} for i in (4, 2, 7)],
    "members": [{"a": 4, "b": 2, "tube_diameter": 0.06}],
}


def test_a_space_frame(tmp_path):
    write_xyz(tmp_path / "hall.xyz", surface())
    (tmp_path / "design.json").write_text(json.dumps(FRAME))
    scene = folder.read_input(tmp_path)
    assert scene.kind == "space-frame"
    assert scene.frame.ids.tolist() == [4, 2, 7]
    assert scene.frame.centres[1].tolist() == [2000, 4000, 500]
    assert (scene.frame.radii == 75.0).all()
    assert (scene.frame.member_a[0], scene.frame.member_b[0], scene.frame.tube_diameters[0]) == (4, 2, 60.0)


@pytest.mark.parametrize(
    "table",
    [
        "id,x,y,z,radius\n4,4,8,0.5,0.075\n2,2,4,0.5,0.075\n7,7,14,0.5,0.075\n",
        "radius_mm;z_mm;y_mm;x_mm;id\n75,0;500;8000;4000;4\n75;500;4000;2000;2\n75;500;14000;7000;7\n\n",
    ],
)
def test_a_table_of_balls(tmp_path, table):
    write_xyz(tmp_path / "hall.xyz", surface())
    (tmp_path / "design.csv").write_text(table)
    frame = folder.read_input(tmp_path).frame
    assert frame.ids.tolist() == [4, 2, 7]
    assert frame.centres.tolist() == [[4000, 8000, 500], [2000, 4000, 500], [7000, 14000, 500]]
    assert frame.radii.tolist() == [75, 75, 75]


def test_the_projects_unit_precedes_that_of_the_command_for_a_table(tmp_path):
    write_xyz(tmp_path / "hall.xyz", surface())
    rows = "4,4000,8000,500,75\n2,2000,4000,500,75\n7,14000,7000,500,75\n"
    (tmp_path / "design.csv").write_text(f"id,x,y,z,radius\n{rows}")
    (tmp_path / "project.toml").write_text('units = "mm"\n')
    assert folder.read_input(tmp_path, "m").frame.radii.tolist() == [75, 75, 75]


def test_the_project_states_the_frame_of_the_design(tmp_path):
    write_xyz(tmp_path / "hall.xyz", surface())
    (tmp_path / "design.json").write_text(json.dumps(FRAME))
    assert folder.read_input(tmp_path).frame.coordinates is None
    (tmp_path / "project.toml").write_text('design_frame = "own"\n')
    scene = folder.read_input(tmp_path)
    assert scene.frame.coordinates == "own"
    store.write_scene(tmp_path / "a.h5", scene, None, {})
    assert store.read_scene(tmp_path / "a.h5").frame.coordinates == "own"
    without = dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, coordinates=None))
    assert store.scene_hash(scene) != store.scene_hash(without)


@pytest.mark.parametrize("suffix", [".stl", ".obj"])
def test_other_meshes(bridge, suffix):
    mesh = bridge / f"design/foot1{suffix}"
    corners = (BOX * 1000.0)[np.array(TRIANGLES)]
    if suffix == ".stl":
        loops = ["".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle) for triangle in corners]
        facets = "".join(f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n" for loop in loops)
        mesh.write_text(f"solid a\n{facets}endsolid a\n")
    else:
        lines = ["mtllib ../../outside.mtl", *(f"v {x} {y} {z}" for x, y, z in BOX * 1000.0)]
        mesh.write_text("\n".join(lines + ["f " + " ".join(str(i + 1) for i in face) for face in TRIANGLES]) + "\n")
    design = arch_design()
    design["components"]["foot1"]["mesh"] = f"design/foot1{suffix}"
    (bridge / "design.json").write_text(json.dumps(design))
    read = folder.read_input(bridge).arch.parts[0]
    assert np.array_equal(read.vertices[read.faces], corners)


def test_faces_of_four_corners_become_triangles(bridge):
    write_ply(bridge / "design/foot1.ply", BOX * 1000.0, [[0, 1, 3, 2], [4, 5, 7, 6, 2]])
    faces = folder.read_input(bridge).arch.parts[0].faces
    assert faces.tolist() == [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [4, 6, 2]]


def change(path, value):
    def apply(design):
        *place, last = path
        for key in place:
            design = design[key]
        if value is None:
            del design[last]
        else:
            design[last] = value

    return apply


DESIGNS = {
    "unit missing": (change(["units"], None), "expected a unit of length as 'units', found nothing"),
    "unit": (change(["units"], "ell"), "unknown unit 'ell'"),
    "kind": (change(["kind"], "tower"), "expected one of arch-bridge, space-frame as 'kind', found 'tower'"),
    "key": (change(["colour"], 1), "unknown key 'colour'"),
    "order": (change(["order"], ["foot1", "rib9"]), "expected each component"),
    "order twice": (change(["order"], ["foot1", "foot1", "rib1"]), "expected each component"),
    "order of numbers": (
        change(["order"], [1, 2]),
        "expected the names of the components from one end to the other as 'order'",
    ),
    "mesh missing": (
        change(["components", "rib1", "mesh"], None),
        r"components: rib1: without a mesh: expected the bottom edges to start at P1 and P2 .* 390 mm away",
    ),
    "mesh outside": (change(["components", "rib1", "mesh"], "../rib1.ply"), "leads out of the folder"),
    "mesh absent": (change(["components", "rib1", "mesh"], "design/x.ply"), "there is no file"),
    "mesh of STEP": (change(["components", "rib1", "mesh"], "design.json"), "expected a mesh"),
    "edge": (change(["components", "rib1", "bottom_edge_left"], [[1, 2]]), "shape n x 3 as 'bottom_edge_left'"),
    "edge of a point": (change(["components", "rib1", "bottom_edge_left"], [[1, 2, 3]]), "two points or more"),
    "edge of one place": (change(["components", "rib1", "bottom_edge_left"], [[1, 2, 3]] * 2), "none repeated"),
    "edge of NaN": (change(["components", "rib1", "bottom_edge_left"], [[1, 2, float("nan")]] * 2), "shape n x 3"),
    "joint missing": (change(["joints"], []), r"no joint of the neighbours 'foot1' \(left\) and 'rib1'"),
    "joint of others": (
        change(["joints", 0, "right"], "foot1"),
        "joint of 'foot1' and 'foot1', which are not neighbours",
    ),
    "point missing": (change(["joints", 0, "points", "P5"], None), "expected numbers of shape 3 as 'P5', found noth"),
    "point more": (change(["joints", 0, "points", "P9"], [1, 2, 3]), "unknown key 'P9'"),
    "huge number": (change(["joints", 0, "points", "P5"], [10**400, 0, 0]), "numbers of shape 3 as 'P5'"),
}


@pytest.mark.parametrize("case", DESIGNS)
def test_mistakes_in_a_design(bridge, case):
    apply, why = DESIGNS[case]
    design = arch_design()
    apply(design)
    (bridge / "design.json").write_text(json.dumps(design))
    with pytest.raises(InputError, match=why) as caught:
        folder.read_input(bridge)
    assert str(bridge) in str(caught.value)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ("id,x,y,z\n1,2,3,4\n", "expected columns id,x,y,z,radius"),
        ("id,x_mm,y_m,z_m,radius_m\n1,2,3,4,5\n", "of one unit"),
        ("id,x,y,z,radius\n1,2,3,4\n", "line 2: expected id,x,y,z,radius"),
        ("id,x,y,z,radius\n1,2,3,4,nan\n", "line 2: expected finite numbers"),
        ("\nid;x;y;z;radius\n\n1;2;3;4;5\n2;3;4;5;nan\n", "line 5: expected finite numbers"),
        ("id,x,y,z,radius\n", "expected nodes, found none"),
        ("", "expected columns"),
    ],
)
def test_mistakes_in_a_table_of_balls(tmp_path, table, why):
    write_xyz(tmp_path / "hall.xyz", surface())
    (tmp_path / "design.csv").write_text(table)
    with pytest.raises(InputError, match=why):
        folder.read_input(tmp_path)


def test_bad_meshes(bridge):
    mesh = bridge / "design/rib1.ply"
    write_ply(mesh, BOX, [[0, 1, 8]])
    with pytest.raises(InputError, match=r"rib1\.ply: .*faces of vertices that do not exist"):
        folder.read_input(bridge)
    write_ply(mesh, BOX, [])
    with pytest.raises(InputError, match=r"rib1\.ply: expected a mesh with faces"):
        folder.read_input(bridge)
    mesh.write_text("solid")
    with pytest.raises(InputError, match=r"rib1\.ply: not a readable PLY"):
        folder.read_input(bridge)


def test_unreadable_json_of_a_design_is_refused(bridge):
    for text in ("{", "[" * 100_000, "[]"):
        (bridge / "design.json").write_text(text)
        with pytest.raises(InputError, match=r"design\.json: (not readable JSON|expected a table)"):
            folder.read_input(bridge)
