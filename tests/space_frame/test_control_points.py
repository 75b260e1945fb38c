"""Control points: the datum of a roof whose stations share a shift."""

import dataclasses

import numpy as np
import pytest

from designgen import recipe_files
from designgen.scenes.make import make
from processor.geometry import rigid
from processor.model import Control, reason
from processor.space_frame import step as space_frame_step
from tests.support.made import made

ROOF = ["frame.nodes_x=6", "frame.nodes_y=5", "scan.stations=[2,2]", "scan.clutter=0", "scan.step_mrad=2.4"]
COMMON_MM = np.array([1.2, -0.9, 1.3])  # 2 mm in all
SHIFT_MM = 2.0  # sd an axis of each station's own


def shifted(scene, seed, common=COMMON_MM, own=SHIFT_MM):
    """The scene with each station's pose wrong by a shift of its own (mean taken off) and one that all share."""
    shift = own * np.random.default_rng(seed).standard_normal((len(scene.scans), 3))
    shift += common - shift.mean(axis=0)
    scans = []
    for scan, off in zip(scene.scans, shift, strict=True):
        T = scan.T_project_scan.copy()
        T[:3, 3] += off
        scans.append(dataclasses.replace(scan, T_project_scan=T))
    return dataclasses.replace(scene, scans=tuple(scans))


def control(scene, seed, sd=0.3, seen_sd=0.4, points=6):
    """Targets on the floor about the roof, each seen by two stations of the true ``scene``."""
    rng = np.random.default_rng(seed)
    low, high = scene.frame.centres.min(axis=0), scene.frame.centres.max(axis=0)
    places = np.column_stack([rng.uniform(low[:2], high[:2], (points, 2)), rng.uniform(0.0, low[2], points)])
    known = places + sd * rng.standard_normal(places.shape)
    point, scan, seen = [], [], []
    for k, place in enumerate(places):
        for s in rng.permutation(len(scene.scans))[:2].tolist():
            back = rigid.apply(rigid.invert(scene.scans[s].T_project_scan), place[None])[0]
            point.append(k)
            scan.append(s)
            seen.append(back + seen_sd * rng.standard_normal(3))
    names = tuple(f"T{k}" for k in range(points))
    rows = np.array(point), np.array(scan), np.full(len(point), -1), np.array(seen), np.full(len(point), seen_sd)
    return Control(names, known, np.full(points, sd), *rows)


def offsets(result, truth):
    off = result.balls.centres - truth.frame.centres
    sd = np.sqrt(np.einsum("kii->ki", result.balls.covariance)[:, :3])
    return off, sd


@pytest.mark.slow
def test_the_shift_all_stations_share_is_found_by_control_points_and_covered_without():
    scene, truth = made(make, "roof", recipe_files.overridden(recipe_files.load("frame-1040")[1], ROOF), 5)
    wrong = shifted(scene, 1)
    held = space_frame_step.run(dataclasses.replace(wrong, control=control(scene, 2)), space_frame_step.Params())
    free = space_frame_step.run(wrong, space_frame_step.Params(datum_mm=1.5))
    off, sd = offsets(held, truth)
    # six targets of 0.3 mm, each seen twice to 0.4: 0.17 mm an axis, and their turn's share at the roof
    assert np.abs(np.mean(off, axis=0)).max() < 0.6
    # All balls share the three numbers of the datum: the rms of three exceeds 1.6 once in 20 cases; 0.70 to 1.02 came.
    assert np.sqrt(np.mean((off / sd) ** 2)) < 1.6
    assert np.mean(np.abs(off) < 1.96 * sd) > 0.85  # 95 % less what they share: 0.93 to 1.0 came, also below
    assert held.datum == (reason("spheres.datum-control", points=6),)
    assert np.all(held.control.used)
    assert np.linalg.norm(held.control.off, axis=1).max() < 2.0  # four times 0.5 mm, by 0.3 and 0.4
    off, sd = offsets(free, truth)
    np.testing.assert_allclose(np.mean(off, axis=0), COMMON_MM, atol=0.15)  # the mean of 50 balls: 0.02 to 0.035 came
    assert np.mean(np.abs(off) < 1.96 * sd) > 0.85
    assert [item.code for item in free.datum] == ["spheres.datum-stations"]
    # and the movements, in the design's own frame, are sure to what the datum is
    true = truth.frame.centres - scene.frame.centres
    for result in (held, free):
        assert np.mean(np.abs(result.balls.movement - true) < result.balls.movement_ci95) > 0.85
    # Of 0.2 mm instead of 1.5 mm, and the balls' own.
    assert np.median(held.balls.movement_ci95) < 0.5 * np.median(free.balls.movement_ci95)
