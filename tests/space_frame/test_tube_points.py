"""The points of a tube by which stations are registered."""

import numpy as np
import pytest

from processor.space_frame.points import line_crops
from processor.space_frame.points.hash_sampling import STEPS_PER_MM
from processor.space_frame.stations.tube_points import END_SHARE, NEAR_MM, tube_points
from tests.support.clouds import ball_clouds

HALF_LENGTH, RADIUS, BOW = 1000.0, 80.0, 20.0


@pytest.mark.parametrize("most", [100, 100_000])
def test_of_many_points_on_a_bowed_tube_so_many_are_chosen_of_all_of_it_and_of_few_all(most):
    rng = np.random.default_rng(3)
    along, turn = rng.uniform(-HALF_LENGTH, HALF_LENGTH, 6000), rng.uniform(0.0, 2.0 * np.pi, 6000)
    off, station = rng.uniform(-2.0 * NEAR_MM, 2.0 * NEAR_MM, 6000), rng.integers(-1, 3, 6000).astype(np.int32)
    arch = BOW * (1.0 - (along / HALF_LENGTH) ** 2)
    points = np.column_stack([along, arch + (RADIUS + off) * np.cos(turn), (RADIUS + off) * np.sin(turn)])
    # Less than a step of 0.01 mm decides no point.
    clear = (np.abs(np.abs(off) - NEAR_MM) > 0.02) & (np.abs(np.abs(along) - END_SHARE * HALF_LENGTH) > 0.02)
    points, station = points[clear], station[clear]
    usable = ((np.abs(off) < NEAR_MM) & (np.abs(along) < END_SHARE * HALF_LENGTH))[clear] & (station >= 0)
    members = ball_clouds.tubes(1, 2.0 * HALF_LENGTH, RADIUS, bow=np.array([[BOW, 0.0]]), node_b=np.array([1]))
    half = np.array([HALF_LENGTH + 50.0])
    lines = line_crops.corridors(members.points, members.directions, -half, half, 150.0)
    gathered = line_crops.gather([(points, station)], STEPS_PER_MM, lines, 8192)
    found = tube_points(gathered, np.array([0]), members, most, threads=1)
    rows = {tuple(row): k for k, row in enumerate(np.rint(points[usable] * STEPS_PER_MM).astype(int).tolist())}
    chosen = [rows[tuple(row)] for row in np.rint(found.points * STEPS_PER_MM).astype(int).tolist()]
    assert len(set(chosen)) == min(most, usable.sum())
    np.testing.assert_array_equal(found.station, station[usable][chosen])
    # Four standard errors of the mean of places that are uniform along the tube.
    assert abs(found.points[:, 0].mean()) < 4.0 * 0.95 * HALF_LENGTH / np.sqrt(3.0 * len(chosen))
