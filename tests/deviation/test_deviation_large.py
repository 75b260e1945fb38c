"""Step deviation on more points than fit into memory: results by blocks equal those in memory."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import trimesh

from processor import large_arrays
from processor.adjustment import mixed_pixels
from processor.deviation import cloud, large_cloud
from processor.deviation import step as deviation_step
from processor.deviation.params import Params
from processor.geometry import nearest_neighbours, rigid
from processor.model import Scan, Scene, StructureDesign, UsageError
from tests.support import arrays_in_files
from tests.support.scenes import bracket_scenes

COUNT = 6_000
scene_of = partial(bracket_scenes.scene_of, outliers=100, count=COUNT)
EQUAL = {"projection_diameter_mm": 60.0, "core_spacing_mm": 30.0, "max_depth_mm": 40.0}  # not by the density

WALL = [[-700.0, 0.0, -400.0], [700.0, 20.0, 400.0]]
POST = [[-30.0, -300.0, -400.0], [30.0, -200.0, 400.0]]


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Scans of a few thousand points are large, their slabs small, and all arrays in files."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 2_500)
    monkeypatch.setattr(cloud, "SAMPLE_POINTS", 2_000)
    monkeypatch.setattr(large_cloud, "SLAB_POINTS", 700)
    monkeypatch.setattr(large_cloud, "PASS_POINTS", 600)
    monkeypatch.setattr(large_cloud, "HALO", 80.0)  # the neighbours of the few points that are alone, too
    arrays_in_files.limit(monkeypatch, 997)
    with large_arrays.in_files(tmp_path):
        yield


def in_order(*columns):
    table = np.column_stack(columns)
    return table[np.lexsort(np.round(table, 3).T)]


SCENES = {"posed": {"scans": 2}, "stations": {"stations": True}}


@pytest.mark.parametrize("options", SCENES.values(), ids=SCENES)
def test_outliers_scanners_and_views_are_those_of_the_whole(options, small, monkeypatch):
    scene = scene_of(**options)
    large = cloud.of_scene(scene, 20, 1.0).large
    monkeypatch.setattr(cloud, "MOST_POINTS", 10 * COUNT)
    held = cloud.of_scene(scene, 20, 1.0)
    assert held.large is None
    assert (large.kept, held.read) == (held.kept, COUNT)
    count = len(held.points)
    np.testing.assert_array_equal(large.scanners, held.scanners)
    for inliers, points, view in (
        (True, held.points, held.view[:count]),
        (False, held.removed, held.view[count:]),
    ):
        ours, theirs = in_order(*large.thinned(inliers, 1)), in_order(points, view)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)  # coordinates of float64 in another frame
    assert large.spacing_mm == pytest.approx(held.spacing_mm, rel=0.03)  # of another sample


@pytest.mark.parametrize("most", [300, 2 * COUNT])
def test_of_a_large_cloud_every_kth_inlier_is_left_where_fewer_points_are_wanted(most, small):
    whole = cloud.of_scene(scene_of(), 20, 1.0)
    found = cloud.of_scene(scene_of(), 20, 1.0, most=most)
    assert (found.read, found.kept) == (whole.read, whole.kept)
    assert (found.large is None) == (most < whole.kept)
    every = whole.large.thinned(True, 1)[0]
    if found.large is None:
        np.testing.assert_array_equal(found.points, every[:: -(-whole.kept // most)])
        assert found.spacing_mm == pytest.approx(whole.large.spacing_mm * np.sqrt(whole.kept / len(found.points)))
    for step in (3, 701):
        np.testing.assert_array_equal(whole.large.thinned(True, step)[0], every[::step])


@pytest.mark.parametrize("kind", [pytest.param("posed", marks=pytest.mark.slow), "stations"])  # posed ones: above
def test_movements_are_those_of_the_whole(kind, small, monkeypatch):
    monkeypatch.setattr(mixed_pixels, "AT_ONCE", 1_000)
    monkeypatch.setattr(mixed_pixels, "BAND_POINTS", 500)
    scene, params = scene_of(**SCENES[kind]), Params(register="none", **EQUAL)
    blocks = deviation_step.run(scene, params)
    monkeypatch.setattr(cloud, "MOST_POINTS", 10 * COUNT)
    whole = deviation_step.run(scene, params)
    assert (blocks.status, blocks.points_read, blocks.points_kept) == (whole.status, COUNT, whole.points_kept)
    np.testing.assert_array_equal(blocks.core.n1, whole.core.n1)
    for name in ("distance", "lod95"):
        # Sums in another order: 1e-14 came with these seeds.
        np.testing.assert_allclose(getattr(blocks.core, name), getattr(whole.core, name), atol=1e-9)
    assert whole.core.n1.sum() > COUNT


def test_a_point_beside_a_post_is_a_mixed_pixel_whatever_the_block_of_the_post(small, monkeypatch):
    """A wall, and a post before it of which no block of the wall's points has any."""
    boxes = [trimesh.creation.box(bounds=bounds) for bounds in (WALL, POST)]
    mesh, step = trimesh.util.concatenate(boxes), 2.5e-3
    turn, rise = (x.ravel() for x in np.meshgrid(np.arange(-0.12, 0.12, step), np.arange(-0.06, 0.06, step)))
    ray = np.stack([np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)], axis=1)
    on_post = np.abs(ray[:, 0] / ray[:, 1]) * (5000.0 + POST[0][1]) < POST[1][0]
    away = (5000.0 + np.where(on_post, POST[0][1], 0.0)) / ray[:, 1]
    place = np.array([0.0, -5000.0, 0.0])
    beside = ~on_post & (np.abs(ray[:, 0] / ray[:, 1] * 5000.0) < 1.5 * POST[1][0])
    assert beside.any()
    points = place + ray * (away - np.where(beside, 12.0, 0.0))[:, None]  # between the post and the wall
    scan = Scan("s", points[np.argsort(on_post, kind="stable")], position=place)
    design = StructureDesign("wall", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    scene = Scene("wall", "structure", (scan,), structure=design, units="mm")
    monkeypatch.setattr(cloud, "MOST_POINTS", 100)
    params = Params(register="none", outlier_ratio=0.0, **EQUAL)
    found = []
    for size in (100, 10 * COUNT):
        monkeypatch.setattr(large_cloud, "PASS_POINTS", size)
        found.append(deviation_step.run(scene, params))
    blocks, whole = (result.core for result in found)
    np.testing.assert_array_equal(blocks.n1, whole.n1)
    np.testing.assert_allclose(blocks.distance, whole.distance, atol=1e-9)  # sums in another order
    on_wall = (whole.normals[:, 1] < -0.9) & (np.abs(whole.points[:, 1] + found[1].origin[1]) < 1.0)
    assert on_wall.sum() > 100
    assert np.nanmax(np.abs(whole.distance[on_wall])) < 1e-9  # points lie on it: rounding


def test_all_points_are_used_without_a_limit_of_points(small, monkeypatch):
    """As many points as fit into memory, and four times as many: the intervals of the same core points halve."""
    scene = scene_of(outliers=0, count=COUNT)
    few = dataclasses.replace(scene, scans=(dataclasses.replace(scene.scans[0], points=scene.scans[0].points[::4]),))
    params = Params(register="none", registration_error_mm=0.0, **{**EQUAL, "projection_diameter_mm": 200.0})
    one, four = (deviation_step.run(each, params) for each in (few, scene))
    # Every fourth of 6,000 points: three sds.
    assert four.core.n1.sum() / one.core.n1.sum() == pytest.approx(4.0, rel=0.05)
    # Three sds of the ratio of two standard deviations of 60 points each, over many places.
    assert np.nanmedian(four.core.lod95 / one.core.lod95) == pytest.approx(0.5, rel=0.1)
    thinned = deviation_step.run(scene, dataclasses.replace(params, most_points=COUNT // 4))
    assert thinned.core.n1.sum() / one.core.n1.sum() == pytest.approx(1.0, rel=0.05)  # as above


@pytest.mark.slow  # every day: of points in memory, in test_deviation_step.py
def test_scans_that_lie_elsewhere_are_left_out_of_all_points(small):
    scene = bracket_scenes.scene_of(scans=2)
    away = dataclasses.replace(scene.scans[1], T_project_scan=rigid.transform(np.eye(3), np.array([9e4, 0.0, 0.0])))
    result = deviation_step.run(dataclasses.replace(scene, scans=(scene.scans[0], away)), Params())
    assert "deviation.scans-elsewhere" in [reason.code for reason in result.reasons]
    assert 0.9 < result.points_kept / (bracket_scenes.COUNT / 2) < 1.0  # less the 200 outliers of 12,000, and some more
    alone = deviation_step.run(dataclasses.replace(scene, scans=scene.scans[:1]), Params(register="none"))
    assert result.mean == pytest.approx(alone.mean, abs=0.05)  # other core points of the same scan: 0.015 came


def test_a_whole_number_of_points_is_asked_for():
    with pytest.raises(UsageError, match="most_points: expected a whole number of 0 or more"):
        Params(most_points=-1).check()


def test_points_of_one_place_and_empty_slabs(small):
    """Two clusters far apart: the slabs between them hold nothing; neighbours are found all the same."""
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 1.0, (4000, 3)) + [[1e6, 0.0, 0.0]] * (np.arange(4000) % 2)[:, None]
    scene = Scene("two", "structure", (Scan("s", points),), units="mm")
    large = cloud.of_scene(scene, 20, 1.0).large
    grid = nearest_neighbours.of_spacing(points)
    assert large.kept == int(nearest_neighbours.statistical_inliers(grid, 20, 1.0).sum())
    assert large.scanners is None
