"""Voxels of points and movements along normals, against closed forms."""

import numpy as np
import pytest

from processor.adjustment.point_groups import group_means
from processor.deviation import cloud as deviation_cloud
from processor.deviation import local_translation as moving
from processor.deviation import station_offsets
from processor.geometry import m3c2

UP = np.array([0.0, 0.0, 1.0])


def test_adaptive_voxels_contain_their_number_of_points():
    rng = np.random.default_rng(10)
    dense, sparse = rng.uniform(0.0, 10.0, (5000, 3)), rng.uniform(0.0, 1000.0, (300, 3))
    points = np.vstack([dense, sparse])
    group = deviation_cloud.adaptive_voxels(points, 2.0, 5, 2.0)
    count = np.bincount(group)
    assert (count[:-1] >= 5).all()
    assert count.sum() == len(points)
    widths = [np.ptp(points[group == g], axis=0).max() for g in range(len(count) - 1)]
    assert max(widths[:50]) <= 2.0 < np.max(widths)
    shifted = deviation_cloud.adaptive_voxels(points + np.array([700.7, -0.3, 1.1]), 2.0, 5, 2.0)
    np.testing.assert_array_equal(shifted, group)  # voxels begin at the lowest point, in any frame
    means = group_means(points, group)
    np.testing.assert_allclose(means[3], points[group == 3].mean(axis=0))


def test_movement_along_the_normal_is_that_of_the_body_for_any_point_normals():
    rng = np.random.default_rng(13)
    angle = rng.uniform(-1.0, 1.0, 4000)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(4000)])
    feet = 80.0 * normals + np.outer(rng.uniform(-300.0, 300.0, 4000), UP)
    moved = np.array([3.0, -7.0, 50.0])
    distance = normals @ moved + rng.normal(0.0, 0.5, 4000)
    grid = m3c2.grid(feet, 150.0)
    place = np.array([[80.0, 0.0, 0.0], [80.0 * np.cos(0.5), 80.0 * np.sin(0.5), 10.0], [900.0, 0.0, 0.0]])
    look = np.array([[1.0, 0.0, 0.0], [np.cos(0.5), np.sin(0.5), 0.0], [1.0, 0.0, 0.0]])
    translations = moving.Translations(place, look, diameter_mm=150.0, least_cos=0.5)
    translations.add(grid, distance[grid.order], normals[grid.order])
    found = translations.movement()
    error = found.along[:2] - look[:2] @ moved
    bound = 1.96 * found.sd[:2] / np.sqrt(found.count[:2])
    assert (np.abs(error) < 2.0 * bound).all()  # four sds
    assert (bound < 0.1).all()  # 1.96 sds of 600 points of 0.5 mm are 0.04, and directions are fitted as well
    expected = np.linalg.lstsq(
        normals[near := np.linalg.norm(feet - place[0], axis=1) <= 75.0][:, :2], distance[near], rcond=None
    )[0]
    np.testing.assert_allclose(found.vector[0], [*expected, 0.0], atol=1e-9)  # float64
    assert found.count[0] == near.sum()
    assert np.isnan(found.along[2])
    assert found.count[2] == 0


@pytest.mark.parametrize(("apart", "variance"), [(3, 0.0), (4, 4 * 2.0 / 100.0)])
def test_stations_differ_where_the_mean_over_pieces_is_twice_its_standard_deviation(apart, variance):
    """Of 100 pieces k have two stations 2 mm apart: mean 2 k / 100; k / (1 - k / 100) > 2^2 from k = 4 on."""
    cell, off = np.repeat(np.arange(100), 2), np.where(np.arange(100) < apart, 1.0, 0.0)
    mean = np.stack([off, -off], axis=1).ravel()
    found = station_offsets._between(cell, mean, np.zeros(200), np.ones(200, bool))
    assert found == pytest.approx(variance)


def test_interval_of_a_movement_covers_for_six_points():
    rng = np.random.default_rng(14)
    held = 0
    for _ in range(400):
        feet = np.column_stack([rng.uniform(-1.0, 1.0, (6, 2)), np.zeros(6)])
        distance = rng.normal(0.0, 1.0, 6)
        grid = m3c2.grid(feet, 4.0)
        translations = moving.Translations(np.zeros((1, 3)), UP[None], diameter_mm=4.0, least_cos=0.5)
        translations.add(grid, distance[grid.order], np.tile(UP, (6, 1)))
        found = translations.movement()
        held += abs(found.along[0]) <= 1.96 * found.sd[0] / np.sqrt(6.0)
    assert held / 400 == pytest.approx(0.95, abs=3.0 * np.sqrt(0.95 * 0.05 / 400))  # three sds of a share of 400
