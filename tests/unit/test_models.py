"""Scans of any model: hits against the CAD kernel's own distances, labels, stations, bodies as built, bad input."""

import dataclasses
import json
import logging

import cadquery as cq
import numpy as np
import pytest
import trimesh
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeVertex
from OCP.BRepExtrema import BRepExtrema_DistShapeShape
from OCP.gp import gp_Pnt

import designgen
from designgen.models import as_built, loading, placement
from designgen.models.model import of_mesh, unique
from designgen.scanning import returns, scanner, surfaces, survey
from designgen.scanning.surfaces import Builder
from designgen.scenes.model import recipe_of
from processor.model import InputError, UsageError

QUIET = scanner.Scanner(**{**scanner.preset("phase"), "flying_share": 0.0, "threshold": 0.0})
SPLINE = [(100, 0), (60, 80), (-70, 60), (-90, -40), (20, -90)]
SOLIDS = {
    "plane": cq.Workplane().box(300, 200, 100),
    "cylinder": cq.Workplane().circle(80).circle(60).extrude(300),
    "cone": cq.Workplane(cq.Solid.makeCone(120, 40, 200)),
    "sphere": cq.Workplane().sphere(100),
    "torus": cq.Workplane(cq.Solid.makeTorus(150, 40)),
    "extruded spline": cq.Workplane().spline(SPLINE, periodic=True).close().extrude(150),
    "loft": cq.Workplane().rect(200, 150).workplane(offset=120).circle(60).workplane(offset=100).rect(60, 90).loft(),
    "fillets and holes": cq.Workplane().box(300, 200, 60).edges("|Z").fillet(40).faces("<Z").workplane().hole(25),
}


def surfaces_of(model):
    builder = Builder()
    for part, body in enumerate(model):
        for patch, smooth in body.patches():
            builder.patch(part, patch, smooth)
    return builder.to_surfaces()


def hits_on(model, step_mrad=6.0, stations=4):
    """Places that the middles of whole footprints hit, in the model's frame."""
    found = []
    for name, T in placement.placed(model, stations, None, QUIET, 0).items():
        seen = returns.scan_station(
            surfaces_of(model.bodies), T, QUIET, scanner.Params(step_mrad=step_mrad), 1, name, keep_hits=True
        ).returns
        found.append(seen.hits[seen.source == 0] @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)


@pytest.mark.parametrize("kind", SOLIDS)
def test_hits_lie_on_the_surface_of_the_solid(kind):
    hits = hits_on(loading.load(SOLIDS[kind]))
    assert len(hits) > 300
    shell = cq.Compound.makeCompound(SOLIDS[kind].val().Shells()).wrapped
    picked = hits[np.random.default_rng(0).choice(len(hits), 300, replace=False)]
    vertices = (BRepBuilderAPI_MakeVertex(gp_Pnt(*hit)).Vertex() for hit in picked.tolist())
    distances = [BRepExtrema_DistShapeShape(vertex, shell).Value() for vertex in vertices]
    assert max(distances) < 1e-5, "a hit is refined to 1e-5 mm; 0.01 mm is promised"


def test_a_tree_of_triangles_gives_the_same_returns(monkeypatch):
    ball = trimesh.creation.icosphere(3, 800.0)
    body = of_mesh(
        "ball", np.asarray(ball.vertices) * [1, 0.6, 1.3] + [0, 3000, 200], np.array(ball.faces, np.int64), 1
    )
    found = []
    for many in (10, 10**9):
        monkeypatch.setattr(surfaces, "MANY", many)
        builder = Builder()
        for patch, smooth in body.patches():
            builder.patch(0, patch, smooth)
        builder.sphere(1, "pole", np.array([300.0, 1500.0, 0.0]), 100.0, [])
        scene, T = builder.to_surfaces(), survey.levelled_pose(np.zeros(3), 0.2)
        assert (scene.tree is None) == (many > 10)
        found.append(returns.scan_station(scene, T, scanner.Scanner(), scanner.Params(step_mrad=6.0), 1, "S1").returns)
    assert len(found[0].points) > 5_000
    for field in dataclasses.fields(found[0]):
        np.testing.assert_array_equal(getattr(found[0], field.name), getattr(found[1], field.name))


def assembly():
    made = cq.Assembly(name="frame")
    made.add(cq.Workplane().box(1000, 400, 20), name="plate")
    made.add(cq.Workplane().circle(60).extrude(600).translate((0, 0, 10)), name="tube")
    return made


FEW = {"scan.step_mrad": 4.0}


