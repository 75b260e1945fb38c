"""Poses in the files are starts of the search: they may be wrong by decimetres and a degree, or altogether."""

import dataclasses
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.geometry import rigid
from processor.scan_folder import folder
from processor.stitching.coarse import pairwise
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support.clouds.stitch_clouds import four
from tests.support.scenes.stitched_rooms import STEP_MRAD, errors, stitched

# As in test_stitching.py, with wider steps between rays.
MOST_MM, MOST_MRAD = 0.3, 0.1


def off(mm, deg, seed):
    """A motion by ``mm`` and ``deg`` about a random axis."""
    shift, axis = np.random.default_rng(seed).normal(size=(2, 3))
    turn = Rotation.from_rotvec(np.radians(deg) * axis / np.linalg.norm(axis)).as_matrix()
    return rigid.transform(turn, mm * shift / np.linalg.norm(shift))


def started(T, scans, wrong=()):
    """Scans with poses that are wrong by 0.3 m and 1 degree about the scanner, or by the motions ``wrong`` of some."""
    poses = [rigid.transform(np.eye(3), T_i[:3, 3]) @ off(300.0, 1.0, i) @ rigid.transform(T_i[:3, :3], np.zeros(3))
             for i, T_i in enumerate(T)]  # fmt: skip
    for i, pose in wrong:
        poses[i] = pose
    return [dataclasses.replace(scan, T_project_scan=pose) for scan, pose in zip(scans, poses, strict=True)]


def without_search():
    """Search near starts alone."""
    search = pairwise.candidate_poses
    return mock.patch.object(
        pairwise,
        "candidate_poses",
        lambda a, b, tilt, efforts, start=None: [] if start is None else search(a, b, tilt, efforts, start),
    )


def is_right(result, T):
    placed = result.scans.T_project_scan
    shift, turn = errors(rigid.invert(placed[0]) @ placed, T)
    return set(result.scans.status) == {"ok"} and np.abs(shift).max() < MOST_MM and turn.max() < MOST_MRAD


@pytest.fixture(scope="module")
def room():
    T, scans = four(step_mrad=STEP_MRAD)
    return T[:3], scans[:3]


def test_starts_wrong_by_decimetres_are_enough(room):
    T, scans = room
    with without_search():
        result = stitched(started(T, scans))
    assert is_right(result, T)
    assert result.frame == "GLCS"


def test_starts_are_read_from_files(room, tmp_path):
    """An E57 file of three scans with their poses."""
    T, scans = room
    e57.write(tmp_path / "room.e57", [*map(of_scan, started(T, scans))])
    (tmp_path / "project.toml").write_text('name = "r"\nkind = "structure"\n[[scan]]\nfile = "room.e57"\n')
    scene = folder.read_input(tmp_path)
    with without_search():
        assert is_right(stitched(scene.scans), T)


@pytest.mark.parametrize(
    "wrong",
    [
        "5 m and 30 degrees",
        pytest.param("another one's", marks=pytest.mark.slow),
        pytest.param("the identity", marks=pytest.mark.slow),
    ],
)
def test_starts_that_are_wrong_altogether_lose_to_the_search(room, wrong):
    T, scans = room
    poses = {
        "5 m and 30 degrees": [(2, T[2] @ off(5000.0, 30.0, 7))],
        "another one's": [(2, T[1])],
        "the identity": [(i, np.eye(4)) for i in range(3)],
    }[wrong]
    assert is_right(stitched(started(T, scans, poses), levelled_mrad=20.0), T)
