"""Compiled hashing and nearest patches compared with plain numpy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor import large_arrays
from processor.stitching.coarse import face_index
from processor.stitching.fine import correspondences
from processor.stitching.planes import border_exclusion, extraction, grouped_sums
from processor.stitching.planes.sampled_patches import Patches
from tests.support import arrays_in_files

ROUNDING = 1e-12  # sums of some hundred products of about one


def test_keys_are_numbered_as_numpy_does():
    rng = np.random.default_rng(1)
    for keys in (
        rng.integers(-50, 50, 1000),
        rng.integers(0, 2**62, 500),
        np.zeros(7, np.int64),
        np.empty(0, np.int64),
    ):
        want, first, number = np.unique(keys, return_index=True, return_inverse=True)
        got_first, got = grouped_sums.numbered(keys)
        np.testing.assert_array_equal(got_first, first)
        np.testing.assert_array_equal(got, number.ravel())
        assert grouped_sums.distinct_count(keys) == len(want)


def test_sums_by_group_are_those_of_a_matrix():
    rng = np.random.default_rng(2)
    points, group = rng.normal(size=(300, 3)), rng.integers(0, 9, 300)
    member = (group == np.arange(9)[:, None]).astype(float)
    np.testing.assert_allclose(grouped_sums.summed(points, group, 9), member @ points)
    x = np.hstack([points, np.ones((300, 1))])
    want = [[(x[group == g, i] * x[group == g, j]).sum() for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2),
                                                                     (0, 3), (1, 3), (2, 3), (3, 3))]
            for g in range(9)]  # fmt: skip
    np.testing.assert_allclose(grouped_sums.sums_of_points(points, group, 9), want)


def random_patches(rng, n, spread):
    normals = rng.normal(size=(n, 3))
    return Patches(rng.uniform(-spread, spread, (n, 3)), normals / np.linalg.norm(normals, axis=1)[:, None])


def test_nearest_patches_are_those_by_all_distances():
    rng = np.random.default_rng(3)
    there, patches = random_patches(rng, 400, 5.0), random_patches(rng, 600, 6.0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), [0.3, -0.2, 0.1]
    x, n = patches.points @ T[:3, :3].T + T[:3, 3], patches.normals @ T[:3, :3].T
    d = np.linalg.norm(x[:, None] - there.points, axis=2)
    off = np.abs(np.einsum("kni,ni->kn", x[:, None] - there.points, there.normals))
    like = n @ there.normals.T
    nearest = np.argsort(d, axis=1)[:, : face_index.NEAREST]
    fits = (d < 1.4) & (off < 0.6) & (like > 0.2)
    want = np.take_along_axis(fits, nearest, axis=1).any(axis=1)
    got = np.empty(600, np.bool_)
    face_index.mark_matches(face_index.build(there, 1.5), T, patches, 1.4, 0.6, 0.2, got)
    np.testing.assert_array_equal(got, want)
    assert 20 < want.sum() < 580

    weight = rng.uniform(0.5, 2.0, 600)
    small, large = face_index.build(there, 0.5), face_index.build(there, 1.5)
    H, g, centre, reach, count = face_index.normal_equations(small, large, T, patches, weight, 1.2, 0.5, 0.1)
    first = nearest[:, 0]
    rows = np.arange(600)
    matched = (d[rows, first] < 1.2) & (off[rows, first] < 0.5) & (like[rows, first] > 0.1)
    assert count == matched.sum() > 50
    p, m, w = x[matched], there.normals[first[matched]], weight[matched]
    r = np.einsum("ni,ni->n", p - there.points[first[matched]], m)
    np.testing.assert_allclose(centre, p.mean(axis=0))
    assert np.isclose(reach, np.sqrt(((p - centre) ** 2).sum(axis=1).mean()))
    J = np.hstack([np.cross((p - centre) / reach, m), m])
    np.testing.assert_allclose(H, J.T @ (w[:, None] * J), atol=ROUNDING)
    np.testing.assert_allclose(g, J.T @ (w * r), atol=ROUNDING)


def test_points_next_to_the_edge_of_a_bar_are_left_out_without_a_grid():
    """A bar's face 5 m away and its side face behind the edge: border points go, inner ones stay, sky is no border."""
    angle = np.arange(-0.05, 0.05, 0.002)
    a, e = (x.ravel() for x in np.meshgrid(angle, angle, indexing="ij"))
    rays = np.stack([np.ones(len(a)), a, e], axis=1)
    # The face ends at y = 100 mm; beyond, the rays meet its side face, which leads away.
    side = a > 0.02
    points = rays * np.where(side, 5000.0 + 60.0 * (a - 0.02) / 0.002, 5000.0)[:, None]
    points += np.random.default_rng(0).normal(0.0, 0.5, len(points))[:, None] * rays
    piece = np.where(a < 0.0301, 0, -1)  # the cube of the face holds the first points of the side face too
    face = points[~side]
    planes = extraction.planes_of(extraction.sums_of(face).sum(axis=0)[None])
    clear = border_exclusion.inside(points, np.arange(len(points)), None, piece, planes)
    assert not clear[side].any()
    assert not clear[(a > 0.0181) & ~side].any()  # a step of 0.002 beside the edge, but for noise
    inner = (a < 0.015) & (np.abs(e) < 0.045)
    # Two steps and more from it.
    assert clear[inner].mean() > 0.9  # 0.966 and 0.988 came


