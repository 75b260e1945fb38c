"""Wrong arguments of the Python interface: each is refused by one ValueError that names it and what came."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import designgen
import processor
from processor.evaluation import space_frame
from processor.geometry import rigid
from processor.model import InputError, Status, Truth, UsageError, reason
from processor.scan_folder import design, text_files
from processor.store import store
from tests.support.solids.meshes import bracket

FRAME = Path(__file__).resolve().parents[2] / "fixtures" / "scan-folder"
RADIUS = 72.5
SCALES = {"normal_diameter": 200.0, "projection_diameter": 100.0, "max_depth": 50.0}
NO_LENGTHS = ["1", None, True, 1j, [1], np.array([100.0]), np.array([1.0, 2.0]), np.nan, -1.0, 10**400]
CORNERS = [[0, 0, 0], [900, 0, 0], [0, 900, 0], [0, 0, 900]]
SIDES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
T_SCAN_MESH = rigid.transform(rigid.rotation_from_vector(np.array([0.3, -1.1, 2.0])), np.array([5e5, 3e6, 100.0]))


def ball(centre=(0.0, 0.0, 0.0), scanner=(9000.0, 0.0, 0.0), count=2000):
    """Points of a ball that face a scanner, mm, with 0.5 mm of noise along the rays."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(4 * count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    points = np.asarray(centre) + RADIUS * direction
    sight = np.asarray(scanner) - points
    facing = np.einsum("ni,ni->n", sight, direction) > 0.0
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    return (points + rng.normal(0.0, 0.5, (len(points), 1)) * sight)[facing][:count]


def planes(count=5000):
    """Two clouds of a plane of 2 m, mm, the second 3 mm higher."""
    rng = np.random.default_rng(2)
    first = np.column_stack([rng.uniform(-1000.0, 1000.0, (count, 2)), rng.normal(0.0, 1.0, count)])
    return first, first + np.array([0.0, 0.0, 3.0])


# --- fit_sphere


@pytest.mark.parametrize("radius", [value for value in NO_LENGTHS if value is not None], ids=repr)
def test_a_radius_is_one_positive_number(radius):
    with pytest.raises(ValueError, match="radius: expected a positive length in mm, got"):
        processor.fit_sphere(ball(), radius=radius)


def test_numbers_of_numpy_are_lengths():
    points = ball()
    fits = [processor.fit_sphere(points, radius=kind(RADIUS)) for kind in (float, np.float32, np.array)]
    assert [fit.radius for fit in fits] == [RADIUS] * 3


def test_a_radius_in_another_unit_is_refused_or_stated():
    points = ball()
    with pytest.raises(ValueError, match=r"radius: expected .* in mm, got 0\.0725; it seems to be in metres"):
        processor.fit_sphere(points, radius=RADIUS / 1000.0)
    with pytest.raises(ValueError, match=r"at most 5 times the span of the points, 14\d.* mm, got 725"):
        processor.fit_sphere(points, radius=10.0 * RADIUS)
    inches = processor.fit_sphere(points, radius=RADIUS / 25.4)
    assert inches.status is Status.FAILED
    assert [one.code for one in inches.reasons] == ["spheres.no-ball", "spheres.unit-mistake"]


def test_a_ball_in_metres_among_clutter_is_weak():
    """The span of the clutter is one that a target in mm may have: the radius that is found shows the unit."""
    clutter = np.random.default_rng(1).uniform(-3000.0, 3000.0, (300, 3))
    cloud = np.vstack([ball(), clutter]) / 1000.0
    fit = processor.fit_sphere(cloud, instrument="phase")
    assert fit.status is Status.WEAK
    assert [one.code for one in fit.reasons] == ["spheres.unit-mistake"]
    with pytest.raises(ValueError, match="span of the points"):
        processor.fit_sphere(cloud, radius=RADIUS)


