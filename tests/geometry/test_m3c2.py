"""M3C2 against brute force from its definition and real planes; order and threads must not change it."""

import numpy as np
import pytest

from processor.geometry import m3c2, point_grid
from tests.support.clouds.m3c2_clouds import brute, wavy
from tests.support.files.scan_bytes import DATA, needs_data

ROUNDING_MM = 1e-12  # of a metre, through sums of some ten points: 1e-13
UP = np.array([0.0, 0.0, 1.0])


def columns(found):
    return np.array([found.distance, found.lod95, found.n1, found.n2, found.std1, found.std2])


def both(reference, compared, core, normal_diameter=80.0, diameter=50.0, depth=40.0, error=0.3, threads=0):
    grids = [m3c2.grid(cloud, diameter) for cloud in (reference, compared)]
    normals = m3c2.oriented(m3c2.normals(grids[0], core, normal_diameter, threads).normals, UP)
    found = m3c2.distances(
        *grids, core, normals, projection_diameter_mm=diameter, max_depth_mm=depth, registration_error_mm=error,
        threads=threads,
    )  # fmt: skip
    return normals, found


@pytest.mark.parametrize("case", [(80.0, 50.0, 40.0), (60.0, 120.0, 5.0), (200.0, 20.0, 300.0)])
def test_normals_and_distances_equal_those_by_brute_force(case):
    reference, compared = wavy(10_000, 1), wavy(8_000, 2, 5.0)
    core = np.vstack([reference[:60], wavy(20, 3, 15.0), [[-400.0, 0.0, 0.0], [1e6, 0.0, 0.0], [500.0, 500.0, 70.0]]])
    normals, found = both(reference, compared, core, *case)
    known = np.isfinite(normals).all(axis=1)
    assert 60 < known.sum() < len(core)
    for place, normal in zip(core[known], normals[known], strict=True):
        near = reference[np.linalg.norm(reference - place, axis=1) <= case[0] / 2]
        expected = np.linalg.svd(near - near.mean(axis=0))[2][2]
        # By singular values of ten points and more.
        np.testing.assert_allclose(normal, expected * np.sign(expected[2]), atol=1e-11)
    expected = brute(reference, compared, core[known], normals[known], *case[1:], 0.3)
    np.testing.assert_allclose(columns(found)[:, known], expected, atol=ROUNDING_MM)
    assert np.isnan(found.distance[~known]).all()
    assert (found.n1[~known] == 0).all()


def test_distances_are_right_along_normals_of_any_direction():
    rng = np.random.default_rng(4)
    reference, compared = rng.uniform(0.0, 300.0, (2, 6000, 3))
    core = rng.uniform(-20.0, 320.0, (100, 3))
    normals = rng.normal(size=(100, 3))
    normals[:6] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    found = m3c2.distances(
        m3c2.grid(reference, 40.0), m3c2.grid(compared, 11.0), core, normals, projection_diameter_mm=40.0,
        max_depth_mm=150.0,
    )  # fmt: skip
    np.testing.assert_allclose(
        columns(found), brute(reference, compared, core, normals, 40.0, 150.0, 0.0), atol=ROUNDING_MM
    )


def test_fewer_than_four_points_have_no_level_of_detection():
    plane = np.array([[x, y, 0.0] for x in range(-5, 6) for y in range(-5, 6)])
    for count, known in ((3, False), (4, True)):
        few = np.array([[0.1, 0.0, 2.0], [0.0, 0.1, 2.5], [0.1, 0.1, 2.0], [0.0, 0.0, 2.5]])[:count]
        found = m3c2.distances(
            m3c2.grid(plane, 4.0), m3c2.grid(few, 4.0), np.zeros((1, 3)), UP[None], projection_diameter_mm=4.0,
            max_depth_mm=3.0,
        )  # fmt: skip
        assert np.isfinite(found.lod95[0]) == known
        assert found.significant[0] == known
        assert found.n2[0] == count
    assert found.n1[0] == 13  # of a grid of unit steps within 2 of a point of it, the rim included
    assert found.lod95[0] == pytest.approx(1.96 * 0.25 / 2.0)  # population sd of +-0.25, four points
    assert found.distance[0] == pytest.approx(2.25)


def test_a_cloud_is_at_no_distance_from_itself():
    cloud = wavy(5000, 5)
    _, found = both(cloud, cloud, cloud)
    np.testing.assert_array_equal(found.distance, 0.0)
    assert not found.significant.any()


def test_order_of_points_and_threads_do_not_change_the_results():
    reference, compared = wavy(10_000, 6), wavy(10_000, 7)
    reference[100:200] = reference[:100]  # twice the same
    core = reference[::7]
    first = both(reference, compared, core, threads=1)
    rng = np.random.default_rng(8)
    mixed = rng.permutation(len(core))
    for threads in (2, 5):
        again = both(rng.permutation(reference), rng.permutation(compared), core[mixed], threads=threads)
        np.testing.assert_array_equal(again[0], first[0][mixed])
        np.testing.assert_array_equal(columns(again[1]), columns(first[1])[:, mixed])


def test_a_finer_grid_than_there_are_points_takes_no_more_room():
    cloud = wavy(2000, 9, size=1e6)
    grid = m3c2.grid(cloud, 1e-3)
    assert grid.cells.starts.size < 10 * len(cloud) + 100
    found = m3c2.distances(grid, grid, cloud, np.tile(UP, (2000, 1)), projection_diameter_mm=1e-3, max_depth_mm=1.0)
    assert (found.n1 == 1).all()


def test_an_empty_cloud_is_no_error():
    cloud = wavy(500, 10)
    _, found = both(cloud, np.empty((0, 3)), cloud[:20], diameter=200.0)
    assert np.isnan(found.distance).all()
    assert (found.n2 == 0).all()
    assert point_grid.of_points(np.empty((0, 3)), 1.0).count == 0


def test_points_on_a_line_have_no_normal():
    line = np.outer(np.arange(50.0), [1.0, 2.0, 3.0])
    assert np.isnan(m3c2.normals(m3c2.grid(line, 20.0), line, 40.0).normals).all()


@needs_data
def test_real_planes_are_a_tenth_apart():
    t1, t2 = (np.loadtxt(DATA / f"m3c2/plane_horizontal_t{i}.xyz") for i in (1, 2))
    _, found = both(t1, t2, t1, normal_diameter=6.0, diameter=4.0, depth=2.0, error=0.0)
    assert np.mean(found.distance) == pytest.approx(-0.100, abs=1e-3)  # as its publishers state it
    assert found.significant.all()
