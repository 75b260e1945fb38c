"""Faces of points near edges and on thin plates: a plate as designed has no deviation, whatever is known of it."""

import dataclasses

import numpy as np
import pytest
import trimesh

from processor.deviation import assignment, surface_movement
from processor.deviation import step as deviation_step
from processor.geometry import mesh_distance
from processor.model import Scan, Scene, StructureDesign
from tests.support.clouds.plate_clouds import AS_IT_LIES, SIGMA, STATIONS, plate


def from_edge(core, thickness):
    half = 0.5 * np.array([300.0, 300.0, thickness])
    distance = half - np.abs(core.points)
    distance[np.arange(len(core)), np.argmax(np.abs(core.normals), axis=1)] = np.inf
    return distance.min(axis=1)


@pytest.mark.parametrize(("positions", "sides"), [(True, 2), (False, 1)])
def test_a_plate_as_designed_deviates_nowhere(positions, sides):
    """Of the plate seen from both sides the step itself finds that no other attitude fits better."""
    scene = plate(5.0, 3, STATIONS[:sides], positions, count=40_000)
    core = deviation_step.run(scene, deviation_step.Params() if positions else AS_IT_LIES).core
    known = np.isfinite(core.lod95)
    edge = from_edge(core, 5.0)
    # A twentieth at most, as LOD95 holds a registration error too: six draws of noise gave 0.027 to 0.039.
    assert 0.02 < core.distances.significant[known].mean() < 0.07
    near = known & (edge < 5.0)
    assert near.sum() > 100
    assert core.distances.significant[near].mean() < 0.12  # core points that share points: about 60 are independent
    # A wrong face would be 5 mm off; largest of six draws 0.34, in means of points of 0.5 mm.
    assert np.abs(core.distance[known]).max() < 1.0
    assert abs(core.distance[known].mean()) < 0.015  # four sds of the mean of 20,000 points of 0.5 mm
    faces = np.argmax(np.abs(core.normals), axis=1) == 2
    seen = faces & (core.normals @ STATIONS[0] > 0.0)
    assert known[seen].mean() > 0.99  # a face in full view: all of it in six draws
    if sides == 1:
        assert not known[faces & ~seen].any()


def test_a_plate_thinner_than_its_noise_has_no_answer_without_positions():
    scene = plate(1.0, 4, STATIONS, positions=False, count=30_000)
    core = deviation_step.run(scene, AS_IT_LIES).core
    # Noise of 0.5 mm hides which of two faces 1 mm apart it is: none in three draws.
    assert np.isfinite(core.lod95).mean() < 0.01
    scene = plate(1.0, 4, STATIONS, positions=True, count=30_000)
    core = deviation_step.run(scene, AS_IT_LIES).core
    known = np.isfinite(core.lod95)
    # Rays tell them apart: 0.993 in three draws, of which 0.039 to 0.046 are significant, and a twentieth should be.
    assert known.mean() > 0.9
    assert core.distances.significant[known].mean() < 0.07


