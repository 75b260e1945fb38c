"""What stands against the structure, as boards, trays and crates do, is no defect of it; what it hides is stated."""

import dataclasses

import numpy as np
import pytest

from processor.defects import step as defects_step
from tests.support.clouds.plate_rows import GAP, SIDE, bump, flat, scene_of
from tests.support.scenes.at_design import AT_DESIGN

PLATES, SIGMA = 3, 0.4
BULGE = 6.0, 110.0, (2.0 * (SIDE + GAP) + 130.0, 470.0)  # depth, radius and place: on the third plate, beside all


def beside(seed):
    """Boxes (b, 2, 3) before the fronts in y = 0: a board, a tray, a crate against a plate and one a little off."""
    rng = np.random.default_rng(seed)
    x, gap, far = rng.uniform(20.0, 60.0), rng.uniform(12.0, 30.0), rng.uniform(30.0, 60.0)
    second, third = SIDE + GAP, 2.0 * (SIDE + GAP)
    return np.array(
        [
            [[x, -40.0, 180.0], [x + 500.0, -1.5, 405.0]],
            [[second - 50.0, -gap - 2.0, 60.0], [second + SIDE + 50.0, -gap, 160.0]],
            [[second + 180.0, -300.0, 240.0], [second + 480.0, -3.0, 500.0]],
            [[third + 300.0, -far - 300.0, -100.0], [third + 580.0, -far, 260.0]],
        ]
    )


def with_boxes(scene, boxes, seed):
    """The scene with all points whose rays meet a box on the box."""
    rng, scans = np.random.default_rng(seed), []
    for scan in scene.scans:
        ray = scan.points - scan.position
        away = np.linalg.norm(ray, axis=1)
        ray = ray / away[:, None]
        with np.errstate(divide="ignore"):
            ends = np.sort((boxes[:, :, None] - scan.position) / ray, axis=1)
        near, last = ends[:, 0].max(axis=2), ends[:, 1].min(axis=2)
        meets = np.where(near < last, near, np.inf).min(axis=0)
        away = np.where(meets < away, meets + rng.normal(0.0, SIGMA, len(away)), away)
        scans.append(dataclasses.replace(scan, points=scan.position + away[:, None] * ray))
    return dataclasses.replace(scene, scans=tuple(scans))


def without_positions(scene):
    return dataclasses.replace(scene, scans=tuple(dataclasses.replace(s, position=np.empty(0)) for s in scene.scans))


def run(scene):
    return defects_step.run(scene, defects_step.Params(), AT_DESIGN)


@pytest.mark.parametrize("positions", [True, False])
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 7))])
def test_what_stands_against_plates_is_no_defect_of_them(seed, positions):
    scene = with_boxes(scene_of(PLATES, flat, seed=seed), beside(seed), seed)
    result = run(scene if positions else without_positions(scene))
    assert result.status == "ok"
    assert result.defects.doubtful.all()  # none is sure
    hidden = [one for one in result.reasons if one.code == "defects.hidden"]
    assert len(hidden) == 1
    if positions:  # along the normal boxes hide 0.35 m2 of the plates, less their borders of 8 mm
        assert 0.2 < hidden[0].values["hidden"] < 0.5


def test_a_bulge_beside_them_is_found_as_without():
    bulged = scene_of(PLATES, bump(-BULGE[0], BULGE[1], BULGE[2]), seed=1)
    alone, among = run(bulged), run(with_boxes(bulged, beside(1), 1))
    for result in (alone, among):
        sure = np.flatnonzero(~result.defects.doubtful)
        assert [str(result.defects.defect_class[row]) for row in sure] == ["bulge"]
        assert np.linalg.norm(result.defects.centre[sure[0], [0, 2]] - BULGE[2]) < result.cell
        assert abs(result.defects.depth_max[sure[0]] + BULGE[0]) < result.defects.depth_ci95[sure[0]] + 0.1


def test_a_bulge_that_is_hidden_in_part_is_doubtful():
    depth, radius, (x, z) = BULGE
    bulged = scene_of(PLATES, bump(-depth, radius, (x, z)), seed=1)
    board = np.array([[[x - 200.0, -60.0, z - 10.0], [x + 200.0, -20.0, z + 200.0]]])
    result = run(with_boxes(bulged, board, 1))
    assert len(result.defects) > 0
    assert result.defects.doubtful.all()
    assert {one.code for row in result.defects.reasons for one in row} == {"defects.beside"}
