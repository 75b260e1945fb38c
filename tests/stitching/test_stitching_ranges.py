"""Errors of ranges in the adjustment: scales, noise by incidence and range, errors by direction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.geometry import rigid
from processor.stitching.fine import bundle_adjustment, direction_errors, noise_model
from processor.stitching.fine.correspondences import Blocks
from processor.stitching.planes import extraction
from processor.stitching.planes.extraction import Planes
from processor.stitching.planes.face_ends import Ends
from processor.stitching.planes.scan_planes import Cloud

HALL = np.array([60000.0, 40000.0, 12000.0])
SIGMA_MM = 2.0
PARTS = 4  # pieces of a wall along each side


def stations():
    """Poses T_hall_scan (4, 4, 4) at four places of a hall."""
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, 3] = [[12000.0, 9000, 1600], [45000, 12000, 1700], [30000, 33000, 1500], [8000, 28000, 1700]]
    T[:, :3, :3] = Rotation.from_euler("z", [[10.0], [75], [200], [-60]], degrees=True).as_matrix()
    return T


def wall_points():
    """Points (n, 9, 3) of the pieces of the hall's walls, floor and ceiling, and their normals (n, 3)."""
    points, normals = [], []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for end in (0.0, HALL[axis]):
            for i, j in np.ndindex(PARTS, PARTS):
                square = np.zeros((9, 3))
                square[:, others] = (np.array([i, j]) + np.indices((3, 3)).reshape(2, 9).T / 2.0) / PARTS
                square *= HALL
                square[:, axis] = end
                points.append(square)
                normals.append(np.eye(3)[axis])
    return np.array(points), np.array(normals)


def blocks_of(T, points, normals, scale, each, shift=None, seen=None):
    """Blocks of exact planes with the scatter of ``each`` points a block: noise across the planes, none in the means.

    ``scale`` (k,) are those of the scans' ranges; ``shift`` (k, n) moves the points of blocks across their planes.
    """
    k, n = len(T), len(points)
    rows = [(p, s) for p in range(n) for s in range(k) if seen is None or seen[s, p]]
    sums, rays = [], []
    for p, s in rows:
        there = points[p] + (0.0 if shift is None else shift[s, p]) * normals[p]
        local = (1.0 + scale[s]) * (there - T[s, :3, 3]) @ T[s, :3, :3]
        weight = each / len(local) / SIGMA_MM**2
        x = np.hstack([local, np.ones((len(local), 1))])
        u = local / np.linalg.norm(local, axis=1)[:, None]
        total = weight * x.T @ x
        normal = T[s, :3, :3].T @ normals[p]
        total[:3, :3] += each * np.outer(normal, normal)
        sums.append(extraction.triangle(total[None])[0])
        rays.append(weight * u.T @ np.hstack([x, u]))
    piece, scan = np.array(rows).T
    none = np.full(len(rows), -1, np.int64)
    return Blocks(
        piece=piece, scan=scan, sums=np.array(sums), count=np.full(len(rows), float(each)), kind=none + 1, pieces=n,
        rays=np.array(rays), face=none,
    )  # fmt: skip


def test_range_scales_are_separated_from_the_poses():
    """Without noise in the means the poses are exact, whatever the scatter of the points about them."""
    T, scale = stations(), 1e-6 * np.array([4.0, -7.0, 5.0, -2.0])
    blocks = blocks_of(T, *wall_points(), scale, each=200_000)
    start = T.copy()
    start[1:, :3, 3] += [1.0, -2.0, 0.5]
    solution = bundle_adjustment.solve(blocks, start, 0, tau=(0.0, 0.0, 0.0))
    # The end of an iteration whose steps shrink by more than a hundred: 3e-9 and 2e-5 mm are left.
    np.testing.assert_allclose(solution.of_scans[:, 1], scale, atol=1e-8)
    np.testing.assert_allclose(solution.T[:, :3, 3], T[:, :3, 3], atol=1e-4)


def test_information_that_is_spurious_in_part_makes_a_covariance_wider():
    """Of shares s of the information the standard deviation is 1 / (1 - s) times as large, at most 100 times."""
    N, share = np.diag([4.0, 9.0, 25.0]), np.array([0.0, 0.5, 0.999])
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    found = bundle_adjustment._genuine_covariance(turn @ N @ turn.T, turn @ (N * share) @ turn.T)
    exact = np.diag(1.0 / np.diag(N) / np.maximum(1.0 - share, 0.01) ** 2)
    np.testing.assert_allclose(turn.T @ found @ turn, exact, rtol=1e-9, atol=1e-9)  # float64


