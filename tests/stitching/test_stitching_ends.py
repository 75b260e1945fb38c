"""Ends of faces between the rays of a scan grid: position, variance, and points near borders."""

from types import SimpleNamespace

import numpy as np
import pytest

from processor.geometry import scan_grid_directions
from processor.stitching.fine import edge_constraints
from processor.stitching.planes import border_exclusion, extraction, face_ends
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.grid_bands import GridBands
from tests.support.clouds.stitch_clouds import pose, scan

ROUNDING = 1e-12  # of unit vectors by sums over a thousand rays


def test_rays_fitted_to_a_grid_are_the_simulated_ones():
    made = scan("S", pose([0.0, 0.0, 1500.0], 0.0), 1, step_mrad=20.0, sigma_mm=0.0)
    keep = np.arange(len(made.points)) % 3 > 0
    row, column = made.grid_row.astype(np.int64), made.grid_column.astype(np.int64)
    rays = scan_grid_directions.fitted(made.points[keep], row[keep], column[keep])
    true = made.points / np.linalg.norm(made.points, axis=1)[:, None]
    np.testing.assert_allclose(rays.of(row, column), true, atol=ROUNDING)
    empty = np.ones((row.max() + 1, column.max() + 1), bool)
    empty[row[keep], column[keep]] = False
    lost = scan_grid_directions.unanswered(rays, empty)
    assert len(lost) == (~keep).sum()
    np.testing.assert_allclose(np.sort(lost, axis=0), np.sort(true[~keep], axis=0), atol=ROUNDING)


def rays_at(turn, up):
    """Unit vectors of rays by their angles about z and above the horizon."""
    return np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], axis=1)


def plane(place, normal, variance=1.0):
    return Planes(np.ones(1), np.array([place]), np.array([normal]), np.full((1, 3), variance), np.eye(3)[None])


AHEAD = [-1.0, 0.0, 0.0]  # the normal of a face ahead


def bands(points, row, column):
    """The points of a grid, each in a cell of its own."""
    return GridBands.of(points, row.astype(np.int32), column.astype(np.int32), np.arange(len(points)))


def post(width_mm, phase, step=5e-3, range_mm=20_000.0):
    """Ends of a post 20 m ahead against the sky, x along the ray; columns at (i + phase) steps, 30 rows."""
    column, row = np.meshgrid(np.arange(200), np.arange(30))
    turn = (column.ravel() - 100 + phase) * step
    u = rays_at(turn, (row.ravel() - 10) * step)
    p = u * (range_mm / u[:, 0])[:, None]
    # The ground below determines the columns of the grid.
    low = row.ravel() < 4
    hit = low | (np.abs(p[:, 1]) < 0.5 * width_mm)
    p[low] *= 0.6
    r, c = row.ravel()[hit], column.ravel()[hit]
    piece = np.where(low[hit], -1, 0)
    piece[~low[hit] & (r % 7 > 0)] = -1  # in a planar piece in few rows only
    rays = scan_grid_directions.fitted(p[hit], r, c)
    return face_ends.ends_of(bands(p[hit], r, c), piece, plane([range_mm, 0.0, 0.0], AHEAD), 2.0, rays)


def test_ends_of_a_post_are_unbiased_for_all_phases_of_the_rays():
    """A post of 1.3 steps is hit by one ray or by two, and its ends are used in both cases."""
    for width in (130.0, 250.0):
        shares = []
        for phase in np.linspace(0.0, 1.0, 40, endpoint=False):
            ends = post(width, phase)
            side = (np.abs(ends.across[:, 1]) > 50.0) & (ends.across[:, 1] > 0.0)
            assert side.sum() >= 20  # of 26 rows, of which 4 were in a piece
            shares.append(np.mean((ends.points[side, 1] - 0.5 * width) / ends.across[side, 1]))
        # Half a gap at most, and of 40 even phases the mean of a share within half a phase.
        assert np.abs(shares).max() < 0.51
        assert abs(np.mean(shares)) < 0.03


