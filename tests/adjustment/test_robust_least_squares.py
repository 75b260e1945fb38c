"""Normal equations, iterated weights and sandwich covariances, by hand and by SciPy."""

import numpy as np
from scipy.optimize import least_squares

from processor.adjustment import robust_least_squares
from processor.robust_statistics import cauchy, huber


def test_iterated_weights_end_where_scipys_robust_losses_do():
    rng = np.random.default_rng(4)
    J = rng.normal(size=(80, 3))
    observed = J @ [1.0, -2.0, 0.5] + 0.1 * rng.normal(size=80)
    observed[::8] += 3.0
    laws = {"cauchy": cauchy, "huber": lambda z: huber(z, 1.0)}
    for loss, law in laws.items():
        found, weight = robust_least_squares.reweighted(
            np.zeros(3),
            lambda x, law=law: law((observed - J @ x) / 0.2),
            lambda _, weight: np.linalg.solve(*robust_least_squares.normal_equations(J, weight, observed)),
            200,
            lambda step: bool(np.abs(step).max() < 1e-12),
        )
        other = least_squares(lambda x: observed - J @ x, np.zeros(3), loss=loss, f_scale=0.2, xtol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found, other.x, atol=1e-5)  # its steps end at a cost of 1e-8 of itself
        assert weight[::8].max() < 0.1 < weight.max()


def test_gradients_are_summed_by_cluster_before_they_are_squared():
    gradient = np.array([[1.0, 2.0, 0.0, 0.0, 0.0, 0.0], [3.0, -1.0, 0.0, 0.0, 0.0, 0.0], *np.eye(6)[2:].repeat(2, 0)])
    cluster = np.array([0, 0, *range(2, 10)])  # a number without rows is no cluster
    # Of 9 clusters and 6 unknowns: 9 / 3. The first has the sum (4, 1).
    expected = 3.0 * np.diag([16.0, 1.0, 2.0, 2.0, 2.0, 2.0])
    expected[0, 1] = expected[1, 0] = 12.0
    np.testing.assert_allclose(robust_least_squares.sandwich(np.eye(6), gradient, cluster), expected)
    np.testing.assert_allclose(robust_least_squares.sandwich(2.0 * np.eye(6), gradient, cluster), 4.0 * expected)
