"""Neighbours, scales, summary, attitude and movements, against closed forms and brute force."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from processor.adjustment import distance_summary
from processor.adjustment.point_groups import group_means
from processor.deviation import cloud as deviation_cloud
from processor.deviation import local_translation as moving
from processor.geometry import m3c2, mesh_distance, nearest_neighbours, rigid
from processor.geometry.m3c2 import Distances
from processor.model import InputError
from processor.registration import principal, surface_registration
from tests.support.clouds.m3c2_clouds import wavy
from tests.support.solids.meshes import bracket

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
    assert nearest_neighbours.spacing(spread) == pytest.approx(10.0, rel=0.02)
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
    assert m3c2.diameter_for(20, np.sqrt(1e6 / 500.0)) == pytest.approx(225.7, abs=0.1)  # 500 points/m2
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


def test_a_share_of_independent_places_has_the_interval_of_its_count():
    rng = np.random.default_rng(7)
    covered = 0
    for _ in range(200):
        marks = rng.random(400) < 0.05
        found = distance_summary.share(
            marks, np.column_stack([np.arange(400) * 10.0, np.zeros(400), np.zeros(400)]), 5.0
        )
        assert found.low <= found.share <= found.high
        covered += found.low <= 0.05 <= found.high
    assert 0.9 <= covered / 200 <= 1.0


def test_share_of_correlated_places_has_the_interval_of_one_per_place():
    marks = np.repeat(np.random.default_rng(8).random(100) < 0.3, 50)
    places = np.repeat(np.arange(100.0), 50)[:, None] * [100.0, 0.0, 0.0]
    found = distance_summary.share(marks, places, 60.0)
    alone = distance_summary.share(marks[::50], places[::50], 60.0)
    assert found.high - found.low == pytest.approx(alone.high - alone.low, rel=0.05)
    none = distance_summary.share(np.zeros(5000, bool), places, 60.0)
    assert none.low == 0.0
    assert 0.02 < none.high < 0.05  # rule of three for 100 cells
    assert np.isnan(distance_summary.share(np.zeros(0, bool), np.zeros((0, 3)), 1.0).share)


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
    shares = [planes_compared(seed) for seed in range(12)]
    assert 0.04 < np.mean(shares) < 0.06
    assert 0.025 < min(shares) < max(shares) < 0.085  # some 1000 cylinders that share no point: sd 0.7 %


def test_unstated_registration_error_gives_significant_distances():
    assert planes_compared(20, off=1.5) > 0.5
    assert planes_compared(20, off=1.5, error=1.5) < 0.05


def test_summary_counts_core_points_without_level_of_detection():
    nan = np.nan
    found = Distances(
        np.array([1.0, -3.0, nan, 2.0]), np.array([0.5, 4.0, nan, nan]), np.array([30, 30, 0, 30]),
        np.array([30, 10, 30, 3]), np.ones(4), np.ones(4),
    )  # fmt: skip
    normals = np.array([UP, UP, [nan] * 3, UP])
    total = distance_summary.of_distances(found, np.arange(12.0).reshape(4, 3), normals, 1.0, 20)
    assert (total.core_points, total.without_lod, total.without_normal) == (4, 2, 1)
    assert (total.few_points, total.significant) == (1, 1)
    assert (total.mean, total.min, total.max, total.rms) == (-1.0, -3.0, 1.0, pytest.approx(np.sqrt(5.0)))


# --- attitude ------------------------------------------------------------------------------------------------------


def coarse(mesh, T, seed):
    points = np.asarray(trimesh.sample.sample_surface(mesh, 20_000, seed=seed)[0])
    moved = rigid.apply(rigid.invert(T), points) + np.random.default_rng(seed).normal(0.0, 2.0, points.shape)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    samples = mesh_distance.sampled(vertices, faces, 30.0)
    return surface_registration.coarse(moved, samples, principal.of_mesh(vertices, faces))


def test_any_attitude_is_found_and_never_a_mirror_image():
    rng = np.random.default_rng(9)
    for seed in range(3):
        T = rigid.transform(rigid.rotation_from_vector(rng.normal(size=3) * 2.0), rng.normal(size=3) * 1e4)
        found = coarse(bracket(), T, seed)
        assert np.linalg.det(found.T_target_source[:3, :3]) == pytest.approx(1.0)
        assert rigid.rotation_angle(found.T_target_source[:3, :3] @ T[:3, :3].T) < 2e-3
        assert found.ambiguity > 2.0


def test_a_symmetric_body_is_ambiguous():
    found = coarse(trimesh.creation.box((3000.0, 900.0, 400.0)), np.eye(4), 1)
    assert found.ambiguity < principal.AMBIGUOUS


def test_axes_are_swapped_where_two_are_alike_alone():
    one = np.array([9.0, 4.0, 1.0])
    assert len(principal.possible_turns(one, one)) == 4
    assert len(principal.possible_turns(np.array([9.0, 4.0, 3.9]), one)) == 8
    every = principal.possible_turns(np.ones(3), np.ones(3))
    assert len(every) == 24
    assert all(np.linalg.det(turn) == pytest.approx(1.0) for turn in every)
    assert len({tuple(turn.ravel()) for turn in every}) == 24


# --- movements -----------------------------------------------------------------------------------------------------


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
    means = group_means(points, group)
    np.testing.assert_allclose(means[3], points[group == 3].mean(axis=0))


def test_samples_of_a_mesh_are_even():
    mesh = trimesh.creation.box((2000.0, 1000.0, 500.0))
    found = mesh_distance.sampled(np.asarray(mesh.vertices), np.asarray(mesh.faces), 20.0)
    assert len(found.points) == pytest.approx(mesh.area / 400.0, rel=0.01)
    on_top = found.normals[:, 2] > 0.5
    assert on_top.mean() == pytest.approx(2e6 / mesh.area, rel=0.02)
    np.testing.assert_allclose(found.points[on_top, 2], 250.0)
    cells = np.histogram2d(*found.points[on_top, :2].T, bins=(10, 5))[0]
    assert cells.min() > 0.8 * cells.mean()


def tube(radius, length, sections):
    mesh = trimesh.creation.cylinder(radius, length, sections)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_facets_of_a_tube_are_as_round_as_the_tube():
    vertices, faces = tube(100.0, 1000.0, 48)
    surface = mesh_distance.of_mesh(vertices, faces)
    curved = mesh_distance.of_surface(surface)
    angle = np.random.default_rng(11).uniform(0.0, 2.0 * np.pi, 3000)
    height = np.random.default_rng(12).uniform(-450.0, 450.0, 3000)
    points = np.column_stack([100.0 * np.cos(angle), 100.0 * np.sin(angle), height])
    facet, distance, _ = surface.distances(points, 50.0)
    assert distance.max() == pytest.approx(100.0 * (1.0 - np.cos(np.pi / 48)), rel=0.01)  # facets lie inside
    feet = points - distance[:, None] * surface.normals[facet]
    left = distance - curved.heights(feet, facet)
    assert np.abs(left).max() < 0.01 * distance.max()
    box = trimesh.creation.box((1000.0, 500.0, 20.0))
    flat = mesh_distance.of_surface(mesh_distance.of_mesh(np.asarray(box.vertices), np.asarray(box.faces)))
    assert np.abs(flat.slopes).max() < 1e-12
    coarse_tube = mesh_distance.of_surface(mesh_distance.of_mesh(*tube(2000.0, 5000.0, 24)))
    assert not coarse_tube.slopes.any()  # would bulge by 17 mm: no tube


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
    assert (np.abs(error) < 2.0 * bound).all()
    assert (bound < 0.2).all()
    expected = np.linalg.lstsq(
        normals[near := np.linalg.norm(feet - place[0], axis=1) <= 75.0][:, :2], distance[near], rcond=None
    )[0]
    np.testing.assert_allclose(found.vector[0], [*expected, 0.0], atol=1e-9)
    assert found.count[0] == near.sum()
    assert np.isnan(found.along[2])
    assert found.count[2] == 0


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
    assert 0.92 <= held / 400 <= 0.98
