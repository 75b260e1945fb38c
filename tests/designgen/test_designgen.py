"""designgen: curves and solids against closed forms and quadrature, clean points, truth, recipes refused."""

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from scipy.integrate import quad

import designgen
from designgen import batch, curves, recipe_files
from designgen.cli import commands
from designgen.designs import arch_bridge, arch_mesh, arch_part, bolt_ball, closed_ring
from designgen.export import folder as export_folder
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scanning import sampler
from designgen.scenes.make import make
from processor.model import InputError, UsageError
from processor.scan_folder import folder
from processor.store import store
from tests.support.made import made
from tests.support.processes.commands import here
from tests.support.solids import built_solids

ROOT = Path(__file__).resolve().parents[2]
EXACT_MM = 1e-6  # float64 at 60 m: 1e-11; curves are solved to 1e-8
HEIGHTS = {  # z(x) with x from the start, written down apart from the code under test
    "parabola": lambda x, L, f: 4.0 * f * x * (L - x) / L**2,
    "circle": lambda x, L, f: np.sqrt((r := (L * L / 4 + f * f) / (2 * f)) ** 2 - (x - L / 2) ** 2) - (r - f),
}


@pytest.mark.parametrize("name", curves.NAMES)
def test_curves_against_quadrature(name):
    span, rise = 60_000.0, 15_000.0
    curve = curves.make(name, span, rise)
    s = np.linspace(0.0, curve.length, 41)
    point, tangent, normal = curve.frame(s)
    np.testing.assert_allclose(point[[0, -1]], [[0, 0, 0], [span, 0, 0]], atol=EXACT_MM)
    np.testing.assert_allclose(point[20], [span / 2, 0, rise], atol=EXACT_MM)
    if name in HEIGHTS:
        np.testing.assert_allclose(point[:, 2], HEIGHTS[name](point[:, 0], span, rise), atol=EXACT_MM)
    ahead = curve.frame(s + 0.5)[0] - curve.frame(s - 0.5)[0]
    np.testing.assert_allclose(ahead, tangent, atol=1e-6)  # unit speed along the tangent
    np.testing.assert_allclose(np.einsum("ni,ni->n", tangent, normal), 0.0, atol=1e-12)  # float64
    assert (normal[:, 2] > 0.0).all()
    turn = np.linalg.norm(curve.frame(s + 0.5)[1] - curve.frame(s - 0.5)[1], axis=1)
    np.testing.assert_allclose(turn, curve.curvature(s), rtol=1e-5)  # differences over 1 mm


def volume_by_quadrature(part):
    """Volume of the closed form: the integral of (1 + k v) over the section's area, plus the pad above the top face."""
    t = part.plates

    def section(s, hollow):
        b, h = float(part.b(np.array(s))), float(part.h(np.array(s)))
        k = float(part.curve.curvature(np.array([s]))[0])

        def slab(half_width, v0, v1):
            return 2.0 * half_width * ((v1 - v0) + 0.5 * k * (v1 * v1 - v0 * v0))

        return slab(b, 0.0, h) - (slab(b - t.web, t.bottom, h - t.top) if hollow else 0.0)

    c0, c1 = part.cavity
    knots = part.knots[1:-1].tolist()
    solid = quad(section, part.s0, part.s1, args=(False,), points=knots or None, epsrel=1e-10)[0]
    hollow = quad(lambda s: section(s, False) - section(s, True), c0, c1, points=knots or None, epsrel=1e-10)[0]
    s, _ = part.pad
    radius = 1.0 / float(part.curve.curvature(np.array([s]))[0]) + float(part.h(np.array([s]))[0])
    sag = arch_part.PAD_SIZE_MM**2 / 24.0 / radius  # the top face falls away under the pad by x^2 / 2R
    pad = arch_part.PAD_SIZE_MM**2 * (arch_part.PAD_HEIGHT_MM + sag)
    return solid - hollow + pad


@pytest.mark.parametrize("recipe", ["arch-s1", "arch-d1", "arch-d2", "arch-d3"])
def test_solids_keep_to_the_closed_form(recipe):
    params = filled(arch_bridge.Params, recipe_files.load(recipe)[1], "bridge")
    for number, part in enumerate(arch_bridge.build(params)):
        solid = made(built_solids.bridge_solid, params, number)
        assert solid.isValid()
        assert solid.Volume() == pytest.approx(volume_by_quadrature(part), rel=1e-6)  # splines through exact corners
        design = trimesh.Trimesh(*arch_mesh.triangulate(part), process=False)
        assert design.is_watertight
        assert design.is_winding_consistent
        assert design.volume == pytest.approx(solid.Volume(), rel=1e-6)  # its steps follow the curve to 0.004 mm