def test_labels_name_bodies_and_the_same_seed_gives_the_same_scene():
    scene, truth = designgen.scan(assembly(), stations=2, seed=5, settings=FEW)
    again, _ = designgen.scan(assembly(), stations=2, seed=5, settings=FEW)
    assert scene.kind == "structure"
    assert truth.labels[0].part_names == ("plate", "tube")
    assert len(truth.defects.ids) == 0
    assert not truth.structure.displacement.any()
    for scan, other, label in zip(scene.scans, again.scans, truth.labels, strict=True):
        np.testing.assert_array_equal(scan.points, other.points)
        points = scan.points @ scan.T_project_scan[:3, :3].T + scan.T_project_scan[:3, 3]
        tube = (label.part == 1) & (label.source == 0)
        radius = np.hypot(points[tube, 0], points[tube, 1])
        assert np.median(np.abs(radius[points[tube, 2] < 600.0] - 60.0)) < 2.0


def test_a_further_station_leaves_the_first_as_they_are_and_stations_are_given_by_a_file(tmp_path):
    model = loading.load(assembly())
    two, three = (placement.placed(model, n, None, QUIET, 3) for n in (2, 3))
    assert list(three) == ["S1", "S2", "S3"]
    for name, T in two.items():
        np.testing.assert_array_equal(T, three[name])
    file = tmp_path / "stations.json"
    file.write_text(json.dumps([{"id": "A", "position": [0, -3000, 500], "heading_deg": 90.0}]))
    np.testing.assert_allclose(placement.given(file, 0)["A"][:3, 3], [0, -3000, 500])
    file.write_text('{"A": {"position": [0, 1]}}')
    with pytest.raises(InputError, match="expected stations as"):
        placement.given(file, 0)


def test_stations_see_what_can_be_seen():
    """Of a box every face but those that no upright scanner sees is seen by the stations together."""
    model = loading.load(SOLIDS["plane"])
    _, truth = designgen.scan(SOLIDS["plane"], stations=6, settings=FEW)
    seen = set().union(*(set(label.surface.tolist()) for label in truth.labels)) - {-1}
    assert len(seen) == len(model.bodies[0].face_names) == 6


@pytest.mark.parametrize("source", ["solid", "mesh"])
def test_bodies_as_built_are_where_the_truth_has_them(source):
    plate = loading.load(cq.Workplane().box(1000, 400, 20))
    if source == "mesh":
        plate = loading.load((plate.bodies[0].vertices, plate.bodies[0].triangles))
    name = plate.bodies[0].name
    params = as_built.Params(dent_mm=5.0, dent_radius_mm=90.0, dent_at_mm=(100.0, 20.0, 10.0), move_mm=(0.0, 0.0, 7.0))
    built = as_built.build(plate, {name: params}, 0)
    assert built.defects.classes == ("dent", "misalignment")
    np.testing.assert_allclose(built.defects.depth_max_mm, [5.0, 7.0])
    hits = hits_on(dataclasses.replace(plate, bodies=built.bodies), 4.0)
    top = hits[(np.abs(hits[:, :2]) < [490, 190]).all(axis=1) & (hits[:, 2] > 5.0)]
    share = np.minimum(((top[:, :2] - [100.0, 20.0]) ** 2).sum(axis=1) / 90.0**2, 1.0)
    off = top[:, 2] - (17.0 - 5.0 * (1.0 - share) ** 2)
    assert (share < 0.5).sum() > 30
    assert np.abs(off).max() < (1e-5 if source == "solid" else 0.01)
    nearest = np.argmin(np.linalg.norm(built.movement.points - [100.0, 20.0, 10.0], axis=1))
    assert built.movement.displacement[nearest, 2] == pytest.approx(2.0, abs=0.3)


def test_bodies_that_bend_turn_and_are_left_out():
    beam = loading.load(cq.Workplane().box(2000, 100, 40))
    built = as_built.build(beam, {"model-1": as_built.Params(bend_mm=6.0, bend_along=(0.0, 0.0, 1.0))}, 0)
    hits = hits_on(dataclasses.replace(beam, bodies=built.bodies))
    top = hits[(np.abs(hits[:, 1]) < 40.0) & (np.abs(hits[:, 0]) < 900.0) & (hits[:, 2] > 15.0)]
    assert len(top) > 100
    np.testing.assert_allclose(top[:, 2], 20.0 + 6.0 * np.cos(np.pi * top[:, 0] / 2000.0), atol=0.01)
    turned = as_built.build(beam, {"model-1": as_built.Params(turn_deg=(0.0, 0.0, 90.0))}, 0).bodies[0]
    np.testing.assert_allclose(np.ptp(turned.vertices, axis=0), [100.0, 2000.0, 40.0], atol=1e-9)
    gone = as_built.build(beam, {"model-1": as_built.Params(missing=True)}, 0)
    assert gone.bodies == (None,)
    assert gone.defects.classes == ("missing-part",)
    assert gone.defects.volume_mm3[0] == pytest.approx(2000.0 * 100.0 * 40.0)
    with pytest.raises(UsageError, match="no body of this name; there are 1, as model-1"):
        as_built.params_of({"asbuilt": {"modell-1": {}}}, ["model-1"])


