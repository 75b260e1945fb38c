"""Errors of views that are not named show in the sums of what the two sides of plates moved outward."""

import numpy as np
import pytest

from processor.adjustment import view_error_from_opposite_sides
from processor.deviation import step as deviation_step
from processor.model import Scan, Scene
from tests.support.clouds.plate_clouds import AS_IT_LIES, STATIONS, plate

SPACING, NOISE, SIDE, THICKNESS = 10.0, 0.08, 60.0, 12.0


def plates(seed, between=0.0):
    """Places on twelve plates, normals, movements, variances; each side is displaced by an error of its view."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(0.0, 300.0, SPACING), np.arange(0.0, 300.0, SPACING))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    points, normals, along = [], [], []
    for k in range(12):
        for sign in (1.0, -1.0):
            points.append(flat + np.array([0.0, 500.0 * k, 0.5 * sign * THICKNESS]))
            normals.append(np.tile([0.0, 0.0, sign], (len(flat), 1)))
            along.append(between * rng.normal() + rng.normal(0.0, NOISE, len(flat)))
    points, normals, along = (np.concatenate(v) for v in (points, normals, along))
    return points, normals, along, np.full(len(points), NOISE**2)


@pytest.mark.parametrize("between", [0.3, 1.0])
def test_the_standard_deviation_between_views_is_that_of_the_sides(between):
    found = [view_error_from_opposite_sides.view_sd(*plates(seed, between), SIDE) for seed in range(12)]
    # Twelve independent sums a seed: one root of their mean square is known to a fifth, the median of twelve to 7 %.
    assert np.median(found) == pytest.approx(between, rel=0.25)


def test_noise_alone_is_no_difference_between_views():
    found = [view_error_from_opposite_sides.view_sd(*plates(seed), SIDE) for seed in range(12)]
    assert max(found) < NOISE  # a place has the mean of some 36 points


def test_a_movement_of_whole_plates_is_no_difference_between_views():
    points, normals, along, variance = plates(1)
    assert view_error_from_opposite_sides.view_sd(points, normals, along + 5.0 * normals[:, 2], variance, SIDE) < NOISE


def test_view_sd_is_zero_where_only_one_side_of_the_plates_was_seen():
    points, normals, along, variance = plates(1, 1.0)
    along[normals[:, 2] < 0.0] = np.nan
    assert view_error_from_opposite_sides.view_sd(points, normals, along, variance, SIDE) == 0.0


def test_facing_sides_of_two_bodies_are_not_compared():
    points, normals, along, variance = plates(1, 1.0)
    assert view_error_from_opposite_sides.view_sd(points, -normals, along, variance, SIDE) == 0.0


def test_levels_of_detection_of_a_merged_cloud_include_view_differences():
    scene = plate(20.0, 3, STATIONS, False)
    above, below = (scan.points + np.array([0.0, 0.0, z]) for scan, z in zip(scene.scans, (0.4, -0.4), strict=True))
    scene = Scene(scene.name, "structure", (Scan("merged", np.vstack([above, below])),), structure=scene.structure)
    result = deviation_step.run(scene, AS_IT_LIES)
    assert "deviation.views-differ" in [reason.code for reason in result.reasons]
    faces = (np.argmax(np.abs(result.core.normals), axis=1) == 2) & np.isfinite(result.core.lod95)
    assert result.core.distances.significant[faces].mean() < 0.05  # as stated: 95 %
    # Both sides moved outward by 0.4 mm: the sum of 0.8 mm is of two views.
    assert np.median(result.core.lod95[faces]) > 0.8