def test_the_ring_at_an_open_end_is_as_wide_as_its_plates_are_thick():
    """Its four rectangles lie beside each other between the outlines, and each is as large as it states."""
    part = arch_bridge.build(arch_bridge.Params())[2]
    b, h, t = part.b(part.s0), part.h(part.s0), part.plates
    ring = [face for face in arch_part.faces(part, 500.0) if face.name == "ring-start"]
    corners = np.array([face.at(np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])) for face in ring])
    half = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]), axis=1)
    np.testing.assert_allclose([face.element(np.zeros(1), np.zeros(1))[0] for face in ring], half, rtol=1e-9)
    assert half.sum() == pytest.approx(2.0 * b * h - (2.0 * b - 2.0 * t.web) * (h - t.bottom - t.top), rel=1e-9)
    np.testing.assert_allclose(np.ptp(corners.reshape(-1, 3)[:, 1]), 2.0 * b, rtol=1e-9)  # y runs across


def test_clean_points_lie_on_the_surface_evenly():
    part = arch_bridge.build(arch_bridge.Params())[0]
    cloud = sampler.scan_part(part, 0, sampler.Params(spacing_mm=30.0, sigma_mm=0.0), generator(0, "x"))
    sample = cloud.points[:: len(cloud.points) // 30]
    shape = trimesh.Trimesh(*arch_mesh.triangulate(part), process=False)
    distance = np.abs(trimesh.proximity.ProximityQuery(shape).on_surface(sample)[1])
    assert distance.max() < 0.004  # the sag of the mesh's steps
    # One point in spacing^2: the outer faces' area by quadrature of the widening section's perimeter.
    outer = [f for f in arch_part.faces(part, 1000.0) if f.name == "outer-bottom"]
    p, q = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(9) + 0.5) / 9)
    area = outer[0].element(p.ravel(), q.ravel()).mean()
    s = np.linspace(part.s0, part.s1, 20_001)
    assert area == pytest.approx(np.trapezoid(2.0 * part.b(s), s), rel=1e-4)  # a mean of 3600 cells
    bottom = sampler._on_face(outer[0], 10.0, generator(0, "y"))
    assert len(bottom) == pytest.approx(area / 100.0, rel=0.02)  # a place drawn in each cell


def test_volume_of_a_bolt_ball_is_the_sphere_less_caps_and_bores():
    directions = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    params = bolt_ball.Params(50.0, directions, bolt_ball.connection(60.0))
    solid = bolt_ball.build(params)
    assert solid.isValid()
    # Sphere less three caps, less bores from 0.3 R to the flats, less the process hole below its depth.
    R, h, bore = 50.0, params.flat_distance, params.connection.bolt / 2
    cap = np.pi * (R - h) ** 2 * (2 * R + h) / 3.0
    bores = np.pi * bore**2 * (h - 0.3 * R)
    low = R - np.sqrt(R * R - 100.0)
    hole = np.pi * 100.0 * (bolt_ball.PROCESS_HOLE_DEPTH_MM - low) + np.pi * low * low * (3 * R - low) / 3.0
    assert solid.Volume() == pytest.approx(
        4.0 / 3.0 * np.pi * R**3 - 3.0 * (cap + bores) - hole,
        rel=1e-6,  # exact but for saddles of the kernel
    )
    rng = np.random.default_rng(0)
    unit = sampler._unit_vectors(20_000, rng)
    kept = bolt_ball.exposed(params, unit)
    expected = 1.0 - 3.0 * (R - h) / (2.0 * R) - low / (2.0 * R)  # caps by Archimedes
    assert kept.mean() == pytest.approx(expected, abs=0.01)  # of 20,000: sd 0.003
    assert not kept[unit[:, 2] < -np.cos(np.arcsin(9.0 / 50.0))].any()


