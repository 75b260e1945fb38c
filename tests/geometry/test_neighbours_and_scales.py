"""Neighbours and the scales of M3C2, against brute force and the share of normal noise."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor.geometry import m3c2, nearest_neighbours
from processor.model import InputError
from tests.support.clouds.m3c2_clouds import wavy

UP = np.array([0.0, 0.0, 1.0])


def test_neighbours_are_those_of_a_tree():
    points = np.vstack([wavy(4000, 1), np.random.default_rng(2).uniform(-500.0, 1500.0, (50, 3))])
    grid = nearest_neighbours.of_spacing(points)
    tree = cKDTree(points)
    expected = tree.query(points, k=21)[0][:, 1:].mean(axis=1)
    np.testing.assert_allclose(nearest_neighbours.mean_distances(grid, 20), expected[grid.order], rtol=1e-12)
    inliers = expected <= expected.mean() + expected.std()
    np.testing.assert_array_equal(nearest_neighbours.statistical_inliers(grid, 20, 1.0), inliers[grid.order])
    np.testing.assert_array_equal(nearest_neighbours.without_outliers(points, 20, 1.0), points[inliers])
    places = np.random.default_rng(3).uniform(-3000.0, 4000.0, (300, 3))
    np.testing.assert_allclose(nearest_neighbours.nearest(grid, places), tree.query(places)[0], rtol=1e-12)


def test_spacing_is_of_a_plane_with_one_point_a_square():
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0.0, 2000.0, (2, 40_000))
    spread = nearest_neighbours.of_spacing(np.column_stack([x, y, 0.0 * x]))
    assert nearest_neighbours.spacing(spread) == pytest.approx(10.0, rel=0.02)  # 40,000 distances of sd 0.5: 0.3 %
    assert np.isnan(nearest_neighbours.spacing(nearest_neighbours.of_spacing(np.zeros((1, 3)))))
    assert nearest_neighbours.spacing(nearest_neighbours.of_spacing(np.zeros((9, 3)))) == 0.0


def test_cells_fit_a_cloud_with_a_point_far_away_however_its_blocks_are_counted(monkeypatch):
    rng = np.random.default_rng(9)
    x, y = rng.uniform(0.0, 2000.0, (2, 40_000))
    points = np.vstack([np.column_stack([x, y, 0.0 * x]), [[1e7, 0.0, 0.0]]])
    monkeypatch.setattr(nearest_neighbours, "CROWDED", 500.0)
    grid = nearest_neighbours.of_spacing(points)
    assert 10.0 < grid.cells.size < 30.0
    monkeypatch.setattr(nearest_neighbours, "CROWD_BLOCKS", 3)
    again = nearest_neighbours.of_spacing(points)
    assert again.cells.size == grid.cells.size
    np.testing.assert_array_equal(again.order, grid.order)


def test_derived_scales_contain_the_intended_number_of_points():
    assert m3c2.diameter_for(20, np.sqrt(1e6 / 500.0)) == pytest.approx(225.7, abs=0.1)  # by hand, 500 points/m2
    assert [m3c2.rounded(x) for x in (0.12345, 225.7, 1e-7, 100.0)] == [0.124, 226.0, 1e-7, 100.0]
    cloud, other = wavy(20_000, 5), wavy(5000, 6, 30.0)
    grids = [nearest_neighbours.of_spacing(one) for one in (cloud, other)]
    found = m3c2.derive_scales(*grids, cloud)
    assert found.compared_spacing_mm > 1.8 * found.reference_spacing_mm
    held = 5000 / 1e6 * np.pi / 4.0 * found.projection_diameter_mm**2
    assert 45.0 < held < 60.0  # of the sparser cloud
    assert 60.0 <= found.max_depth_mm <= 10.0 * found.projection_diameter_mm
    given = m3c2.derive_scales(*grids, cloud, 7.0, 8.0, 9.0)
    assert (given.normal_diameter_mm, given.projection_diameter_mm, given.max_depth_mm) == (7.0, 8.0, 9.0)
    same = nearest_neighbours.of_spacing(np.zeros((9, 3)))
    with pytest.raises(InputError, match="density"):
        m3c2.derive_scales(same, same, cloud)


def planes_compared(seed, off=0.0, error=0.0):
    """Share beyond LOD95 of two noisy scans of one plane, the second ``off`` by so much; scales by density."""
    rng = np.random.default_rng(seed)
    pair = [np.column_stack([*rng.uniform(0.0, 3000.0, (2, 60_000)), rng.normal(0.0, 2.0, 60_000)]) for _ in range(2)]
    grids = [nearest_neighbours.of_spacing(one + k * off * UP) for k, one in enumerate(pair)]
    x, y = (one.ravel() for one in np.meshgrid(*[np.arange(100.0, 2901.0, 40.0)] * 2))
    core = np.column_stack([x, y, 0.0 * x])
    used = m3c2.derive_scales(*grids, core)
    normals = m3c2.oriented(m3c2.normals(grids[0], core, used.normal_diameter_mm).normals, UP)
    return m3c2.distances(
        *grids, core, normals, projection_diameter_mm=used.projection_diameter_mm, max_depth_mm=used.max_depth_mm,
        registration_error_mm=error,
    ).significant.mean()  # fmt: skip


def test_five_percent_are_significant_for_normal_noise_without_change():
    """Normal noise, no registration error: 5 %, and a little more as sd of few points are a little small."""
    shares = [planes_compared(seed) for seed in range(4)]
    # Some 1000 cylinders that share no point: sd 0.7 % of one share, 0.35 % of the mean.
    assert 0.04 < np.mean(shares) < 0.06
    assert 0.025 < min(shares) < max(shares) < 0.085


def test_unstated_registration_error_gives_significant_distances():
    assert planes_compared(20, off=1.5) > 0.5
    assert planes_compared(20, off=1.5, error=1.5) < 0.05
