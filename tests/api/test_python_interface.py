"""The Python interface, called as a user calls it."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh
from threadpoolctl import threadpool_info, threadpool_limits

import designgen
import processor
from processor import pipeline
from processor.geometry import rigid
from processor.model import InputError, Scene, Status, UsageError, Verdict
from processor.report import all_tables
from processor.report.table import csv_text
from processor.space_frame.spheres import search_without_design
from tests.support.made import made
from tests.support.solids.meshes import bracket

FRAME_OF_FOUR = Path(__file__).resolve().parents[2] / "fixtures" / "frame-of-four.toml"
SCAN_FOLDER = Path(__file__).resolve().parents[2] / "fixtures" / "scan-folder"
CENTRE, RADIUS = np.array([1.0e6, 2.0e6, 100.0]), 75.0


def test_every_name_of_the_interface_is_there():
    for name in processor.__all__:
        assert getattr(processor, name)
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        processor.magic  # noqa: B018


@pytest.mark.parametrize("in_memory", [False, True])
def test_steps_run_with_one_thread_of_linear_algebra(in_memory, monkeypatch):
    """With more the last digits of results would depend on the machine."""
    seen = []
    execute = pipeline.execute

    def observed(*arguments):
        seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return execute(*arguments)

    monkeypatch.setattr(pipeline, "execute", observed)
    with threadpool_limits(2, user_api="blas"):
        processor.run(
            processor.read(SCAN_FOLDER) if in_memory else SCAN_FOLDER, steps="spheres", method="least-squares"
        )
    assert set(seen) == {1}


def test_a_sphere_of_a_target():
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    direction = direction[direction[:, 0] > 0.1]
    points = CENTRE + (RADIUS + rng.normal(0.0, 0.5, (len(direction), 1))) * direction
    clutter = CENTRE + rng.uniform(-300.0, 300.0, (150, 3))
    fit = processor.fit_sphere(np.vstack([points, clutter]))
    sd = np.sqrt(np.diag(fit.covariance))
    assert fit.status is Status.OK
    # By the class of scanners ranges are 0.5 mm off, which moves the centre along x, and 0.3 mm by incidence, as a
    # larger radius farther away is. The rest is the noise of 1400 points.
    assert sd[[0, 3]] == pytest.approx([np.hypot(0.5, 0.3), 0.3], rel=0.1)
    assert sd[1:3].max() < 0.1
    # Four standard deviations, and what is left of clutter within the noise of the sphere: 0.1 mm, a fifth of it.
    assert (np.abs(fit.centre - CENTRE) < 4.0 * sd[:3] + 0.1).all()
    assert abs(fit.radius - RADIUS) < 4.0 * sd[3] + 0.1
    held = processor.fit_sphere(points, radius=RADIUS)
    assert held.radius == RADIUS
    assert held.covariance[3, 3] == 0.0


def seen_by_a_beam(rng, width, noise=1.5, count=500):
    """Points (count, 3) of a sphere seen from afar along z, by a beam that returns up to ``width`` beside its limb."""
    off, turn = (RADIUS + width) * np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * np.pi, count)
    z = np.sqrt(np.maximum(RADIUS**2 - off**2, 0.0)) + rng.normal(0.0, noise, count)
    return CENTRE + np.column_stack([off * np.cos(turn), off * np.sin(turn), z])


@pytest.mark.parametrize("width", [pytest.param(0.0, marks=pytest.mark.slow), 2.5])
def test_interval_of_a_sphere_whose_scanner_is_unknown_holds_what_the_limb_adds(width):
    """Of 30 intervals of 95 %, 24 or more hold in all but 3 of 10,000 series; without the limb's share 1 holds."""
    inside = 0
    for seed in range(30):
        fit = processor.fit_sphere(seen_by_a_beam(np.random.default_rng(seed), width))
        assert fit.status is Status.OK
        inside += abs(fit.radius - RADIUS) < 1.96 * np.sqrt(fit.covariance[3, 3])
    assert inside >= 24


def test_a_sphere_that_no_ranges_fit_is_weak(monkeypatch):
    monkeypatch.setattr(search_without_design, "robust_fit", lambda *_: None)
    fit = processor.fit_sphere(seen_by_a_beam(np.random.default_rng(0), 0.0))
    assert fit.status is Status.WEAK
    assert [one.code for one in fit.reasons] == ["spheres.unknown-side", "spheres.instrument-assumed"]


def test_interval_of_a_sphere_seen_from_all_around_stays_as_it_is():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    fit = processor.fit_sphere(CENTRE + (RADIUS + rng.normal(0.0, 1.0, (4000, 1))) * normals)
    # The mean of 4000 distances, a little less efficient by Tukey's weights; the 0.5 mm of the class of scanners; and
    # what correlation may add, which 90 cells alone bound: up to half of the sd where there is none.
    assert 1.0 <= np.sqrt(fit.covariance[3, 3] - 0.5**2) / (1.0 / np.sqrt(4000.0)) < 1.5


def test_a_sphere_without_noise():
    """As one makes it to try the function: residuals of rounding alone are no scale of noise."""
    direction = np.random.default_rng(0).normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    for points in (direction, direction[direction[:, 0] > 0.1]):
        fit = processor.fit_sphere(CENTRE + RADIUS * points)
        assert fit.status is Status.OK
        # float64 has steps of 2e-10 mm at the centre, 2 km away; the fit ends at steps of 1e-6 mm
        np.testing.assert_allclose([*fit.centre, fit.radius], [*CENTRE, RADIUS], atol=1e-6)


def test_points_of_no_sphere_fail_and_are_no_error():
    fit = processor.fit_sphere(np.random.default_rng(0).uniform(-500.0, 500.0, (300, 3)))
    assert fit.status in (Status.FAILED, Status.WEAK)