def test_a_frame_of_balls_sleeves_cones_and_tubes():
    frame, solid = built_solids.frame(False), made(built_solids.frame_solid, False)
    assert (len(frame.centres), len(frame.members)) == (5, 8)
    assert solid.isValid()
    top = frame.centres[:, 2].argmax()
    assert solid.BoundingBox().zmax == pytest.approx(
        frame.centres[top, 2] + frame.radii[top],
        abs=1e-3,  # gap of the kernel's box
    )
    assert len(solid.Solids()) == 5 + 8 * 5


def test_noise_and_outliers_are_those_of_the_recipe():
    part = arch_bridge.build(arch_bridge.Params())[2]
    clean = sampler.scan_part(part, 2, sampler.Params(spacing_mm=20.0, sigma_mm=0.0), generator(3, "a"))
    noisy = sampler.scan_part(
        part, 2, sampler.Params(spacing_mm=20.0, sigma_mm=2.0, outlier_share=0.01), generator(3, "a")
    )
    error = noisy.points[: len(clean.points)] - clean.points
    assert error.std() == pytest.approx(2.0, rel=0.02)  # of some 1e5 numbers: sd 0.2 %
    assert abs(error.mean()) < 0.03  # of 1e5 numbers: sd 0.006
    assert (noisy.source == sampler.OUTLIER).mean() == pytest.approx(0.01, rel=0.01)  # a whole number of them
    assert (noisy.part[noisy.source == sampler.OUTLIER] == -1).all()


def test_truth_belongs_to_its_scan_and_seeds_repeat():
    recipe = recipe_files.overridden(recipe_files.load("arch-s1")[1], ["scan.spacing_mm=80", "scan.sigma_mm=0"])
    scene, truth = make("x", recipe, 5)
    again, _ = make("x", recipe, 5)
    other, _ = make("x", recipe, 6)
    assert store.scene_hash(scene) == store.scene_hash(again) != store.scene_hash(other)
    parts = arch_bridge.build(arch_bridge.Params())
    for i, scan in enumerate(scene.scans):
        T = truth.arch.T_bridge_scan[i]
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        np.testing.assert_allclose(
            truth.arch.key_points_scan[i] @ T[:3, :3].T + T[:3, 3],
            truth.arch.key_points_bridge[i],
            atol=1e-8,  # float64 at 60 m
        )
        inside = scan.points @ T[:3, :3].T + T[:3, 3]
        ends = parts[i].curve.frame(np.array([parts[i].s0, parts[i].s1]))[0]
        assert inside[:, 0].min() == pytest.approx(ends[0, 0], abs=1500.0)  # the section is 1100 high
        assert inside[:, 0].max() == pytest.approx(ends[1, 0], abs=1500.0)  # the same
    assert np.isnan(truth.arch.key_points_scan[0, 0]).all()
    assert np.isfinite(truth.arch.key_points_scan[0, 1]).all()
    np.testing.assert_allclose(truth.arch.key_points_bridge[1, 0], scene.arch.joint_points[0])


@pytest.mark.parametrize(
    ("recipe", "setting", "said"),
    [
        *(("arch-s1", *row) for row in (
            ("scan.sigma=2", "scan.sigma: unknown parameter (did you mean 'sigma_mm'?); known are"),
            ("bridg.span_mm=2", "unknown key 'bridg'"),
            ("scan.spacing_mm=-5", "scan.spacing_mm: expected 0.05 to 1000, got -5.0"),
            ("scan.sigma_mm=nan", "scan.sigma_mm: expected a finite number, found nan"),
            ("scan.mode=beams", "scan.mode: expected surface or rays, got 'beams'"),
            ("bridge.plate_web_mm=700", "bridge.plate_web_mm: expected less than half of width_mm, got 700.0"),
            ("bridge.joints=[0.5,0.4,0.6,0.8]", "bridge.joints: expected rising fractions"),
            ("bridge.rise_mm=90000", "bridge.rise_mm: expected less than half of span_mm"),
            ("bridge.span_mm=true", "bridge.span_mm: expected a finite number, found True"),
            ("bridge.curve=spiral", "bridge.curve: expected one of parabola, catenary, circle"),
            ("seed=-1", "seed: expected a whole number from 0"),
            ("kind=tent", "kind: expected one of arch-bridge, space-frame, structure"),
            ("scan", "expected section.key=value"),
        )),
        *(("frame-small", *row) for row in (
            ("frame.radii_mm=[0.0]", "frame.radii_mm: expected radii above 0, got 0.0"),
            ("frame.radii_mm=[20.0]", "frame.radii_mm: expected more than the flat's radius"),
            ("frame.tube_diameter_mm=61.0", "expected one of 60, 75.5"),
            ("frame.spacing_mm=100.0", "frame.spacing_mm: expected more than four radii"),
            ("frame.nodes_x=1", "2 or more"),
        )),
    ],
)  # fmt: skip
def test_impossible_recipes_are_refused_by_key(recipe, setting, said):
    with pytest.raises(UsageError) as refused:
        make("x", recipe_files.overridden(recipe_files.load(recipe)[1], [setting]))
    assert said in str(refused.value)


