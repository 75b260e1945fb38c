"""Systematic errors and moved objects, for which the covariance of an adjustment alone is too small."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.geometry import rigid
from processor.stitching.fine import bundle_adjustment, correspondences, normal_equations
from processor.stitching.planes import extraction
from tests.support.clouds.stitch_clouds import ROOM, four
from tests.support.scenes.stitched_rooms import STEP_MRAD, adjusted, errors, longer


def bent(scan, mm):
    """Range errors that vary with the direction: common to a wall, and not absorbed by a pose."""
    return longer(scan, mm * np.sin(3.0 * np.arctan2(scan.points[:, 1], scan.points[:, 0])))


def in_room(scan, T):
    return rigid.apply(T, scan.points)


def test_systematic_range_errors_raise_the_standard_deviations():
    T, scans = (some[:3] for some in four(3, step_mrad=STEP_MRAD))  # the least that closes a loop
    good, bad = (adjusted(T, some) for some in (scans, (scans[0], *(bent(scan, 8.0) for scan in scans[1:]))))
    off = np.linalg.norm(errors(bad.scans.T_project_scan, T)[0][1:], axis=1)
    assert off.max() > 0.5  # far more than the noise makes
    # Errors of 8 mm beside noise of 2 mm.
    assert (bad.scans.position_sd[1:].max(axis=1) > 2.0 * good.scans.position_sd[1:].max(axis=1)).all()
    assert (off < 4.0 * np.linalg.norm(bad.scans.position_sd[1:], axis=1)).all()  # four sds


def by_walls(scan, T):
    """Each wall, the floor and the ceiling have a range error of their own, that all scans of it share."""
    at_ends = np.array([[3.0, -1.0, 2.0], [-2.0, 1.5, -3.0]])  # low and high of x, y, z, mm
    return longer(
        scan, sum((np.abs(in_room(scan, T) - end) < 15.0) @ row for end, row in zip(ROOM, at_ends, strict=True))
    )


@pytest.mark.parametrize("kind", ["offsets of scans", pytest.param("errors of walls", marks=pytest.mark.slow)])
def test_range_errors_are_separated_from_the_poses(kind):
    """Opposite walls show them: without an unknown of its own an offset goes into the poses, by its size."""
    T, scans = (some[:3] for some in four(3, step_mrad=STEP_MRAD))
    if kind == "offsets of scans":
        scans = [longer(scan, mm) for scan, mm in zip(scans, (1.5, -1.0, -1.5), strict=True)]
    else:
        scans = [by_walls(*both) for both in zip(scans, T, strict=True)]
    result = adjusted(T, scans)
    pulls = []
    for a, b, T_a_b, C in zip(*(getattr(result.pairs, x) for x in ("a", "b", "T_a_b", "covariance")), strict=True):
        off = T_a_b @ np.linalg.inv(T[int(b[1:]) - 1]) @ T[int(a[1:]) - 1]
        pulls.append(np.append(Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]) / np.sqrt(np.diag(C)))
    assert result.pairs.used.all()
    # Of 18 numbers in three pairs of three scans, 12 are free: their rms scatters by 20 %.
    assert np.abs(pulls).max() < 4.0
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5
    if kind == "offsets of scans":
        assert np.abs(errors(result.scans.T_project_scan, T)[0]).max() < 0.3  # a fifth of the offsets


def test_range_error_of_a_scan_with_unknown_rays_is_that_of_the_class():
    """In a frame whose origin is not the scanner the rays are not known; the other scans' range errors are seen."""
    T, scans = (some[:3] for some in four(3, step_mrad=STEP_MRAD, grid=False))
    away = rigid.transform(np.eye(3), np.array([0.0, 0.0, 1e4]))
    lost = dataclasses.replace(scans[1], points=rigid.apply(away, scans[1].points))
    result = adjusted([T[0], T[1] @ rigid.invert(away), T[2]], (scans[0], lost, scans[2]))
    stated = [why for why in result.reasons if why.code == "stitch.ranges-by-class"]
    assert [why.values for why in stated] == [{"scans": ("S2",), "sd_mm": 0.5}]


def test_the_variance_of_faces_is_that_of_an_analysis_of_variance():
    """Errors y of equal variances 1 / a about an unknown mean: sum (y - mean)^2 / (f - 1) - 1 / a, or 0."""
    a, y = 4.0, np.array([0.9, -1.6, 0.4, 2.1, -0.7])
    x, f = 0.3 * y - 0.2, len(y)  # the equations are at range errors x
    N, g = np.zeros((8 + f, 8 + f)), np.zeros(8 + f)
    faces = np.arange(8, 8 + f)
    N[3, 3], N[3, faces], N[faces, 3], N[faces, faces] = a * f, a, a, a
    for shrunk, expected in ((1.0, y.var(ddof=1) - 1.0 / a), (0.2, 0.0)):
        g[faces], g[3] = a * (x - shrunk * y), a * (x - shrunk * y).sum()
        found = bundle_adjustment.variance_of_errors(
            N + np.diag([0.0] * 6 + [4.0, 1.0] + [0.0] * f), g, x, np.array([3, 6, 7]), faces
        )
        np.testing.assert_allclose(found, expected, rtol=1e-8)  # the end of an iteration


