"""Self-registration of stations on tubes: recovery, honest covariances, datum, weak ties; tubes simulated by numpy."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor.adjustment import scanner_class_errors
from processor.adjustment.control_points import Sightings
from processor.geometry import linalg_small
from processor.model import reason
from processor.space_frame.points.hash_sampling import STEPS_PER_MM
from processor.space_frame.points.line_crops import corridors, gather
from processor.space_frame.result import StationMotion
from processor.space_frame.stations import normal_equations, records, residual_kernels
from processor.space_frame.stations import posterior as stations_posterior
from processor.space_frame.stations.corrected_source import Corrected, corrected_gathered
from processor.space_frame.stations.records import TubePoints
from processor.space_frame.stations.registration import register
from processor.space_frame.stations.residual_kernels import Axes, Layout
from tests.support.clouds import tube_clouds
from tests.support.clouds.memory_source import InMemory

ROUNDING = 1e-9  # mm, or a share; float64 at 10 m is 2e-12 mm


def codes(found):
    return {one.code for one in found.messages}


def left_out(found):
    """Code, point and scan of the reasons that name a control point left out."""
    return [(one.code, one.values["point"], one.values.get("scan")) for one in found.messages if "left-out" in one.code]


def frame(seed, nx=4, ny=4, grid=(2, 2), **how):
    """A small roof seen from a grid of stations, and rough axes as a fit of the merged cloud gives them."""
    rng = np.random.default_rng(seed)
    nodes, ends = tube_clouds.roof(nx, ny)
    size = 3000.0 * np.array([nx - 1, ny - 1])
    i, j = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    at = (np.stack([i, j], axis=1) + 0.5) / grid * size + rng.uniform(-700.0, 700.0, (len(i), 2))
    seen = tube_clouds.scan(ends, np.column_stack([at, np.full(len(i), 1600.0)]), rng, **how)
    return nodes, seen, rng


def registered(seen, rng, **more):
    middle, along = ends_to_axes(seen.ends)
    rough = middle + rng.normal(0.0, 1.0, middle.shape)
    return register(seen.points, rough, along, np.full(len(rough), seen.radius + 0.3), seen.scanners, **more)


def ends_to_axes(ends):
    along = ends[:, 1] - ends[:, 0]
    return ends.mean(axis=1), along / np.linalg.norm(along, axis=1)[:, None]


def with_points(seen, points, station=None, start=None, ends=None):
    """The same tubes and stations with other points (n, 3); stations and starts as they were where none are given."""
    station = seen.points.station if station is None else station
    start = seen.points.start if start is None else start
    ends = seen.ends if ends is None else ends
    return tube_clouds.Seen(TubePoints(points, station, start), ends, seen.scanners, seen.motions, seen.places, 30.0)


def only(seen, keep):
    """Those points of ``seen`` that are kept, by a function of (station, tube) of each."""
    tube = np.repeat(np.arange(len(seen.ends)), np.diff(seen.points.start))
    kept = keep(seen.points.station, tube)
    start = np.concatenate([[0], np.cumsum(np.bincount(tube[kept], minlength=len(seen.ends)))])
    return with_points(seen, seen.points.points[kept], seen.points.station[kept], start)


def longer(seen, offset):
    """Ranges that are longer by the offset of each station (s,), or of all."""
    ray = seen.points.points - seen.scanners[seen.points.station]
    mm = np.broadcast_to(offset, len(seen.scanners))[seen.points.station][:, None]
    return with_points(seen, seen.points.points + mm * ray / np.linalg.norm(ray, axis=1)[:, None])


def as_measured(seen, places, stations):
    """Places (n, 3) as the stations (n,) have them in the project before they are registered."""
    return np.array([
        tube_clouds.turn(seen.motions[k, :3]) @ (p - seen.places[k]) + seen.places[k] + seen.motions[k, 3:]
        for k, p in zip(stations, places, strict=True)
    ])  # fmt: skip


def remaining(seen, found):
    """What is left of each station's motion (s, 6) after its correction, about its registered place."""
    left = []
    for motion, place, at, T in zip(seen.motions, seen.places, seen.scanners, found.T_project_station, strict=True):
        R = tube_clouds.turn(motion[:3])
        wrong = np.eye(4)
        wrong[:3, :3], wrong[:3, 3] = R, place - R @ place + motion[3:]
        E = T @ wrong
        w = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
        left.append(np.concatenate([w, E[:3, :3] @ at + E[:3, 3] - at]))
    return np.array(left)


