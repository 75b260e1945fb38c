"""Voxels, their linearity, thinning by hashes and points near lines, against plain numpy."""

import numpy as np
import pytest

from processor.geometry.thread_ranges import over_ranges
from processor.space_frame.members import voxel_linearity, voxel_lines
from processor.space_frame.points import hash_sampling, line_crops, voxels
from tests.support.clouds.memory_source import InMemory


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(1)
    t = rng.uniform(-2000.0, 3000.0, 20_000)
    line = np.outer(t, [0.6, 0.64, 0.48]) + rng.normal(scale=15.0, size=(20_000, 3))
    return np.round(np.concatenate([line, rng.uniform(-1500.0, 1500.0, (20_000, 3))]), 2)


def test_voxels_are_those_of_numpy(cloud):
    found = voxels.gathered(np.rint(cloud * 100.0).astype(np.int32), 100.0, 2)
    cell = np.floor(np.round(cloud, 2) / 100.0 + 1e-9).astype(np.int64)
    unique, inverse, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse.ravel(), cloud[:, i]) for i in range(3)], axis=1) / count[:, None]
    rows = {tuple(c): i for i, c in enumerate(unique.tolist())}
    assert found.number == (count >= 2).sum()
    at = [rows[tuple(c)] for c in found.cells.tolist()]
    assert (found.counts == count[at]).all()
    assert np.abs(found.means - means[at]).max() < 1e-8  # rounding, in sums
    for b in range(len(found.blocks)):
        assert (found.cells[found.starts[b] : found.starts[b + 1]] // voxels.SIDE == found.blocks[b]).all()
        for k, other in enumerate(found.beside[b]):
            if other >= 0:
                assert tuple(found.blocks[other] - found.blocks[b]) == (k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1)


def test_linearity_is_that_of_the_window(cloud):
    found = voxels.gathered(np.rint(cloud * 100.0).astype(np.int32), 100.0, 2)
    linear = voxel_linearity.linearity(found, 2.0)  # never linear enough: the better of both windows
    for i in np.random.default_rng(2).integers(0, found.number, 100):
        best = 0.0
        for radius2 in (voxel_linearity.SMALL2, voxel_linearity.LARGE2):
            near = ((found.cells - found.cells[i]) ** 2).sum(axis=1) <= radius2
            if near.sum() < voxel_linearity.LEAST_VOXELS:
                continue
            values, vectors = np.linalg.eigh(np.cov(found.means[near].T, bias=True))
            value = 1.0 - np.sqrt(max(values[1], 0.0) / values[2])
            if value > best:
                best, axis, mean = value, vectors[:, 2], found.means[near].mean(axis=0)
        assert linear.values[i] == pytest.approx(best, abs=1e-12)  # rounding
        if best > 0.0:
            assert abs(linear.directions[i] @ axis) == pytest.approx(1.0, abs=1e-12)  # rounding
            assert linear.means[i] == pytest.approx(mean)


def test_principal_axes_of_any_matrix():
    rng = np.random.default_rng(3)
    for scale in ([1.0, 1.0, 1.0], [1.0, 1e-3, 1e-6], [1.0, 1.0, 1e-4], [0.0, 0.0, 0.0]):
        for _ in range(20):
            Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
            M = Q @ np.diag(scale) @ Q.T
            first, second, *axis = voxel_linearity.principal(M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2])
            values = np.linalg.eigvalsh(M)
            # A closed form: roots of rounding.
            assert (first, second) == pytest.approx((values[2], values[1]), abs=1e-7)
            assert np.linalg.norm(axis) == pytest.approx(1.0)
            if scale[1] < 0.5 < scale[0]:
                # As above.
                assert np.linalg.norm(M @ axis - first * np.array(axis)) < 1e-6


def test_a_line_is_one_segment(cloud):
    found = voxels.gathered(np.rint(cloud[:20_000] * 100.0).astype(np.int32), 100.0, 2)
    one = voxel_lines.segments(found, voxel_linearity.linearity(found, 0.72), 0.72, 400.0)
    assert one.count == 1
    # 10,000 points of 15 mm: 1e-4 by noise, 1e-3 by the voxels of 100 mm of 5 m; two of these at its ends.
    assert one.directions[0] == pytest.approx([0.6, 0.64, 0.48], abs=3e-3)
    assert 2.0 * one.halves[0] == pytest.approx(5000.0, abs=250.0)
    assert np.linalg.norm(np.cross(one.points[0], one.directions[0])) < 10.0


