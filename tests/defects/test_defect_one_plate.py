"""Defects of a single plate: its pose cannot be fitted by other components, and may be off by more than the noise."""

import dataclasses

import numpy as np
import pytest

from processor.defects import step as defects_step
from processor.model import Scan
from tests.support.clouds.plate_rows import SIDE, THICK, bump, scene_of
from tests.support.scenes.at_design import AT_DESIGN

DENT = bump(4.0, 90.0, (0.5 * SIDE, 0.5 * SIDE))


def found(inward, *more, earlier=AT_DESIGN, spacing=7.0):
    """Depth and interval of each class, for scans of the front and ``more`` scans."""
    scene = scene_of(1, inward, spacing=spacing)
    scene = dataclasses.replace(scene, scans=(*scene.scans, *more))
    defects = defects_step.run(scene, defects_step.Params(), earlier).defects
    kinds = [str(kind) for kind in defects.defect_class]
    return dict(zip(kinds, zip(defects.depth_max, defects.depth_ci95, strict=True), strict=True))


@pytest.mark.parametrize(("off_mm", "earlier"), [(0.15, AT_DESIGN), pytest.param(0.5, {}, marks=pytest.mark.slow)])
def test_a_dent_is_found_where_the_whole_plate_is_off(off_mm, earlier):
    """A registration within its error of 1 mm moves the plate by more than the noise of its mean.

    Of the second plate the step itself finds that it lies at the design.
    """
    of_class = found(lambda x, z: DENT(x, z) + off_mm, earlier=earlier)
    assert list(of_class) == ["dent"]
    depth, ci95 = of_class["dent"]
    assert abs(depth - 4.0) < min(ci95, 0.2)


@pytest.mark.parametrize("bow_mm", [pytest.param(-1.0, marks=pytest.mark.slow), 1.0])
def test_a_dent_is_found_on_a_bowed_plate(bow_mm):
    """Both are found: an error of the pose moves a plate but does not bow it, so that the bow is known well."""
    half = 0.5 * SIDE
    of_class = found(lambda x, z: DENT(x, z) + bow_mm * (1.0 - ((z - half) / half) ** 2), spacing=5.0)
    assert sorted(of_class) == ["bend", "dent"]
    assert abs(abs(of_class["bend"][0]) - 1.0) < of_class["bend"][1] < 0.2
    assert abs(of_class["dent"][0] - 4.0) < 0.2


def test_a_plate_that_is_off_within_the_error_of_its_pose_has_no_defect():
    assert found(lambda x, z: np.full(len(x), 0.5)) == {}


@pytest.mark.parametrize("inward", [lambda x, z: np.zeros(len(x)), DENT])
def test_range_error_of_the_class_is_no_defect_on_a_side_seen_by_one_station(inward):
    """Its ranges are 0.6 mm too long, within what a view of a scanner may be off; the back is as designed."""
    rng, station = np.random.default_rng(7), np.array([0.4 * SIDE, 4000.0, 500.0])
    x, z = rng.uniform(0.0, SIDE, (2, 7_000))
    ray = np.stack([x, np.full(len(x), THICK), z], axis=1) - station
    away = np.linalg.norm(ray, axis=1)[:, None]
    points = station + ray * (1.0 + (0.6 + rng.normal(0.0, 0.4, away.shape)) / away)
    of_class = found(inward, Scan("S3", points, position=station, T_project_scan=np.eye(4)))
    assert list(of_class) == (["pit"] if inward is DENT else [])
    for depth, ci95 in of_class.values():
        assert abs(depth - 4.0) < ci95