def without_common(left, found):
    """Motions of stations (s, 6) less the rigid motion that fits them best; by numpy's own least squares."""
    sd = np.tile(np.repeat([found.before_rad, found.before_mm], 3), len(left))
    arms = np.zeros((len(left), 6, 6))
    for i, (x, y, z) in enumerate(found.places - found.places.mean(axis=0)):
        arms[i, :3, :3] = arms[i, 3:, 3:] = np.eye(3)
        arms[i, 3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    arms = arms.reshape(-1, 6)
    best = np.linalg.lstsq(arms / sd[:, None], left.ravel() / sd, rcond=None)[0]
    return (left.ravel() - arms @ best).reshape(-1, 6)


def test_stations_are_laid_onto_each_other():
    _, seen, rng = frame(1, 5, 5, per_pair=40)
    found = registered(seen, rng)
    assert found.status == "ok"
    before, after = without_common(seen.motions, found), without_common(remaining(seen, found), found)
    assert np.abs(before[:, 3:]).max() > 1.5  # else void: of shifts of 2 mm 4.9 and 5.4 came
    assert np.abs(after[:, 3:]).max() < 0.2  # 20 points of 2 mm on each of 100 tubes: 0.05 mm and their arms
    assert np.abs(after[:, :3]).max() < 3e-5  # as much over arms of 6 m
    np.testing.assert_allclose(found.range_sd, 2.0, rtol=0.1)  # 2000 points of a station: 1.6 %, less the tubes' own
    assert found.floor_mm < 0.2  # neither bows nor offsets are drawn: 0 came


def test_covariances_agree_with_errors_over_many_seeds():
    """Pulls of centres seen from two stations each, datum and all, and of the stations against each other."""
    pulls, between = [], []
    for seed in range(14):
        nodes, seen, rng = frame(seed, per_pair=24)
        found = registered(seen, rng)
        left = remaining(seen, found)
        share = np.zeros((len(nodes), 4))
        near = np.argsort(np.linalg.norm(nodes[:, None] - seen.scanners, axis=2), axis=1)[:, :2]
        np.put_along_axis(share, near, [[0.7, 0.3]], axis=1)
        arm = nodes[:, None] - seen.scanners
        moved = np.einsum("ks,ksi->ki", share, left[None, :, 3:] + np.cross(left[None, :, :3], arm))
        sd = np.sqrt(np.einsum("kii->ki", found.effect(nodes, share)))
        pulls.append(moved / sd)
        relative = np.sqrt(np.einsum("sii->si", found.between))
        between.append(without_common(left, found)[:, 3:] / relative)
    # 14 scenes of some six free motions each: their rms is known to about 1 / sqrt(2 14 6) = 8 %
    assert 0.85 < np.sqrt(np.mean(np.square(pulls))) < 1.2
    assert 0.85 < np.sqrt(np.mean(np.square(between))) < 1.2


def test_the_size_of_the_errors_comes_from_the_data():
    for shift_mm, turn_rad in ((0.0, 0.0), (0.5, 2e-5), (6.0, 2e-4)):
        _, seen, rng = frame(5, 5, 5, grid=(3, 3), per_pair=30, shift_mm=shift_mm, turn_rad=turn_rad)
        found = registered(seen, rng)
        drawn = np.sqrt(np.mean(seen.motions[:, 3:] ** 2))
        # 27 numbers of nine stations: 14 %, and of turns, whose levers are short, more.
        assert found.before_mm == pytest.approx(drawn, rel=0.4, abs=0.06)
        assert found.before_rad == pytest.approx(np.sqrt(np.mean(seen.motions[:, :3] ** 2)), rel=0.5, abs=6e-6)
        if shift_mm == 0.0:  # nothing to correct: nothing is moved
            assert np.abs(found.T_project_station - np.eye(4))[:, :3, 3].max() < 0.1  # two of 0.05 mm, as above
            assert not any(found.reasons)


def test_bowed_tubes_strays_and_tubes_off_their_place():
    for how in ({"bow": 1e-3}, {"outliers": 0.1}, {"off_mm": 0.4}):
        _, seen, rng = frame(3, 5, 5, per_pair=40, **how)
        found = registered(seen, rng)
        after = without_common(remaining(seen, found), found)
        pulls = after[:, 3:] / np.sqrt(np.einsum("sii->si", found.between))
        # Twice that of straight tubes, as they are off by as much: 0.10 to 0.29 in six draws; and four sds.
        assert np.abs(after[:, 3:]).max() < 0.4, how
        assert np.abs(pulls).max() < 4.0, how
    assert found.floor_mm == pytest.approx(0.4, abs=0.1)  # 100 tubes of two directions: 5 %, and their points' 0.05 mm


def test_only_differences_of_range_offsets_between_stations_are_corrected():
    """A wide beam on thin tubes looks like an offset of all ranges: balls must not be moved by that."""
    _, seen, rng = frame(8, 5, 5, per_pair=60)
    offset = np.array([1.8, 0.5, 1.2, 0.4])
    found = registered(longer(seen, offset), rng)
    assert np.abs(found.range_offset.mean()) < 1e-9  # rounding
    sd = np.sqrt(np.diag(found.covariance)[6::7])
    assert np.abs((found.range_offset - (offset - offset.mean())) / sd).max() < 4.0  # four sds
    assert sd.max() < 0.15  # 3,000 points of 2 mm each, less what radii and axes take up: 0.07 came
    assert "spheres.range-offset" in codes(found)
    # what all share may be the mean of four that scatter so, along the mean ray
    square = np.sum((offset - offset.mean()) ** 2)
    # offsets that are known to 0.1 to 0.2 mm
    assert found.shared_offset_sd == pytest.approx(scanner_class_errors.mean_offset_sd(4, square, 3), rel=0.1)
    above = found.places.mean(axis=0) + np.array([0.0, 0.0, 1e6])
    # Rays of 1 km from stations metres apart are parallel to 1e-2.
    np.testing.assert_allclose(records.moved_by_offset(above[None], found.places), [[0.0, 0.0, 1.0]], atol=1e-2)
    # What is corrected is shorter by the offset, seen from where the scanner is put.
    shifted, station = longer(seen, offset).points.points, seen.points.station
    scanners = np.array([T[:3, :3] @ p + T[:3, 3] for T, p in zip(found.T_project_station, found.places, strict=True)])
    before = np.linalg.norm(shifted - found.places[station], axis=1)
    after = np.linalg.norm(found.corrected(shifted, station) - scanners[station], axis=1)
    np.testing.assert_allclose(before - after, found.range_offset[station], atol=ROUNDING)


def test_stations_are_not_corrected_if_a_wide_beam_explains_their_residuals():
    for shift_mm, status in ((0.1, "doubtful"), (4.0, "ok")):
        _, seen, rng = frame(8, 5, 5, per_pair=60, shift_mm=shift_mm, turn_rad=0.0)
        found = registered(longer(seen, 1.5), rng)
        assert found.status == status
        assert ("spheres.stations-left" in codes(found)) == (status == "doubtful")


def test_without_control_the_datum_is_the_mean_of_the_stations():
    """The common translation is known to sd / sqrt(s) of the stations' own, whatever the tubes."""
    _, seen, rng = frame(2, 5, 5, grid=(3, 3), per_pair=30)
    found = registered(seen, rng)
    middle = found.places.mean(axis=0)
    shift = np.sqrt(np.diag(found.common(middle))[3:])
    # a turn of all about the middle has the levers' help; a shift has none
    np.testing.assert_allclose(shift, found.before_mm / 3.0, rtol=1e-3)
    assert [one.code for one in found.datum] == ["spheres.datum-stations"]
    np.testing.assert_allclose(found.datum_at(middle[None])[0], found.common(middle)[3:, 3:], rtol=ROUNDING)


def test_control_points_fix_the_datum():
    nodes, seen, rng = frame(4, 5, 5, per_pair=40)
    corner = nodes[[0, 4, 20, 24, 40]]
    station = np.argmin(np.linalg.norm(corner[:, None] - seen.scanners, axis=2), axis=1)
    measured = as_measured(seen, corner, station)
    # The whole project lies 40 mm and 1 mrad off the control's frame.
    turn, shift = tube_clouds.turn(np.array([2e-4, -1e-4, 1e-3])), np.array([40.0, -25.0, 10.0])
    target = corner @ turn.T + shift
    control = sighted(measured, target, station, 0.3)
    found = registered(seen, rng, control=control)
    assert found.datum == (reason("spheres.datum-control", points=5),)
    for k in range(4):
        R = tube_clouds.turn(seen.motions[k, :3])
        wrong = (nodes - seen.places[k]) @ R.T + seen.places[k] + seen.motions[k, 3:]
        right = nodes @ turn.T + shift
        # Five points of 0.3 mm, 0.13 mm an axis, and their turns out to 8 m: 0.20 to 0.45 in eight draws.
        assert np.abs(found.corrected(wrong, np.full(len(nodes), k)) - right).max() < 1.0
    assert np.sqrt(np.diag(found.common(nodes.mean(axis=0)))[3:]).max() < 0.2  # 0.3 / sqrt(5) is 0.13
    assert found.before_mm < 5.0  # the 40 mm are no station's error


def targets(seen, seed, count, sd=0.3, off=None, sightings=2):
    """Targets about the roof, seen by two stations each, their places known to ``sd``; ``off`` is added to those."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-2e3, 14e3, (count, 2)), rng.uniform(0.0, 6e3, count)])
    known = places + rng.normal(0.0, sd, places.shape) + (0.0 if off is None else off)
    s = [rng.permutation(len(seen.scanners))[:sightings] for _ in range(count)]
    point, s = np.repeat(np.arange(count), [len(one) for one in s]), np.concatenate(s)
    measured = as_measured(seen, places[point], s)
    measured += rng.normal(0.0, 0.5, measured.shape)
    return sighted(measured, known[point], s, 0.5, point, sd)


def sighted(measured, target, station, seen_sd, point=None, sd=0.0):
    """Sightings of targets T0, T1, ... by stations S1, S2, ...; without ``point`` each of a target of its own."""
    point = np.arange(len(measured)) if point is None else point
    return Sightings(
        point=point, body=station, seen=measured, seen_sd=np.full(len(point), seen_sd), known=target,
        known_sd=np.full(len(point), sd), point_name=tuple(f"T{k}" for k in point),
        body_name=tuple(f"S{k + 1}" for k in station),
    )  # fmt: skip


@pytest.mark.slow
def test_covariances_with_control_points_agree_with_errors_over_many_seeds():
    """Pulls of nodes after the correction, the error that the sightings of one target share among them."""
    pulls, shift, doubted = [], [], 0
    for seed in range(30):
        nodes, seen, rng = frame(seed, per_pair=24)
        found = registered(seen, rng, control=targets(seen, seed, 4, sd=0.6))
        doubted += int((found.control_used == 0).sum())
        share = np.full((len(nodes), 4), 0.25)
        left = remaining(seen, found)
        moved = np.mean(left[None, :, 3:] + np.cross(left[None, :, :3], nodes[:, None] - seen.scanners), axis=1)
        pulls.append(moved / np.sqrt(np.einsum("kii->ki", found.effect(nodes, share))))
        shift.append(np.diag(found.common(found.places.mean(axis=0)))[3:])
    # four of 0.6 mm seen twice to 0.5: 0.35 mm at their middle, and more where the stations are
    assert 0.35 < np.sqrt(np.median(shift)) < 0.8
    assert 0.85 < np.sqrt(np.mean(np.square(pulls))) < 1.2  # the three of a datum count most: 90 numbers, 8 %
    assert doubted == 0


def test_a_wrong_control_point_is_left_out_and_named():
    _, seen, _ = frame(4, 5, 5, per_pair=40)
    for size in (15.0, 400.0):
        off = np.zeros((5, 3))
        off[2] = [0.6 * size, 0.0, 0.8 * size]
        good, wrong = (
            registered(seen, np.random.default_rng(1), control=one)
            for one in (targets(seen, 3, 5).take(np.repeat(np.arange(5) != 2, 2)), targets(seen, 3, 5, off=off))
        )
        assert wrong.control_used.tolist() == [1, 1, 1, 1, 0, 0, 1, 1, 1, 1]
        assert left_out(wrong) == [("spheres.control-left-out", "T2", None)]
        np.testing.assert_allclose(wrong.T_project_station, good.T_project_station, atol=ROUNDING)
        # Of 0.5 and 0.3 mm and the datum's.
        np.testing.assert_allclose(wrong.control_off[4:6], np.tile(off[2], (2, 1)), atol=3.0)


@pytest.mark.parametrize("sightings", [2, 4])
def test_a_wrong_sighting_is_left_out_alone_and_named(sightings):
    _, seen, _ = frame(4, 5, 5, per_pair=40)
    right = targets(seen, 3, 5, sightings=sightings)
    for count in range(1, sightings // 2 + 1):
        measured = right.seen.copy()
        rows = 2 * sightings + np.arange(count)  # of T2
        measured[rows] += [[0.0, 30.0, 0.0], [-18.0, 0.0, 0.0]][:count]
        wrong = dataclasses.replace(right, seen=measured)
        found = registered(seen, np.random.default_rng(1), control=wrong)
        np.testing.assert_array_equal(np.flatnonzero(found.control_used == 0), rows)
        for row in rows:
            scan = right.body_name[row]
            assert ("spheres.sighting-left-out", "T2", scan) in left_out(found)
            assert found.control_scan[row] == scan
        good = registered(seen, np.random.default_rng(1), control=right.take(~np.isin(np.arange(len(measured)), rows)))
        np.testing.assert_allclose(found.T_project_station, good.T_project_station, atol=ROUNDING)


def test_control_points_that_contradict_each_other_widen_the_intervals():
    """Of three none can be identified as wrong; a single one is contradicted by the stations' own scatter alone."""
    nodes, seen, _ = frame(4, 5, 5, per_pair=40)
    three = targets(seen, 3, 3)
    away = three.known[0] - three.known[[2, 4]].mean(axis=0)
    off = np.zeros((3, 3))
    off[0] = 30.0 * away / np.linalg.norm(away)  # no motion of all keeps the distances between them
    for control in (targets(seen, 3, 3, off=off), targets(seen, 3, 1, off=[0.0, 0.0, 60.0])):
        found = registered(seen, np.random.default_rng(1), control=control)
        assert found.status == "weak"
        assert {"spheres.control-contradicts", "spheres.control-contradicts-stations"} & codes(found)
        assert (found.control_used == 1).all()
        sd = np.sqrt(np.diag(found.common(nodes.mean(axis=0)))[3:])
        left = remaining(seen, found)
        moved = np.mean(left[:, 3:] + np.cross(left[:, :3], nodes.mean(axis=0) - seen.scanners), axis=0)
        assert (np.abs(moved) < 2.0 * sd).all()  # two sds, as intervals are widened


def test_single_station_is_placed_by_control_points():
    _, seen, rng = frame(1, 5, 5, grid=(1, 1), per_pair=40)
    shift = np.array([30.0, -20.0, 8.0])
    found = registered(seen, rng, control=targets(seen, 2, 4, off=shift))
    left = remaining(seen, found)[0, 3:] - shift
    assert np.abs(left).max() < 1.5  # five of 0.29 mm: four of 0.3 mm, seen to 0.5
    assert np.abs(left / np.sqrt(np.diag(found.covariance)[3:6])).max() < 4.0  # four sds


def test_declared_common_shift_of_stations_is_added_to_the_datum_variance():
    _, seen, _ = frame(2, 5, 5, grid=(3, 3), per_pair=30)
    own, more = (registered(seen, np.random.default_rng(1), datum_mm=sd) for sd in (0.0, 3.0))
    variance = [np.diag(one.common(one.places.mean(axis=0)))[3:] for one in (own, more)]
    # The stations' own scatter is estimated anew: it changes by 1 %.
    np.testing.assert_allclose(variance[1] - variance[0], 9.0, rtol=0.05)
    np.testing.assert_allclose(more.between, own.between, rtol=0.05, atol=1e-4)
    assert more.datum[0].values["sd"] > 3.0


def test_two_control_points_reduce_the_covariance_of_the_datum():
    nodes, seen, _ = frame(4, 5, 5, per_pair=40)
    row, station = np.repeat([0, 24], 4), np.tile(np.arange(4), 2)  # each seen from all stations
    seen_at = as_measured(seen, nodes[row], station) + np.array([30.0, 0.0, 0.0])
    control = sighted(seen_at, nodes[row], station, 0.2, row)
    free, held = registered(seen, np.random.default_rng(1)), registered(seen, np.random.default_rng(1), control=control)
    before, after = (np.trace(one.datum_at(nodes[[12]])[0]) for one in (free, held))
    assert after < 0.05 * before  # 0.07 mm of two points against 1 mm of four stations is 0.005; turns are in it
    moved = held.T_project_station[:, 0, 3].mean() - free.T_project_station[:, 0, 3].mean()
    assert moved == pytest.approx(-30.0, abs=4.0)  # by what the points are off; four stations are off by 2 mm each
    assert [one.code for one in held.datum] == ["spheres.datum-stations-and-control"]


def test_motion_undetermined_by_tubes_is_reported_and_stays_uncertain():
    """All tubes lie along x: the positions of the stations along x are undetermined."""
    rng = np.random.default_rng(3)
    y, z = np.meshgrid(np.arange(6) * 1500.0, [6000.0, 7500.0, 9000.0])
    start = np.stack([np.zeros(18), y.ravel(), z.ravel()], axis=1)
    ends = np.stack([start, start + np.array([2500.0, 0.0, 0.0])], axis=1)
    places = np.array([[x, y, 1600.0] for x in (-2000.0, 1000.0, 4000.0) for y in (1000.0, 6000.0)])
    seen = tube_clouds.scan(ends, places, rng, per_pair=80)
    found = registered(seen, rng)
    assert found.status == "weak"
    weak = [one.values["motions"] for (one,) in found.reasons]
    assert all(StationMotion.SHIFT_X in motions for motions in weak)
    assert not any(StationMotion.SHIFT_Y in motions or StationMotion.SHIFT_Z in motions for motions in weak)
    sd = np.sqrt(np.diag(found.covariance)).reshape(-1, 7)
    np.testing.assert_allclose(sd[:, 3], found.before_mm, rtol=1e-3)  # the prior's
    assert np.abs(found.T_project_station[:, 0, 3]).max() < 2.0 * found.before_mm  # not moved beyond its prior


def test_a_station_with_few_tubes_is_named():
    _, seen, rng = frame(6, 5, 5, grid=(2, 3), per_pair=40)
    found = registered(only(seen, lambda station, tube: (station != 3) | (tube == 7)), rng)
    assert found.observations[3] == 1
    (weak,) = found.reasons[3]
    assert any("shift" in motion for motion in weak.values["motions"])
    assert reason("spheres.weak-station", station=3, motions=weak.values["motions"]) in found.messages
    assert not any(one for k, one in enumerate(found.reasons) if k != 3)
    left = remaining(seen, found)[3, 3:]
    assert np.abs(left / np.sqrt(np.diag(found.covariance))[7 * 3 + 3 : 7 * 3 + 6]).max() < 4.0  # four sds


def test_a_station_that_sees_no_tube_changes_nothing():
    """The motions of the others, their variance and their common motion are those of a registration without it."""
    seen = frame(3)[1]
    few = only(seen, lambda station, tube: station < 3)
    blind, without = (
        registered(dataclasses.replace(few, scanners=seen.scanners[:n]), np.random.default_rng(4)) for n in (4, 3)
    )
    assert blind.before_mm == pytest.approx(without.before_mm, rel=1e-6)
    np.testing.assert_allclose(blind.T_project_station[:3], without.T_project_station, atol=1e-6)
    place = seen.scanners[0]
    np.testing.assert_allclose(blind.common(place), without.common(place), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(blind.between[:3], without.between, rtol=1e-6, atol=1e-9)
    assert blind.reasons[3]
    assert blind.datum[0].values["stations"] == 3


def test_one_station_is_its_own_datum_and_stations_without_ties_are_unknown():
    _, seen, rng = frame(1, grid=(1, 1), per_pair=10)
    one = registered(seen, rng)
    assert one.status == "single"
    assert not one.covariance.any()
    np.testing.assert_array_equal(one.T_project_station, np.eye(4)[None])
    _, seen, rng = frame(1, grid=(1, 2), per_pair=10)
    found = registered(only(seen, lambda station, tube: station == tube % 2), rng)
    assert found.status == "unknown"
    assert np.isnan(found.covariance).all()


def test_points_without_station_and_tubes_without_points_are_accepted():
    _, seen, rng = frame(1, 5, 5, per_pair=40)
    station = seen.points.station.copy()
    station[::7] = -1
    start = np.append(seen.points.start, seen.points.start[-1])
    ends = np.concatenate([seen.ends, [[[0.0, 0.0, 9e3], [0.0, 3e3, 9e3]]]])
    found = registered(with_points(seen, seen.points.points, station, start, ends), rng)
    assert found.status == "ok"
    assert np.isfinite(found.axis_points).all()
    np.testing.assert_array_equal(found.corrected(seen.points.points, station)[::7], seen.points.points[::7])


# --- kernels against numpy ------------------------------------------------------------------------------------------


def test_residuals_are_those_of_rays_met_with_a_cylinder():
    """By bisection along the ray, in the frame of the world."""
    rng = np.random.default_rng(7)
    a, d = rng.normal(0.0, 100.0, 3), rng.normal(0.0, 1.0, 3)
    d /= np.linalg.norm(d)
    e1 = np.cross(d, [0.0, 0.0, 1.0])
    e1 /= np.linalg.norm(e1)
    scanner = np.array([[3000.0, -8000.0, -4000.0]])
    points = a + rng.uniform(-800.0, 800.0, (50, 1)) * d + rng.normal(0.0, 18.0, (50, 3))
    layout = Layout(np.array([0, 50]), np.array([0]), np.array([0]), np.array([0, 1]))
    axes = Axes(np.concatenate([a, d])[None], e1[None], np.cross(d, e1)[None], np.array([800.0]), np.array([30.0]))
    seen = residual_kernels.residuals(points, layout, np.eye(4)[None], np.array([0.25]), scanner, axes, 0.3)
    met = 0
    for point, (residual, cosine, n1, n2, zeta) in zip(points, seen, strict=True):
        ray = point - scanner[0]
        length = np.linalg.norm(ray)
        ray /= length

        def outside(t, ray=ray):
            off = scanner[0] + np.reshape(t, (-1, 1)) * ray - a
            return np.linalg.norm(off - (off @ d)[:, None] * d, axis=1) - 30.0

        steps = np.linspace(length - 300.0, length + 300.0, 601)  # a mm apart: a chord as short has no cosine of 0.3
        value = outside(steps)
        if not (value < 0.0).any():
            assert cosine == 0.0
            continue
        first = int(np.argmax(value < 0.0))
        low, high = steps[first - 1], steps[first]
        for _ in range(60):
            mid = 0.5 * (low + high)
            low, high = (mid, high) if outside(mid)[0] > 0.0 else (low, mid)
        hit = scanner[0] + low * ray
        normal = hit - a - ((hit - a) @ d) * d
        normal /= np.linalg.norm(normal)
        if -normal @ ray < 0.3:
            assert cosine == 0.0
            continue
        met += 1
        assert residual == pytest.approx(length - 0.25 - low, abs=ROUNDING)
        assert cosine == pytest.approx(-normal @ ray, abs=ROUNDING)
        assert (n1, n2) == pytest.approx((normal @ e1, normal @ np.cross(d, e1)), abs=ROUNDING)
        assert zeta == pytest.approx((hit - a) @ d / 800.0, abs=ROUNDING)
    assert met > 25


def test_eliminating_the_tubes_is_solving_for_all_at_once():
    rng = np.random.default_rng(2)
    tubes, stations, per = 6, 3, 3
    q = tubes * per
    F = rng.normal(size=(q, 12, 8))
    y = rng.normal(size=(q, 12))
    N, b = np.einsum("qai,qaj->qij", F, F), np.einsum("qai,qa->qi", F, y)
    tube, station = np.repeat(np.arange(tubes), per), np.tile(np.arange(stations), tubes)
    axis, places, half = rng.normal(size=(tubes, 6)), rng.normal(size=(stations, 3)), rng.uniform(1.0, 2.0, tubes)
    e1, e2 = rng.normal(size=(tubes, 3)), rng.normal(size=(tubes, 3))
    weight = rng.uniform(0.5, 1.0, q)
    prior = np.tile([1e-3] * 7 + [1e14], (tubes, 1))
    arguments = (
        normal_equations.Equations(N, b, weight, 0.0),
        Layout(np.zeros(q + 1, np.int64), tube, station, np.arange(0, q + 1, per)),
        normal_equations.Geometry(Axes(axis, e1, e2, half, np.ones(tubes)), places, prior),
    )
    H, g = normal_equations.reduced(*arguments)
    # One row a point: tube's seven unknowns less the station's motion of the axis at the middle and at its end.
    A, right, moved = [], [], []
    for i in range(q):
        j, s = tube[i], station[i]
        G = np.zeros((8, 7))
        for k in range(7):
            w, t = (np.eye(6)[k, :3], np.eye(6)[k, 3:]) if k < 6 else (np.zeros(3), np.zeros(3))
            at = t + np.cross(w, axis[j, :3] - places[s])
            end = np.cross(w, half[j] * axis[j, 3:])
            G[:4, k] = at @ e1[j], at @ e2[j], end @ e1[j], end @ e2[j]
        G[7, 6] = 1.0
        moved.append(G)
        for f, value in zip(F[i], y[i], strict=True):
            row = np.zeros(7 * tubes + 7 * stations)
            row[7 * j : 7 * j + 7] = f[:7]
            row[7 * tubes + 7 * s : 7 * tubes + 7 * s + 7] = -f @ G
            A.append(np.sqrt(weight[i]) * row)
            right.append(np.sqrt(weight[i]) * value)
    A, right = np.array(A), np.array(right)
    full = A.T @ A + np.diag([1e-3] * (7 * tubes) + [1e-2] * (7 * stations))
    x = np.linalg.solve(full, A.T @ right)
    mine = np.linalg.solve(H + 1e-2 * np.eye(len(H)), g)
    # Rounding, by the condition of the normal equations: 4e-10 came.
    np.testing.assert_allclose(mine, x[7 * tubes :], rtol=1e-8, atol=ROUNDING)
    found, scores = normal_equations.tubes(*arguments, mine, 0.09)
    np.testing.assert_allclose(found[:, :7].ravel(), x[: 7 * tubes], rtol=1e-8, atol=ROUNDING)
    # Scores by their definition: residuals' gradient by the axis's place, and its covariance V after the fit.
    for i in range(q):
        j, rows = tube[i], tube == tube[i]
        left = y[i] - F[i] @ (found[j] - moved[i] @ mine[7 * station[i] : 7 * station[i] + 7])
        u = (F[i].T @ left)[:2]
        C = np.linalg.inv(N[i, :2, :2] + np.eye(2) / 0.09)
        of_tube = (weight[rows, None, None] * N[rows]).sum(axis=0) + np.diag(prior[j])
        V = (N[i] - weight[i] * N[i] @ np.linalg.inv(of_tube) @ N[i])[:2, :2]
        np.testing.assert_allclose(scores[i], [u @ C @ u, np.trace(C @ V), np.trace(C @ V @ V)], rtol=1e-8)  # rounding


def test_a_floor_is_an_unknown_of_its_own():
    rng = np.random.default_rng(5)
    F = rng.normal(size=(20, 8))
    N, b = F.T @ F, F.T @ rng.normal(size=20)
    more = np.zeros((10, 10))
    more[:8, :8], more[8:, :8], more[:8, 8:], more[8:, 8:] = N, N[:2], N[:, :2], N[:2, :2] + np.eye(2) / 0.3
    right = np.concatenate([b, b[:2]])
    M, y = normal_equations.with_floor(N, b, 0.3)
    np.testing.assert_allclose(np.linalg.solve(M, y), np.linalg.solve(more, right)[:8], rtol=ROUNDING)
    np.testing.assert_allclose(np.linalg.inv(M), np.linalg.inv(more)[:8, :8], rtol=ROUNDING)


def test_small_linear_algebra_equals_that_of_numpy():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(9, 9))
    A = A @ A.T + np.eye(9)
    B = rng.normal(size=(9, 4))
    L = linalg_small.cholesky(A)
    # Rounding.
    np.testing.assert_allclose(L, np.linalg.cholesky(A), rtol=1e-12)
    np.testing.assert_allclose(linalg_small.solve(L, B), np.linalg.solve(A, B), rtol=1e-12)
    np.testing.assert_allclose(linalg_small.product(A, B), A @ B, rtol=1e-12)
    assert np.isnan(linalg_small.cholesky(-A)).all()


def test_the_effect_is_every_stations_motion_at_the_place():
    rng = np.random.default_rng(3)
    places, points = rng.normal(0.0, 1e4, (3, 3)), rng.normal(0.0, 1e4, (5, 3))
    C = rng.normal(size=(21, 21)) * np.tile([1e-5] * 3 + [1.0] * 4, 3)[:, None]
    C = C @ C.T
    influence = rng.normal(size=(5, 3, 4, 3))
    draws = rng.multivariate_normal(np.zeros(21), C, 100_000).reshape(-1, 3, 7)
    k = 2
    arm = points[k] - places
    moved = draws[:, :, 3:6] + np.cross(draws[:, :, :3], arm)
    moved += draws[:, :, 6:] * (arm / np.linalg.norm(arm, axis=1)[:, None])
    sampled = np.cov(np.einsum("sdi,nsi->nd", influence[k], moved).T)
    J = records._by_stations(points, influence, places)[k]
    found = J @ C @ J.T
    # A variance of 100,000 draws scatters by 0.4 %.
    np.testing.assert_allclose(found, sampled, atol=0.02 * np.abs(found).max())


def test_the_prior_of_a_free_common_motion_leaves_it_free():
    rng = np.random.default_rng(0)
    places = rng.normal(0.0, 1e4, (4, 3))
    target = rng.normal(0.0, 1e4, (3, 3))
    control = sighted(target, target, np.arange(3), 1.0)
    posterior = stations_posterior.Posterior(places, control)
    P = posterior._prior(posterior.variance)
    common = stations_posterior.common_motion(places - places.mean(axis=0))
    assert np.abs(P @ common).max() < 1e-6 * np.abs(np.diag(P)[:, None] * common).max()  # of its own size: 2e-7 came
    assert np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)))).min() > -1e-9  # rounding