@pytest.mark.parametrize("height", [0, 8])
def test_a_bar_that_one_ray_hits_has_an_end_on_either_side(height):
    """Be it the first or the last ray of a scan: rays 5 mrad apart at 20 m pass 50 mm beside it."""
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(200), np.arange(9)))
    u = rays_at((column - 100) * 5e-3, (row - height) * 5e-3)
    on_bar = (row == height) & (column == 100)
    p = u * np.where(on_bar, 20_000.0, 12_000.0)[:, None]  # other rows determine the columns of the grid
    kept = on_bar | (np.abs(row - 4) < 2)
    rays = scan_grid_directions.fitted(p[kept], row[kept], column[kept])
    piece = np.where(on_bar[kept], 0, -1)
    ends = face_ends.ends_of(
        bands(p[kept], row[kept], column[kept]), piece, plane([20_000.0, 0.0, 0.0], AHEAD), 2.0, rays
    )
    beside = np.abs(ends.across[:, 1]) > 50.0
    np.testing.assert_allclose(np.sort(ends.points[beside, 1]), [-50.0, 50.0], rtol=1e-4)  # squares of 5 mrad


def test_an_end_is_bounded_by_a_piece_behind_that_stands_across_its_face():
    """A face along x at y = 20 ends at x = 1 m; the piece there faces a second scan, away from the first."""
    T = np.stack([pose([-5000.0, 400.0, 0.0], 40.0, 5.0), pose([3000.0, -700.0, 90.0], 130.0, 8.0)])
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-100.0, 100.0, 9), np.linspace(-100.0, 100.0, 9)))
    piece = (np.stack([np.full(81, 1000.0), y, z], axis=1) - T[1, :3, 3]) @ T[1, :3, :3]
    blocks = SimpleNamespace(
        piece=np.zeros(1, np.int64), scan=np.ones(1, np.int64), pieces=1,
        sums=extraction.sums_of(piece).sum(axis=0, keepdims=True),
    )  # fmt: skip
    # The step from ray to ray is 30 mm: an end is within 0.75 of it and the gate of 2 mm.
    (X, Y, Z), x = np.eye(3), 1006.0 * np.eye(3)[0]
    at = np.array([x, x + 19.0 * X, x, x, x + 160.0 * Y, x - 26.0 * X]) + 20.0 * Y + 10.0 * Z
    faces, steps = np.array([Y, Y, X, Y, Y, Z]), 30.0 * np.array([X, X, X, Z, X, X])
    ends = face_ends.Ends(
        (at - T[0, :3, 3]) @ T[0, :3, :3], steps @ T[0, :3, :3], faces @ T[0, :3, :3], np.arange(6), 10 * np.arange(6)
    )
    clouds = [SimpleNamespace(ends=ends, cell_mm=5.0), SimpleNamespace(ends=face_ends.Ends(), cell_mm=5.0)]
    found = edge_constraints.match(clouds, blocks, T, 2.0)
    assert found.gap.tolist() == [0, 5]
    assert found.edge.tolist() == [0, 50]
    np.testing.assert_allclose(found.off, [6.0, -20.0], atol=1e-9)  # float64 of some m
    np.testing.assert_allclose(found.width, 30.0, atol=1e-9)
    np.testing.assert_allclose(found.normal, [X, X], atol=1e-9)


def matches(share, gap):
    n = len(share)
    zeros = np.zeros(n, np.int64)
    width = np.full(n, 60.0)
    return edge_constraints.Matches(
        piece=zeros, scan=zeros, points=np.zeros((n, 3)), off=share * width, width=width,
        normal=np.tile([0.0, 1.0, 0.0], (n, 1)), gap=gap, edge=zeros,
    )  # fmt: skip


def test_ends_in_one_gap_weigh_as_one_and_spread_ends_by_their_number():
    """200 ends of a post at one position in one gap: the variance of their mean is that of a single end, w^2 / 12."""
    rng = np.random.default_rng(0)
    post_ends = edge_constraints.variance(matches(0.3 + rng.normal(0.0, 0.005, 200), np.zeros(200, np.int64)))
    assert 1.0 / (1.0 / post_ends).sum() > 0.98 * 60.0**2 / 12.0  # one and the same but for 0.005 of a gap
    anywhere = (0.618034 * np.arange(200)) % 1.0 - 0.5
    slanting = edge_constraints.variance(matches(anywhere, np.arange(200)))
    np.testing.assert_allclose(slanting, 60.0**2 / 12.0)
    steep = edge_constraints.variance(matches(np.linspace(-0.5, 0.5, 200), np.zeros(200, np.int64)))
    np.testing.assert_allclose(1.0 / (1.0 / steep).sum(), 60.0**2 / 12.0 / 200, rtol=1e-9)  # rounding


