"""Rows of nearest points of a grid, compared with all distances."""

import numpy as np
import pytest

from processor.geometry import mesh_distance, nearest_neighbours, point_grid


def by_all_distances(points, places, reach, count):
    """Return rows (m, count) by all distances, of equal ones the lower row; -1 beyond the reach."""
    square = ((places[:, None] - points[None]) ** 2).sum(axis=2)
    rows = np.argsort(square, axis=1, kind="stable")[:, :count]
    distance = np.sqrt(np.take_along_axis(square, rows, axis=1))
    near = np.take_along_axis(square, rows, axis=1) < reach**2
    return np.where(near, rows, -1), np.where(near, distance, np.inf)


@pytest.mark.parametrize("height", [1.0, 100.0])  # within one block of cells, and across several
@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("reach", [3.0, 40.0, np.inf])
def test_rows_are_those_of_all_distances(reach, count, height):
    rng = np.random.default_rng(7)
    grid = point_grid.of_points(rng.uniform(0.0, [100.0, 100.0, height], (2_000, 3)), 4.0)
    places = np.vstack([rng.uniform(-60.0, 160.0, (300, 3)), grid.cells.points[:100]])
    rows, distance = nearest_neighbours.nearest_rows(grid.cells, places, reach, count)
    expected, away = by_all_distances(grid.cells.points, places, reach, count)
    np.testing.assert_array_equal(rows, expected)
    np.testing.assert_allclose(distance, away, rtol=1e-15)  # a square root


def test_of_equally_near_points_the_lower_row_is_found():
    # Every place is as far from eight corners of a lattice; the place before is another one each time.
    lattice = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = point_grid.of_points(lattice, 1.5)
    places = lattice[lattice.max(axis=1) < 5.0] + 0.5
    for order in (np.arange(len(places)), np.random.default_rng(1).permutation(len(places))):
        for count in (1, 3):
            rows, _ = nearest_neighbours.nearest_rows(grid.cells, places[order], 2.0, count)
            np.testing.assert_array_equal(rows, by_all_distances(grid.cells.points, places[order], 2.0, count)[0])


def test_nothing_is_near_a_place_that_is_not_finite_nor_in_an_empty_grid():
    grid = point_grid.of_points(np.zeros((1, 3)), 1.0)
    rows, distance = nearest_neighbours.nearest_rows(
        grid.cells, np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 2.0]]), np.inf
    )
    np.testing.assert_array_equal(rows, [[-1], [0]])
    np.testing.assert_array_equal(distance, [[np.inf], [2.0]])
    empty = point_grid.of_points(np.empty((0, 3)), 1.0)
    assert nearest_neighbours.nearest_rows(empty.cells, np.zeros((1, 3)), np.inf)[0].tolist() == [[-1]]


def test_the_nearest_sample_of_a_mesh_is_on_its_facet():
    vertices = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 700.0, 0.0], [0.0, 0.0, 800.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    surface = mesh_distance.of_mesh(vertices, faces)
    samples, of_sample = surface.samples(), np.repeat(np.arange(4), surface.count)
    places = np.random.default_rng(3).uniform(-50.0, 950.0, (150, 3))
    expected, away = (one[:, 0] for one in by_all_distances(samples, places, 120.0, 1))
    facet, distance = surface.nearest(places, 120.0)
    np.testing.assert_array_equal(facet, np.where(expected >= 0, of_sample[expected], -1))
    np.testing.assert_allclose(distance, away, rtol=1e-15)  # a square root
