"""Defects of a single plate: its pose cannot be fitted by other components, and may be off by more than the noise."""

import numpy as np
import pytest

from processor.defects import step as defects_step
from tests.support.plate_rows import SIDE, bump, scene_of

DENT = bump(4.0, 90.0, (0.5 * SIDE, 0.5 * SIDE))


def found(inward):
    defects = defects_step.run(scene_of(1, inward), defects_step.Params()).defects
    kinds = [str(kind) for kind in defects.defect_class]
    return dict(zip(kinds, zip(defects.depth_max, defects.depth_ci95, strict=True), strict=True))


@pytest.mark.parametrize("off_mm", [0.15, 0.5])
def test_a_dent_is_found_where_the_whole_plate_is_off(off_mm):
    """A registration within its error of 1 mm moves the plate by more than the noise of its mean."""
    of_class = found(lambda x, z: DENT(x, z) + off_mm)
    assert list(of_class) == ["dent"]
    depth, ci95 = of_class["dent"]
    assert abs(depth - 4.0) < min(ci95, 0.2)


@pytest.mark.parametrize("bow_mm", [-1.0, 1.0])
def test_a_dent_is_found_on_a_bowed_plate(bow_mm):
    """Both are found: an error of the pose moves a plate but does not bow it, so that the bow is known well."""
    half = 0.5 * SIDE
    of_class = found(lambda x, z: DENT(x, z) + bow_mm * (1.0 - ((z - half) / half) ** 2))
    assert sorted(of_class) == ["bend", "dent"]
    assert abs(abs(of_class["bend"][0]) - 1.0) < of_class["bend"][1] < 0.2
    assert abs(of_class["dent"][0] - 4.0) < 0.2


def test_a_plate_that_is_off_within_the_error_of_its_pose_has_no_defect():
    assert found(lambda x, z: np.full(len(x), 0.5)) == {}
