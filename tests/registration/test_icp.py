"""Iterative closest points and principal axes against closed forms, plain searches and Open3D."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.registration import icp, principal
from processor.robust_statistics import robust_sd


def test_mesh_axes_of_a_box_surface():
    # The surface of a 6 x 4 x 2 box: variance along an axis of half-length a is the faces' share by area.
    a, b, c = 3.0, 2.0, 1.0
    corners = np.array([[x, y, z] for x in (-a, a) for y in (-b, b) for z in (-c, c)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])
    area = 8.0 * (b * c + a * c + a * b)
    along_x = (8.0 * b * c * a**2 + 8.0 * a * c * a**2 / 3.0 + 8.0 * a * b * a**2 / 3.0) / area
    found = principal.of_mesh(corners + 1e6, faces)
    np.testing.assert_allclose(found.centre, [1e6] * 3)
    assert found.variances[0] == pytest.approx(along_x)
    assert abs(found.axes[0, 0]) == pytest.approx(1.0)
    assert np.linalg.det(found.axes) == pytest.approx(1.0)


def test_point_to_point_agrees_with_open3d():
    o3d = pytest.importorskip("open3d")
    rng = np.random.default_rng(2)
    target = rng.uniform(0.0, 1000.0, (800, 3))
    T_true = rigid.transform(rigid.rotation_from_vector(np.array([0.01, -0.02, 0.015])), np.array([5.0, -4.0, 3.0]))
    source = rigid.apply(rigid.invert(T_true), target) + rng.normal(0.0, 1.0, target.shape)
    found = icp.point_to_point(source, target, np.eye(4), max_distance_mm=80.0, max_iterations=200)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud)) for cloud in (source, target)]
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(1e-12, 1e-12, 200)
    theirs = o3d.pipelines.registration.registration_icp(*clouds, 80.0, np.eye(4), criteria=criteria)
    np.testing.assert_allclose(found.T_target_source, theirs.transformation, atol=1e-10)
    assert found.rms == pytest.approx(theirs.inlier_rmse, rel=1e-12)  # the same pairs, and so the same sums


def point_to_plane_by_arrays(source, points, normals, start, gates_mm, axes):
    """Return the pose of icp.point_to_plane, by a plain search for all points and whole arrays."""
    tree, T = cKDTree(points), start
    for gate in gates_mm:
        for _ in range(15):
            placed = rigid.apply(T, source)
            distance, index = tree.query(placed, distance_upper_bound=3.0 * gate)
            p, at = placed[np.isfinite(distance)], index[np.isfinite(distance)]
            r = np.einsum("ni,ni->n", p - points[at], normals[at])
            keep = np.abs(r) <= gate
            p, n, r = p[keep], normals[at][keep], r[keep]
            weight = np.minimum(1.0, 1.345 * robust_sd(r, gate / 12.0) / np.maximum(np.abs(r), 1e-12))
            weight *= 1.0 if axes is None else icp.balance(icp.facing(n, axes))
            centre = p.mean(axis=0)
            J = np.hstack([np.cross(p - centre, n), n])
            step = np.linalg.lstsq(J.T @ (weight[:, None] * J), -J.T @ (weight * r), rcond=None)[0]
            R = rigid.rotation_from_vector(step[:3])
            T = rigid.transform(R, centre + step[3:] - R @ centre) @ T
            reach = np.linalg.norm(p - centre, axis=1).max()
            if np.linalg.norm(step[:3]) * reach + np.linalg.norm(step[3:]) < 1e-3 * gate:
                break
    return T


@pytest.mark.parametrize("turn", [0.02, 0.3])
@pytest.mark.parametrize("sides", [1, 3])
def test_point_to_plane_by_its_kernel_is_that_by_arrays(turn, sides):
    rng = np.random.default_rng(8)
    points, normals = rng.uniform(-1.0, 1.0, (4000, 3)) * [3000.0, 900.0, 500.0], np.zeros((4000, 3))
    axis = 2 - rng.integers(0, sides, len(points))  # of one side alone, three motions are not determined
    points[np.arange(len(points)), axis] = np.array([3000.0, 900.0, 500.0])[axis]
    normals[np.arange(len(points)), axis] = 1.0
    T = rigid.transform(rigid.rotation_from_vector(np.array([turn, -0.02, 0.01])), np.array([60.0, -30.0, 20.0]))
    source = rigid.apply(T, points[::7]) + rng.normal(0.0, 0.5, (len(points[::7]), 3))
    boxes, gates = icp.boxes_of(points, normals), (400.0, 150.0, 12.0)
    for axes in (None, rigid.rotation_from_vector(np.array([0.02, 0.01, 0.0]))):
        found = icp.point_to_plane(source, boxes, np.eye(4), gates_mm=gates, axes=axes).T_target_source
        expected = point_to_plane_by_arrays(source, points, normals, np.eye(4), gates, axes)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)  # sums of 600 points in another order


def test_point_to_plane_without_pairs_leaves_the_pose():
    points, normals = np.eye(3)[[0, 1, 2, 0, 1, 2, 0]] * 10.0, np.eye(3)[[2, 2, 2, 2, 2, 2, 2]]
    boxes = icp.boxes_of(points, normals)
    found = icp.point_to_plane(points + 1e4, boxes, np.eye(4), gates_mm=(50.0, 10.0))
    assert (found.rms, found.paired_share, found.iterations) == (np.inf, 0.0, 1)
    np.testing.assert_array_equal(found.T_target_source, np.eye(4))


@pytest.mark.parametrize("count", [3, 40, 3000])
def test_partners_of_points_that_move_are_those_of_a_plain_search(count):
    rng = np.random.default_rng(6)
    samples = rng.uniform(0.0, 1000.0, (count, 3))
    tree, boxes = cKDTree(samples), icp.boxes_of(samples, samples)
    points = rng.uniform(-100.0, 1100.0, (2000, 3))
    known, near = icp.nothing_known(len(points)), np.empty(len(points), np.bool_)
    for step, reach in ((0.0, 90.0), (300.0, 90.0), (20.0, 90.0), (3.0, 90.0), (0.3, 60.0), (0.0, 60.0), (3.0, 200.0)):
        points = points + rng.normal(0.0, step, points.shape)
        icp.find_partners(boxes, points, reach, known, near)
        distance, expected = tree.query(points, distance_upper_bound=reach)
        np.testing.assert_array_equal(near, np.isfinite(distance))
        np.testing.assert_array_equal(boxes.samples[known.first[near]], samples[expected[near]])
        assert 0 < near.sum() < len(points)
    icp.find_partners(boxes, points, np.inf, known, near)
    np.testing.assert_array_equal(boxes.samples[known.first], samples[tree.query(points)[1]])
