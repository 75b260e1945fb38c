"""Facets of bodies: the nearest that a scanner sees, lines that end at them, samples, and what bodies enclose."""

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_bodies, mesh_distance
from tests.support.clouds.plate_rows import box


def test_facets_are_the_nearest_that_a_scanner_can_see():
    vertices, faces = box((0.0, 0.0, 0.0), (300.0, 12.0, 200.0))
    normals = np.array(trimesh.Trimesh(vertices, faces, process=False).face_normals)  # writeable, as the step has them
    rng = np.random.default_rng(3)
    points = rng.uniform([-30.0, -30.0, -30.0], [330.0, 42.0, 230.0], (2000, 3))
    grid = mesh_distance.facet_grid(vertices, faces, normals, 60.0)
    facet, distance = mesh_distance.nearest_visible(grid, points, np.zeros((1, 3)), np.full(2000, -1))
    _, true, _ = trimesh.proximity.closest_point_naive(trimesh.Trimesh(vertices, faces, process=False), points)
    corner = vertices[faces[facet, 0]]
    np.testing.assert_allclose(distance, np.einsum("ni,ni->n", points - corner, normals[facet]), atol=1e-9)
    nearest = np.array([trimesh.triangles.closest_point(vertices[faces[f]][None], p[None])[0]
                        for f, p in zip(facet, points, strict=True)])  # fmt: skip
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), true, atol=1e-9)
    # Deep in the plate, nearer to its back, but seen from the front.
    deep = np.array([[150.0, 9.0, 100.0]])
    facet, distance = mesh_distance.nearest_visible(
        grid, deep, np.array([[150.0, -4000.0, 100.0]]), np.zeros(1, np.int64)
    )
    assert distance[0] == pytest.approx(-9.0)
    np.testing.assert_allclose(normals[facet[0]], [0.0, -1.0, 0.0])


def test_lines_of_sight_end_at_facets():
    """Lines from a wide plate to a far place cross a narrow plate 600 mm before it, or pass beside it."""
    near, far = box((0.0, 0.0, 0.0), (1000.0, 10.0, 1000.0)), box((-500.0, 600.0, -500.0), (1500.0, 610.0, 1500.0))
    vertices, faces = np.vstack([near[0], far[0]]), np.vstack([near[1], far[1] + 8])
    surface = mesh_distance.of_mesh(vertices, faces)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 30.0)
    rng = np.random.default_rng(3)
    starts = np.stack([rng.uniform(-450, 1450, 400), np.full(400, 599.0), rng.uniform(-450, 1450, 400)], axis=1)
    ends = np.repeat([[500.0, -6000.0, 450.0]], 400, axis=0)
    shares = {y: (599.0 - y) / 6599.0 for y in (10.0, 0.0)}
    at = [starts + share * (ends - starts) for share in shares.values()]
    crossed = np.array([((p[:, [0, 2]] > 0.0) & (p[:, [0, 2]] < 1000.0)).all(axis=1) for p in at])
    row, _, share = mesh_distance.crossings(grid, starts, ends, False)
    across = np.array([np.isclose(share, expected) for expected in shares.values()])
    for k in range(2):
        assert 0 < crossed[k].sum() < 400
        np.testing.assert_array_equal(np.sort(row[across[k]]), np.flatnonzero(crossed[k]))
    sides = crossed.any(axis=0)
    assert set(mesh_distance.crossings(grid, starts, ends, True)[0]) >= set(np.flatnonzero(sides).tolist())
    # The other way, from far outside of the voxels
    row, _, share = mesh_distance.crossings(grid, ends, starts, False)
    for k in range(2):
        across = np.isclose(share, 1.0 - list(shares.values())[k])
        np.testing.assert_array_equal(np.sort(row[across]), np.flatnonzero(crossed[k]))
    beside = ends + np.array([0.0, 0.0, 4000.0])
    assert not len(mesh_distance.crossings(grid, ends, beside, False)[0])


