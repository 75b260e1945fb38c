"""Distances to a mesh as to a smooth surface, against closed forms."""

import numpy as np
import pytest
import trimesh

from processor.geometry import mesh_distance


def test_a_cylinder_of_fine_facets_is_a_cylinder():
    mesh = trimesh.creation.cylinder(1000.0, 4000.0, sections=3000)
    surface = mesh_distance.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, 5000), rng.uniform(-1900.0, 1900.0, 5000)
    off = rng.normal(0.0, 5.0, 5000)
    radius = 1000.0 + off
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    face, distance, beyond = surface.distances(points, 50.0)
    assert (face >= 0).all()
    np.testing.assert_allclose(distance, off, atol=1000.0 * (1.0 - np.cos(np.pi / 3000)) * 1.1)
    np.testing.assert_allclose(beyond, 0.0, atol=0.03)  # outside of the wedge between two facets' normals


def test_a_plate_has_two_sides_and_edges():
    mesh = trimesh.creation.box((2000.0, 1000.0, 20.0))
    surface = mesh_distance.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    points = np.array([[300.0, 100.0, 12.0], [-700.0, -200.0, -13.0], [300.0, 495.0, 8.0], [300.0, 100.0, 400.0]])
    face, distance, beyond = surface.distances(points, 60.0)
    np.testing.assert_allclose(distance[:3], [2.0, 3.0, -2.0], atol=1e-12)  # rounding of coordinates of a metre
    np.testing.assert_allclose(surface.normals[face[:2], 2], [1.0, -1.0], atol=1e-12)
    assert face[3] == -1
    assert np.isnan(distance[3])
    np.testing.assert_allclose(beyond[:3], 0.0, atol=1e-12)  # rounding of coordinates of a metre
    outside = surface.distances(np.array([[300.0, 507.0, 9.0]]), 60.0)
    # Beside the edge: on the side's face it is 7 mm away; or on the top's it is 7 mm beyond the edge.
    assert outside[1][0] == pytest.approx(7.0) or outside[2][0] == pytest.approx(7.0)


def test_how_far_a_point_is_beyond_each_side_of_a_facet():
    one = np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0], [0.0, 400.0, 0.0]])
    surface = mesh_distance.of_mesh(np.vstack([one, one + 5000.0]), np.arange(6).reshape(2, 3))
    points = np.array([[120.0, -7.0, 3.0], [-7.0, 160.0, -3.0], [150.0 + 5.6, 200.0 + 4.2, 3.0], [50.0, 50.0, 3.0]])
    face, distance, beyond = surface.distances(points, 60.0)
    assert face.tolist() == [0] * 4
    np.testing.assert_allclose(distance, [3.0, -3.0, 3.0, 3.0])
    np.testing.assert_allclose(beyond, [7.0, 7.0, 7.0, 0.0], atol=1e-12)  # rounding


def test_facets_are_neighbours_over_smooth_sides_only():
    mesh = trimesh.creation.box((100.0, 100.0, 100.0))
    surface = mesh_distance.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    # Of each facet's three sides the diagonal alone is smooth.
    assert ((surface.neighbours >= 0).sum(axis=1) == 1).all()
    for face, row in enumerate(surface.neighbours):
        other = row.max()
        np.testing.assert_allclose(surface.normals[face], surface.normals[other])


def _walked(surface, point, at):
    """The facet a point's foot is on, its signed distance, and how far its foot is beyond the face: one by one."""

    def shares(face):
        corners = surface.vertices[surface.faces[face]]
        edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]])
        second, third = np.linalg.lstsq(edges.T, point - corners[0], rcond=None)[0]
        return np.array([1.0 - second - third, second, third]), corners

    for _ in range(mesh_distance.WALK_STEPS):
        share, corners = shares(at)
        over = surface.neighbours[at, share.argmin()]
        if share.min() > -1e-9 or over < 0:
            break
        at = over
    share, corners = shares(at)
    side = share.argmin()
    base = corners[(side + 2) % 3] - corners[(side + 1) % 3]
    up = corners[side] - corners[(side + 1) % 3]
    height = np.linalg.norm(up - base * (up @ base) / (base @ base))
    return at, (point - corners[0]) @ surface.normals[at], max(-share[side], 0.0) * height


