"""Scans of models: points and hits on the CAD kernel's surfaces, labels, stations, bodies as built, bad models."""

import dataclasses
import json
import logging
from types import SimpleNamespace

import cadquery as cq
import numpy as np
import pytest
import trimesh

import designgen
from designgen import recipe_files
from designgen.models import as_built, body_deviations, loading, station_placement
from designgen.models.model import of_mesh, unique_names
from designgen.scanning import ray_kernels, returns, scanner, surfaces, survey
from designgen.scanning.facets import Facets
from designgen.scanning.surfaces import Builder
from designgen.scenes import make
from processor.model import InputError, UsageError
from processor.store import store
from tests.support.processes import commands

pytestmark = pytest.mark.usefixtures("cad_here")
QUIET = scanner.Scanner(**{**scanner.preset("phase"), "flying_share": 0.0, "threshold": 0.0})
FINE = {"scan.scanner": "plain-2mm", "scanner.noise_mm": 0.0, "scan.step_mrad": 4.5}
FEW = {"scan.step_mrad": 4.0}
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
SPLINE = [(50, 0), (30, 40), (-35, 30), (-45, -20), (10, -45)]
SOLIDS = {
    "plane": cq.Workplane().box(300, 200, 100),
    "extruded spline": cq.Workplane().spline(SPLINE, periodic=True).close().extrude(80),
    "loft": cq.Workplane().rect(200, 150).workplane(offset=120).circle(60).workplane(offset=100).rect(60, 90).loft(),
    "fillets and holes": cq.Workplane().box(300, 200, 60).edges("|Z").fillet(40).faces("<Z").workplane().hole(25),
}


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
    whole = {
        "box": cq.Solid.makeBox(400, 300, 200),
        "cylinder": cq.Solid.makeCylinder(80, 300, cq.Vector(700, 0, 0)),
        "cone": cq.Solid.makeCone(120, 40, 250, cq.Vector(0, 700, 0)),
        "ball": cq.Solid.makeSphere(150, cq.Vector(700, 700, 150), angleDegrees1=-90),
        "torus": cq.Workplane().center(1400, 0).circle(40).revolve(90, (-150, 0, 0), (-150, 1, 0)).val(),
        "spline": spline.lineTo(1600, 900).lineTo(1200, 900).close().extrude(150).val(),
    }
    return {name: shape.scale(0.3) for name, shape in whole.items()}


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


def run(*arguments):
    return commands.here("designgen", *arguments)


def hits_on(model, step_mrad=6.0, stations=2):
    """Places that the middles of whole footprints hit, in the model's frame."""
    builder = Builder()
    for part, body in enumerate(model.bodies):
        for patch, smooth in body.patches():
            builder.patch(part, patch, smooth)
    found, surfaces, params = [], builder.to_surfaces(), scanner.Params(step_mrad=step_mrad)
    for name, T in station_placement.place_stations(model, stations, None, QUIET, 0).items():
        seen = returns.scan_station(surfaces, T, QUIET, params, 1, name, keep_hits=True).returns
        found.append(seen.hits[seen.source == 0] @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)


# --- points, hits and labels ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen():
    made = shapes()
    scene, truth = designgen.scan(assembly(made), stations=4, seed=1, settings=FINE)
    points, bodies, faces = joined(scene, truth)
    return SimpleNamespace(shapes=made, scene=scene, truth=truth, points=points, bodies=bodies, faces=faces)


