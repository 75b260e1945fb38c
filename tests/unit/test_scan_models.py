"""Scans of models: points on the CAD kernel's surfaces, labels, bodies as built by formula, bad models refused."""

import json
import logging
import sys
from types import SimpleNamespace

import cadquery as cq
import numpy as np
import pytest

import designgen
from designgen import __main__, recipe_files
from designgen.models import loading, placement
from designgen.scanning import scanner
from designgen.scenes import make
from processor.model import InputError, UsageError

QUIET = {"scan.scanner": "plain-2mm", "scanner.noise_mm": 0.0, "scan.step_mrad": 2.5}
TOLERANCE_MM = 0.01  # of points on a CAD model, stated in docs/simulation.md
NAMES = ("box", "cylinder", "cone", "ball", "torus", "spline")
CORNERS = np.array([[x, y, z] for z in (0.0, 900.0) for y in (0.0, 900.0) for x in (0.0, 900.0)])
SIDES = np.array(
    [
        *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
        *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
    ]
)
EMPTY_STEP = (
    "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
    "FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n"
)


def mesh_text(faces, vertices=CORNERS, name="plain"):
    """A mesh as the text of an STL file."""
    lines = [f"solid {name}"]
    for face in faces:
        corners = "\n".join("vertex {} {} {}".format(*vertices[k]) for k in face)
        lines.append(f"facet normal 0 0 0\nouter loop\n{corners}\nendloop\nendfacet")
    return "\n".join([*lines, f"endsolid {name}\n"])


def shapes():
    outline = [(0, 0), (100, 120), (300, 40), (400, 100)]
    spline = cq.Workplane().moveTo(1200, 600).spline([(1200 + x, 600 + y) for x, y in outline[1:]], includeCurrent=True)
    return {
        "box": cq.Solid.makeBox(400, 300, 200),
        "cylinder": cq.Solid.makeCylinder(80, 300, cq.Vector(700, 0, 0)),
        "cone": cq.Solid.makeCone(120, 40, 250, cq.Vector(0, 700, 0)),
        "ball": cq.Solid.makeSphere(150, cq.Vector(700, 700, 150), angleDegrees1=-90),
        "torus": cq.Solid.makeTorus(150, 40, cq.Vector(1400, 0, 40)),
        "spline": spline.lineTo(1600, 900).lineTo(1200, 900).close().extrude(150).val(),
    }


def assembly(of):
    whole = cq.Assembly(name="whole")
    for name, shape in of.items():
        whole.add(shape, name=name)
    return whole


def joined(scene, truth):
    """All points in the project's frame, with the names of their body and face."""
    columns = []
    for scan, label in zip(scene.scans, truth.labels, strict=True):
        T = scan.T_project_scan
        faces = [(*label.surface_names, "")[k] for k in label.surface]
        columns.append((scan.points @ T[:3, :3].T + T[:3, 3], np.take(label.part_names, label.part), faces))
    return tuple(np.concatenate(column) for column in zip(*columns, strict=True))


