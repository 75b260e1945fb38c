"""Universal kriging of patches' means, against draws of known size."""

import numpy as np

from processor.adjustment import kriging

NOISE = 0.1


def drawn(rng, waves):
    """Patches of a face 500 by 800 mm with a tilt, waves and noise; the wanted places and the truth there."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(25.0, 500.0, 50.0), np.arange(25.0, 800.0, 50.0), indexing="ij"))
    length, phase = rng.uniform(500.0, 900.0), rng.uniform(0.0, 2.0 * np.pi)

    def surface(x, y):
        wave = np.sin(2.0 * np.pi * x / length + phase) * np.sin(np.pi * y / 800.0)
        return 0.3 + 0.2 * x / 500.0 + waves * wave

    trend = np.stack([np.ones_like(x), x / 500.0, y / 800.0], axis=1)
    value = surface(x, y) + NOISE * rng.standard_normal(len(x))
    means = kriging.Means(np.stack([x, y], axis=1), value, np.full(len(x), NOISE**2), trend)
    at = np.array([[0.0, 0.0], [0.0, 400.0], [0.0, 800.0]])
    return means, at, surface(at[:, 0], at[:, 1])


def test_kriging_follows_waves_and_its_interval_covers():
    rng = np.random.default_rng(0)
    off, pulls = [], []
    for _ in range(25):  # of 75 pulls 95 % are within 1.96 with a standard deviation of 2.5 %
        means, at, truth = drawn(rng, 1.0)
        kriged = kriging.average(kriging.by_hypotheses(means, at))
        both = np.hstack([np.ones((3, 1)), at / [500.0, 800.0], np.eye(3)])  # trend and process together
        off.append(both @ kriged.mean - truth)
        pulls.append(off[-1] / np.sqrt(np.diag(both @ kriged.covariance @ both.T)))
    assert np.sqrt(np.mean(np.square(off))) < 0.25  # at the border; the trend alone is off by 0.5
    assert 0.9 < np.mean(np.abs(pulls) < 1.96) <= 1.0


def test_without_waves_it_is_least_squares():
    rng = np.random.default_rng(1)
    found = [kriging.by_hypotheses(*drawn(rng, 0.0)[:2]) for _ in range(10)]
    weights = kriging.learned_weights(found)
    assert np.median(weights[:, 0]) > 0.6  # the other faces show none
    means, at, _ = drawn(rng, 0.0)
    one = kriging.by_hypotheses(means, at)
    only = np.zeros(len(kriging.HYPOTHESES))
    only[0] = 1.0
    kriged = kriging.average(one, only)
    expected = np.linalg.lstsq(means.trend, means.value, rcond=None)[0]
    np.testing.assert_allclose(kriged.mean, [*expected, 0.0, 0.0, 0.0], atol=1e-9)  # float64, as below
    by_noise = NOISE**2 * np.linalg.inv(means.trend.T @ means.trend)
    np.testing.assert_allclose(kriged.covariance[:3, :3], by_noise, rtol=1e-9, atol=1e-15)


def test_trend_undetermined_by_collinear_patches_equals_the_conditional_gaussian():
    rng = np.random.default_rng(2)
    x = np.arange(25.0, 500.0, 50.0)
    trend = np.stack([np.ones_like(x), x / 500.0, np.full(len(x), 0.3), 0.3 * x / 500.0], axis=1)
    value, expected, sd, noise = trend @ [1.0, 2.0, 3.0, 4.0] + NOISE * rng.standard_normal(len(x)), 0.5, 20.0, NOISE
    place = np.stack([x, np.full(len(x), 240.0)], axis=1)
    means = kriging.Means(place, value, np.full(len(x), noise**2), trend, np.inf, np.full(4, expected), sd)
    only = np.eye(len(kriging.HYPOTHESES))[0]  # no waves
    kriged = kriging.average(kriging.by_hypotheses(means, np.zeros((1, 2))), only)
    # Conditional distribution of a Gaussian, in the space of the values; (20 / 0.1)^2 of 1e-16 and 240 of condition.
    gain = sd**2 * trend.T @ np.linalg.inv(sd**2 * trend @ trend.T + noise**2 * np.eye(len(x)))
    np.testing.assert_allclose(kriged.mean[:4], expected + gain @ (value - trend @ np.full(4, expected)), atol=1e-6)
    covariance = sd**2 * (np.eye(4) - gain @ trend)
    np.testing.assert_allclose(kriged.covariance[:4, :4], covariance, atol=1e-6 * sd**2)
    assert np.sqrt(kriged.covariance[0, 0]) > 0.2 * sd  # level and tilt across are not told apart