@pytest.mark.parametrize("name", NAMES)
def test_points_lie_on_the_face_that_their_label_names(seen, name):
    faces = seen.shapes[name].Faces()
    names = np.unique(seen.faces[seen.bodies == name])
    assert len(names) >= len(faces) - 1, "the scanner sees every face but the bottom"
    for face in names:
        rows = np.flatnonzero((seen.bodies == name) & (seen.faces == face))
        points = seen.points[rows[:: len(rows) // 8 + 1]]
        assert departures(points, faces[int(face.removeprefix("face ")) - 1]).max() < TOLERANCE_MM, face


def test_labels_name_bodies_and_bodies_as_designed_have_no_defect(seen):
    assert all(label.part_names == NAMES for label in seen.truth.labels)
    assert len(seen.truth.defects.ids) == 0
    assert len(seen.truth.structure.displacement) > 1000
    assert not seen.truth.structure.displacement.any()


@pytest.mark.parametrize("kind", [kind for kind in SOLIDS if kind != "plane"])
def test_hits_lie_on_the_surface_of_the_solid(kind):
    hits = hits_on(loading.load(SOLIDS[kind]))
    assert len(hits) > 100
    picked = hits[np.random.default_rng(0).permutation(len(hits))[:40]]  # a face that lies wrong has many of them
    distances = departures(picked, cq.Compound.makeCompound(SOLIDS[kind].val().Shells()))
    assert max(distances) < 1e-5, "a hit is refined to 1e-5 mm; 0.01 mm is promised"


def test_a_tree_of_triangles_gives_the_same_returns(monkeypatch):
    """Of three bodies in one place, too: the first has the hits. Float32 decides at edges alone: 0.01 mm there."""
    ball = trimesh.creation.icosphere(3, 800.0)
    body = of_mesh(
        "ball", np.asarray(ball.vertices) * [1, 0.6, 1.3] + [0, 3000, 200], np.array(ball.faces, np.int64), 1
    )
    found = []
    for many in (10, 10**9):
        monkeypatch.setattr(surfaces, "MANY", many)
        builder = Builder()
        for part in (0, 2, 3):
            for patch, smooth in body.patches():
                builder.patch(part, patch, smooth)
        builder.sphere(1, "pole", np.array([300.0, 1500.0, 0.0]), 100.0, [])
        scene, T = builder.to_surfaces(), survey.levelled_pose(np.zeros(3), 0.2)
        assert (scene.facets is None) == (many > 10)
        found.append(returns.scan_station(scene, T, scanner.Scanner(), scanner.Params(step_mrad=6.0), 1, "S1").returns)
    assert len(found[0].points) > 5_000
    for field in dataclasses.fields(found[0]):
        np.testing.assert_allclose(getattr(found[0], field.name), getattr(found[1], field.name), 1e-6, 0.01)
    assert set(found[0].part) <= {-1, 0, 1}


def test_rays_from_inside_a_closed_mesh_all_hit_it_at_its_edges_too():
    """At edges float32 may give the facet beside; a ray that misses it in float64 has the range where it passes."""
    ball = trimesh.creation.icosphere(5, 5000.0)
    corners = np.add(ball.triangles, [40_000.0, 0.0, 0.0])
    share = np.random.default_rng(0).random((len(corners), 1))
    onto = np.concatenate([corners[:, 0] + share * (corners[:, 1] - corners[:, 0]), corners.mean(axis=1)])
    # By 1 um off the edge: more than the slack of the test in float64, less than float32 resolves.
    onto += np.random.default_rng(1).normal(0.0, 1e-3, onto.shape)
    place = np.array([44_990.0, 3.0, 2.0])  # 10 mm from the wall: many rays graze it
    rays = (onto - place) / np.linalg.norm(onto - place, axis=1)[:, None]
    facets = Facets.of(corners)
    met = facets.first(place, rays)
    assert (met >= 0).all()
    shape, range_ = np.full(len(met), -1), np.full(len(met), np.inf)
    ray_kernels.meet(corners, np.arange(len(corners)), place, rays, met, 1e9, shape, range_)
    assert (shape == met).all()
    points = place + range_[:, None] * rays - [40_000.0, 0.0, 0.0]
    assert trimesh.proximity.closest_point(ball, points)[1].max() < TOLERANCE_MM
    assert not facets.free(np.broadcast_to(place, onto.shape), place + 2.0 * (onto - place)).any()
    assert facets.free(np.broadcast_to(place, corners[:, 0].shape), corners.mean(axis=1)).mean() > 0.999  # a few graze


def test_a_step_file_by_the_command(tmp_path, caplog):
    whole = cq.Workplane().box(8, 4, 3).edges("|Z").fillet(1).faces(">Z").workplane().hole(2.0)
    path, output = tmp_path / "part.step", tmp_path / "out.h5"
    cq.exporters.export(whole, str(path))
    settings = [part for key, value in FINE.items() for part in ("--set", f"{key}={value}")]
    arguments = ["scan", path, "-o", output, "--stations", 2, "--units", "inch", "--seed", 3, *settings, "--json"]
    printed = json.loads(run(*arguments).stdout)
    assert (printed["scene"], printed["seed"], printed["scans"]) == (str(output), 3, 2)
    assert caplog.messages == [
        "part: its numbers are in inch (25.4 mm, given by --units); the scene is in mm",
        "part: 1 bodies have no names in the file: they are numbered, as part-1",
    ]
    scene, truth = designgen.scan(path, 2, seed=3, units="inch", settings=FINE)
    points = joined(scene, truth)[0]
    assert len(points) == printed["points"]
    shape = whole.val().scale(25.4)
    assert departures(points[:: len(points) // 40 + 1], shape.Shells()[0]).max() < TOLERANCE_MM
    assert np.ptp(scene.structure.vertices, axis=0) == pytest.approx([203.2, 101.6, 76.2], abs=TOLERANCE_MM)


def test_same_seed_same_bytes_and_a_recipe_is_the_same_as_the_command(tmp_path, monkeypatch):
    (tmp_path / "cube.stl").write_text(mesh_text(SIDES))
    (tmp_path / "cube.toml").write_text(
        'kind = "structure"\n[model]\nfile = "cube.stl"\n[scan]\nmode = "rays"\nstations = [2]\nstep_mrad = 5.0\n'
    )
    monkeypatch.chdir(tmp_path)
    for output, seed in (("a.h5", 1), ("b.h5", 1), ("c.h5", 2)):
        wanted = ["--stations", 2, "--seed", seed, "--set", "scan.step_mrad=5.0"]
        assert run("scan", "cube.stl", "-o", output, *wanted).returncode == 0
    one, same, other = ((tmp_path / name).read_bytes() for name in ("a.h5", "b.h5", "c.h5"))
    assert one == same != other
    monkeypatch.chdir("/")  # the model is beside its recipe
    scene, _ = designgen.make(tmp_path / "cube.toml", seed=1)
    direct, _ = designgen.scan(tmp_path / "cube.stl", 2, seed=1, settings={"scan.step_mrad": 5.0})
    for a, b in zip(scene.scans, direct.scans, strict=True):
        assert a.points.tobytes() == b.points.tobytes()


def test_models_in_step_python_and_stl_are_loaded_with_their_size(tmp_path, caplog):
    step, python, stl = (tmp_path / name for name in ("part.step", "part.py", "part.stl"))
    cq.exporters.export(SOLIDS["plane"], str(step))
    python.write_text("import cadquery as cq\nresult = cq.Workplane().box(300, 200, 100)\n")
    trimesh.creation.box((300.0, 200.0, 100.0)).export(stl)
    for path in (step, python, stl):
        vertices, triangles = loading.load(path).mesh()
        np.testing.assert_allclose(np.ptp(vertices, axis=0), [300.0, 200.0, 100.0])
        assert len(triangles) == 12
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.log_notes(loading.load(stl))
    assert "names no unit: its numbers are taken as mm" in caplog.text
    assert np.ptp(loading.load(stl, "inch").mesh()[0]) > 25.0 * 300.0 / 2.0


# --- stations ---------------------------------------------------------------------------------------------------------


def test_stations_from_a_file_and_placed(tmp_path):
    path = tmp_path / "places.json"
    path.write_text('{"A": {"position": [3000, 450, 1500], "heading_deg": 90}, "B": {"position": [450, -2500, 900]}}')
    scene, _ = designgen.scan((CORNERS, SIDES), stations=path, settings={**FINE, "scan.step_mrad": 5.0})
    assert [scan.station for scan in scene.scans] == ["A", "B"]
    assert [scan.T_project_scan[:3, 3].tolist() for scan in scene.scans] == [[3000, 450, 1500], [450, -2500, 900]]
    np.testing.assert_allclose(scene.scans[0].T_project_scan[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)  # float64
    device = scanner.Scanner(**scanner.preset("phase"))
    model = loading.load((CORNERS, SIDES))
    few, more, many = (station_placement.place_stations(model, count, None, device, 1) for count in (2, 3, 4))
    assert list(more) == ["S1", "S2", "S3"]
    for name, T in few.items():
        np.testing.assert_array_equal(T, more[name])
        np.testing.assert_array_equal(T, many[name])
    path.write_text(json.dumps([{"id": "A", "position": [0, -3000, 500], "heading_deg": 90.0}]))
    np.testing.assert_allclose(station_placement.read_stations(path, 0)["A"][:3, 3], [0, -3000, 500])
    for wrong in ("{}", "[1]", '{"A": {"position": [1, 2]}}', '{"A": {"position": [1, 2, 3], "heading_deg": "x"}}'):
        path.write_text(wrong)
        with pytest.raises(InputError, match=r"places\.json: expected stations as"):
            station_placement.read_stations(path, 1)


def test_placed_stations_see_every_visible_face_of_a_box():
    """Of a box every face but those that no upright scanner sees is seen by the stations together."""
    model = loading.load(SOLIDS["plane"])
    _, truth = designgen.scan(SOLIDS["plane"], stations=6, settings=FEW)
    seen = set().union(*(set(label.surface.tolist()) for label in truth.labels)) - {-1}
    assert len(seen) == len(model.bodies[0].face_names) == 6


# --- bodies as built --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built():
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
    scene, truth = designgen.scan(assembly(made), 4, seed=1, settings={**FINE, **deviations})
    points, bodies, _ = joined(scene, truth)
    return SimpleNamespace(shapes=made, points=points, bodies=bodies, truth=truth, scene=scene)


def test_a_moved_body_and_its_truth(built):
    rows = np.flatnonzero(built.bodies == "moved")
    there = built.shapes["moved"].moved(cq.Location(cq.Vector(10, 0, 0)))
    assert departures(built.points[rows[:: len(rows) // 20 + 1]], there.Shells()[0]).max() < TOLERANCE_MM
    truth, defects = built.truth.structure, built.truth.defects
    on_it = truth.points[:, 0] > 610.0
    assert on_it.sum() > 1000
    assert np.abs(truth.displacement[on_it] - [10.0, 0.0, 0.0]).max() < 1e-9  # float64
    assert dict(zip(defects.components, defects.classes, strict=True)) == {
        "moved": "misalignment",
        "dented": "dent",
        "gone": "missing-part",
    }
    assert defects.depth_max_mm[0] == pytest.approx(10.0, abs=0.05)  # at points of the net, spread over the body
    design = built.scene.structure.vertices
    assert design[:, 0].max() == pytest.approx(780.0, abs=TOLERANCE_MM), "the design is not moved"
    assert set(built.bodies) == {"moved", "dented"}
    assert defects.volume_mm3[2] == pytest.approx(1e6)


def test_the_truth_names_bodies_and_their_movements(built, tmp_path):
    bodies, points = built.truth.structure.bodies, built.truth.structure.points
    assert bodies.names == ("moved", "dented", "gone")
    assert bodies.moved.tolist() == [True, False, False]
    np.testing.assert_array_equal(bodies.shift, [[10.0, 0.0, 0.0], [0.0] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(bodies.of_point == 0, points[:, 0] > 610.0)
    assert set(bodies.of_point.tolist()) == {0, 1}
    store.write_scene(tmp_path / "s.h5", built.scene, built.truth, {})
    again = store.read_truth(tmp_path / "s.h5", labels=False).structure.bodies
    np.testing.assert_array_equal(again.of_point, bodies.of_point)
    assert again.names == bodies.names


def test_a_dent_has_its_shape(built):
    x, y, z = built.points[built.bodies == "dented"].T
    top = (z > 150.0) & (np.hypot(x - 200.0, y - 150.0) < 140.0)
    share = np.minimum(np.hypot(x - 200.0, y - 150.0)[top] / 60.0, 1.0) ** 2
    assert (share < 0.5).sum() > 50
    np.testing.assert_allclose(z[top], 200.0 - 8.0 * (1.0 - share) ** 2, atol=TOLERANCE_MM)
    truth = built.truth.structure
    middle = np.hypot(*(truth.points - [200.0, 150.0, 200.0]).T[:2]) < 5.0
    middle &= truth.points[:, 2] > 199.0
    assert middle.any()
    assert np.abs(truth.displacement[middle] - [0.0, 0.0, -8.0]).max() < 0.15  # 5 mm off the middle: 0.11
    defects = built.truth.defects
    assert defects.volume_mm3[1] == pytest.approx(np.pi * 60.0**2 * 8.0 / 3.0)  # 2 pi int r (1 - r2/R2)^2 dr


def test_a_body_of_a_mesh_that_is_dented_and_moved_is_where_the_truth_has_it():
    plate = loading.load(cq.Workplane().box(1000, 400, 20))
    plate = loading.load((plate.bodies[0].vertices, plate.bodies[0].triangles))
    name = plate.bodies[0].name
    params = body_deviations.Params(
        dent_mm=5.0, dent_radius_mm=90.0, dent_at_mm=(100.0, 20.0, 10.0), move_mm=(0.0, 0.0, 7.0)
    )
    built = as_built.build(plate, {name: params}, 0)
    assert built.defects.classes == ("dent", "misalignment")
    np.testing.assert_allclose(built.defects.depth_max_mm, [5.0, 7.0])
    hits = hits_on(dataclasses.replace(plate, bodies=built.bodies))
    top = hits[(np.abs(hits[:, :2]) < [490, 190]).all(axis=1) & (hits[:, 2] > 5.0)]
    share = np.minimum(((top[:, :2] - [100.0, 20.0]) ** 2).sum(axis=1) / 90.0**2, 1.0)
    off = top[:, 2] - (17.0 - 5.0 * (1.0 - share) ** 2)
    assert (share < 0.5).sum() > 15
    assert np.abs(off).max() < TOLERANCE_MM
    nearest = np.argmin(np.linalg.norm(built.movement.points - [100.0, 20.0, 10.0], axis=1))
    assert abs(built.movement.displacement[nearest, 2] - 2.0) < 0.3  # of the nearest sample, up to 15 mm off


def test_bodies_that_bend_turn_and_are_left_out():
    beam = loading.load(cq.Workplane().box(2000, 100, 40))
    built = as_built.build(beam, {"model-1": body_deviations.Params(bend_mm=6.0, bend_along=(0.0, 0.0, 1.0))}, 0)
    hits = hits_on(dataclasses.replace(beam, bodies=built.bodies))
    top = hits[(np.abs(hits[:, 1]) < 40.0) & (np.abs(hits[:, 0]) < 900.0) & (hits[:, 2] > 15.0)]
    assert len(top) > 100
    np.testing.assert_allclose(top[:, 2], 20.0 + 6.0 * np.cos(np.pi * top[:, 0] / 2000.0), atol=TOLERANCE_MM)
    turned = as_built.build(beam, {"model-1": body_deviations.Params(turn_deg=(0.0, 0.0, 90.0))}, 0).bodies[0]
    np.testing.assert_allclose(np.ptp(turned.vertices, axis=0), [100.0, 2000.0, 40.0], atol=1e-9)  # float64
    gone = as_built.build(beam, {"model-1": body_deviations.Params(missing=True)}, 0)
    assert gone.bodies == (None,)
    assert gone.defects.classes == ("missing-part",)
    assert gone.defects.volume_mm3[0] == pytest.approx(2000.0 * 100.0 * 40.0)
    with pytest.raises(UsageError, match="no body of this name; there are 1, as model-1"):
        body_deviations.params_of({"asbuilt": {"modell-1": {}}}, ["model-1"])


# --- bad models -------------------------------------------------------------------------------------------------------


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
    if len(faces) == len(SIDES):
        assert trimesh.Trimesh(*model.mesh(), process=False).volume == pytest.approx(900.0**3)


def test_a_mesh_in_pieces_makes_bodies_and_a_cavity_belongs_to_its_body():
    two = loading.load((np.vstack([CORNERS, CORNERS + 1000.0]), np.vstack([SIDES, SIDES + len(CORNERS)])))
    assert [body.name for body in two.bodies] == ["model-1", "model-2"]
    # The normals of a cavity point into it.
    middle = CORNERS.mean(axis=0)
    inner = middle + 0.5 * (CORNERS - middle)
    hollow = np.vstack([CORNERS, inner]), np.vstack([SIDES, SIDES[:, ::-1] + len(CORNERS)])
    (body,) = loading.load(hollow).bodies
    volume = trimesh.Trimesh(body.vertices, body.triangles, process=False).volume
    assert volume == pytest.approx(900.0**3 * 7.0 / 8.0)


def test_bodies_of_one_name_are_numbered(tmp_path, caplog):
    text = mesh_text(SIDES, name="rib") + mesh_text(SIDES, CORNERS + 2000.0, name="rib")
    (tmp_path / "two.stl").write_text(text)
    model = loading.load(tmp_path / "two.stl", "mm")
    assert [body.name for body in model.bodies] == ["rib", "rib (2)"]
    with caplog.at_level(logging.WARNING, "designgen"):
        loading.log_notes(model)
    assert caplog.messages == [
        "two: 2 bodies share 1 name(s), as 'rib' 2 times: they are numbered, 'rib', 'rib (2)', ..."
    ]
    assert unique_names(["web", "web", "web (2)", "web"]) == ["web", "web (3)", "web (2)", "web (4)"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.step", EMPTY_STEP, "holds no geometry"),
        ("a.step", "", "expected a STEP or IFC text file"),
        ("a.stl", "solid a\nendsolid a\n", "expected a mesh with faces, found none"),
        ("a.stl", mesh_text([[0, 0, 1]]), "expected triangles with an area, found none"),
        ("a.stl", mesh_text(SIDES)[:500], "is cut off"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "has no PLY header"),
        ("a.txt", "", "expected a model"),
        ("a.py", "x = 1\n\nx / 0\n", "ended with an error in line 3 (ZeroDivisionError"),
        ("a.py", "x = 1\n", "in the variable result, which it does not set"),
        ("a.py", "result = 3\n", "found int"),
        ("a.py", "import nothing_of_this_name", "ended with an error in line 1"),
        ("a.obj", "v 0 0 0\nf 1 2 9\n", "finite vertices"),
        ("a.ifczip", "no zip", "is no zip file"),
    ],
)
def test_a_bad_model_is_one_line_and_exit_code_3(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    done = run("scan", tmp_path / name, "-o", tmp_path / "out.h5")
    assert done.returncode == 3
    said = done.stderr.splitlines()
    assert [line for line in said if line.startswith("error: ")] == said[-1:], "one line, and no second one"
    assert message in said[-1]
    assert str(tmp_path / name) in said[-1]
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
def test_wrong_usage_is_exit_code_2(arguments, message, tmp_path):
    (tmp_path / "cube.stl").write_text(mesh_text(SIDES, name=""))
    done = run("scan", tmp_path / "cube.stl", "-o", tmp_path / "out.h5", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_a_model_is_scanned_by_rays():
    recipe = {"kind": "structure", "model": {"file": "x.stl"}}
    with pytest.raises(UsageError, match=r"scan\.mode"):
        make.make("x", recipe_files.overridden(recipe, []), 0)
    with pytest.raises(UsageError, match=r"set scan\.mode"):
        designgen.scan((CORNERS, SIDES), settings={"scan": {"mode": "surface"}})