# --- the whole cloud ------------------------------------------------------------------------------------------------


def test_a_source_and_gathered_points_are_corrected_alike():
    _, seen, rng = frame(2, per_pair=30)
    found = registered(seen, rng)
    source = InMemory(seen.points.points, seen.points.station, seen.scanners, chunk_size=1000)
    corrected = Corrected(source, found)
    middle, along = ends_to_axes(seen.ends)
    lines = corridors(middle, along, np.full(len(middle), -1500.0), np.full(len(middle), 1500.0), 200.0)
    room = gather(((c.points, c.station) for c in source.chunks()), STEPS_PER_MM, lines, 200)
    after = corrected_gathered(room, found)
    moved = np.concatenate([chunk.points for chunk in corrected.chunks()])
    assert (np.abs(moved - seen.points.points).max(axis=0) > 0.3).all()  # else void
    tree, mask = cKDTree(moved), (1 << 21) - 1
    for m, count in enumerate(after.counts):
        places = after.places[m * after.room : m * after.room + count]
        steps = np.stack([places >> 42, (places >> 21) & mask, places & mask], axis=1) - (1 << 20) + after.middles[m]
        assert tree.query(steps / STEPS_PER_MM)[0].max() < 0.02  # rounded before and after
    R = found.T_project_station[1, :3, :3]
    np.testing.assert_allclose(
        corrected.scanners[1],
        R @ seen.scanners[1] + found.T_project_station[1, :3, 3],
        rtol=1e-12,  # rounding
    )