@pytest.mark.parametrize(
    ("centre", "true", "given", "message"),
    [
        ((0, 0, 0), (3000, 1000, 1500), (3, 1, 1.5), "no scanner measures that near"),
        ((1e6, 2e6, 1e3), (1.01e6, 2e6, 1500), (1010, 2000, 1.5), "no scanner distinguishes points so close"),
        ((8000, 2000, 1000), (8000, -6000, 1000), (0, 0, 0), "% of the points on the sphere face away"),
    ],
)
def test_a_scanner_that_cannot_have_measured_the_points(centre, true, given, message):
    points = ball(centre, true)
    assert processor.fit_sphere(points, scanner=true).status is Status.OK
    with pytest.raises(ValueError, match=f"scanner: expected .*{message}"):
        processor.fit_sphere(points, scanner=given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: np.ones_like(p), "points: expected points at different places, got 2000 that all coincide"),
        (lambda p: p + 1j, "points: expected numbers, got complex128"),
        (lambda p: p > 0.0, "points: expected numbers, got bool"),
        (lambda p: p.astype(str), "points: expected numbers, got <U32"),
        (lambda p: [[1.0, 2.0, None]] * 20, "points: expected numbers, got list"),
        (lambda p: [[1, 2, 3], [1, 2]], "points: expected numbers in rows of one length, got list"),
        (lambda p: np.ma.array(p, mask=p > 60.0), "points: expected numbers, got a masked array"),
        (lambda p: p / 1000.0, "in metres"),
        (lambda p: p[:5], "10 points or more, got 5"),
        (lambda p: p[:, :2], r"array \(n, 3\).*got shape"),
        (lambda p: np.where(p > p.mean(), np.nan, p), "NaN or infinite"),
    ],
)
def test_arrays_of_no_points(change, message):
    with pytest.raises(ValueError, match=message):
        processor.fit_sphere(change(ball()))


@pytest.mark.parametrize(
    "scanner", [np.zeros(2), np.zeros((5, 3)), 0.0], ids=["two numbers", "five places", "a number"]
)
def test_a_scanner_is_one_place_or_one_of_each_point(scanner):
    with pytest.raises(ValueError, match=r"scanner: expected shape \(3,\) or \(2000, 3\), got"):
        processor.fit_sphere(ball(), scanner=scanner)


# --- register


@pytest.fixture(scope="module")
def scan():
    """A scan of the bracket in a frame of its own, mm, and the bracket's mesh."""
    mesh = bracket()
    points = np.asarray(trimesh.sample.sample_surface(mesh, 4000, seed=3)[0])
    return rigid.apply(T_SCAN_MESH, points), np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f[:, [0, 0, 1]], r"faces: expected triangles with an area, got 36 whose corners coincide"),
        (lambda f: [[0, 1, 2], [0, 1]], r"faces: expected an array \(f, 3\) .*got rows of different lengths"),
        (lambda f: f[:0], "faces: expected triangles, got none"),
        (lambda f: None, r"faces: expected an array \(f, 3\) of whole numbers"),
        (lambda f: f > 1, r"faces: expected an array \(f, 3\) of whole numbers, got bool"),
    ],
)
def test_faces_that_are_no_mesh(scan, change, message):
    points, vertices, faces = scan
    with pytest.raises(ValueError, match=message):
        processor.register(points, vertices, change(faces))


def test_a_pose_states_why_it_is_not_ok(scan):
    points, vertices, faces = scan[0][::2], *scan[1:]
    good = processor.register(points, vertices, faces)
    assert (good.status, good.reasons) == (Status.OK, ())
    large = processor.register(10.0 * points, vertices, faces)
    assert large.status is Status.FAILED
    assert [one.code for one in large.reasons] == ["register.not-at-mesh", "register.unit-mistake"]
    assert large.reasons[1].values["unit_mm"] == 10.0
    plane = np.column_stack([np.random.default_rng(0).uniform(0.0, 300.0, (500, 2)), np.zeros(500)])
    small = processor.register(plane, vertices, faces)
    assert small.status in (Status.AMBIGUOUS, Status.WEAK)
    assert reason("register.undetermined") in small.reasons
    assert small.reasons[-1].code in ("register.sizes-differ", "register.unit-mistake")


