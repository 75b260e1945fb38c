"""Points of a scene found by their places, beside a search tree over all of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor import large_arrays
from processor.geometry import rigid
from processor.inspection import points_in_design_frame
from processor.model import Scan, Scene, Stations
from tests.support import arrays_in_files

NOWHERE = np.eye(4), np.zeros(3)


def along_x(count, first):
    return np.column_stack([first + 100.0 * np.arange(count), np.zeros(count), np.zeros(count)])


@pytest.mark.parametrize("large", [False, True])
def test_points_near_places_are_those_of_a_search_tree_with_their_rays(large, monkeypatch, tmp_path):
    rng = np.random.default_rng(4)
    points, station = rng.uniform(-900.0, 900.0, (6000, 3)), rng.integers(0, 3, 6000)
    positions = 1e6 + rng.uniform(-9e3, 9e3, (3, 3))
    pose = rigid.transform(rigid.rotation_from_vector(np.array([0.0, 0.0, 0.7])), np.array([1e6, 1e6, 1e6]))
    own = np.array([100.0, 9e3, 0.0])  # of the second scan, in its frame
    scans = (
        Scan("a", points, point_station=station, T_project_scan=pose),
        Scan("b", points + 3.0, position=own, T_project_scan=pose),
    )
    scene = Scene("x", "structure", scans, stations=Stations(ids=("1", "2", "3"), positions=positions))
    T = rigid.transform(rigid.rotation_from_vector(np.array([0.2, 0.0, 0.0])), np.array([50.0, 60.0, 70.0]))
    origin = np.full(3, 1e6)
    if large:
        arrays_in_files.limit(monkeypatch, 500, 2000)
    with large_arrays.in_files(tmp_path):
        cloud = points_in_design_frame.of_scene(scene, T, origin)
        places = rng.uniform(-800.0, 800.0, (40, 3)) + rigid.apply(T @ pose, np.zeros(3)) - origin
        seen = cloud.near(places, 180.0)
    placed = rigid.apply(T @ pose, np.concatenate([points, points + 3.0])) - origin
    scanners = np.concatenate([positions[station], np.tile(rigid.apply(pose, own), (6000, 1))])
    ray = placed + origin - rigid.apply(T, scanners)
    rows = np.flatnonzero(cKDTree(places).query(placed)[0] < 180.0)
    rows = rows[np.lexsort(placed[rows].T)]
    order = np.lexsort(seen.points.T)
    np.testing.assert_allclose(seen.points[order], placed[rows], atol=1e-6)  # float64 at 1e6
    expected = ray[rows] / np.linalg.norm(ray[rows], axis=1, keepdims=True)
    np.testing.assert_allclose(seen.ray[order], expected, atol=1e-9)  # of rays of some metres
    assert set(cloud.near(places + 1e5, 180.0).view.tolist()) == set()


def test_rays_are_unknown_where_the_place_of_any_scanner_is():
    scans = (Scan("a", along_x(3, 0.0), position=np.ones(3)), Scan("b", along_x(3, 900.0)))
    seen = points_in_design_frame.of_scene(Scene("x", "structure", scans), *NOWHERE).near(along_x(12, 0.0), 1.0)
    assert len(seen.points) == 6
    assert np.isnan(seen.ray).all()