def test_scatter_of_points_does_not_bias_the_range_scales():
    """Residuals are smaller in smaller scans: the least sum of squares alone would make all of them too small."""
    T = stations()
    blocks = blocks_of(T, *wall_points(), np.zeros(4), each=1_000_000)
    solution = bundle_adjustment.solve(blocks, T, 0, tau=(0.0, 0.0, 0.0))
    assert np.abs(solution.of_scans[:, 1]).max() < 1e-8  # the bias would be 1e-7: 2 mm squared by the points and 20 m


def cloud_of(planes, position=True):
    """A cloud whose cells are its pieces."""
    return Cloud(
        origin=np.zeros(3), has_position=position, cell_mm=100.0, sigma_mm=1.0, sums=np.zeros((len(planes.mean), 10)),
        mean=planes.mean, normal=planes.normal, planes=planes, ends=Ends(), free_space=None,
    )  # fmt: skip


@pytest.mark.parametrize(("across", "along"), [((0.0, 0.0), (4.0, 0.0)), ((0.02, 0.03), (0.1, 0.2))])
def test_the_noise_follows_incidence_and_range(across, along):
    """Variances a + b R^2 across the face and along the ray; every seventh piece is rough."""
    rng = np.random.default_rng(1)
    n, dof = 900, 40.0
    mean, normal = (rng.normal(size=(n, 3)) for _ in range(2))
    R = rng.uniform(3e3, 4e4, n)
    mean *= (R / np.linalg.norm(mean, axis=1))[:, None]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    c2, r2 = np.einsum("ni,ni->n", mean, normal) ** 2 / R**2, (R / 1e4) ** 2
    true = across[0] + across[1] * r2 + (along[0] + along[1] * r2) * c2
    scatter = true * rng.chisquare(dof, n) / dof
    scatter[::7] += 9.0
    variance = np.column_stack([scatter * dof / (dof + 3.0), np.full((n, 2), 1e4)])
    planes = Planes(np.full(n, dof + 3.0), mean, normal, variance, np.tile(np.eye(3), (n, 1, 1)))
    found = noise_model.variances(cloud_of(planes))
    steep = c2 > 0.04  # the least variance at grazing incidence is a bound
    # 900 pieces of 40 freedoms know a variance to 0.7 %, four of them apart to some 5 %; a seventh is rough.
    assert np.abs(np.log(found / true)[steep]).max() < 0.25
    assert np.abs(np.median(found / true) - 1.0) < 0.1


def test_pieces_weigh_by_their_freedoms_and_by_what_pieces_differ_by():
    """Variances 1 of 10 freedoms and 1.1 of any number: 1 / (2 / 10 + 0.3^2) and 1 / 0.3^2 are their weights."""
    v, dof = np.array([1.0, 1.1, 1.0, 1.0]), np.array([10.0, 1e12, 1e12, 1e12])
    mean, other = noise_model._fitted(np.repeat(np.eye(2), 2, axis=0), v, dof)
    expected = (1.0 / 0.29 + 1.1 / 0.09) / (1.0 / 0.29 + 1.0 / 0.09)
    assert mean / other == pytest.approx(expected, rel=1e-9)  # rounding, and 2 / 1e12 beside 0.09


def test_noise_is_one_number_for_scans_with_unknown_rays():
    n = 30
    planes = Planes(np.full(n, 20.0), np.eye(3)[np.arange(n) % 3] * 1e4, np.tile([0.0, 0.0, 1.0], (n, 1)),
                    np.tile([3.4, 1e4, 1e4], (n, 1)), np.tile(np.eye(3), (n, 1, 1)))  # fmt: skip
    np.testing.assert_allclose(noise_model.variances(cloud_of(planes, position=False)), 3.4 * 20.0 / 17.0)


