"""Checks of stitched poses against the true ones."""

import numpy as np
import pytest

from processor.evaluation import stitching as stitching_evaluation
from processor.model import Scene, StationTruth, Truth
from processor.stitching import step as stitching_step
from processor.stitching.result import ControlPoints, Scans
from tests.support.clouds import stitch_clouds


def checks_of(T, true, status, **more):
    """Checks of given poses (k, 4, 4) against true ones, by name."""
    k = len(T)
    names = tuple(f"S{i + 1}" for i in range(k))
    scans = Scans(
        name=names, status=status, reasons=((),) * k, T_project_scan=T, position=T[:, :3, 3],
        position_sd=np.full((k, 3), 1.0), rotation_sd=np.full((k, 3), 1e-4), covariance=np.zeros((k, 6, 6)),
        scale=np.ones(k), scale_sd=np.zeros(k),
        rivalry=np.zeros(k), T_rival_scan=np.full((k, 4, 4), np.nan), from_frame=names, to_frame=names,
    )  # fmt: skip
    made = stitching_step.Result(status="ok", method="automatic", reference="S1", scans=scans, **more)
    truth = Truth(stations=StationTruth(names, true))
    return {metric.name: metric.value for metric in stitching_evaluation.check(Scene("s", "structure"), made, truth)}


def test_a_weak_scan_does_not_affect_the_checks_of_the_others():
    true = np.array([stitch_clouds.pose([8000.0 * i, 3000.0 * i**2, 0.0], 50.0 * i) for i in range(5)])
    T = true.copy()
    T[4, :3, 3] += [0.0, 0.0, 400.0]
    checks = checks_of(T, true, ("ok",) * 4 + ("weak",))
    assert checks["scans called ok, over 50 mm off"] == 0.0
    assert checks["station positions after datum fit, max"] == pytest.approx(400.0)
    assert checks_of(T, true, ("ok",) * 5)["scans called ok, over 50 mm off"] > 0.0


def test_poses_by_control_points_are_checked_in_the_control_frame():
    true = np.array([stitch_clouds.pose([8000.0 * i, 3000.0 * i**2, 0.0], 50.0 * i) for i in range(4)])
    T = true.copy()
    T[:, 0, 3] += 3.0  # common to all, which a datum fit would absorb
    free = checks_of(T, true, ("ok",) * 4)
    controlled = checks_of(T, true, ("ok",) * 4, control=ControlPoints(holds=True))
    assert "station positions by control points, max" not in free
    assert controlled["station positions by control points, max"] == pytest.approx(3.0)
    assert controlled["station positions after datum fit, max"] == pytest.approx(0.0, abs=1e-6)
    assert free["pose components within their 95 % intervals"] == pytest.approx(100.0)
    assert controlled["pose components within their 95 % intervals"] == pytest.approx(100.0 * 5 / 6)


def test_a_datum_fit_weights_rotations_by_the_displacement_that_they_cause():
    """All scans turned by 0.1 mrad on the spot: 6 places of a station hold against 4 that turn, a fit by 2 / 5 of it.

    A shift outward by 0.15 mm is left; across it are 0.4 * 0.1 mrad * 5 m = 0.2 mm, which makes 0.25 mm.
    """
    places = np.array([[5e3, 0.0, 0.0], [0.0, 5e3, 0.0], [-5e3, 0.0, 0.0], [0.0, -5e3, 0.0], np.zeros(3)])
    true, T = (
        np.array([stitch_clouds.pose(place, np.degrees(turn)) for place in (1.0 + out / 5e3) * places])
        for turn, out in ((0.0, 0.0), (1e-4, 0.15))
    )
    checks = checks_of(T, true, ("ok",) * 5)
    assert checks["rotations after datum fit, max"] == pytest.approx(0.06, abs=1e-5)  # squares of angles are left out
    assert checks["station positions after datum fit, max"] == pytest.approx(0.25, abs=1e-5)
    assert checks["station positions after datum fit, rms"] == pytest.approx(0.25 * np.sqrt(4.0 / 5.0), abs=1e-5)


def test_true_pose_of_a_tilted_scan_maps_its_points_to_their_places():
    """Points p of a scan with a tilt w are p + w x p: a pose turned back by w brings them to their places."""
    T = np.stack([stitch_clouds.pose([3000.0, -2000.0, 1500.0], 40.0)] * 2)
    tilt = np.array([[2e-5, -3e-5], [0.0, 0.0]])
    point = np.array([5000.0, 1000.0, -800.0])
    truth = StationTruth(("a", "b"), T, np.zeros(2), np.zeros(2), tilt)
    poses = stitching_evaluation.true_poses(truth)
    seen = point + np.cross([2e-5, -3e-5, 0.0], point)
    np.testing.assert_allclose((poses[0] @ np.append(seen, 1.0))[:3], (T[0] @ np.append(point, 1.0))[:3], atol=1e-4)
    np.testing.assert_array_equal(poses[1], T[1])
