"""Step deviation on more points than fit into memory: results by blocks equal those in memory."""

import dataclasses

import numpy as np
import pytest

from processor import large_arrays
from processor.adjustment import mixed_pixels
from processor.deviation import cloud, large_cloud
from processor.deviation import step as deviation_step
from processor.deviation.params import Params
from processor.geometry import nearest_neighbours, rigid
from processor.model import Scan, Scene, UsageError
from tests.support.scenes.bracket_scenes import COUNT, scene_of

EQUAL = {"projection_diameter_mm": 60.0, "core_spacing_mm": 30.0, "max_depth_mm": 40.0}  # not by the density


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Scans of a few thousand points are large, their slabs small, and all arrays in files."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 5_000)
    monkeypatch.setattr(cloud, "SAMPLE_POINTS", 4_000)
    monkeypatch.setattr(large_cloud, "SLAB_POINTS", 700)
    monkeypatch.setattr(large_cloud, "PASS_POINTS", 600)
    monkeypatch.setattr(large_cloud, "HALO", 80.0)  # the neighbours of the few points that are alone, too
    monkeypatch.setattr(large_arrays, "BLOCK_ROWS", 997)
    monkeypatch.setattr(large_arrays, "MEMORY_BYTES", 0)
    monkeypatch.setattr(large_arrays, "LEAST_BYTES", 1)
    with large_arrays.in_files(tmp_path):
        yield


def in_order(*columns):
    table = np.column_stack(columns)
    return table[np.lexsort(np.round(table, 3).T)]


SCENES = {"posed": {"scans": 2}, "stations": {"stations": True}}


@pytest.mark.parametrize("options", SCENES.values(), ids=SCENES)
def test_outliers_scanners_and_sources_are_those_of_the_whole(options, small, monkeypatch):
    scene = scene_of(**options)
    large = cloud.of_scene(scene, 20, 1.0).large
    monkeypatch.setattr(cloud, "MOST_POINTS", 10 * COUNT)
    held = cloud.of_scene(scene, 20, 1.0)
    assert held.large is None
    assert (large.kept, held.read) == (held.kept, COUNT)
    count = len(held.points)
    for inliers, points, scanner, source in (
        (True, held.points, held.scanner, held.source[:count]),
        (False, held.removed, held.removed_scanner, held.source[count:]),
    ):
        ours, theirs = in_order(*large.thinned(inliers, 1)), in_order(points, scanner, source)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert large.spacing_mm == pytest.approx(held.spacing_mm, rel=0.03)  # of another sample


def test_isolated_points_beyond_the_halo_hardly_change_the_inliers(small, monkeypatch):
    """Their mean distance is overstated: the limit, and a point or two at it, change."""
    exact = cloud.of_scene(scene_of(), 20, 1.0).kept
    monkeypatch.setattr(large_cloud, "HALO", 20.0)
    assert cloud.of_scene(scene_of(), 20, 1.0).kept == pytest.approx(exact, abs=20)


def test_a_sample_is_every_kth_inlier(small):
    large = cloud.of_scene(scene_of(), 20, 1.0).large
    every = large.thinned(True, 1)[0]
    for step in (2, 3, 700, 701):
        np.testing.assert_array_equal(large.thinned(True, step)[0], every[::step])


@pytest.mark.parametrize("options", SCENES.values(), ids=SCENES)
def test_movements_are_those_of_the_whole(options, small, monkeypatch):
    """But for mixed pixels: those whose nearer neighbour lies in another block are not known as such."""
    monkeypatch.setattr(mixed_pixels, "mark", lambda points, *_: np.zeros(len(points), np.bool_))
    scene, params = scene_of(**options), Params(register="none", **EQUAL)
    blocks = deviation_step.run(scene, params)
    monkeypatch.setattr(cloud, "MOST_POINTS", 10 * COUNT)
    whole = deviation_step.run(scene, params)
    assert (blocks.status, blocks.points_read, blocks.points_kept) == (whole.status, COUNT, whole.points_kept)
    np.testing.assert_array_equal(blocks.core.n1, whole.core.n1)
    for name in ("distance", "lod95"):
        np.testing.assert_allclose(getattr(blocks.core, name), getattr(whole.core, name), atol=1e-3)
    assert whole.core.n1.sum() > COUNT


def test_all_points_are_used_without_a_limit_of_points(small, monkeypatch):
    """As many points as fit into memory, and four times as many: the intervals of the same core points halve."""
    scene = scene_of(outliers=0)
    few = dataclasses.replace(scene, scans=(dataclasses.replace(scene.scans[0], points=scene.scans[0].points[::4]),))
    params = Params(register="none", registration_error_mm=0.0, **{**EQUAL, "projection_diameter_mm": 200.0})
    one, four = (deviation_step.run(each, params) for each in (few, scene))
    assert four.core.n1.sum() / one.core.n1.sum() == pytest.approx(4.0, rel=0.05)
    assert np.nanmedian(four.core.lod95 / one.core.lod95) == pytest.approx(0.5, rel=0.1)
    thinned = deviation_step.run(scene, dataclasses.replace(params, most_points=COUNT // 4))
    assert thinned.core.n1.sum() / one.core.n1.sum() == pytest.approx(1.0, rel=0.05)


def test_scans_that_lie_elsewhere_are_left_out_of_all_points(small):
    scene = scene_of(scans=2)
    away = dataclasses.replace(scene.scans[1], T_project_scan=rigid.transform(np.eye(3), np.array([9e4, 0.0, 0.0])))
    result = deviation_step.run(dataclasses.replace(scene, scans=(scene.scans[0], away)), Params())
    assert "deviation.scans-elsewhere" in [reason.code for reason in result.reasons]
    assert COUNT / 2 * 0.9 < result.points_kept < COUNT / 2
    alone = deviation_step.run(dataclasses.replace(scene, scans=scene.scans[:1]), Params())
    assert result.mean == pytest.approx(alone.mean, abs=0.05)


def test_a_whole_number_of_points_is_asked_for():
    with pytest.raises(UsageError, match="most_points: expected 0 or more"):
        Params(most_points=-1).check()


def test_points_of_one_place_and_empty_slabs(small):
    """Two clusters far apart: the slabs between them hold nothing; neighbours are found all the same."""
    rng = np.random.default_rng(0)
    points = np.vstack([rng.normal(0.0, 1.0, (4000, 3)), rng.normal(0.0, 1.0, (4000, 3)) + np.array([1e6, 0.0, 0.0])])
    scene = Scene("two", "structure", (Scan("s", points),), units="mm")
    large = cloud.of_scene(scene, 20, 1.0).large
    grid = nearest_neighbours.of_spacing(points)
    assert large.kept == int(nearest_neighbours.statistical_inliers(grid, 20, 1.0).sum())
    assert large.scanners is None
