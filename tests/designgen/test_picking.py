"""Picked points of made scenes: where they are, how far apart, with what noise, and the file they are written to."""

import numpy as np
import pytest

from designgen import recipe_files
from designgen.export import folder as export_folder
from designgen.scanning import picking
from designgen.scenes.make import make
from processor.geometry import rigid
from processor.model import Scan, UsageError
from processor.scan_folder import folder
from processor.store import store
from tests.support.clouds.stitch_clouds import pose

COARSE = ["scan.step_mrad=20.0", "scan.stations=3", "scan.repeated=0"]


def scans_of(count=4, points=500):
    """Scans of the same corners of a hall, and where each has its frame."""
    rng = np.random.default_rng(1)
    hall = rng.uniform([0.0, 0.0, 0.0], [30_000.0, 20_000.0, 8_000.0], (points, 3))
    T = [pose(rng.uniform(-1e4, 1e4, 3), 40.0 * k, 0.0) for k in range(count)]
    origin = np.array([1e5, 2e5, 0.0])
    return [Scan(f"s{k}", rigid.apply(rigid.invert(T[k]), hall) - origin, origin) for k in range(count)], T


def test_picks_without_noise_are_the_same_place_in_both_scans():
    scans, T = scans_of()
    picks, places = picking.pick(scans, T, picking.Params(points=4, sigma_mm=0.0, apart_mm=3000.0), 5)
    rows = {scan.name: k for k, scan in enumerate(scans)}
    seen = zip(picks.scan_a, picks.scan_b, picks.in_a, picks.in_b, places, strict=True)
    for a, b, in_a, in_b, place in seen:
        np.testing.assert_allclose(rigid.apply(T[rows[a]], in_a[None])[0], place, atol=1e-6)  # float64 at 200 m
        np.testing.assert_allclose(rigid.apply(T[rows[b]], in_b[None])[0], place, atol=1e-6)  # float64 at 200 m
    pairs = list(zip(picks.scan_a, picks.scan_b, strict=True))
    assert len(set(pairs)) == 6  # in a ring of four each is tied to all others
    for first in range(0, len(places), 4):
        own = places[first : first + 4]
        assert min(np.linalg.norm(own[i] - own[j]) for i in range(4) for j in range(i)) >= 3000.0


def test_the_noise_is_as_asked_for_and_of_the_seed():
    scans, T = scans_of(points=3000)
    params = picking.Params(points=3, sigma_mm=5.0)
    drawn = [picking.pick(scans, T, params, seed)[0] for seed in range(40)]
    rows = {scan.name: k for k, scan in enumerate(scans)}
    off = [
        (rigid.apply(T[rows[a]], x[None]) - rigid.apply(T[rows[b]], y[None]))[0]
        for one in drawn
        for a, b, x, y in zip(one.scan_a, one.scan_b, one.in_a, one.in_b, strict=True)
    ]
    assert np.std(off) == pytest.approx(5.0 * np.sqrt(2.0), rel=0.06)  # 2160 numbers: 1.5 %
    np.testing.assert_array_equal(drawn[0].in_a, picking.pick(scans, T, params, 0)[0].in_a)
    assert np.abs(drawn[0].in_a - drawn[1].in_a).max() > 1.0


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"points": 2}, "picks.points: expected 3 or more"),
        ({"sigma_mm": -1.0}, "picks.sigma_mm"),
        ({"at": "towers"}, "picks.at: expected points or corners"),
        ({"apart_mm": 1e5}, "no 3 points in common with the others that lie 100000 mm from one another"),
    ],
)
def test_picks_that_cannot_be_made_are_refused(params, said):
    with pytest.raises(UsageError, match=said):
        picking.pick(*scans_of(count=2), picking.Params(**params), 0)  # a pair: each is drawn thousands of times


def test_corners_are_picked_where_the_first_scan_saw_them_and_the_second_may():
    scans, T = scans_of(points=2000)
    hall = rigid.apply(T[0], scans[0].points + scans[0].origin)
    unseen = np.array([0.0, 0.0, 9000.0])
    corners = np.vstack([hall[:40] + 30.0, hall[40:80] + unseen])
    params = picking.Params(points=3, sigma_mm=0.0, apart_mm=100.0, at="corners")
    picks, places = picking.pick(scans, T, params, 4, corners, lambda points: points[:, 0] > 0.0)
    off = np.linalg.norm(places[:, None] - corners[:40], axis=2).min(axis=1)
    assert off.max() < 1e-2  # the nearest point lies 30 mm off in each axis: the corner itself is picked
    assert (picks.in_b[:, 0] > 0.0).all()
    with pytest.raises(UsageError, match="no 3 corners in common"):
        picking.pick(scans, T, params, 4, corners, lambda points: points[:, 0] > 1e9)


def test_scanner_with_a_window_returns_no_points_outside_it():
    recipe = recipe_files.overridden(
        recipe_files.load("truss-bridge-chain")[1], ["scan.step_mrad=15.0", "picks.sigma_mm=0"]
    )
    scene, truth = make("t", recipe, 2)
    assert len(scene.scans) == 9
    assert len({tuple(np.round(T[:3, 3])) for T in truth.stations.T_project_station}) == 6
    for scan in scene.scans:
        x, y, z = scan.points.T
        azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
        assert np.abs(azimuth).max() <= 20.01  # the encoders turn rays by some 0.001 degrees
        assert np.abs(elevation - 12.0).max() <= 20.01
        assert len(scan.points) > 100


@pytest.mark.parametrize(
    "scan", [{"mode": "surface"}, {"mode": "rays", "step_mrad": 20.0, "stations": 3, "merged": True}]
)
def test_only_scans_of_one_station_each_have_picks(scan):
    recipe = dict(recipe_files.load("truss-bridge-picks")[1], scan=scan)
    with pytest.raises(UsageError, match="picks: points are picked in scans"):
        make("t", recipe, 1)


def test_picks_go_through_the_folder(tmp_path):
    scene, truth = make(
        "t", recipe_files.overridden(recipe_files.load("truss-bridge-picks")[1], [*COARSE, "picks.points=6"]), 1
    )
    store.write_scene(tmp_path / "t.h5", scene, truth, {})
    export_folder.export(tmp_path / "t.h5", tmp_path / "out", "ply", with_truth=False)
    read = folder.read_input(tmp_path / "out")
    for name in ("scan_a", "scan_b", "points"):
        assert getattr(read.picks, name) == getattr(scene.picks, name)
    np.testing.assert_allclose(read.picks.in_a, scene.picks.in_a, atol=1e-9)  # written in full
    np.testing.assert_allclose(read.picks.in_b, scene.picks.in_b, atol=1e-9)  # written in full
