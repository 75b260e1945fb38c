"""Rigid motions, lines and closest points against closed forms, hand-worked numbers and Open3D."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from processor import large_arrays
from processor.geometry import nearest_neighbours, point_grid, rigid, thinning
from processor.geometry.lines_and_polylines import Line, Polyline, crossing, fit_line, ransac_line
from tests.support import arrays_in_files

ROUNDING = 1e-12  # of coordinates of some metres, in mm 1e-13 each


def test_fit_recovers_a_quarter_turn_worked_by_hand():
    source = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [1.0, 1.0, 1.0]])
    target = np.array([[5.0, 1.0, 0.0], [3.0, 0.0, 0.0], [5.0, 0.0, 3.0], [4.0, 1.0, 1.0]])  # (x, y) -> (5 - y, x)
    T = rigid.fit(source, target)
    np.testing.assert_allclose(T, [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], atol=ROUNDING)


def test_fit_never_mirrors():
    source = np.random.default_rng(0).normal(size=(20, 3))
    T = rigid.fit(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_invert_and_angle():
    T = rigid.transform(rigid.rotation_from_vector(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(rigid.invert(T) @ T, np.eye(4), atol=1e-15)  # a unit in the last place
    assert rigid.rotation_angle(T[:3, :3]) == pytest.approx(np.sqrt(0.14), abs=1e-14)
    tiny = rigid.rotation_from_vector(np.array([1e-9, 0.0, 0.0]))
    assert rigid.rotation_angle(tiny) == pytest.approx(1e-9, rel=1e-6)  # an arc cosine of it would be 0
    assert rigid.rotation_angle(np.diag([-1.0, -1.0, 1.0])) == pytest.approx(np.pi)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-9, -2e-9, 3e-9), (0.3, -0.4, 0.5), (-1.7, 0.2, 2.0)])
def test_a_rotation_has_the_vector_that_it_was_made_of(vector):
    R = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rigid.vector_from_rotation(R), vector, rtol=1e-7, atol=1e-16)  # float64 of a sine
    np.testing.assert_allclose(rigid.rotation_from_vector(np.array(vector)), R, atol=1e-15)


@pytest.mark.parametrize("size", [6, 7])
def test_a_covariance_about_the_origin_is_that_of_points_moved_about_a_position(size):
    """The motion about the origin that moves points as one about a position does, by its effect on four points."""
    position, h = np.array([300.0, -200.0, 50.0]), 1e-6
    points = np.array([[0.0, 0, 0], [1000.0, 0, 0], [0, 1000.0, 0], [0, 0, 1000.0]])

    def moved(x, about):
        R, t, s = rigid.rotation_from_vector(x[:3]), x[3:6], np.exp(x[6]) if size == 7 else 1.0
        return (about + s * (points - about) @ R.T + t - points).ravel()

    def effect(about):
        return np.column_stack([(moved(h * x, about) - moved(-h * x, about)) / (2.0 * h) for x in np.eye(size)])

    at_position = np.diag(np.linspace(1.0, 2.0, size))
    J = np.linalg.lstsq(effect(np.zeros(3)), effect(position), rcond=None)[0]
    # Differences over 1e-6 of coordinates of 1 m: 1e-9, times levers of 300.
    np.testing.assert_allclose(rigid.about_origin(at_position, position), J @ at_position @ J.T, rtol=1e-5, atol=1e-4)


def test_line_distance_and_crossing_by_hand():
    line = Line(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(line.distances(np.array([[7.0, 3.0, 4.0], [1.0, 0.0, 0.0]])), [5.0, 0.0])
    other = Line(np.array([2.0, 5.0, 1.0]), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(crossing(line, other), [2.0, 0.0, 0.5])
    assert np.isnan(crossing(line, Line(np.ones(3), line.direction))).all()


def test_ransac_line_passes_over_outliers():
    rng = np.random.default_rng(1)
    points = np.linspace(0.0, 100.0, 40)[:, None] * np.array([0.6, 0.8, 0.0]) + rng.normal(0.0, 0.1, (40, 3))
    points[::3] += rng.uniform(20.0, 50.0, (14, 3))
    line = ransac_line(points, 1.0, 0.999, 500, rng)
    assert line is not None
    # A cosine: 40 points of 0.1 mm over 100 mm turn by 1e-3.
    assert abs(line.direction @ [0.6, 0.8, 0.0]) == pytest.approx(1.0, abs=1e-5)
    assert ransac_line(np.zeros((5, 3)), 1.0, 0.99, 50, rng) is None
    assert abs(fit_line(points).direction @ [0.6, 0.8, 0.0]) < 0.99  # which least squares alone does not


def test_polyline_nearest_by_hand():
    line = Polyline.through(np.array([[0.0, 0, 0], [10.0, 0, 0], [10.0, 10.0, 0]]))
    s, offset = line.nearest(np.array([[4.0, 3.0, 0.0], [13.0, 6.0, 4.0], [-1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(s, [4.0, 16.0, 0.0])
    np.testing.assert_allclose(offset, [[0, 3, 0], [3, 0, 4], [-1, 0, 0]])
    np.testing.assert_allclose(line.at(np.array([15.0])), [[10.0, 5.0, 0.0]])


def test_polyline_nearest_beside_all_pairs():
    rng = np.random.default_rng(5)
    vertices = np.cumsum(rng.normal(0.0, 20.0, (200, 3)), axis=0)
    vertices[50] = vertices[51]  # a segment without length
    points = rng.normal(0.0, 200.0, (300, 3))
    points[7] = np.nan
    line = Polyline.through(vertices)
    start, along = np.delete(vertices[:-1], 50, axis=0), np.delete(np.diff(vertices, axis=0), 50, axis=0)
    off = points[:, None] - start
    t = np.clip(np.einsum("nmi,mi->nm", off, along) / np.einsum("mi,mi->m", along, along), 0.0, 1.0)
    off -= t[..., None] * along
    best = np.linalg.norm(off, axis=2).argmin(axis=1)
    s, offset = line.nearest(points)
    np.testing.assert_allclose(offset, off[np.arange(300), best], atol=ROUNDING)
    there = np.arange(300) != 7
    np.testing.assert_allclose(line.at(s[there]) + offset[there], points[there], atol=ROUNDING)
    distances, _ = cKDTree(line.at(np.linspace(0.0, line.length, 400_000))).query(points[there])
    np.testing.assert_allclose(np.linalg.norm(offset[there], axis=1), distances, atol=0.01)


def test_spacing_of_a_grid_and_of_random_points():
    x, y = np.meshgrid(np.arange(100.0) * 7.0, np.arange(100.0) * 7.0)
    grid = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    # Of a disc's neighbours: 11 % too far.
    assert nearest_neighbours.surface_spacing(grid) == pytest.approx(7.0, rel=0.15)
    rng = np.random.default_rng(4)
    loose = np.column_stack([rng.uniform(0.0, 700.0, (10_000, 2)), np.zeros(10_000)])
    assert nearest_neighbours.surface_spacing(loose) == pytest.approx(7.0, rel=0.10)  # 10,000 random points: 1.5 %
    assert np.isnan(nearest_neighbours.surface_spacing(np.zeros((1, 3))))
    many = np.column_stack([rng.uniform(0.0, 7000.0, 250_000), rng.uniform(0.0, 1750.0, 250_000), np.zeros(250_000)])
    assert nearest_neighbours.surface_spacing(many) == pytest.approx(7.0, rel=0.05)


def test_mean_distances_do_not_depend_on_density_or_on_far_points():
    """Dense, sparse and equal points, and one as far away as an origin is from a map's coordinates."""
    rng = np.random.default_rng(6)
    plane = np.column_stack([rng.uniform(0.0, 1000.0, (6_000, 2)), rng.normal(0.0, 1.0, 6_000)])
    dense, same = rng.normal(300.0, 1.0, (1000, 3)), np.repeat(rng.uniform(0.0, 1000.0, (40, 3)), 30, axis=0)
    points = np.vstack([plane, dense, same, rng.uniform(-900.0, 900.0, (50, 3)), [[1e6, 2e6, 1e5]]])
    grid = nearest_neighbours.of_spacing(points)
    expected = cKDTree(points).query(points, k=21)[0][:, 1:].mean(axis=1)
    np.testing.assert_allclose(nearest_neighbours.mean_distances(grid, 20), expected[grid.order], rtol=ROUNDING)
    assert grid.cells.size < 100.0


