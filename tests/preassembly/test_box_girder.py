"""Parts without a mesh: their outer box against the generator's closed form, and the measurement with it."""

import json

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner

from designgen import cli as designgen_cli
from designgen import recipe_files
from designgen.designs import arch_bridge
from designgen.scenes.make import make as make_scene
from processor.evaluation import preassembly as preassembly_evaluation
from processor.geometry import box_girder_mesh
from processor.model import InputError, UsageError
from processor.preassembly import step as preassembly_step
from processor.preassembly.ends import plate_sides
from processor.preassembly.params import SystematicParams
from processor.preassembly.parts import attitude, measure
from processor.scan_folder import folder
from processor.store import store

# The design's curves have stations 20 mm apart, between which a box has chords: (20 mm)^2 / (8 * 10 m) = 0.005 mm.
CHORD_MM = 0.01
SKEWED = ["bridge.joints=[0.19, 0.38, 0.62, 0.81]"]


def parts(**bridge):
    return arch_bridge.build(arch_bridge.Params(**bridge))


def surrogate_of(parts_, i, **options):
    part = parts_[i]
    start = part.key_points(part.s0) if i > 0 else None
    end = part.key_points(part.s1) if i < 4 else None
    return box_girder_mesh.mesh(*part.bottom_edges(), start, end, **options)


def sections(part, count=400):
    """Chainages (n,), half widths, heights and a number in 0..1 each."""
    rng = np.random.default_rng(5)
    s = rng.uniform(part.s0, part.s1, count)
    return s, part.b(s), part.h(s), rng.uniform(0.0, 1.0, count)


def off(mesh, points):
    return trimesh.proximity.closest_point(mesh, points)[1]


# --- the box ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bridge",
    [pytest.param({}, marks=pytest.mark.slow), {"curve": "circle"}, {"curve": "catenary", "span_mm": 60_000.0}],
)
def test_surrogate_of_a_rib_is_its_outer_faces(bridge):
    part = parts(**bridge)[1]
    mesh = trimesh.Trimesh(*surrogate_of(parts(**bridge), 1), process=False)
    s, b, h, w = sections(part)
    for u, v in (((2 * w - 1) * b, 0 * h), ((2 * w - 1) * b, h), (b, w * h), (-b, w * h)):
        assert off(mesh, part.point(s, u, v)).max() < CHORD_MM
    # And nothing else: inner faces would make it twice as much; the rings of the ends add 4 % at most.
    assert mesh.area < 1.02 * (2 * (part.s1 - part.s0) * (b[0] * 2 + h[0]) * 1.06 + 4 * 20 * (b[0] * 2 + h[0]))


@pytest.mark.parametrize("i", [0, 4])
def test_surrogate_of_a_foot_omits_faces_that_its_one_joint_does_not_determine(i):
    part = parts()[i]
    vertices, faces = surrogate_of(parts(), i)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    s, b, h, w = sections(part)
    assert off(mesh, part.point(s, (2 * w - 1) * b, 0 * h)).max() < CHORD_MM
    low = 0.9 * w * h
    for side in (1.0, -1.0):
        assert off(mesh, part.point(s, side * b, low)).max() < 0.02  # widening: twice the chord
    joint, base = (part.s1, part.s0) if i == 0 else (part.s0, part.s1)
    near = np.abs(s - joint) < 1000.0
    top = part.point(s, 0.9 * (2 * w - 1) * b, h)
    assert off(mesh, top[near]).max() < CHORD_MM
    assert off(mesh, top[np.abs(s - joint) > 1500.0]).min() > 40.0  # no top where the height is not known
    plate = part.point(np.full(50, base), np.zeros(50), np.linspace(0.2, 0.8, 50) * part.h(np.array(base)))
    assert off(mesh, plate).min() > 100.0  # no base


def test_normals_look_outward():
    every = parts()
    for i, part in enumerate(every):
        vertices, faces = surrogate_of(every, i)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal, middle = np.cross(b - a, c - a), (a + b + c) / 3.0
        s = np.linspace(part.s0, part.s1, 300)
        axis = part.point(s, 0 * s, 0.5 * part.h(s))
        inward = axis[np.argmin(np.linalg.norm(middle[:, None] - axis[None], axis=2), axis=1)] - middle
        ends = {s: np.array(part.curve.frame(np.array([s]))[1][0]) for s in (part.s0, part.s1)}
        walls = np.ones(len(faces), bool)
        for s_end, sense in ((part.s0, -1.0), (part.s1, 1.0)):
            there = part.point(np.array([s_end]), np.zeros(1), np.zeros(1))[0]
            flat = (np.abs((vertices[faces] - there) @ ends[s_end]) < 0.01).all(axis=1)
            walls &= ~flat
            assert flat.sum() == (0 if part.closed == ("start" if sense < 0 else "end") else 8)
            assert (sense * (normal[flat] @ ends[s_end]) > 0.0).all()
        assert (np.einsum("ni,ni->n", normal, inward)[walls] < 0.0).all()