def test_exported_folder_has_design_and_truth(tmp_path):
    small = ["scan.spacing_mm=80", "frame.nodes_x=2", "frame.nodes_y=2"]
    recipe = recipe_files.overridden(recipe_files.load("frame-small")[1], small)
    scene, truth = make("roof", recipe)
    store.write_scene(tmp_path / "s.h5", scene, truth, {"parameters": recipe})
    export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=True, step=True)
    back = folder.read_input(tmp_path / "out")
    assert (back.kind, back.name) == ("space-frame", "roof")
    np.testing.assert_array_equal(back.frame.centres, scene.frame.centres)
    np.testing.assert_array_equal(back.frame.member_b, scene.frame.member_b)
    assert folder.truth_file(tmp_path / "out") is not None
    assert (tmp_path / "out/design/frame.step").stat().st_size > 10_000
    with pytest.raises(UsageError, match="not empty"):
        export_folder.export(tmp_path / "s.h5", tmp_path / "out", "ply", with_truth=True)


def test_the_command_line(tmp_path):
    def run(*arguments):
        return here("designgen", *arguments)

    listed = run("list").stdout.splitlines()
    entries = [line for line in listed if line.startswith("  ")]
    assert {*recipe_files.named(), "bolt_ball"} <= {line.split()[0] for line in entries}
    column = max(len(line.split()[0]) for line in entries) + 4
    assert all(line[column - 1] == " " and line[column] != " " for line in entries)
    scene = tmp_path / "s.h5"
    words = ["make", "balls-100", "-o", scene, "--seed", "4", "--set", "scan.spacing_mm=20", "--json"]
    done = run(*words)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["seed"] == 4
    assert store.read_provenance(scene)["parameters"]["scan"]["spacing_mm"] == 20
    assert run("make", "no-such", "-o", tmp_path / "x.h5").returncode == 2
    assert run("make", tmp_path / "no.toml", "-o", tmp_path / "x.h5").returncode == 3
    assert run("export", tmp_path / "no.h5", "-o", tmp_path / "f", "--format", "ply").returncode == 3
    assert run("export", scene, "-o", tmp_path / "f", "--format", "ptx").returncode == 2  # no grid
    assert run("export", scene, "-o", tmp_path / "f", "--format", "ply", "--spherical").returncode == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.h5"]


def test_scenes_are_made_from_python_as_by_the_command(tmp_path):
    settings = {"scan.spacing_mm": np.float64(160.0), "bridge.joints": (0.2, 0.4, 0.6, 0.8)}
    scene, truth = designgen.make("arch-s1", seed=3, settings=settings)
    changes = ["scan.spacing_mm=160.0", "bridge.joints=[0.2, 0.4, 0.6, 0.8]"]
    arguments = ["make", "arch-s1", "-o", str(tmp_path / "s.h5"), "--seed", "3"]
    done = CliRunner().invoke(commands, [*arguments, *(text for change in changes for text in ("--set", change))])
    assert done.exit_code == 0, done.output
    provenance = store.read_provenance(tmp_path / "s.h5")
    store.write_scene(tmp_path / "python.h5", scene, truth, provenance)
    assert (tmp_path / "python.h5").read_bytes() == (tmp_path / "s.h5").read_bytes()
    own = tmp_path / "own.toml"
    own.write_text((ROOT / "designgen/recipes/arch-s1.toml").read_text("utf-8"), "utf-8")
    again, _ = designgen.make(own, 3, settings)
    assert again.name == "own"
    np.testing.assert_array_equal(again.scans[2].points, scene.scans[2].points)
    default, _ = designgen.make("arch-s1", settings=settings)
    assert not np.array_equal(default.scans[2].points[:5], scene.scans[2].points[:5])
    with pytest.raises(UsageError, match="no recipe 'tent'"):
        designgen.make("tent")
    with pytest.raises(UsageError, match=r"scan.sigma: unknown parameter"):
        designgen.make("arch-s1", settings={"scan.sigma": 1.0})
    with pytest.raises(UsageError, match=r"setting seed.a: seed is not a section"):
        designgen.make("arch-s1", settings={"seed.a": 1.0})
    with pytest.raises(InputError, match="not a readable recipe"):
        designgen.make(tmp_path / "none.toml")


