"""Errors of stations in tubes against points that are moved by them and fitted again."""

import numpy as np
import pytest

from processor.space_frame.stations import station_error_propagation
from processor.space_frame.stations.records import Stations, StationStatus
from tests.support.clouds import ball_clouds

RADIUS, OFFSET = 80.0, 0.5


def tube():
    return ball_clouds.tubes(1, 2000.0, RADIUS, node_b=np.array([1]))


def stations(places, covariance, **errors):
    return Stations(
        status=StationStatus.OK, places=np.array(places, float), covariance=covariance,
        T_project_station=np.tile(np.eye(4), (len(places), 1, 1)), range_offset=np.zeros(len(places)),
        observations=np.zeros(len(places), np.int64), reasons=((),) * len(places), range_sd=np.ones(len(places)),
        **errors,
    )  # fmt: skip


def fitted_radius_change(places, rng):
    """Radius of the circle through points whose ranges are too long by OFFSET, less the true one."""
    points = []
    for place in places:
        away = np.linalg.norm(place)
        to = np.array(place)[1:] / away
        off = rng.uniform(-RADIUS, RADIUS, int(2e11 / away**2))  # rays that are nearly parallel
        across = np.array([-to[1], to[0]])
        height = np.sqrt(RADIUS**2 - off**2)
        points.append(off[:, None] * across + (height - OFFSET)[:, None] * to)
    yz = np.vstack(points)
    state = np.array([0.0, 0.0, RADIUS])
    for _ in range(10):
        arm = yz - state[:2]
        r = np.linalg.norm(arm, axis=1)
        J = np.column_stack([arm / r[:, None], np.ones(len(r))])
        state = state + np.linalg.lstsq(J, r - state[2], rcond=None)[0]
    return state[2] - RADIUS


@pytest.mark.parametrize(
    "places",
    [
        [(0, 5000, 0), (0, -5000, 0)],
        [(0, 5000, 0), (0, 0, -5000), (0, -7000, -4000)],
        [(0, 4000, -4000), (0, 9000, 1000)],
    ],
)
def test_radius_changes_by_an_offset_of_ranges_as_a_fit_to_moved_points_does(places):
    one = stations(places, np.zeros((7 * len(places),) * 2), shared_offset=OFFSET)
    sd = float(np.sqrt(station_error_propagation.of_radii(tube(), one)[0]))
    # Rays that are not quite parallel.
    assert sd == pytest.approx(abs(fitted_radius_change(places, np.random.default_rng(1))), rel=0.02)


def test_a_tube_seen_from_one_side_keeps_its_radius():
    """The points lie on a circle of the same radius, shifted along the rays, but for the limb."""
    one = stations([(0, 5000, 0)], np.zeros((7, 7)), shared_offset_sd=OFFSET)
    assert np.sqrt(station_error_propagation.of_radii(tube(), one)[0]) < 1e-9  # rounding


def test_a_motion_common_to_all_stations_moves_the_axis_as_much():
    places = [(0, 5000, 0), (0, -3000, 2000)]
    J = np.zeros((14, 3))
    J[3:6], J[10:13] = np.eye(3), np.eye(3)
    shift = np.diag([4.0, 1.0, 9.0])
    one = stations(places, J @ shift @ J.T)
    covariance = station_error_propagation.of_axes(tube(), one, np.array([500.0]))[0]
    np.testing.assert_allclose(covariance, np.diag([1.0, 9.0]), atol=1e-9)  # rounding
