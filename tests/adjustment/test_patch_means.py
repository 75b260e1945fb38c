"""Means of residuals over patches, against draws of known size."""

import numpy as np
import pytest
from scipy import stats

from processor.adjustment.point_groups import patch_means


def test_patches_have_the_means_and_the_noise_of_their_points():
    rng = np.random.default_rng(6)
    place = rng.uniform(0.0, 2000.0, (80_000, 2))
    waves = 0.7 * np.sin(2.0 * np.pi * place[:, 0] / 8000.0)
    found = patch_means(place, waves + 0.5 * rng.standard_normal(len(place)), 100.0)
    assert len(found.mean) == 400
    assert found.points.sum() == len(place)
    # By 79,600 degrees of freedom: 0.5 %; slopes within a patch add 0.1 %.
    assert found.noise_variance == pytest.approx(0.25, rel=0.03)
    expected = 0.7 * np.sin(2.0 * np.pi * found.centre[:, 0] / 8000.0)
    z = (found.mean - expected) / np.sqrt(0.25 / found.points)
    assert stats.kstest(z, "norm").pvalue > 1e-3  # by chance in one of a thousand: the seed is fixed