def test_variance_of_ends_in_step_with_the_grid():
    """Compared with the variance of the mean position over explicit shifts of the edge across a whole gap."""
    rng = np.random.default_rng(1)
    moves = (np.arange(1000) + 0.5) / 1000.0
    for share in (np.full(40, 0.2), np.tile([-0.4, 0.1], 20), 0.1 * rng.standard_normal(40) - 0.2, np.array([0.37])):
        shifted = (share[None] - moves[:, None] + 0.5) % 1.0 - 0.5
        want = np.mean(shifted.mean(axis=1) ** 2) * len(share)
        got = edge_constraints.in_step(share, np.zeros(len(share), np.int64))
        np.testing.assert_allclose(got, max(want, 1.0 / 12.0), rtol=0.08)  # 16 harmonics, of which two in step have 8


def test_far_edges_of_an_inclined_face_are_unbiased():
    """A floor that ends 9 m ahead of a scanner 1.5 m above it: rays are even in angle, so that gaps widen outwards."""
    height, edge, step = 1500.0, 9000.0, 2e-3
    off, width = [], []
    for phase in np.linspace(0.0, 1.0, 25, endpoint=False):
        column, row = np.meshgrid(np.arange(60), np.arange(300))
        u = rays_at((column.ravel() - 30.3) * step, -0.4507 + (row.ravel() + phase) * step)
        p = u * (-height / u[:, 2])[:, None]
        hit = (u[:, 2] < 0.0) & (p[:, 0] < edge)
        beside = ~hit & (row.ravel() > 280)  # points above determine the rows of the grid
        p[beside] = 20_000.0 * u[beside]
        keep = hit | beside
        r, c = row.ravel()[keep], column.ravel()[keep]
        rays = scan_grid_directions.fitted(p[keep], r, c)
        floor = plane([0.0, 0.0, -height], [0.0, 0.0, 1.0])
        ends = face_ends.ends_of(bands(p[keep], r, c), np.where(hit[keep], 0, -1), floor, 2.0, rays)
        far = (ends.across[:, 0] > 0.0) & (np.abs(ends.across[:, 1]) < 0.5 * ends.across[:, 0])
        assert far.sum() >= 40
        off += (ends.points[far, 0] - edge).tolist()
        width += ends.across[far, 0].tolist()
    # Half way along the face would be too far out by 2e-3 / 3 times 6, the tangent of the incidence: 0.4 % of the gap.
    assert abs(np.mean(off)) < 0.001 * np.mean(width)


def test_points_next_to_another_face_are_left_out():
    """A box corner: the front 5 m ahead ends at y = 0, and its side runs away from there."""
    y = np.linspace(-500.0, 200.0, 15) + 3.0
    front = np.stack([np.full(15, 5000.0), y, np.zeros(15)], axis=1)
    side = y > 0.0
    front[side, 0] += 1.5 * y[side]
    points = np.vstack([front + np.array([0.0, 0.0, 40.0 * i]) for i in range(3)])
    grid = bands(points, *np.divmod(np.arange(45), 15))
    piece = np.where(points[:, 1] < 60.0, 0, -1)  # two columns of the side face are in the piece
    ahead = plane([5000.0, 0.0, 0.0], AHEAD, 4.0)
    clear = border_exclusion.inside(points, np.arange(45), grid, piece, ahead).reshape(3, 15)
    ends_at = int((y < 0.0).sum())  # the first column there lies 4.5 mm behind the front, within the noise
    assert not clear[:, ends_at:].any()
    assert clear[:, 1:ends_at].all()
    # A bar hit by two columns of rays, with background on both sides, would lose all points: it keeps them.
    bar = np.stack([np.full(8, 5000.0), np.tile([0.0, 40.0], 4), np.repeat(40.0 * np.arange(4), 2)], axis=1)
    behind = np.stack([np.full(8, 5080.0), np.tile([-40.0, 80.0], 4), np.repeat(40.0 * np.arange(4), 2)], axis=1)
    points, row = np.vstack([bar, behind]), np.tile(np.repeat(np.arange(4), 2), 2)
    grid = bands(points, row, np.concatenate([np.tile([1, 2], 4), np.tile([0, 3], 4)]))
    clear = border_exclusion.inside(points, np.arange(16), grid, np.repeat([0, -1], 8), ahead)
    assert clear[:8].all()
    assert not clear[8:].any()