def departures(points, shape):
    """Distances of points from a shape, mm, by the CAD kernel (BRepExtrema)."""
    return np.array([cq.Vertex.makeVertex(*point).distance(shape) for point in points])


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["designgen", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        __main__.main()
    return ended.value.code or 0


@pytest.fixture(scope="module")
def seen():
    made = shapes()
    points, bodies, faces = joined(*designgen.scan(assembly(made), stations=4, seed=1, settings=QUIET))
    return SimpleNamespace(shapes=made, points=points, bodies=bodies, faces=faces)


@pytest.mark.parametrize("name", NAMES)
def test_points_lie_on_the_face_that_their_label_names(seen, name):
    faces = seen.shapes[name].Faces()
    names = np.unique(seen.faces[seen.bodies == name])
    assert len(names) >= len(faces) - 1, "the scanner sees every face but the bottom"
    for face in names:
        rows = np.flatnonzero((seen.bodies == name) & (seen.faces == face))
        points = seen.points[rows[:: len(rows) // 40 + 1]]
        assert departures(points, faces[int(face.removeprefix("face ")) - 1]).max() < TOLERANCE_MM, face


def test_a_step_file_by_the_command(tmp_path, monkeypatch, capsys, caplog):
    whole = cq.Workplane().box(8, 4, 3).edges("|Z").fillet(1).faces(">Z").workplane().hole(2.0)
    path, output = tmp_path / "part.step", tmp_path / "out.h5"
    cq.exporters.export(whole, str(path))
    settings = [part for key, value in QUIET.items() for part in ("--set", f"{key}={value}")]
    arguments = ["scan", path, "-o", output, "--stations", 2, "--units", "inch", "--seed", 3, *settings, "--json"]
    assert run(monkeypatch, *arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["scene"], printed["seed"], printed["scans"]) == (str(output), 3, 2)
    assert caplog.messages == ["part: its numbers are in inch (25.4 mm, given by --units); the scene is in mm"]
    scene, truth = designgen.scan(path, 2, seed=3, units="inch", settings=QUIET)
    points = joined(scene, truth)[0]
    assert len(points) == printed["points"]
    shape = whole.val().scale(25.4)
    assert departures(points[:: len(points) // 200 + 1], shape.Shells()[0]).max() < TOLERANCE_MM
    assert np.ptp(scene.structure.vertices, axis=0) == pytest.approx([203.2, 101.6, 76.2], abs=0.01)


def test_same_seed_same_bytes_and_a_recipe_is_the_same_as_the_command(tmp_path, monkeypatch):
    (tmp_path / "cube.stl").write_text(mesh_text(SIDES))
    (tmp_path / "cube.toml").write_text(
        'kind = "structure"\n[model]\nfile = "cube.stl"\n[scan]\nmode = "rays"\nstations = [2]\nstep_mrad = 5.0\n'
    )
    monkeypatch.chdir(tmp_path)
    for output, seed in (("a.h5", 1), ("b.h5", 1), ("c.h5", 2)):
        wanted = ["--stations", 2, "--seed", seed, "--set", "scan.step_mrad=5.0"]
        assert run(monkeypatch, "scan", "cube.stl", "-o", output, *wanted) == 0
    one, same, other = ((tmp_path / name).read_bytes() for name in ("a.h5", "b.h5", "c.h5"))
    assert one == same
    assert one != other
    monkeypatch.chdir("/")  # the model is beside its recipe
    scene, _ = designgen.make(tmp_path / "cube.toml", seed=1)
    direct, _ = designgen.scan(tmp_path / "cube.stl", 2, seed=1, settings={"scan.step_mrad": 5.0})
    for a, b in zip(scene.scans, direct.scans, strict=True):
        assert a.points.tobytes() == b.points.tobytes()


@pytest.fixture(scope="module")
def as_built():
    made = {
        "moved": cq.Solid.makeCylinder(80, 300, cq.Vector(700, 0, 0)),
        "dented": cq.Solid.makeBox(400, 300, 200),
        "gone": cq.Solid.makeBox(100, 100, 100, cq.Vector(0, 600, 0)),
    }
    deviations = {
        "asbuilt.moved.move_mm": [10.0, 0.0, 0.0],
        "asbuilt.dented.dent_mm": 8.0,
        "asbuilt.dented.dent_radius_mm": 60.0,
        "asbuilt.dented.dent_at_mm": [200.0, 150.0, 200.0],
        "asbuilt.gone.missing": True,
    }
    scene, truth = designgen.scan(assembly(made), 4, seed=1, settings={**QUIET, **deviations})
    points, bodies, _ = joined(scene, truth)
    return SimpleNamespace(shapes=made, points=points, bodies=bodies, truth=truth, scene=scene)


def test_a_moved_body_and_its_truth(as_built):
    rows = np.flatnonzero(as_built.bodies == "moved")
    there = as_built.shapes["moved"].moved(cq.Location(cq.Vector(10, 0, 0)))
    assert departures(as_built.points[rows[:: len(rows) // 100 + 1]], there.Shells()[0]).max() < TOLERANCE_MM
    truth, defects = as_built.truth.structure, as_built.truth.defects
    on_it = truth.points[:, 0] > 610.0
    assert on_it.sum() > 1000
    np.testing.assert_allclose(truth.displacement[on_it], np.tile([10.0, 0.0, 0.0], (on_it.sum(), 1)), atol=1e-9)
    assert dict(zip(defects.components, defects.classes, strict=True)) == {
        "moved": "misalignment",
        "dented": "dent",
        "gone": "missing-part",
    }
    assert defects.depth_max_mm[0] == pytest.approx(10.0, abs=0.05)
    design = as_built.scene.structure.vertices
    assert design[:, 0].max() == pytest.approx(780.0, abs=0.01), "the design is not moved"


def test_a_dent_has_its_shape(as_built):
    x, y, z = as_built.points[as_built.bodies == "dented"].T
    top = (z > 150.0) & (np.hypot(x - 200.0, y - 150.0) < 140.0)
    share = np.minimum(np.hypot(x - 200.0, y - 150.0)[top] / 60.0, 1.0) ** 2
    assert (share < 0.5).sum() > 50
    np.testing.assert_allclose(z[top], 200.0 - 8.0 * (1.0 - share) ** 2, atol=TOLERANCE_MM)
    truth = as_built.truth.structure
    middle = np.hypot(*(truth.points - [200.0, 150.0, 200.0]).T[:2]) < 5.0
    middle &= truth.points[:, 2] > 199.0
    assert middle.any()
    np.testing.assert_allclose(truth.displacement[middle], np.tile([0.0, 0.0, -8.0], (middle.sum(), 1)), atol=0.15)
    defects = as_built.truth.defects
    assert defects.volume_mm3[1] == pytest.approx(np.pi * 60.0**2 * 8.0 / 3.0)  # 2 pi int r (1 - r2/R2)^2 dr


def test_a_body_left_out_returns_no_points(as_built):
    assert set(as_built.bodies) == {"moved", "dented"}
    assert as_built.truth.defects.volume_mm3[2] == pytest.approx(1e6)


@pytest.mark.parametrize(
    ("faces", "note"),
    [
        (SIDES[1:], "'cube' is not closed (3 open edges): it is scanned as it is, from both sides"),
        (SIDES[:, ::-1], "'cube': 12 of 12 triangles were turned so that all normals point outward"),
        (np.array([f[::-1] if k in (2, 7) else f for k, f in enumerate(SIDES)]), "'cube': 2 of 12 triangles were"),
    ],
    ids=["hole", "inside out", "mixed"],
)
def test_a_mesh_with_a_hole_or_turned_faces(faces, note, tmp_path):
    (tmp_path / "cube.stl").write_text(mesh_text(faces, name=""))
    model = loading.load(tmp_path / "cube.stl")
    assert sum(note in found for found in model.notes) == 1
    (body,) = model.bodies
    corners = body.vertices[body.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ni,ni->n", outward, corners.mean(axis=1) - 450.0) > 0.0).all()


def test_bodies_of_one_name_are_numbered(tmp_path, caplog):
    text = mesh_text(SIDES, name="rib") + mesh_text(SIDES, CORNERS + 2000.0, name="rib")
    (tmp_path / "two.stl").write_text(text)
    model = loading.load(tmp_path / "two.stl", "mm")
    assert [body.name for body in model.bodies] == ["rib", "rib (2)"]
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.say(model)
    assert caplog.messages == [
        "two: 2 bodies share 1 name(s), as 'rib' 2 times: they are numbered, 'rib', 'rib (2)', ..."
    ]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.step", EMPTY_STEP, "holds no geometry"),
        ("a.step", "", "expected a STEP or IFC text file"),
        ("a.stl", "solid a\nendsolid a\n", "expected a mesh with faces, found none"),
        ("a.stl", mesh_text([[0, 0, 1]]), "expected triangles with an area, found none"),
        ("a.stl", mesh_text(SIDES)[:500], "is cut off"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "is damaged"),
        ("a.txt", "", "expected a model"),
        ("a.py", "x = 1\n\nx / 0\n", "ended with an error in line 3 (ZeroDivisionError"),
        ("a.py", "x = 1\n", "in the variable result, which it does not set"),
        ("a.py", "result = 3\n", "found int"),
    ],
)
def test_a_bad_model_is_one_line_and_exit_code_3(name, content, message, tmp_path, monkeypatch, capsys):
    (tmp_path / name).write_text(content)
    assert run(monkeypatch, "scan", tmp_path / name, "-o", tmp_path / "out.h5") == 3
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert message in errors[0]
    assert str(tmp_path / name) in errors[0]
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "scan.nothing=1"], "scan.nothing"),
        (["--set", "asbuilt.nobody.dent_mm=1"], "the model has no body of this name; there are 1, as cube"),
        (["--set", "asbuilt.cube.dint_mm=1"], "asbuilt.cube.dint_mm"),
        (["--set", "asbuilt.cube.move_mm=1"], "move_mm"),
        (["--set", "modle.file=x"], "unknown key 'modle'"),
        (["--scanner", "nobody"], "nobody"),
        (["--units", "parsec"], "parsec"),
        (["--stations", "0"], "stations"),
        (["--stations", "many"], "--stations many: expected a number from 1 or a .json file"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments, message, tmp_path, monkeypatch, capsys):
    (tmp_path / "cube.stl").write_text(mesh_text(SIDES, name=""))
    assert run(monkeypatch, "scan", tmp_path / "cube.stl", "-o", tmp_path / "out.h5", *arguments) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert "Traceback" not in errors


def test_stations_from_a_file_and_placed(tmp_path):
    path = tmp_path / "places.json"
    path.write_text('{"A": {"position": [3000, 450, 1500], "heading_deg": 90}, "B": {"position": [450, -2500, 900]}}')
    scene, _ = designgen.scan((CORNERS, SIDES), stations=path, settings={**QUIET, "scan.step_mrad": 5.0})
    assert [scan.station for scan in scene.scans] == ["A", "B"]
    assert [scan.T_project_scan[:3, 3].tolist() for scan in scene.scans] == [[3000, 450, 1500], [450, -2500, 900]]
    np.testing.assert_allclose(scene.scans[0].T_project_scan[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    device = scanner.Scanner(**scanner.preset("phase"))
    model = loading.load((CORNERS, SIDES))
    few, many = (placement.placed(model, count, None, device, 1) for count in (2, 4))
    for name, T in few.items():
        np.testing.assert_array_equal(T, many[name])
    for wrong in ("{}", "[1]", '{"A": {"position": [1, 2]}}', '{"A": {"position": [1, 2, 3], "heading_deg": "x"}}'):
        path.write_text(wrong)
        with pytest.raises(InputError, match=r"places\.json: expected stations as"):
            placement.given(path, 1)


def test_a_model_is_scanned_by_rays():
    recipe = {"kind": "structure", "model": {"file": "x.stl"}}
    with pytest.raises(UsageError, match=r"scan\.mode"):
        make.make("x", recipe_files.overridden(recipe, []), 0)