def test_the_nearest_face_is_taken_and_its_clearance_is_the_distance_of_the_next():
    mesh = trimesh.creation.box((200.0, 200.0, 20.0))
    surface = mesh_distance.of_design(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 30.0)
    curved = mesh_distance.of_surface(surface)
    points = np.array([[97.0, 0.0, 9.5], [99.5, 0.0, 7.0], [0.0, 0.0, 8.0], [0.0, 0.0, -50.0], [101.0, 0.0, 12.0]])
    seen = assignment.assigned(points, None, curved, grid)
    np.testing.assert_allclose(seen.distance[:3], [-0.5, -0.5, -2.0], atol=1e-9)  # float64
    np.testing.assert_allclose(surface.normals[seen.facet[:3]], [[0, 0, 1], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(seen.clearance[:3], [3.0, 3.0, 10.0], atol=1e-9)  # half of the thickness
    assert seen.facet[3] == -1
    assert not assignment.clear(seen, np.full(5, 2.0))[[0, 1, 3, 4]].any()
    assert assignment.clear(seen, np.full(5, 2.0))[2]
    middles = np.vstack([surface.vertices[surface.faces].mean(axis=1), [0.0, 0.0, -50.0]])
    cloud = surface_movement.Cloud(middles, np.zeros(13, bool), np.zeros(13, np.int64))
    of_points = surface_movement._assigned_of(cloud, surface_movement._Fit(None, curved, grid, 20.0, 30.0, None))
    assert of_points[2].face.tolist() == [*surface.part_of, -1]  # of every facet, the first as well
    assert of_points[3] == (12, 13)
    # From below, the top is not visible: neither to a point that lies there, nor as what a point may be mistaken for.
    below = assignment.assigned(points, np.tile([0.0, 0.0, -5000.0], (5, 1)), curved, grid)
    assert surface.normals[below.facet[2], 2] == pytest.approx(-1.0)
    assert not np.isfinite(below.clearance[2])


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_stations_that_differ_widen_the_level_of_detection(offset):
    """Five stations see both of a box's large faces from one side; the truth is that of a box as designed."""
    rng = np.random.default_rng(8)
    mesh = trimesh.creation.box((600.0, 600.0, 300.0))
    points, facet = trimesh.sample.sample_surface(mesh, 20_000, seed=8)
    normals = mesh.face_normals[facet]
    stations, scans = rng.integers(0, 5, len(points)), []
    for k in range(5):
        some = stations == k
        off = rng.normal(0.0, SIGMA, some.sum()) + rng.normal(0.0, offset, 6) @ np.vstack(
            [np.isclose(normals[some] @ axis, 1.0) for axis in (*np.eye(3), *-np.eye(3))]
        )
        scans.append(Scan(f"s{k}", np.asarray(points)[some] + off[:, None] * normals[some]))
    design = StructureDesign("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    scene = Scene("box", "structure", tuple(scans), structure=design, units="mm")
    core = deviation_step.run(scene, dataclasses.replace(AS_IT_LIES, registration_error_mm=0.0)).core
    known = np.isfinite(core.lod95)
    shared = core.std1[known] / np.sqrt(core.n1[known])
    if offset == 0.0:
        assert (shared == 0.0).all()
    else:
        assert 0.06 < np.median(shared) < 0.4  # 0.3 / sqrt(5), widened for five stations
        # A twentieth, but of five offsets a face alone: three draws gave 0.004 to 0.03.
        assert core.distances.significant[known].mean() < 0.1


def test_mixed_pixels_behind_bars_are_no_deviation():
    """A beam that meets the edge of a bar and the wall 20 mm behind it states a range between the two."""
    scanner, step, bars = np.array([0.0, -5000.0, 0.0]), 2.0e-3, 60.0 * np.arange(-5, 6)
    turn, rise = (x.ravel() for x in np.meshgrid(np.arange(-40, 41) * step, np.arange(-40, 41) * step))
    ray = np.stack([np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)], axis=1)
    x = ray[:, 0] / ray[:, 1] * 4980.0  # in the plane of the bars' faces
    beside = np.abs(x[:, None] - bars).min(axis=1) - 10.0  # of a bar's edge: bars are 20 mm wide
    share = np.clip(0.5 - beside / 7.0, 0.0, 1.0)  # of a beam 7 mm wide that meets a bar
    depth = 5000.0 - 20.0 * share
    noise = np.random.default_rng(5).normal(0.0, 0.3, len(ray))
    points = scanner + ray * (depth / ray[:, 1] + noise)[:, None]
    boxes = [trimesh.creation.box((800.0, 20.0, 800.0)).apply_translation((0.0, 10.0, 0.0))]
    boxes += [trimesh.creation.box((20.0, 5.0, 800.0)).apply_translation((x, -17.5, 0.0)) for x in bars]
    mesh = trimesh.util.concatenate(boxes)
    design = StructureDesign("grating", np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    scene = Scene("grating", "structure", (Scan("s", points, position=scanner),), structure=design, units="mm")
    result = deviation_step.run(scene, AS_IT_LIES)
    known = np.isfinite(result.core.lod95)
    assert known.sum() > 500
    # A mixed pixel would be off by up to 20 mm; largest of three draws 0.22, in means of points of 0.3 mm.
    assert np.abs(result.core.distance[known]).max() < 1.0
    assert abs(result.mean) < 0.02  # five sds of 6,561 rays of 0.3 mm
