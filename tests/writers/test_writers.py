"""Rotations as quaternions, and names of files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.writers import e57, project


@pytest.mark.parametrize("turn", [(np.pi, 0, 0), (0, np.pi, 0), (0, 0, np.pi), (0, 0, 0), (0.5, -1.1, 1.6)])
def test_quaternions_of_all_kinds_of_rotations(turn):
    rotation = Rotation.from_rotvec(turn)
    expected = rotation.as_quat()[[3, 0, 1, 2]]
    q = np.array(e57.quaternion(rotation.as_matrix()))
    assert min(np.abs(q - expected).max(), np.abs(q + expected).max()) < 1e-12  # some roundings and a square root


def test_names_of_files_show_the_names_of_parts_and_are_unique():
    names = ["AR-01 springing W", "AR-01_springing_W", "A/../b", "a/../B", "拱肋 1", "", "x" * 300, "scan0"]
    stems = project.stems(names)
    assert stems[:6] == ["AR-01_springing_W-2", "AR-01_springing_W", "A____b", "a____B-2", "拱肋_1", "scan"]
    assert stems[7] == "scan0"
    assert len({stem.casefold() for stem in stems}) == len(stems)
    assert max(len(stem.encode()) for stem in stems) <= 204
    assert project.stems(["S1", "s1", "S1"]) == ["S1", "s1-2", "S1-3"]
