"""Derivatives of distances by small motions, against moved points."""

import numpy as np
from scipy.spatial.transform import Rotation

from processor.adjustment import body_motions
from processor.geometry import rigid


def test_the_derivative_of_distances_is_that_of_points_moved_by_a_tiny_motion():
    rng = np.random.default_rng(1)
    points, normals, rays = rng.normal(0.0, 1e3, (9, 3)), *rng.normal(size=(2, 9, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    centre, x = np.array([300.0, -200.0, 50.0]), np.array([3e-7, -2e-7, 5e-7, 1e-3, 2e-3, -4e-3, 7e-3])
    after = Rotation.from_rotvec(x[:3]).apply(points - centre) + centre + x[3:6] + x[6] * rays
    moved = np.einsum("ni,ni->n", after - points, normals)
    # The second order of 6e-7 rad at 2 m is 4e-10 mm.
    np.testing.assert_allclose(body_motions.distance_derivative(points - centre, normals, rays) @ x, moved, atol=1e-9)
    by_six = body_motions.distance_derivative(points - centre, normals) @ x[:6]
    np.testing.assert_allclose(by_six, moved - x[6] * np.einsum("ni,ni->n", rays, normals), atol=1e-9)
    T = body_motions.transform_about(x, centre)
    np.testing.assert_allclose(rigid.apply(T, points), after - x[6] * rays, atol=1e-9)


def test_variances_are_those_of_drawn_unknowns():
    rng = np.random.default_rng(2)
    J, half = rng.normal(size=(4, 6)), rng.normal(size=(6, 6))
    drawn = rng.normal(size=(100_000, 6)) @ half.T @ J.T
    # A variance of 100,000 draws is known to 0.45 %.
    np.testing.assert_allclose(body_motions.variances(J, half @ half.T), drawn.var(axis=0), rtol=0.02)
    assert body_motions.variances(np.ones((1, 6)), -np.eye(6)) == 0.0  # rounding leaves no negative variance


def test_covariances_of_points_are_those_of_drawn_motions():
    rng = np.random.default_rng(5)
    half = rng.normal(size=(6, 6)) * np.repeat([1e-3, 1.0], 3)[:, None]
    arm = np.array([[1000.0, -400.0, 250.0]])
    x = rng.normal(size=(100_000, 6)) @ half.T
    drawn = np.cov((np.cross(x[:, :3], arm) + x[:, 3:]).T)
    found = body_motions.point_covariances(arm, half @ half.T)[0]
    np.testing.assert_allclose(found, drawn, atol=0.02 * np.abs(drawn).max())  # a variance of 100,000 draws: 0.45 %
