"""Evidence that points on a fitted sphere are those of a ball, by closed forms."""

import numpy as np
import pytest

from processor.geometry.sphere import Sphere
from processor.geometry.sphere_evidence import LARGEST_HALF_SD, redundant
from processor.geometry.sphere_fit import RobustFit

RADIUS = 50.0


def redundant_on(directions, scale, radius_held):
    points = np.array([1.0, 2.0, 3.0]) + RADIUS * directions
    ball = Sphere(np.array([1.0, 2.0, 3.0]), RADIUS, np.eye(4))
    fit = RobustFit(
        sphere=ball,
        inliers=np.ones(len(points), bool),
        scale=scale,
        converged=True,
        residuals=np.zeros(len(points)),
        derivatives=np.zeros((len(points), 4)),
    )
    return redundant(points, fit, radius_held)


@pytest.mark.parametrize("way", [1.0, -1.0])  # either half may be the first
def test_the_weaker_half_of_the_points_determines_the_centre(way):
    """Squares of (0.8, +-0.6, 0), (0.96, 0, +-0.28) sum to the least along z, 2 0.28^2: sd = scale / root."""
    weak, strong = [[0.96, 0.0, 0.28], [0.96, 0.0, -0.28]], [[-0.8, 0.0, 0.6], [-0.8, 0.0, -0.6]]
    directions = np.array([*weak, *strong, *[[x, y, 0.0] for x in (0.8, -0.8) for y in (0.6, -0.6)]])
    directions[:, 0] *= way
    limit = LARGEST_HALF_SD * RADIUS * 0.28 * np.sqrt(2.0)
    assert redundant_on(directions, 0.999 * limit, radius_held=True)
    assert not redundant_on(directions, 1.001 * limit, radius_held=True)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_half_that_is_a_line_determines_no_radius(way):
    angles = 2.0 * np.pi * np.arange(24) / 24.0
    x = np.concatenate([np.full(24, 0.6), -np.tile([0.3, 0.6, 0.9], 8)])
    angles = np.tile(angles, 2)
    across = np.sqrt(1.0 - x**2)
    directions = np.column_stack([way * x, across * np.cos(angles), across * np.sin(angles)])
    assert redundant_on(directions, 0.1, radius_held=True)
    assert not redundant_on(directions, 0.1, radius_held=False)
    directions[:24, 0] *= np.tile([0.5, 1.0, 1.5], 8)  # three lines do
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert redundant_on(directions, 0.1, radius_held=False)