def test_walks_over_facets_end_where_a_step_by_step_walk_ends():
    mesh = trimesh.creation.cylinder(500.0, 2000.0, sections=48)
    surface = mesh_distance.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (300, 3)) * (600.0, 600.0, 1100.0)
    start = rng.integers(-1, len(mesh.faces), len(points))
    face, distance, beyond = surface.distances(points, 50.0, start)
    assert (face[start < 0] == -1).all()
    for i in np.flatnonzero(start >= 0):
        expected = _walked(surface, points[i], start[i])
        assert face[i] == expected[0]
        assert distance[i] == pytest.approx(expected[1], abs=1e-11)  # by least squares there
        assert beyond[i] == pytest.approx(expected[2], abs=1e-11)  # by least squares there


# --- facets by voxels -------------------------------------------------------------------------------------------------


def slivers(count, length=3000.0, width=3.0, seed=3):
    """Long thin triangles askew: vertices (3f, 3) and faces (f, 3)."""
    rng = np.random.default_rng(seed)
    start, along = rng.uniform(0.0, 2000.0, (count, 3)), rng.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(along, rng.normal(size=(count, 3)))
    across *= width / np.linalg.norm(across, axis=1)[:, None]
    far = start + length * along
    return np.stack([start, far, far + across], axis=1).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_long_triangle_is_halved_at_its_longest_edge(turn, monkeypatch):
    """Away from the origin, whichever of its edges that is."""
    monkeypatch.setattr(mesh_distance, "assign_rows", np.copyto)  # that of kernels cannot be called from Python
    corners = np.roll([[900.0, 500.0, 0.0], [0.0, 500.0, 0.0], [800.0, 600.0, 0.0]], turn, axis=0)
    stack = np.stack([corners, np.zeros((3, 3))])
    mesh_distance._halved.py_func(stack, 0)
    middle = [450.0, 500.0, 0.0]
    halves = [{tuple(corner) for corner in half} for half in stack.tolist()]
    assert halves[0] | halves[1] == {tuple(corner) for corner in corners.tolist()} | {tuple(middle)}
    assert halves[0] & halves[1] == {tuple(middle), (800.0, 600.0, 0.0)}


@pytest.mark.parametrize("count", [20, 4000], ids=["few", "so many that voxels are larger"])
def test_every_voxel_near_a_sliver_facet_lists_it_once(count, monkeypatch):
    vertices, faces = slivers(count)
    monkeypatch.setattr(mesh_distance, "MOST_ENTRIES", 200_000)
    cross, double = mesh_distance.double_areas(vertices, faces)
    reach = 20.0
    grid = mesh_distance.facet_grid(vertices, faces, cross / double[:, None], reach)
    assert (grid.size > 1.5 * reach) == (count > 1000)
    rng = np.random.default_rng(4)
    facet = rng.integers(0, count, 5000)
    on_it = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), 5000), vertices[faces[facet]])
    off = rng.normal(size=(5000, 3))
    near = on_it + off * (0.99 * reach * rng.uniform(0.0, 1.0, 5000) / np.linalg.norm(off, axis=1))[:, None]
    i, j, k = np.floor((near - grid.low) / grid.size).astype(int).T
    voxel = (i * grid.shape[1] + j) * grid.shape[2] + k
    listed = [grid.facet[grid.start[v] : grid.start[v + 1]] for v in voxel]
    assert all(f in those for f, those in zip(facet, listed, strict=True))
    assert all(len(np.unique(those)) == len(those) for those in listed)
    # About the voxels of a sliver's length times those across it, not those of its box or of its plane in the box.
    assert len(grid.facet) < 30 * count * (3000.0 / grid.size + 2.0)