def test_equal_points_of_a_cell_keep_their_order():
    points = np.repeat(np.random.default_rng(7).uniform(0.0, 10.0, (500, 3)), 7, axis=0)
    grid = point_grid.of_points(points, 0.3)
    np.testing.assert_array_equal(points[grid.order], grid.cells.points)
    same = (np.diff(grid.cells.points, axis=0) == 0.0).all(axis=1)
    assert same.sum() == 6 * 500
    assert (np.diff(grid.order)[same] > 0).all()


def test_voxel_means_by_hand():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [10.0, 0, 0], [11.0, 2.0, 0], [30.0, 0, 0]])
    means = thinning.voxel_means(points, 5.0, least=2)
    np.testing.assert_allclose(means, [[0.5, 0, 0], [10.5, 1.0, 0]])


def test_voxel_means_do_not_depend_on_how_many_voxels_are_empty():
    points = np.random.default_rng(7).uniform(0.0, 100.0, (500, 3))
    near = thinning.voxel_means(points, 10.0)  # 1000 voxels for 500 points
    far = thinning.voxel_means(np.vstack([points, np.full((1, 3), 1e5)]), 10.0)  # 10^12 voxels
    np.testing.assert_array_equal(far[:-1], near)
    np.testing.assert_array_equal(far[-1], [1e5, 1e5, 1e5])