def test_a_height_between_two_joints_is_linear():
    edge = np.stack([np.linspace(0.0, 4000.0, 5), np.full(5, 400.0), np.zeros(5)], axis=1)
    ends = []
    for x, h in ((0.0, 800.0), (4000.0, 1200.0)):
        corners = np.array([[x, 400.0, 0], [x, -400.0, 0], [x, -400.0, h], [x, 400.0, h]])
        ends.append(np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))]))
    vertices, faces = box_girder_mesh.mesh(edge, edge * [1, -1, 1], *ends)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    # Rounding.
    assert off(mesh, np.array([[1000.0, 0.0, 900.0], [3000.0, 100.0, 1100.0], [2000.0, 400.0, 990.0]])).max() < 1e-9


def test_edges_and_joints_that_do_not_belong_together():
    rib = parts()[1]
    edges, start, end = rib.bottom_edges(), rib.key_points(rib.s0), rib.key_points(rib.s1)
    with pytest.raises(InputError, match=r"end at P1 and P2 of the joint there, found them \d+ mm away"):
        box_girder_mesh.mesh(*edges, start, start)
    with pytest.raises(InputError, match="above P2 and P1"):
        box_girder_mesh.mesh(*edges[::-1], start[[1, 0, 3, 2, 4, 7, 6, 5]], end[[1, 0, 3, 2, 4, 7, 6, 5]])
    with pytest.raises(InputError, match="a joint at one end"):
        box_girder_mesh.mesh(*edges, None, None)


# --- through a folder ------------------------------------------------------------------------------------------------


def exported(tmp_path, scene, truth, *options):
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    said = CliRunner().invoke(
        designgen_cli.commands,
        ["export", str(tmp_path / "s.h5"), "-o", str(tmp_path / "out"), "--format", "ply", *options],
    )
    assert said.exit_code == 0, said.output
    return tmp_path / "out"


def made(settings=(), seed=1):
    return make_scene("bridge", recipe_files.overridden(recipe_files.load("arch-s1")[1], list(settings)), seed)


def test_a_folder_without_meshes_comes_back_with_thicknesses_of_the_design(tmp_path):
    scene, truth = made(["scan.spacing_mm=200"])
    out = exported(tmp_path, scene, truth, "--without-meshes")
    assert not (out / "design").exists()
    written = json.loads((out / "design.json").read_text())
    assert all("mesh" not in part for part in written["components"].values())
    back = folder.read_input(out)
    assert [part.source for part in back.arch.parts] == ["curves"] * 5
    assert [part.source for part in scene.arch.parts] == ["mesh"] * 5
    for ours, theirs in zip(scene.arch.parts, back.arch.parts, strict=True):
        np.testing.assert_array_equal(theirs.bottom_edge_left, ours.bottom_edge_left)
        low, high = ours.vertices.min(axis=0), ours.vertices.max(axis=0)
        assert (theirs.vertices > low - 50.0).all()
        assert (theirs.vertices < high + 50.0).all()
        assert (theirs.source, ours.source) == (box_girder_mesh.SOURCE, "mesh")
    store.write_scene(tmp_path / "again.h5", back, None, {})
    assert [part.source for part in store.read_scene(tmp_path / "again.h5").arch.parts] == ["curves"] * 5
    written["components"]["rib1"]["plate_mm"] = 36.0
    (out / "design.json").write_text(json.dumps(written))
    rib = folder.read_input(out).arch.parts[1]
    start = scene.arch.joint_points[0]
    near = rib.vertices[np.linalg.norm(rib.vertices - start[0], axis=1) < 60.0]
    # The ring's inner corner: less than a plate from the outer one, along both sides.
    assert np.abs(np.linalg.norm(near - start[0], axis=1) - np.sqrt(2.0) * 0.7 * 36.0).min() < 1e-9
    written["components"]["rib1"]["plate_mm"] = -1.0
    (out / "design.json").write_text(json.dumps(written))
    with pytest.raises(InputError, match="rib1: expected a number above 0 as 'plate_mm'"):
        folder.read_input(out)