def test_ground_around_a_part_does_not_change_the_status_of_its_pose(scan):
    points, vertices, faces = scan
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-6000.0, 8000.0, (10_000, 2)), rng.normal(-1000.0, 1.0, 10_000)])
    pose = processor.register(np.vstack([points, rigid.apply(T_SCAN_MESH, ground)]), vertices, faces)
    assert (pose.status, pose.reasons) == (Status.OK, ())


def test_a_pose_at_which_a_third_of_the_points_has_no_surface_is_weak(scan):
    """What stands in the part is no ground or wall, which are left out."""
    points, vertices, faces = scan[0][::2], *scan[1:]
    rng = np.random.default_rng(1)
    beside = rng.uniform([0.0, 0.0, 200.0], [1500.0, 1500.0, 900.0], (750, 3)) + vertices.min(axis=0)
    pose = processor.register(np.vstack([points, rigid.apply(T_SCAN_MESH, beside)]), vertices, faces)
    assert pose.status is Status.WEAK
    assert [one.code for one in pose.reasons] == ["register.points-elsewhere"]


# --- m3c2


@pytest.mark.parametrize("name", SCALES)
@pytest.mark.parametrize("value", [*NO_LENGTHS, 0.0], ids=repr)
def test_scales_are_positive_numbers(name, value):
    with pytest.raises(ValueError, match=f"{name}: expected a positive length in the unit of the coordinates, got"):
        processor.m3c2(*planes(200), **{**SCALES, name: value})


@pytest.mark.parametrize("value", NO_LENGTHS, ids=repr)
def test_a_registration_error_is_a_number(value):
    with pytest.raises(ValueError, match="registration_error: expected 0 or a positive length, got"):
        processor.m3c2(*planes(200), **SCALES, registration_error=value)


@pytest.mark.parametrize("length", [2.0, 0.0, 1.00001])
def test_normals_are_unit_vectors(length):
    first, second = planes()
    normals = np.tile([0.0, 0.0, length], (10, 1))
    with pytest.raises(ValueError, match=f"normals: expected unit vectors, .*the first {length:g} in row 0"):
        processor.m3c2(first, second, core=first[:10], normals=normals, **SCALES)
    single = np.tile(np.float32([0.6, 0.0, 0.8]), (10, 1))
    processor.m3c2(first, second, core=first[:10], normals=single, **SCALES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, b: {"compared": b / 1000.0}, "compared: spans 2, the reference 2000; expected clouds of one unit"),
        (lambda a, b: {"compared": b[:0]}, "compared: expected"),
        (lambda a, b: {"reference": a[:, :2]}, r"array \(n, 3\) of coordinates, got"),
        (lambda a, b: {"core": a / 1000.0}, "core: spans 2, .*core points times 1000 lie all over it"),
        (lambda a, b: {"compared": b + 1e4}, "core: none of the 5000 core points has points of both"),
        (lambda a, b: {"core": a + 1e4}, "normal_diameter: within 200 no core point has enough"),
        (lambda a, b: {name: value / 1000.0 for name, value in SCALES.items()}, "normal_diameter: within 0.2 no core"),
        (lambda a, b: {"max_depth": 0.05}, "max_depth: 0.05 is less than 1/300 of projection_diameter, 100"),
        (lambda a, b: {"projection_diameter": 0.1}, "projection_diameter: 0.1 is less than 1/300 of normal_diameter"),
        (lambda a, b: {"normal_diameter": 0.2}, "normal_diameter: 0.2 is less than 1/300 of projection_diameter"),
    ],
)
def test_clouds_and_lengths_of_different_units(change, message):
    first, second = planes()
    with pytest.raises(ValueError, match=message):
        processor.m3c2(**{"reference": first, "compared": second, **SCALES, **change(first, second)})


def test_core_points_without_neighbours_are_nan_beside_others():
    first, second = planes()
    table = processor.m3c2(first, second, core=[[0.0, 0.0, 0.0], [1e4, 0.0, 0.0]], **SCALES)
    np.testing.assert_array_equal(np.isfinite(table.distance), [True, False])