@pytest.mark.parametrize("grid_mm", [1e-6, 7.0])
def test_the_order_by_cells_is_that_of_sorting_by_cell_and_coordinates(grid_mm):
    points = np.round(np.random.default_rng(5).uniform(0.0, 300.0, (3000, 3)) / grid_mm) * grid_mm
    x, y, z = (points - points.min(axis=0)).T // 40.0
    np.testing.assert_array_equal(thinning.by_cell(points, 40.0).row, np.lexsort((*points.T[::-1], z, y, x)))


def test_many_points_are_sorted_and_averaged_by_cells_through_files_alike(monkeypatch, tmp_path):
    points = np.random.default_rng(8).normal(0.0, 200.0, (9000, 3)).round(0)
    whole, means = thinning.by_cell(points, 40.0), thinning.voxel_means(points, 40.0, 2)
    arrays_in_files.limit(monkeypatch, 700, 1000)
    with large_arrays.in_files(tmp_path):
        parts = thinning.by_cell(points, 40.0)
        np.testing.assert_array_equal(parts.row, whole.row)
        np.testing.assert_array_equal(parts.points, whole.points)
        np.testing.assert_array_equal(thinning.voxel_means(points, 40.0, 2), means)


def test_the_nearest_rotation_is_the_polar_factor_and_never_a_reflection():
    R = rigid.rotation_from_vector(np.array([0.4, -1.1, 0.7]))
    stretch = np.array([[3.0, 0.5, 0.1], [0.5, 2.0, 0.3], [0.1, 0.3, 1.0]])
    np.testing.assert_allclose(rigid.nearest_rotation(R @ stretch), R, atol=1e-14)
    np.testing.assert_allclose(rigid.nearest_rotation(np.diag([3.0, 2.0, -1.0])), np.eye(3), atol=1e-14)


def test_a_cell_of_many_points_is_sorted_like_one_of_few():
    rng = np.random.default_rng(5)
    points = np.round(rng.uniform(0.0, 39.0, (3_000, 3)))  # of one cell, some of them equal
    points = np.vstack([points, points[:500], np.full((1, 3), 85.0)])
    np.testing.assert_array_equal(thinning.by_cell(points, 40.0).row, np.lexsort(points.T[::-1]))


def test_marks_within_reach_are_those_of_all_distances():
    rng = np.random.default_rng(6)
    points, places = rng.uniform(0.0, 1000.0, (2_000, 3)), rng.uniform(-200.0, 1200.0, (300, 3))
    near = np.linalg.norm(points[:, None] - places, axis=2) < 90.0
    of_points, of_places = nearest_neighbours.within_reach(points, places, 90.0)
    np.testing.assert_array_equal(of_points, near.any(axis=1))
    np.testing.assert_array_equal(of_places, near.any(axis=0))
    assert 0 < of_places.sum() < len(places)
    assert not any(marks.any() for marks in nearest_neighbours.within_reach(points, places[:0], 90.0))