def test_errors_by_direction_are_estimated_and_widen_the_poses_to_their_errors():
    """Each scan's ranges err by 0.5 mm (sd) in each of the 24 directions; pieces have a noise of 0.05 mm."""
    T, (points, normals) = stations(), wall_points()
    pulls, found = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        shift = rng.normal(0.0, 0.05, (4, len(points)))
        for s in range(4):
            rays = rigid.apply(rigid.invert(T[s]), points.mean(axis=1))
            rays /= np.linalg.norm(rays, axis=1)[:, None]
            axis = np.abs(rays).argmax(axis=1)
            key = np.column_stack([axis, rays > 0.0]) @ [8, 4, 2, 1]
            error = rng.normal(0.0, 0.5, 32)[key]
            shift[s] += error * np.einsum("ni,ni->n", rays @ T[s][:3, :3].T, normals)
        blocks = blocks_of(T, points, normals, np.zeros(4), each=1600, shift=shift)
        solution = bundle_adjustment.solve(blocks, T, 0, tau=(0.0, 0.0, 0.0), robust=False)
        added, variance = direction_errors.added_covariance(blocks, solution, 0)
        np.testing.assert_array_equal(added[:6], 0.0)
        found.append(np.sqrt(variance))
        sd = np.sqrt(np.diag(added + np.nan_to_num(solution.covariance)))[6:].reshape(3, 6)
        pulls.append((solution.T[1:, :3, 3] - T[1:, :3, 3]) / sd[:, 3:])
    # Of some 4 x 20 errors, less the poses, a standard deviation is known to 10 %; ten draws know their mean to 3 %.
    assert np.mean(found) == pytest.approx(0.5, rel=0.1)
    # 90 pulls, three of a scan and scans of one reference, which share much: an rms of 30 free ones is known to 13 %.
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.3)


def test_scans_without_errors_by_direction_are_not_widened_by_much():
    T, (points, normals) = stations(), wall_points()
    shift = np.random.default_rng(1).normal(0.0, 0.05, (4, len(points)))
    blocks = blocks_of(T, points, normals, np.zeros(4), each=1600, shift=shift)
    solution = bundle_adjustment.solve(blocks, T, 0, tau=(0.0, 0.0, 0.0))
    assert direction_errors.added_covariance(blocks, solution, 0)[1] < 0.02**2  # pieces are known to 0.05 mm each


def test_points_moved_in_a_half_of_one_scan_widen_the_poses():
    T, (points, normals) = stations(), wall_points()
    shift = np.zeros((4, len(points)))
    shift[2] = 2.0 * (points.mean(axis=1)[:, 1] > 20000.0) * np.sign(points.mean(axis=1)[:, 0] - 30000.0)
    blocks = blocks_of(T, points, normals, np.zeros(4), each=1600, shift=shift)
    solution = bundle_adjustment.solve(blocks, T, 0, tau=(0.0, 0.0, 0.0), robust=False)
    added = np.diag(direction_errors.added_covariance(blocks, solution, 0)[0])[15:18]
    off = solution.T[2, :3, 3] - T[2, :3, 3]
    assert np.abs(off).max() > 4.0 * np.sqrt(np.diag(solution.covariance)[15:18]).max()  # that of pieces is too small
    assert (np.abs(off) < 2.0 * np.sqrt(added)).all()


def test_bias_by_incidence_of_the_class_widens_the_poses_by_what_it_moves_them():
    """Ranges of all scans are longer by 0.3 mm (1 / cos - 1), up to 74 degrees, as class phase states them."""
    T, (points, normals) = stations(), wall_points()
    shift = np.zeros((4, len(points)))
    for s in range(4):
        rays = points.mean(axis=1) - T[s, :3, 3]
        along = np.einsum("ni,ni->n", rays / np.linalg.norm(rays, axis=1)[:, None], normals)
        shift[s] = 0.3 * (1.0 / np.maximum(np.abs(along), 0.28) - 1.0) * along
    blocks = blocks_of(T, points, normals, np.zeros(4), each=1600, shift=shift)
    exact = blocks_of(T, points, normals, np.zeros(4), each=1600)
    solution = bundle_adjustment.solve(blocks, T, 0, tau=(0.0, 0.0, 0.0), robust=False)
    moved = (solution.T - bundle_adjustment.solve(exact, T, 0, tau=(0.0, 0.0, 0.0), robust=False).T)[1:, :3, 3]
    covariance = direction_errors.covariance_by_incidence(exact, solution, 0)
    np.testing.assert_array_equal(covariance[:6], 0.0)
    expected = np.sqrt(np.diag(covariance))[6:].reshape(3, 6)[:, 3:]
    assert np.abs(moved).max() > 0.03
    # Pieces 10 to 15 m wide have rays of many incidences, of which the data here have the middle one's bias alone.
    np.testing.assert_allclose(np.abs(moved), expected, rtol=0.1, atol=0.01)
