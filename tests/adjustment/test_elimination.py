"""Elimination of nuisance unknowns, against the inverse of the full normal matrix."""

import numpy as np

from processor.adjustment.elimination import eliminate


def test_reduced_equations_have_the_solution_and_covariance_of_the_full_ones():
    rng = np.random.default_rng(3)
    bodies, groups, u, p = 3, 5, 2, 2
    group = np.repeat(np.arange(groups), 3)
    columns = u * np.tile(np.arange(bodies), groups)[:, None] + np.arange(u)
    own, nuisance = rng.normal(size=(15, 4, u)), rng.normal(size=(15, 4, p))  # four observations a row
    observed = rng.normal(size=(15, 4))
    full, right = np.zeros((bodies * u + groups * p,) * 2), np.zeros(bodies * u + groups * p)
    for row in range(15):
        at = np.concatenate([columns[row], bodies * u + p * group[row] + np.arange(p)])
        A = np.hstack([own[row], nuisance[row]])
        full[np.ix_(at, at)] += A.T @ A
        right[at] += A.T @ observed[row]
    N, g = full[: bodies * u, : bodies * u].copy(), right[: bodies * u].copy()
    blocks = full[bodies * u :, bodies * u :].reshape(groups, p, groups, p)[np.arange(groups), :, np.arange(groups)]
    coupling = np.einsum("rai,raj->rij", own, nuisance)
    eliminate(group, columns, coupling, np.linalg.inv(blocks), right[bodies * u :].reshape(groups, p), N, g)
    np.testing.assert_allclose(np.linalg.solve(N, g), np.linalg.solve(full, right)[: bodies * u], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(N), np.linalg.inv(full)[: bodies * u, : bodies * u], rtol=1e-9)