def test_files_come_back(tmp_path, caplog):
    step, python, stl = (tmp_path / name for name in ("part.step", "part.py", "part.stl"))
    cq.exporters.export(SOLIDS["plane"], str(step))
    python.write_text("import cadquery as cq\nresult = cq.Workplane().box(300, 200, 100)\n")
    trimesh.creation.box((300.0, 200.0, 100.0)).export(stl)
    for path in (step, python, stl):
        vertices, triangles = loading.load(path).mesh()
        np.testing.assert_allclose(np.ptp(vertices, axis=0), [300.0, 200.0, 100.0])
        assert len(triangles) == 12
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.say(loading.load(stl))
    assert "names no unit: its numbers are taken as mm" in caplog.text
    assert np.ptp(loading.load(stl, "inch").mesh()[0]) > 25.0 * 300.0 / 2.0


def test_a_recipe_names_a_model_beside_it(tmp_path):
    cq.exporters.export(SOLIDS["plane"], str(tmp_path / "part.step"))
    (tmp_path / "part.toml").write_text(
        'kind = "structure"\n[model]\nfile = "part.step"\n[scan]\nmode = "rays"\nstations = 1\nstep_mrad = 6.0\n'
        '[asbuilt."part-1"]\nmissing = false\nmove_mm = [0, 0, 5]\n'
    )
    names = loading.load(tmp_path / "part.step").bodies
    text = (tmp_path / "part.toml").read_text().replace("part-1", names[0].name)
    (tmp_path / "part.toml").write_text(text)
    scene, truth = designgen.make(tmp_path / "part.toml")
    assert len(scene.scans[0].points) > 100
    np.testing.assert_allclose(truth.structure.displacement, np.tile([0.0, 0.0, 5.0], (len(truth.structure.points), 1)))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.py", "import nothing_of_this_name", "ended with an error in line 1"),
        ("a.py", "x = 1", "expected a CadQuery .* in the variable result"),
        ("a.py", "result = 3", "found int"),
        ("a.stl", "solid x\nfacet", "is cut off"),
        ("a.obj", "v 0 0 0\n", "expected a mesh with faces"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "expected triangles with an area"),
        ("a.obj", "v 0 0 0\nf 1 2 9\n", "finite vertices"),
        ("a.ply", "no ply", "is damaged"),
        ("a.ifczip", "no zip", "is no zip file"),
        ("a.xyz", "", "expected a model"),
    ],
)
def test_bad_files_end_in_one_line(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=said) as error:
        loading.load(tmp_path / name)
    assert "\n" not in str(error.value)


def test_bad_meshes_are_repaired_or_reported():
    box = trimesh.creation.box((300.0, 200.0, 100.0))
    vertices, faces = np.asarray(box.vertices), np.array(box.faces, np.int64)
    mixed = faces.copy()
    mixed[::2] = mixed[::2, ::-1]
    for wrong, count in ((mixed, 6), (faces[:, ::-1], 12)):
        model = loading.load((vertices, wrong))
        points, triangles = model.mesh()
        assert trimesh.Trimesh(points, triangles, process=False).volume == pytest.approx(6e6)
        assert f"{count} of 12 triangles were turned" in " ".join(model.notes)
    assert "is not closed (3 open edges)" in " ".join(loading.load((vertices, faces[1:])).notes)
    two = loading.load((np.vstack([vertices, vertices + 1000.0]), np.vstack([faces, faces + len(vertices)])))
    assert [body.name for body in two.bodies] == ["model-1", "model-2"]
    # A cavity belongs to the body around it, and its normals point into it.
    hollow = np.vstack([vertices, 0.5 * vertices]), np.vstack([faces, faces[:, ::-1] + len(vertices)])
    (body,) = loading.load(hollow).bodies
    assert trimesh.Trimesh(body.vertices, body.triangles, process=False).volume == pytest.approx(6e6 * 7.0 / 8.0)


def test_names_are_unique_and_settings_are_checked():
    assert unique(["web", "web", "web (2)", "web"]) == ["web", "web (3)", "web (2)", "web (4)"]
    with pytest.raises(UsageError, match=r"expected a number from 1 or a \.json file"):
        recipe_of("a.step", "six", "phase", "", ())
    with pytest.raises(UsageError, match=r"set scan\.mode"):
        designgen.scan(assembly(), settings={"scan": {"mode": "surface"}})
