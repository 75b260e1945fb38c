"""Systematic errors and moved objects, for which the covariance of an adjustment alone is too small."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from processor.model import Scene
from processor.stitching import step as stitching_step
from processor.stitching.fine import bundle_adjustment, correspondences, normal_equations
from tests.support.clouds.stitch_clouds import ROOM, four

LEVEL = stitching_step.Params(levelled_mrad=20.0)  # the same poses as without, by half of the search


def bent(scan, mm):
    """Range errors that vary with the direction: common to a wall, and not absorbed by a pose."""
    R = np.linalg.norm(scan.points, axis=1)
    turn = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    return dataclasses.replace(scan, points=scan.points * (1.0 + mm * np.sin(3.0 * turn) / R)[:, None])


def test_systematic_range_errors_raise_the_standard_deviations():
    T, scans = (some[:3] for some in four(3, step_mrad=20.0))  # the least that closes a loop
    want = np.linalg.inv(T[0]) @ T
    crooked = (scans[0], *(bent(scan, 8.0) for scan in scans[1:]))
    good, bad = (stitching_step.run(Scene("room", "structure", some), LEVEL) for some in (scans, crooked))
    off = np.linalg.norm(bad.scans.T_project_scan[1:, :3, 3] - want[1:, :3, 3], axis=1)
    assert off.max() > 0.5  # far more than the noise makes
    assert (bad.scans.position_sd[1:].max(axis=1) > 2.0 * good.scans.position_sd[1:].max(axis=1)).all()
    assert (off < 4.0 * np.linalg.norm(bad.scans.position_sd[1:], axis=1)).all()


def assert_covered(result, T):
    """All pairs are used, and their errors are of the size of their standard deviations; T (k, 4, 4): true poses."""
    pulls = []
    for i in range(len(result.pairs)):
        a, b = (int(name[1:]) - 1 for name in (result.pairs.a[i], result.pairs.b[i]))
        off = result.pairs.T_a_b[i] @ np.linalg.inv(T[b]) @ T[a]
        turn = Rotation.from_matrix(off[:3, :3]).as_rotvec()
        pulls.append(np.append(turn, off[:3, 3]) / np.sqrt(np.diag(result.pairs.covariance[i])))
    assert result.pairs.used.all()
    assert np.abs(pulls).max() < 4.0
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_range_offsets_are_separated_from_the_poses():
    """Opposite walls show them: without an unknown of its own an offset goes into the poses, by its size."""
    T, scans = four(3, step_mrad=20.0)
    offsets = (1.5, -1.0, 0.0, -1.5)
    shifted = []
    for scan, mm in zip(scans, offsets, strict=True):
        R = np.linalg.norm(scan.points, axis=1)[:, None]
        shifted.append(dataclasses.replace(scan, points=scan.points * (1.0 + mm / R)))
    result = stitching_step.run(Scene("room", "structure", tuple(shifted)), LEVEL)
    assert_covered(result, T)
    off = result.scans.T_project_scan[:, :3, 3] - (np.linalg.inv(T[0]) @ T)[:, :3, 3]
    assert np.abs(off).max() < 0.3


def test_range_errors_of_walls_are_separated_from_the_poses():
    """Each wall, the floor and the ceiling have a range error of their own, that all scans of it share."""
    T, scans = four(3, step_mrad=20.0)
    errors = np.array([[3.0, -1.0, 2.0], [-2.0, 1.5, -3.0]])  # at the low and high ends of x, y, z, mm
    shifted = []
    for pose, scan in zip(T, scans, strict=True):
        place = scan.points @ pose[:3, :3].T + pose[:3, 3]
        mm = sum((np.abs(place - end) < 15.0) @ row for end, row in zip(ROOM, errors, strict=True))
        R = np.linalg.norm(scan.points, axis=1)
        shifted.append(dataclasses.replace(scan, points=scan.points * (1.0 + mm / R)[:, None]))
    result = stitching_step.run(Scene("room", "structure", tuple(shifted)), LEVEL)
    assert_covered(result, T)


def test_range_error_of_a_scan_with_unknown_rays_is_that_of_the_class():
    """In a frame whose origin is not the scanner the rays are not known; the other scans' range errors are seen."""
    _, scans = four(3, step_mrad=20.0, grid=False)
    lost = dataclasses.replace(scans[1], points=scans[1].points + np.array([0.0, 0.0, 1e4]))
    scene = Scene("room", "structure", (scans[0], lost, scans[2]))
    result = stitching_step.run(scene, LEVEL)
    stated = [why for why in result.reasons if why.code == "stitch.ranges-by-class"]
    assert [why.values for why in stated] == [{"scans": ("S2",), "sd_mm": 0.5}]