def test_only_an_arch_bridge_goes_without_meshes(tmp_path):
    from designgen.export import folder as export_folder

    scene, truth = make_scene(
        "f", recipe_files.overridden(recipe_files.load("frame-small")[1], ["scan.spacing_mm=300"]), 1
    )
    store.write_scene(tmp_path / "f.h5", scene, truth, {})
    with pytest.raises(UsageError, match="only an arch bridge"):
        export_folder.export(tmp_path / "f.h5", tmp_path / "out", "ply", with_truth=True, with_meshes=False)


# --- measurement -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def without_meshes(tmp_path_factory):
    """A bridge with a crown rib that is not symmetric about the crown, and the same without meshes; truth."""
    place = tmp_path_factory.mktemp("bare")
    scene, truth = made(["scan.spacing_mm=25", *SKEWED])
    out = exported(place, scene, truth, "--without-meshes")
    return folder.read_input(out), truth


@pytest.mark.slow
def test_ends_are_measured_as_with_meshes(without_meshes):
    scene, truth = without_meshes
    result = preassembly_step.run(scene, preassembly_step.Params(seed=1))
    checks = {metric.name: metric.value for metric in preassembly_evaluation.check(scene, result, truth)}
    assert checks["wrong poses called ok"] == 0.0
    status = dict(zip(result.components.name, result.components.status, strict=True))
    assert all(status[name] == "ok" for name in ("foot1", "rib1", "rib3", "foot2")), result.components.reasons
    assert status["rib2"] == "ambiguous"  # the mark is not in the curves
    error = result.components.key_points_scan - truth.arch.key_points_scan
    for i in (0, 1, 3, 4):
        known = error[i][np.isfinite(error[i])]
        assert np.sqrt(np.mean(known**2)) < 0.25  # points 25 mm apart with 1 mm of noise, as with meshes
        spread = result.components.key_points_sd[i][np.isfinite(error[i])]
        assert np.mean(np.abs(known) < 3.5 * spread) > 0.97  # nearly all within 3.5 sds; errors of an end hang together


@pytest.mark.slow
def test_a_wrong_part_is_not_called_ok(without_meshes):
    scene, _ = without_meshes
    scans, systematic = {scan.component: scan for scan in scene.scans}, SystematicParams()
    for asked, came in ((1, "rib2"), (2, "rib1"), (0, "rib3")):
        fitted = measure.fit([scans[came]], asked, attitude.Shapes(scene.arch), 1.0, systematic)
        (found,) = measure.estimate([fitted], systematic)
        assert found.status != "ok", (asked, came, found.reasons)


# --- the two sides of a plate ----------------------------------------------------------------------------------------


def test_the_outer_layer():
    rng = np.random.default_rng(2)
    outside, inside = rng.normal(1.5, 1.0, 3000), rng.normal(-22.0, 1.0, 2800)
    out = np.concatenate([outside, inside, rng.uniform(-50.0, 50.0, 60)])
    kept = plate_sides.outer_layer(out)
    assert kept[:3000].all()
    assert not kept[3000:5800].any()
    assert plate_sides.outer_layer(outside).all()
    assert plate_sides.outer_layer(
        np.concatenate([outside, rng.uniform(-50.0, 50.0, 60)])
    ).all()  # strays are left to the fit
    assert plate_sides.outer_layer(np.empty(0)).shape == (0,)


@pytest.mark.parametrize("walls", [True, False])
@pytest.mark.parametrize("true_mm", [12.0, 20.0, 32.0])
def test_a_plates_thickness(true_mm, walls):
    rng = np.random.default_rng(4)
    ring = np.stack([np.zeros(2000), rng.uniform(0.0, true_mm, 2000)], axis=1)
    deep = np.stack([rng.uniform(-80.0, 0.0, 4000), np.repeat([0.0, true_mm], 2000)], axis=1)[: 4000 if walls else 2000]
    x, e = (np.vstack([ring, deep]) + rng.normal(0.0, 0.8, (2000 + len(deep), 2))).T
    assert abs(plate_sides.plate_thickness(x, e, 0.8, 20.0) - true_mm) < (0.2 if walls else 1.0)
    assert plate_sides.plate_thickness(x[:5], e[:5], 0.8, 20.0) == 20.0  # too few to say