def test_a_shift_of_a_plane_by_m3c2():
    rng = np.random.default_rng(2)
    first = np.column_stack([rng.uniform(-1000.0, 1000.0, (20_000, 2)), rng.normal(0.0, 1.0, 20_000)]) + CENTRE
    second = first + np.array([0.0, 0.0, 5.0])
    scales = {"normal_diameter": 200.0, "projection_diameter": 100.0, "max_depth": 50.0}
    table = processor.m3c2(first, second, core=first[:300], **scales)
    # All points move by the same along the plane's normal: the median core has that but for normals' tilt squared.
    np.testing.assert_allclose(np.median(table.distance), 5.0, atol=1e-3)
    assert table.significant.all()
    assert table.core.shape == table.normals.shape == (300, 3)
    given = processor.m3c2(first, second, core=first[:10], normals=np.tile([0.0, 0.0, -1.0], (10, 1)), **scales)
    # The discs differ at their edges by the tilt alone: means of 40 points have 0.16 mm, three of it
    np.testing.assert_allclose(given.distance, -5.0, atol=0.5)
    metres = {name: length / 1e6 for name, length in scales.items()}
    small = processor.m3c2(first / 1e6, second / 1e6, core=first[:300] / 1e6, **metres)
    np.testing.assert_allclose(1e6 * small.distance, table.distance, atol=1e-3)


def test_a_folder_is_read_and_run(tmp_path):
    scene = processor.read(SCAN_FOLDER)
    assert isinstance(scene, Scene)
    results = processor.run(SCAN_FOLDER, tmp_path / "out", steps="spheres")
    assert (tmp_path / "out" / "results.json").exists()
    assert results.steps["spheres"].status in tuple(Status)
    assert isinstance(results.verdict, Verdict)
    assert results.checks  # the folder holds a truth
    with pytest.raises(InputError, match="no such file"):
        processor.run(tmp_path / "nothing")
    with pytest.raises(UsageError, match="no step 'magic'"):
        processor.run(SCAN_FOLDER, steps=["magic"])


def test_a_scene_is_run_and_compared_with_its_truth():
    scene, truth = made(designgen.make, str(FRAME_OF_FOUR), 1)
    results = processor.run(scene, method=("ray", "ransac"))
    assert results.checks == ()
    assert set(results.comparison["spheres"]) == {"ransac"}
    checks = processor.check(results, truth)
    assert {check.method for check in checks} == {"", "ransac"}


def test_tables_are_data_frames_with_the_columns_of_their_files():
    results = processor.run(made(designgen.make, str(FRAME_OF_FOUR), 1)[0], steps="spheres,inspect")
    for file, table in {
        "balls": results.balls,
        "inspect": results.characteristics,
        "tubes": results.table("tubes"),
    }.items():
        (written,) = [one for one in all_tables.tables_of_run(results.execution, results.report) if one.file == file]
        read = pd.read_csv(io.StringIO(csv_text(written)))
        assert list(table.columns) == list(read.columns)
        assert len(table) == len(read) > 0
    assert list(results.balls)[:5] == ["id", "x_mm", "y_mm", "z_mm", "ci95_x_mm"]
    assert results.balls["x_mm"].dtype == np.float64
    np.testing.assert_allclose(results.balls["radius_mm"], results.steps["spheres"].balls.radii)
    with pytest.raises(UsageError, match=r"no table 'defects'; this run has .*balls"):
        results.defects  # noqa: B018
    assert repr(results).startswith("<processor.Results")
    assert len(repr(results)) < 600
    assert dir(processor) == sorted(processor.__all__)


def test_a_scan_is_registered_to_its_mesh_from_any_pose():
    mesh = bracket()
    rng = np.random.default_rng(3)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 5000, seed=3)[0]) + rng.normal(0.0, 1.0, (5000, 3))
    T = rigid.transform(rigid.rotation_from_vector(np.array([0.3, -1.1, 2.0])), np.array([5e5, 3e6, 100.0]))
    scan = rigid.apply(rigid.invert(T), points)
    pose = processor.register(scan, mesh.vertices, mesh.faces)
    off = pose.T_design_scan @ rigid.invert(T)
    # 5000 points of 1 mm give a pose to some 0.04 mm; a face less or another minimum would be beyond half a noise.
    assert np.abs(rigid.apply(off, mesh.vertices) - mesh.vertices).max() < 0.5
    assert pose.status in (Status.OK, Status.AMBIGUOUS, Status.WEAK)
    assert pose.covariance.shape == (6, 6)
    for faces, message in ((mesh.faces.astype(float), "whole numbers"), (mesh.faces + 10_000, "numbers of vertices")):
        with pytest.raises(ValueError, match=message):
            processor.register(scan, mesh.vertices, faces)
    with pytest.raises(ValueError, match="expected both in mm"):
        processor.register(scan, np.asarray(mesh.vertices) * 1000.0, mesh.faces)


def test_a_scanner_decides_between_poses_that_fit_alike():
    """A square plate of one side seen: turned over it fits as well, but then its seen side faces away."""
    plate = trimesh.creation.box((2000.0, 1500.0, 4.0))
    rng = np.random.default_rng(4)
    places = rng.uniform([-1000.0, -750.0], [1000.0, 750.0], (8000, 2))
    seen = np.column_stack([places, 2.0 + rng.normal(0.0, 0.5, 8000)])
    pose = processor.register(seen, plate.vertices, plate.faces, scanners=[0.0, 0.0, 5000.0])
    up = pose.T_design_scan[:3, :3] @ [0.0, 0.0, 1.0]
    height = rigid.apply(pose.T_design_scan, seen)[:, 2].mean()
    assert np.sign(up[2]) == np.sign(height)
