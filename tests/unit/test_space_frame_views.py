"""Merged clouds of frames whose views nobody names: what the views have in common is part of the intervals."""

import dataclasses

import numpy as np
import pytest

from processor.space_frame.catalogue import of_radii
from processor.space_frame.spheres import fit_all
from processor.space_frame.spheres.unnamed_views import of_tubes
from tests.support import ball_clouds
from tests.support.memory_source import InMemory

STATIONS = np.array([[-7000.0, -6500, -4500], [7500, -6000, -4500], [6500, 7000, -4500], [-6000, 7500, -4500]])
CENTRES = np.array([[x, y, 0.0] for x in (-4000.0, 0, 4000) for y in (-4000.0, 0, 4000)])
RADII = np.array([53.0, 60, 67] * 3)


def fitted(seed, shift_mm):
    """Fit balls in a merged cloud; each view has a shift, and the axes have the mean of all."""
    rng = np.random.default_rng(seed)
    shifts = shift_mm * rng.standard_normal((len(STATIONS), 3))
    named, nodes, members = ball_clouds.frame(
        rng, CENTRES, RADII, STATIONS, step_mrad=1.5, sigma=1.0, node_sd=0.3, shifts=shifts
    )
    chunk = next(iter(named.chunks()))
    merged = InMemory(chunk.points, np.full(len(chunk.points), -1, np.int32), np.empty((0, 3)))
    return fit_all.fit_spheres(merged, nodes, members, of_radii(RADII))


@pytest.mark.parametrize("shift_mm", [0.0, 0.6])
def test_lowest_points_hold_whether_views_agree_or_not(shift_mm):
    pulls, wide = [], []
    for seed in range(5):
        found = fitted(seed, shift_mm)
        pulls.append((found.lowest[:, 2] - (CENTRES[:, 2] - RADII)) / found.lowest_sd)
        wide.append(np.median(found.lowest_sd))
        message = next(one for one in found.messages if one.code == "spheres.unnamed-views")
        sd = dict(message.values)["common"]
        assert sd < (0.25 if shift_mm == 0.0 else 3.0 * shift_mm)
    assert np.mean(np.abs(pulls) < 1.96) > 0.85
    assert np.median(wide) < (0.35 if shift_mm == 0.0 else 1.0)


def test_errors_of_views_common_to_all_spheres_are_part_of_the_whole():
    found = fitted(1, 0.6)
    left = found.covariance - found.common
    assert (np.linalg.eigvalsh(left).min(axis=1) > 0.0).all()
    assert (found.common[:, 2, 2] > 0.2**2 - 1e-9).all()


def test_tubes_of_a_merged_cloud_hold_shifted_views():
    """Circles seen from below by four views: what the fit takes up of their shifts is in the intervals."""
    found = fitted(1, 0.6)
    axis, side = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    (covariance,) = of_tubes(found.views, axis, side)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    exact = dataclasses.replace(found.views, sd=0.0)
    (least,) = of_tubes(exact, axis, side)
    assert np.sqrt(np.diag(least)) == pytest.approx([0.2, 0.2, 2.0 / 3.0 * 0.2], abs=1e-6)
    assert (np.diag(covariance) > np.diag(least)).all()