def test_the_variance_of_faces_is_that_of_an_analysis_of_variance():
    """Errors y of equal variances 1 / a about an unknown mean: sum (y - mean)^2 / (f - 1) - 1 / a, or 0."""
    a, y = 4.0, np.array([0.9, -1.6, 0.4, 2.1, -0.7])
    x, f = 0.3 * y - 0.2, len(y)  # the equations are at range errors x
    N, g = np.zeros((8 + f, 8 + f)), np.zeros(8 + f)
    faces = np.arange(8, 8 + f)
    N[3, 3], N[3, faces], N[faces, 3], N[faces, faces] = a * f, a, a, a
    for shrunk, expected in ((1.0, np.sqrt(y.var(ddof=1) - 1.0 / a)), (0.2, 0.0)):
        g[faces], g[3] = a * (x - shrunk * y), a * (x - shrunk * y).sum()
        none = np.empty(0)
        equations = normal_equations.Equations(N=N, spurious=N, g=g, z=none, offset=none, variance=none)
        found = bundle_adjustment._estimate_face_sd(equations, np.array([3, 6, 7, *faces]), 1, np.append([0.0, 0.0], x))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_rays_along_a_cell_are_those_of_finite_differences():
    points = np.array([[3000.0, -2000.0, 500.0], [-100.0, 4000.0, -1500.0]])
    near = points + np.array([[4.0, -3.0, 5.0], [-2.0, 6.0, 1.0]])
    rays = np.einsum("nij,nj->ni", correspondences.ray_maps(points), np.column_stack([near, np.ones(2)]))
    np.testing.assert_allclose(rays, near / np.linalg.norm(near, axis=1)[:, None], atol=5e-6)
    assert np.abs(rays - points / np.linalg.norm(points, axis=1)[:, None]).max() > 5e-4


def test_a_board_that_moved_during_one_scan_does_not_bias_its_pose():
    """A board on the nearest wall, 3 mm off during one scan: its pieces have the most points of all."""
    T, scans = four(4, step_mrad=20.0)
    inside = scans[2].points @ T[2][:3, :3].T + T[2][:3, 3]
    board = (inside[:, 0] > 6900.0) & (np.abs(inside[:, 1:] - [-2000.0, 1500.0]) < 750.0).all(axis=1)
    assert board.sum() > 400
    points = (inside + np.where(board, 3.0, 0.0)[:, None] * [1.0, 0.0, 0.0] - T[2][:3, 3]) @ T[2][:3, :3]
    changed = (*scans[:2], dataclasses.replace(scans[2], points=points), scans[3])
    result = stitching_step.run(Scene("room", "structure", changed), LEVEL)
    want = np.linalg.inv(T[0]) @ T
    off = np.abs(result.scans.T_project_scan[1:, :3, 3] - want[1:, :3, 3])
    assert (off < 4.0 * result.scans.position_sd[1:]).all()
    assert off.max() < 0.25


def test_a_wall_that_moved_during_one_scan_is_contradicted_by_the_rejected_faces():
    """The points of the near wall outweigh all others in its direction, so that the pose follows it."""
    T, scans = four(6, step_mrad=20.0)
    inside = scans[2].points @ T[2][:3, :3].T + T[2][:3, 3]
    shifted = inside + np.where(inside[:, 0] > 6900.0, 3.0, 0.0)[:, None] * [1.0, 0.0, 0.0]
    wrong = dataclasses.replace(scans[2], points=(shifted - T[2][:3, 3]) @ T[2][:3, :3])
    result = stitching_step.run(Scene("room", "structure", (*scans[:2], wrong, scans[3])), LEVEL)
    off = np.linalg.inv(T[0]) @ T - result.scans.T_project_scan
    assert np.abs(off[2, :3, 3]).max() > 1.0  # else the test would be void
    assert result.scans.status == ("ok", "ok", "weak", "ok")
    assert [one.code for one in result.scans.reasons[2]] == ["stitch.faces-contradict"]