def test_samples_of_a_mesh_are_even():
    mesh = trimesh.creation.box((2000.0, 1000.0, 500.0))
    found = mesh_distance.sampled(np.asarray(mesh.vertices), np.asarray(mesh.faces), 20.0)
    assert len(found.points) == pytest.approx(mesh.area / 400.0, rel=0.01)  # whole rows of 100 a side
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
    # Facets lie inside; of 3000 points.
    assert distance.max() == pytest.approx(100.0 * (1.0 - np.cos(np.pi / 48)), rel=0.01)
    feet = points - distance[:, None] * surface.normals[facet]
    left = distance - curved.heights(feet, facet)
    assert np.abs(left).max() < 0.01 * distance.max()
    box = trimesh.creation.box((1000.0, 500.0, 20.0))
    flat = mesh_distance.of_surface(mesh_distance.of_mesh(np.asarray(box.vertices), np.asarray(box.faces)))
    assert np.abs(flat.slopes).max() < 1e-12
    coarse_tube = mesh_distance.of_surface(mesh_distance.of_mesh(*tube(2000.0, 5000.0, 24)))
    assert not coarse_tube.slopes.any()  # would bulge by 17 mm: no tube


def block(size, at):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def test_points_inside_or_in_contact_with_another_body_are_enclosed():
    hollow = block((300, 300, 300), (0, 3000, 0))
    hollow.invert()  # the cavity of the next
    places = {(2000, 100, 100): (0, 0, 0), (100, 100, 900): (0, 0, 430), (200, 100, 20): (900, 0, 60)}
    bodies = [block(size, at) for size, at in places.items()]
    bodies += [block((320, 320, 320), (0, 3000, 0)), hollow]
    mesh = trimesh.util.concatenate(bodies)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    surface = mesh_distance.of_design(vertices, faces)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 20.0)
    points = np.array(
        [[0, 0, 50], [500, 0, 50], [0, 50, 0], [0, 0, -20], [900, 0, 50], [900, 0, 50], [900, 0, 70], [150, 3000, 0]],
        float,
    )
    normals = np.array(
        [[0, 0, 1], [0, 0, 1], [0, 1, 0], [0, 0, -1], [0, 0, 1], [0, 0, -1], [0, 0, 1], [-1, 0, 0]], float
    )
    inside = mesh_bodies.enclosed(points, normals, grid, mesh_bodies.closed_bodies(surface.faces))
    # Of the beam below the post; beside it; its side; the post's end; beam and plate in contact; the plate; the cavity.
    np.testing.assert_array_equal(inside, [True, False, False, True, True, True, False, False])
    opened = surface.faces[1:]  # a beam without one facet is no body
    assert (mesh_bodies.closed_bodies(opened)[:11] < 0).all()
    assert (mesh_bodies.closed_bodies(opened)[11:] >= 0).all()


def test_enclosed_by_any_of_many_bodies():
    """Boxes of any size and place, some within others: what lies in one is computed from their corners."""
    rng = np.random.default_rng(11)
    low = rng.uniform(-2000.0, 2000.0, (150, 3))
    high = low + rng.uniform(5.0, 1500.0, (150, 3)) * rng.choice([1.0, 1.0, 1.0, 0.02], (150, 3))
    meshes = [trimesh.creation.box(bounds=np.array(corners)) for corners in zip(low, high, strict=True)]
    mesh = trimesh.util.concatenate(meshes)
    surface = mesh_distance.of_design(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 50.0)
    points, facet = trimesh.sample.sample_surface(mesh, 5_000, seed=1)
    normals = mesh.face_normals[facet]
    place = points + mesh_bodies.OUTSIDE_MM * normals
    gap = np.maximum(low[None] - place[:, None], place[:, None] - high[None]).max(axis=2)  # negative within a box
    sure = np.abs(gap).min(axis=1) > 0.01
    inside = mesh_bodies.enclosed(points, normals, grid, mesh_bodies.closed_bodies(surface.faces))
    assert 0.1 < inside[sure].mean() < 0.9
    np.testing.assert_array_equal(inside[sure], (gap.min(axis=1) < 0.0)[sure])