# --- whole inputs


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: processor.read(3), r"path: expected a path \(text or pathlib.Path\), got int"),
        (lambda: processor.read("a\0b"), "path: expected a path .*got a text with a zero byte"),
        (lambda: processor.read(FRAME, units=3), "units: expected a text, got 3"),
        (lambda: processor.run(None), "input_: expected a path .*or a scene, got NoneType"),
        (lambda: processor.run("a", steps=[3]), r"steps: expected names, in a list or one text with commas, got \[3\]"),
        (lambda: processor.run("a", params=3), "params: expected a path .*or a mapping of one table per step, got int"),
        (lambda: processor.run("a", params={3: {}}), "params: name of a step: expected a text, got 3"),
        (lambda: processor.run("a", seed=-1), "seed: expected a whole number from 0, got -1"),
        (lambda: processor.run("a", lang="fr"), "lang: expected one of en, zh, got 'fr'"),
        (lambda: processor.run("a", cluster=3), "cluster: expected a text, got 3"),
        (lambda: processor.run("a", log=3), "log: expected a function of one text, got 3"),
        (lambda: processor.check(3, 4), "results: expected Results of processor.run, got int"),
        (lambda: processor.convert("a", 3), "there is no such file|output: expected a path"),
        (lambda: processor.export(3, "b"), "results: expected a path .*or Results, got int"),
        (lambda: processor.export("a", "b", spacing_mm="1"), "spacing_mm: expected 0 or a positive length in mm"),
        (lambda: designgen.scan((CORNERS, [[0, 1, 2.5]])), r"model: expected finite vertices \(v, 3\) and faces"),
        (lambda: designgen.scan((CORNERS, SIDES, SIDES)), r"model: expected vertices \(v, 3\) .*found 3 arrays"),
        (lambda: designgen.scan((CORNERS, SIDES), stations=True), "stations: expected a number from 1 or a .json file"),
        (lambda: designgen.scan((CORNERS, SIDES), stations=2.5), "stations: expected a number from 1 or a .json file"),
        (lambda: designgen.scan((CORNERS, SIDES), settings=3), "settings: expected a mapping by .section.key., got 3"),
        (lambda: designgen.make("arch-s1", settings={3: 4}), "settings: expected a mapping by .section.key."),
        (lambda: designgen.make(3), "no recipe '3'"),
    ],
)
def test_wrong_arguments_of_whole_inputs(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert isinstance(caught.value, InputError | UsageError)


def test_a_truth_is_not_the_pair_that_designgen_returns():
    made = designgen.scan((CORNERS, SIDES), stations=1, settings={"scan.step_mrad": 20.0})
    results = processor.run(made[0], steps="deviation")
    with pytest.raises(ValueError, match=r"truth: expected Truth of designgen.make .*\(scene, truth\), got tuple"):
        processor.check(results, made)


# --- Errors of the project are ValueErrors, and pass unchanged where those of others are caught


def test_error_raised_with_an_open_scene_file_is_not_replaced(tmp_path):
    scene, truth = designgen.scan((CORNERS, SIDES), stations=1, settings={"scan.step_mrad": 20.0})
    store.write_scene(tmp_path / "scene.h5", scene, truth, {})
    for kind in (InputError, UsageError):
        with pytest.raises(kind, match=r"^mine$"), store.opened(tmp_path / "scene.h5", ["scene"]):
            raise kind("mine")


def test_a_file_that_is_too_large_is_not_called_unreadable_json(tmp_path, monkeypatch):
    monkeypatch.setattr(text_files.read_text, "__defaults__", (10,))
    (tmp_path / "design.json").write_text('{"kind": "space-frame"}')
    with pytest.raises(InputError, match=r"^[^:]*design\.json: expected at most 10 bytes, found 23"):
        design.read_json(tmp_path / "design.json")


def test_error_raised_by_a_check_is_not_replaced(monkeypatch):
    def check(*_):
        raise InputError("mine")

    results = processor.run(FRAME, steps="spheres", method="least-squares")
    monkeypatch.setattr(space_frame, "check", check)
    with pytest.raises(InputError, match=r"^mine$"):
        processor.check(results, Truth())
