"""Covariance by correlated residuals, against draws of a field whose size and length are known."""

import numpy as np
import pytest

from processor.adjustment.residual_correlation import added_covariance
from processor.adjustment.scanner_class_errors import view_errors


def half_a_sphere(rng, count):
    """Unit normals (n, 3) with x > 0.3, evenly spread."""
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normals[normals[:, 0] > 0.3]


def cells_of(normals):
    i, j, k = np.floor(4.0 * normals).astype(np.int64).T
    return (i * 16 + j) * 16 + k


def field(normals, length):
    """Factor (n, n) of a field that falls with the distance of normals as exp(-distance / length)."""
    distance = np.linalg.norm(normals[:, None] - normals[None], axis=2)
    return np.linalg.cholesky(np.exp(-distance / length) + 1e-9 * np.eye(len(normals)))


@pytest.mark.parametrize(("size", "length"), [(0.0, 0.2), (0.6, 0.1), (1.0, 0.2), (1.0, 0.5)])
def test_the_standard_deviation_is_that_of_fits_to_a_known_field(size, length):
    """The ratio of rms error to stated sd over 60 fits; as if residuals were independent it is 1.6 to 5.9 with a field.

    The size and the length of the field are known from 90 cells alone, and the mean over what they may be is above the
    true variance: ratios down to 0.5 are no error, those above 1.25 are not, with two standard errors of 60 fits.
    """
    rng = np.random.default_rng(7)
    normals = half_a_sphere(rng, 1800)
    J, cell, root = np.column_stack([normals, np.ones(len(normals))]), cells_of(normals), field(normals, length)
    inverse = np.linalg.inv(J.T @ J)
    squares, stated, formal = np.zeros(4), np.zeros(4), np.diag(inverse)
    for _ in range(60):
        errors = rng.standard_normal(len(normals)) + size * root @ rng.standard_normal(len(normals))
        change = inverse @ J.T @ errors
        residual = errors - J @ change
        noise = residual @ residual / (len(normals) - 4)
        squares += change**2
        stated += noise * formal + np.diag(added_covariance(J, residual, np.ones(len(normals)), normals, cell))
    ratio = np.sqrt(squares / stated)
    assert (ratio > 0.5).all()
    assert (ratio < 1.5).all()


def test_few_cells_and_residuals_without_noise_add_nothing():
    rng = np.random.default_rng(0)
    normals = half_a_sphere(rng, 400)
    J = np.column_stack([normals, np.ones(len(normals))])
    ones = np.ones(len(normals))
    few = np.arange(len(normals)) % 10
    assert (added_covariance(J, rng.standard_normal(len(normals)), ones, normals, few) == 0.0).all()
    assert (added_covariance(J, np.zeros(len(normals)), ones, normals, cells_of(normals)) == 0.0).all()


def test_errors_of_views_are_offset_scale_and_bias_by_incidence():
    """By hand: 0.5 mm with 5 ppm of 100 m, and 0.3 mm times 1 / cosine less 1."""
    errors = view_errors(np.array([0.0, 1e5]), np.array([1.0, 0.5]), np.array([1, 0]))
    assert errors == pytest.approx(np.array([[0.0, 0.5, 0.0], [np.hypot(0.5, 0.5), 0.0, 0.3]]))
