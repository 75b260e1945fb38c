"""Bayesian model averaging of departures, against closed forms."""

import numpy as np
import pytest

from processor.adjustment.model_averaging import (
    Estimate,
    estimate,
    mixture,
    weights_by_others,
    with_least_covariance,
)

# All of 3 to 5 by 3 to 5 matrices of condition 100 in float64, but for roots of a zero eigenvalue: 2e-8.


def test_covariance_is_raised_in_every_direction():
    rng = np.random.default_rng(4)
    least, own = (a @ a.T + 0.1 * np.eye(5) for a in rng.normal(size=(2, 5, 5)))
    raised = with_least_covariance(Estimate(np.arange(5.0), own, np.eye(5)), least)
    for floor in (own, least):
        assert np.linalg.eigvalsh(raised.covariance - floor).min() > -1e-9
    np.testing.assert_array_equal(raised.mean, np.arange(5.0))
    # A larger covariance does not change.
    same = with_least_covariance(Estimate(np.zeros(5), 2.0 * least, np.eye(5)), least)
    np.testing.assert_allclose(same.covariance, 2.0 * least, rtol=1e-12)


def test_a_known_zero_departure_keeps_its_zero_variance():
    least = np.diag([0.5, 0.0])  # without noise bends are known to be zero
    raised = with_least_covariance(Estimate(np.zeros(2), np.diag([0.1, 0.0]), np.eye(2)), least)
    np.testing.assert_allclose(raised.covariance, least, atol=2e-8)


def test_a_mixture_of_two_sets_equals_the_average_over_all_hypotheses():
    rng = np.random.default_rng(6)
    noise, *priors = (a @ a.T + 0.1 * np.eye(3) for a in rng.normal(size=(5, 3, 3)))
    every = [(before, prior) for before, prior in zip((0.4, 0.1, 2.0, 1.0), priors, strict=True)]
    value = rng.normal(size=3)
    whole = estimate(value, noise, every)
    for parts in ((every[:1], every[1:]), (every[2:], every[:2])):
        found = mixture(*(estimate(value, noise, part) for part in parts))
        np.testing.assert_allclose(found.mean, whole.mean, rtol=1e-10)
        np.testing.assert_allclose(found.covariance, whole.covariance, rtol=1e-10, atol=1e-14)  # float64, as above
        np.testing.assert_allclose(found.gain @ value, whole.mean, rtol=1e-10)
        np.testing.assert_allclose(found.gain, whole.gain, rtol=1e-10, atol=1e-14)
        assert found.log_evidence == pytest.approx(whole.log_evidence)


def test_weights_are_estimated_from_the_other_items():
    before = np.array([1.0, 1.0, 2.0])
    logs = np.log(np.array([[0.9, 0.1, 1e-9], [0.8, 0.2, 1e-9], [1e-9, 1e-9, 1.0], [0.9, 0.1, 1e-9]]))
    one_trait = np.arange(3)[None]
    weights = weights_by_others(logs, before, one_trait)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    # Three support the first: it has most weight for all, and for the third, with three others for it, the most.
    assert (weights.argmax(axis=1) == 0).all()
    assert weights[2, 0] > weights[0, 0] > 0.45
    # A single thing, and flat likelihoods, leave the prior.
    np.testing.assert_allclose(weights_by_others(logs[:1], before, one_trait), [[0.25, 0.25, 0.5]])
    silent = weights_by_others(np.zeros((3, 3)), before, one_trait)
    np.testing.assert_allclose(silent, np.tile([0.25, 0.25, 0.5], (3, 1)))


def test_weights_of_traits_are_estimated_separately():
    """Two shifts by two bends: two ends of either shift are straight, the bend of the last one is unknown."""
    traits = np.array([[0, 0, 1, 1], [0, 1, 0, 1]])
    near, far, far_alone = np.log([[1.0, 1e-6, 1e-6, 1e-6], [1e-6, 1e-6, 1.0, 1e-6], [1e-6, 1e-6, 1.0, 1.0]])
    logs = np.stack([near, near, far, far, far_alone])
    weights = weights_by_others(logs, np.ones(4), traits)
    # By the four others, with the prior as a fifth: nine of ten for straight, whatever the shift.
    np.testing.assert_allclose(weights[4, 2] / weights[4, 2:].sum(), 0.9, rtol=1e-3)  # likelihoods of 1e-6
    np.testing.assert_allclose(weights[4, 0] / weights[4, :2].sum(), 0.9, rtol=1e-3)
    whole = weights_by_others(logs, np.ones(4), np.arange(4)[None])
    assert whole[4, 2] / whole[4, 2:].sum() < 0.9