def test_hash_thinning_depends_on_coordinates_alone(cloud):
    whole = {tuple(p) for p in np.rint(cloud * 100.0).astype(int).tolist()}
    kept = hash_sampling.thinned(InMemory(cloud), 10_000)
    assert len(kept) == pytest.approx(10_000, abs=4.0 * np.sqrt(7_500))  # four sds
    assert {tuple(p) for p in kept.tolist()} <= whole
    again = hash_sampling.thinned(InMemory(cloud[::-1], chunk_size=999), 10_000, threads=2)
    assert sorted(map(tuple, again.tolist())) == sorted(map(tuple, kept.tolist()))
    # Evenly over space: neither of the halves across any axis gets more.
    for i in range(3):
        upper = kept[:, i] > np.median(cloud[:, i]) * 100.0
        assert upper.mean() == pytest.approx(0.5, abs=0.02)  # four times 0.5 / sqrt(10,000)
    assert len(hash_sampling.thinned(InMemory(cloud), 10**9)) == len(cloud)


def lines(rng, count):
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return (
        rng.uniform(-1000.0, 1000.0, (count, 3)),
        directions,
        rng.uniform(-900, -100, count),
        rng.uniform(50, 900, count),
    )


def near_by_hand(cloud, points, directions, low, high, reach):
    away = cloud[:, None] - points
    t = np.einsum("nmi,mi->nm", away, directions)
    off = np.linalg.norm(away - t[..., None] * directions, axis=2)
    return (off <= reach) & (t >= low) & (t <= high)


def test_points_near_lines_are_those_near_by_hand(cloud):
    rng = np.random.default_rng(4)
    points, directions, low, high = lines(rng, 25)
    station = rng.integers(-1, 5, len(cloud)).astype(np.int32)
    expected = near_by_hand(cloud, points, directions, low, high, 120.0)
    found = line_crops.gather(
        [(cloud, station)], 100.0, line_crops.corridors(points, directions, low, high, 120.0), len(cloud)
    )
    assert (found.shares == 1.0).all()
    for m in range(25):
        rows = slice(m * found.room, m * found.room + found.counts[m])
        assert found.counts[m] == expected[:, m].sum()
        places, at = found.places[rows], found.stations[rows]
        assert (np.lexsort((places, at)) == np.arange(len(at))).all()
        mask = (1 << line_crops.FIELD) - 1
        fields = np.stack([places >> 2 * line_crops.FIELD, places >> line_crops.FIELD & mask, places & mask], axis=1)
        got = np.column_stack([fields - line_crops.HALF + found.middles[m], at])
        want = np.column_stack([np.rint(cloud * 100.0).astype(int), station])[expected[:, m]]
        assert sorted(map(tuple, got.tolist())) == sorted(map(tuple, want.tolist()))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_points_at_the_rim_of_a_corridor_along_an_axis_are_near(axis):
    """Wherever the line runs through the cells of 200 mm, which only their rims may touch."""
    turn, at = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 33)[1:], np.linspace(-800.0, 800.0, 9))
    ring = np.stack([at.ravel(), *(119.9 * f(turn.ravel()) for f in (np.cos, np.sin))], axis=1)
    for shift in np.linspace(0.0, 200.0, 21):
        points, direction = np.roll([[0.0, shift, 1.7 * shift]], axis, axis=1), np.roll(np.eye(3)[:1], axis, axis=1)
        near = line_crops.corridors(points, direction, np.array([-900.0]), np.array([900.0]), 120.0)
        cloud = points + np.roll(ring, axis, axis=1)
        assert line_crops.gather([(cloud, np.empty(0, np.int32))], 100.0, near, len(cloud)).counts[0] == len(cloud)


def test_full_line_crop_keeps_the_largest_share_that_fits(cloud):
    rng = np.random.default_rng(5)
    points, directions, low, high = lines(rng, 25)
    near = line_crops.corridors(points, directions, low, high, 120.0)
    whole = near_by_hand(cloud, points, directions, low, high, 120.0).sum(axis=0)
    one = line_crops.gather([(cloud, np.empty(0, np.int32))], 100.0, near, 64)
    assert (one.counts <= 64).all()
    assert (one.shares[whole > 64] < 1.0).all()
    assert (one.shares[whole <= 64] == 1.0).all()
    # The next larger power of two did not fit: half of it is there, give or take the luck of the hash.
    assert one.counts[whole > 64].min() > 15
    order = rng.permutation(len(cloud))
    pieces = [(cloud[order[i : i + 1234]], np.empty(0, np.int32)) for i in range(0, len(cloud), 1234)]
    two = line_crops.gather(pieces, 100.0, near, 64, threads=1)
    assert (one.counts == two.counts).all()
    for m in range(25):
        rows = slice(m * 64, m * 64 + one.counts[m])
        assert (one.places[rows] == two.places[rows]).all()


def test_parallel_ranges_cover_every_index_once_and_raise_errors():
    for count in (0, 1, 31, 1000):
        done = np.zeros(count, int)

        def kernel(first, last, done=done):
            done[first:last] += 1

        over_ranges(kernel, count, threads=3)
        assert (done == 1).all()

    def failing(first, last):
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        over_ranges(failing, 100, threads=2)