@pytest.mark.parametrize("count", [5, 4000])
def test_points_clear_in_angle_are_those_by_all_directions(monkeypatch, tmp_path, count):
    """A dense floor, sparse points above and a few lone ones at the poles: blocks of few points, in files."""
    rng = np.random.default_rng(5)
    points = rng.normal(0.0, 1.0, (count, 3)) * [1.0, 1.0, 0.05] * rng.uniform(0.5, 90.0, (count, 1))
    points[::9, 2] = rng.uniform(-60.0, 60.0, len(points[::9]))
    points[:2] = [[0.0, 0.0, 50.0], [0.0, 0.0, -2.0]]
    piece, cell = rng.integers(-1, 3, 7), rng.integers(0, 7, count)
    flat = rng.normal(0.0, 9.0, (3, 50, 3)) * [[[1.0, 1.0, 0.1]], [[1.0, 0.1, 1.0]], [[1.0, 1.0, 1.0]]]
    planes, limit = (
        extraction.planes_of(extraction.sums_of(flat.reshape(-1, 3)).reshape(3, 50, -1).sum(axis=1)),
        np.array([4.0, 20.0, 9.0]),
    )
    monkeypatch.setattr(border_exclusion, "CHUNK", 90)
    arrays_in_files.limit(monkeypatch, 170)
    with large_arrays.in_files(tmp_path):
        clear = border_exclusion._clear_in_angle(points, cell, piece, planes, limit)
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    for i, f in enumerate(piece[cell]):
        near = points[np.argsort(-(rays @ rays[i]), kind="stable")[: border_exclusion.NEIGHBOURS + 1]]
        off = np.abs((near - planes.mean[f]) @ planes.normal[f])
        behind = border_exclusion.BEYOND * np.linalg.norm(points[i])
        own = abs((points[i] - planes.mean[f]) @ planes.normal[f]) < limit[f]
        assert clear[i] == (f >= 0 and own and ((off < limit[f]) | (off > behind)).all())
    assert clear.any()


@pytest.mark.parametrize(
    ("piece", "kept", "numbers", "faces"),
    [([2, 2, 5, 7, 7, 7], [0, 1, 3, 4, 5], [0, 0, 1, 1, 1], [-1, -1, 0, 0, 0]), ([1, 4], [], [], []), ([], [], [], [])],
)
def test_pieces_of_one_scan_alone_are_left_out_and_the_others_numbered_anew(piece, kept, numbers, faces):
    rows = np.arange(len(piece))
    face = np.where(np.array(piece, np.int64) > 2, 6, -1)
    blocks = correspondences.Blocks(
        np.array(piece, np.int64), rows, np.zeros((len(rows), 10)), np.ones(len(rows)), rows * 0, 9,
        np.zeros((len(rows), 3, 7)), face,
    )  # fmt: skip
    shared = blocks.shared()
    assert (shared.scan.tolist(), shared.piece.tolist(), shared.face.tolist()) == (kept, numbers, faces)
    assert (shared.pieces, shared.faces) == (len(set(numbers)), len(set(faces) - {-1}))


def test_pieces_that_scatter_by_more_than_the_noise_weigh_less():
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-500.0, 500.0, (400, 2)), rng.normal(0.0, 1.0, 400)])
    rough = flat * [1.0, 1.0, 3.0]
    sums = np.stack([extraction.sums_of(points).sum(axis=0) for points in (flat, flat, rough, rough)])
    excess = correspondences._excess(sums, np.full(4, 400.0), np.array([0, 0, 1, 1]), 2)
    # A variance of 400 points scatters by 7 %.
    assert 1.0 <= excess[0] < 1.15
    assert 8.0 < excess[1] < 10.0
