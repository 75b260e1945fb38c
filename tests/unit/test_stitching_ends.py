"""Ends of faces between the rays of a grid: where they are, how many say the same, and what was never met."""

import numpy as np

from processor.stitching import bounding, ends, rays
from processor.stitching.octree import Planes
from tests.stitch_clouds import pose, scan


def test_rays_of_a_grid_are_those_that_made_it():
    made = scan("S", pose([0.0, 0.0, 1500.0], 0.0), 1, step_mrad=20.0, sigma_mm=0.0)
    keep = np.arange(len(made.points)) % 3 > 0
    row, column = made.grid_row.astype(np.int64), made.grid_column.astype(np.int64)
    found = rays.fitted(made.points[keep], row[keep], column[keep])
    true = made.points / np.linalg.norm(made.points, axis=1)[:, None]
    np.testing.assert_allclose(found.of(row, column), true, atol=1e-9)
    lost = rays.unanswered(found, row[keep], column[keep])
    assert len(lost) == (~keep).sum()
    np.testing.assert_allclose(np.sort(lost, axis=0), np.sort(true[~keep], axis=0), atol=1e-9)


def post(width_mm, phase, step=5e-3, range_mm=20_000.0):
    """A post 20 m ahead against the sky, x along the ray; columns at (i + phase) steps, 30 rows. Returns its ends."""
    column, row = np.meshgrid(np.arange(200), np.arange(30))
    turn = (column.ravel() - 100 + phase) * step
    up = (row.ravel() - 10) * step
    u = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], axis=1)
    p = u * (range_mm / u[:, 0])[:, None]
    # The ground below gives the grid its columns.
    low = row.ravel() < 4
    hit = low | (np.abs(p[:, 1]) < 0.5 * width_mm)
    p[low] *= 0.6
    plane = Planes(
        np.ones(1), np.array([[range_mm, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]]), np.ones((1, 3)), np.eye(3)[None]
    )
    r, c = row.ravel()[hit], column.ravel()[hit]
    piece = np.where(low[hit], -1, 0)
    piece[~low[hit] & (r % 7 > 0)] = -1  # found as flat in few rows only
    own = rays.fitted(p[hit], r, c)
    return ends.ends_of(p[hit], r, c, piece, plane, 2.0, own)


def test_ends_of_a_post_are_without_bias_whatever_the_rays_met_of_it():
    """Phases all over a step: a post of 1.3 steps is met by one ray or by two, and its ends count all the same."""
    for width in (130.0, 250.0):
        shares = []
        for phase in np.linspace(0.0, 1.0, 40, endpoint=False):
            found = post(width, phase)
            side = (np.abs(found.across[:, 1]) > 50.0) & (found.across[:, 1] > 0.0)
            assert side.sum() >= 20  # of 26 rows, of which 4 were in a piece
            shares.append(np.mean((found.points[side, 1] - 0.5 * width) / found.across[side, 1]))
        assert np.abs(shares).max() < 0.51
        assert abs(np.mean(shares)) < 0.03


def matches(share, gap, scan_row=None):
    n = len(share)
    zeros = np.zeros(n, np.int64)
    width = np.full(n, 60.0)
    return bounding.Matches(
        zeros, zeros if scan_row is None else scan_row, np.zeros((n, 3)), share * width, width,
        np.tile([0.0, 1.0, 0.0], (n, 1)), gap,
    )  # fmt: skip


def test_ends_in_one_gap_tell_no_more_than_one_others_as_many_as_they_are():
    """200 ends of a post share one place in one gap: the variance of their mean is that of one end, w^2 / 12."""
    rng = np.random.default_rng(0)
    post_ends = bounding.variance(matches(0.3 + rng.normal(0.0, 0.005, 200), np.zeros(200, np.int64)))
    assert 1.0 / (1.0 / post_ends).sum() > 0.98 * 60.0**2 / 12.0
    slanting = bounding.variance(matches(rng.uniform(-0.5, 0.5, 200), np.arange(200)))
    np.testing.assert_allclose(slanting, 60.0**2 / 12.0)
    steep = bounding.variance(matches(np.linspace(-0.5, 0.5, 200), np.zeros(200, np.int64)))
    np.testing.assert_allclose(1.0 / (1.0 / steep).sum(), 60.0**2 / 12.0 / 200, rtol=0.3)
