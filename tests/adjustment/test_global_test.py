"""Global tests: by chance as often as stated, and failed by residuals beyond the noise."""

import numpy as np

from processor.adjustment import global_test, kriging


def fitted(rng, noise, stated):
    """Tail of a level face in 80 patches of noise, where another noise is stated."""
    place = rng.uniform(-500.0, 500.0, (80, 2))
    trend = np.stack([np.ones(80), *(place / 500.0).T], axis=1)
    means = kriging.Means(place, noise * rng.normal(size=80), np.full(80, stated**2), trend, 3000.0)
    return kriging.tail(kriging.by_hypotheses(means, np.zeros((1, 2))), kriging.PRIOR)


def test_a_tail_is_uniform_or_larger_by_chance():
    rng = np.random.default_rng(0)
    tails = np.array([fitted(rng, 0.1, 0.1) for _ in range(75)])  # of the level of 2 % one or two are expected
    for level in (0.02, 0.1, 0.3):
        assert (tails < level).mean() <= global_test.PREDICTIVE * level
    assert not global_test.contradicted(tails).any()


def test_noise_much_larger_than_stated_contradicts():
    """Patches next to each other that differ are no waves."""
    rng = np.random.default_rng(1)
    assert global_test.contradicted(np.array([fitted(rng, 4.0, 0.1), fitted(rng, 0.1, 0.1), np.nan])).tolist() == [
        True, False, False,
    ]  # fmt: skip