def test_the_package_loads_at_once_and_software_of_a_scene_lists_the_libraries_that_make_it():
    code = (
        "import sys, designgen\n"
        "assert not {'numpy', 'scipy', 'click'} & set(sys.modules)\n"
        "designgen.make('plates-defects', settings={'scan.step_mrad': 50.0})\n"
        "from processor.store import store\n"
        "print(*{module.partition('.')[0] for module in sys.modules})\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True, text=True)
    loaded = set(done.stdout.split())
    assert set(batch.SOFTWARE) <= loaded
    assert not {"cadquery", "OCP"} & loaded
    assert set(batch.software()) == {"designgen", *batch.SOFTWARE}
    assert all((ROOT / package / "py.typed").is_file() for package in ("designgen", "processor"))


LAYERS = ("designs", "asbuilt", "scanning", "models", "scenes", "export")  # each imports those before it, cad none


def test_imports_go_one_way():
    for number, layer in enumerate((*LAYERS, "cad")):
        later = LAYERS if layer == "cad" else LAYERS[number + 1 :]
        for path in (ROOT / "designgen" / layer).glob("*.py"):
            assert not any(f"designgen.{one}" in path.read_text("utf-8") for one in later), path


@pytest.mark.parametrize("count", [2, 7])
def test_a_bridge_of_any_number_of_parts_meets_at_its_joints(count):
    parts = arch_bridge.build(arch_bridge.Params(parts=count))
    assert [part.name for part in parts] == ["foot1", *(f"rib{k}" for k in range(1, count - 1)), "foot2"]
    for left, right in pairwise(parts):
        np.testing.assert_allclose(left.key_points(left.s1), right.key_points(right.s0), atol=1e-9)  # float64
    assert [part.closed for part in parts] == ["start", *[""] * (count - 2), "end"]
    lengths = [part.s1 - part.s0 for part in parts]
    np.testing.assert_allclose(lengths, parts[0].curve.length / count)


def test_a_net_of_points_has_points_on_the_edges_of_every_face():
    part = arch_bridge.build(arch_bridge.Params())[1]
    cloud = sampler.scan_part(part, 0, sampler.Params(spacing_mm=40.0, sigma_mm=0.0, net=True), generator(0, "x"))
    for s in (part.s0, part.s1):
        corners = part.key_points(s)[:4]
        off = np.linalg.norm(cloud.points[:, None] - corners, axis=2).min(axis=0)
        np.testing.assert_allclose(off, 0.0, atol=1e-6)  # float64 at 60 m
    random = sampler.scan_part(part, 0, sampler.Params(spacing_mm=40.0, sigma_mm=0.0), generator(0, "x"))
    assert len(cloud.points) == pytest.approx(len(random.points), rel=0.15)  # rows of points on both edges of a face


def test_a_ring_is_closed_and_has_the_volume_of_a_turned_section():
    """Pappus: the area of the section times the way of its centroid, and six pads of 200 x 200 x 20 mm."""
    parts = closed_ring.build(closed_ring.Params())
    for left, right in zip(parts, (*parts[1:], parts[0]), strict=True):
        np.testing.assert_allclose(left.key_points(left.s1), right.key_points(right.s0), atol=1e-9)  # float64
    meshes = [trimesh.Trimesh(*arch_mesh.triangulate(part)) for part in parts]
    assert all(mesh.is_watertight for mesh in meshes)
    turned = 2.0 * np.pi * 4400.0 * (600.0 * 800.0 - 560.0 * 760.0)
    assert sum(mesh.volume for mesh in meshes) == pytest.approx(
        turned + 6 * 200.0 * 200.0 * 20.0,
        rel=1e-4,  # chords of the mesh
    )