@pytest.mark.parametrize("kind", [correspondences.ON_PIECE, correspondences.FACE_END])
def test_an_offset_of_each_block_takes_information_from_its_points(kind):
    """Four and twelve points, of variance 1, on one plane: m = M / (1 + t2 M) each, and m m' / (m + m') of a shift.

    The standard deviation of an offset is 0.5 mm, of ends 0.5 of a single one's: of three ends for each mm^-2.
    """
    corners = 1000.0 * np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    sums = np.stack([each * extraction.sums_of(corners).sum(axis=0) for each in (1.0, 3.0)])
    rows = np.arange(2)
    blocks = correspondences.Blocks(
        np.zeros(2, np.int64), rows, sums, 3.0 * sums[:, 9], np.full(2, kind), 1, np.zeros((2, 3, 7)), rows * 0 - 1
    )
    T = np.stack([np.eye(4)] * 2)
    found = normal_equations.linearize(blocks, T, np.zeros(4), np.full(2, 0.5), np.ones(2))
    mass = np.array([4.0, 12.0])
    m = mass / (1.0 + 0.5**2 * (1.0 if kind == correspondences.ON_PIECE else 3.0) * mass)
    shifts = found.N[np.ix_([5, 11], [5, 11])]
    np.testing.assert_allclose(shifts, m.prod() / m.sum() * np.array([[1.0, -1.0], [-1.0, 1.0]]), rtol=1e-9)
    np.testing.assert_allclose(found.variance, 1.0 / mass)


def test_rays_along_a_cell_are_those_of_finite_differences():
    points = np.array([[3000.0, -2000.0, 500.0], [-100.0, 4000.0, -1500.0]])
    near = points + np.array([[4.0, -3.0, 5.0], [-2.0, 6.0, 1.0]])
    # A point 5 mm beside one 2.7 m away: (0.005 / 2.7)^2 is 3e-6 of a unit vector.
    rays = np.einsum("nij,nj->ni", correspondences.ray_maps(points), np.column_stack([near, np.ones(2)]))
    np.testing.assert_allclose(rays, near / np.linalg.norm(near, axis=1)[:, None], atol=5e-6)
    # 5 mm at 3 to 4 m are 1e-3 of a ray.
    assert np.abs(rays - points / np.linalg.norm(points, axis=1)[:, None]).max() > 5e-4


def moved(seed, pick, mm):
    """Poses and scans of a room, where ``pick`` of the third scan's points (n, 3) in the room lies ``mm`` off in x."""
    T, scans = (some[:3] for some in four(seed, step_mrad=STEP_MRAD))
    points = in_room(scans[2], T[2])
    points = points + np.where(pick(points), mm, 0.0)[:, None] * [1.0, 0.0, 0.0]
    changed = dataclasses.replace(scans[2], points=rigid.apply(rigid.invert(T[2]), points))
    return T, (*scans[:2], changed)


def test_a_board_that_moved_during_one_scan_does_not_bias_its_pose():
    """A board on the nearest wall, 3 mm off during one scan: its pieces have the most points of all."""
    T, scans = moved(
        4, lambda at: (at[:, 0] > 6900.0) & (np.abs(at[:, 1:] - [-2000.0, 1500.0]) < 750.0).all(axis=1), 3.0
    )
    result = adjusted(T, scans)
    off = np.abs(errors(result.scans.T_project_scan, T)[0][1:])
    assert (off < 4.0 * result.scans.position_sd[1:]).all()  # four sds
    assert off.max() < 0.25  # without the board, ten seeds: 0.06 to 0.29


def test_a_wall_that_moved_during_one_scan_is_contradicted_by_the_rejected_faces():
    """The points of the near wall outweigh all others in its direction, so that the pose follows it."""
    T, scans = moved(6, lambda at: at[:, 0] > 6900.0, 8.0)
    result = adjusted(T, scans)
    assert np.abs(errors(result.scans.T_project_scan, T)[0][2]).max() > 1.0  # else the test would be void
    assert result.scans.status == ("ok", "ok", "weak")
    assert [one.code for one in result.scans.reasons[2]] == ["stitch.faces-contradict"]
