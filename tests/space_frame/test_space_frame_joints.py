"""Joints that have balls and those that have none: scaffolds in a frame, and the assignment of all joints together."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor.space_frame import extract
from processor.space_frame.members import member_extraction
from processor.space_frame.spheres import ball_joint_classification
from processor.space_frame.spheres.ball_joint_classification import UNLIKE, log_odds_of_ball, most_likely, of_frame
from tests.support.clouds import frame_clouds
from tests.support.clouds.frame_clouds import STATIONS
from tests.support.clouds.memory_source import InMemory


def tower(rng, corner, width, depth, lifts, scanner, clamp=47.0):
    """Points of a scaffold: four poles, ledgers at each lift, and clamps where they meet."""
    feet = corner + np.array([[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]])
    parts = []
    for k, foot in enumerate(feet):
        parts.append(
            frame_clouds.tube(np.append(foot, 0.0), np.append(foot, lifts[-1] + 600.0), 24.0, 1500, scanner, 2.0, rng)
        )
        for z in lifts:
            a, b = np.append(foot, z), np.append(feet[(k + 1) % 4], z)
            parts.append(frame_clouds.tube(a, b, 24.0, 700, scanner, 2.0, rng))
            low, high = a - np.array([0.0, 0.0, 45.0]), a + np.array([0.0, 0.0, 45.0])
            parts.append(frame_clouds.tube(low, high, clamp, 120, scanner, 2.0, rng))
    return np.concatenate(parts)


def found(frame, sleeves=True, seed=3, **kinds):
    """Nodes that are judged to have balls, of a frame with a scaffold in it."""
    rng = np.random.default_rng(seed)
    points, station = frame_clouds.scanned(frame, rng, **kinds)
    extra = [tower(rng, np.array([3100.0, 900.0]), 1570.0, 1090.0, (400.0, 2200.0, 4000.0), s) for s in STATIONS]
    owner = [np.full(len(part), s, np.int32) for s, part in enumerate(extra)]
    source = InMemory(np.concatenate([points, *extra]), np.concatenate([station, *owner]), STATIONS)
    start = extract.blind(source, member_extraction.Params())
    meeting = member_extraction.meeting(start.measured, member_extraction.Params().largest_scatter_mm)
    positions = start.measured.nodes.positions
    return positions[meeting], positions[meeting & start.balls]


def test_no_ball_has_less_than_five_quarters_of_the_radius_of_its_thinnest_tube(monkeypatch):
    """Of tubes of 50 and 40 mm: radii from 50 mm on are tried. Inner kernels cannot be called from Python."""
    tried = []
    monkeypatch.setattr(ball_joint_classification, "_beside_members", lambda points, *_: np.arange(len(points)))
    monkeypatch.setattr(ball_joint_classification, "_sphere_ratio", lambda *of: tried.append(of[2]) or -1.0)
    monkeypatch.setattr(ball_joint_classification, "_neck_ratio", lambda *_: 0.0)
    monkeypatch.setattr(ball_joint_classification, "_mean_of", max)
    crops = SimpleNamespace(start=[0, 3], points=np.zeros((3, 3)), rays=np.zeros((3, 3)))
    axes = np.eye(3)[:2]
    ends = SimpleNamespace(start=[0, 2], points=0.0 * axes, directions=axes, tube_radii=np.array([50.0, 40.0]))
    ball_joint_classification._evidence.py_func(crops, ends, 1.0, np.zeros(1), np.zeros(1), 0, 1)
    np.testing.assert_array_equal(tried, np.arange(50.0, 160.0, 2.5))


def test_joints_of_a_scaffold_are_no_nodes():
    frame = frame_clouds.grid(rng=np.random.default_rng(1))
    every, kept = found(frame)
    assert len(every) >= len(frame.nodes) + 8  # most joints of the tower are places where members meet
    distance = cKDTree(frame.nodes).query(kept)[0]
    assert len(kept) == len(frame.nodes)
    assert distance.max() < 3.0  # as the evaluation counts nodes as found; 0.45 came


def test_balls_without_sleeves_are_recognised_by_their_surface():
    odds = log_odds_of_ball(np.array([40.0] * 8 + [-9.0] * 4 + [1.0]), np.array([-60.0] * 12 + [-20.0]))
    # Log odds: 20 to 1.
    assert (odds[:8] > 3.0).all()
    assert (odds[8:12] < -3.0).all()


def test_round_looking_clamp_follows_the_neighbouring_clamps():
    sphere, neck = np.array([30.0] * 20 + [6.0, -5.0, -8.0, -6.0]), np.array([50.0] * 20 + [-40.0] * 4)
    pairs = np.array([(i, i + 1) for i in range(19)] + [(20, 21), (20, 22), (20, 23)])
    assert most_likely(log_odds_of_ball(sphere, neck), pairs).tolist() == [True] * 20 + [False] * 4


def test_round_joints_without_sleeves_are_of_no_frame_with_sleeves():
    """A frame of six balls, a lift of three round joints apart from it, a ball with a sleeve that nothing leads to."""
    balls = np.array([True] * 6 + [True] * 3 + [True, False])
    neck = np.array([60.0, 50.0, -1.0, 70.0, 55.0, 40.0, -90.0, 2.0, -80.0, 12.0, 30.0])
    pairs = np.array([(i, i + 1) for i in range(5)] + [(6, 7), (7, 8)])
    assert of_frame(balls, neck, pairs).tolist() == [True] * 6 + [False] * 3 + [True, False]
    # The lift's joints are kept where a member leads from them to the frame, and where the frame has no sleeves.
    assert of_frame(balls, neck, np.vstack([pairs, [[5, 6]]])).tolist() == balls.tolist()
    assert of_frame(balls, -neck, pairs).tolist() == balls.tolist()
    assert of_frame(balls[:0], neck[:0], pairs[:0]).tolist() == []


@pytest.mark.parametrize("chain", [5, 9])
def test_joints_without_evidence_follow_their_neighbours(chain):
    pairs = np.stack([np.arange(chain - 1), np.arange(1, chain)], axis=1)
    odds = np.zeros(chain)
    odds[0] = 9.0
    assert most_likely(odds, pairs).all()
    odds[0], odds[-1] = -9.0, -9.0
    assert most_likely(odds, pairs).tolist() == [False] * chain
    odds[0] = 9.0  # cut once, where it costs least
    assert most_likely(odds, pairs).sum() in range(1, chain)


def test_the_assignment_is_the_best_of_all():
    rng = np.random.default_rng(2)
    for _ in range(20):
        odds, pairs = rng.normal(0.0, 2.0, 7), rng.integers(0, 7, (9, 2))
        pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
        alike = np.log((1.0 - UNLIKE) / UNLIKE)
        every = (np.arange(1 << 7)[:, None] >> np.arange(7)) & 1
        cost = -every @ odds + alike * (every[:, pairs[:, 0]] != every[:, pairs[:, 1]]).sum(axis=1)
        assert most_likely(odds, pairs).tolist() == every[np.argmin(cost)].astype(bool).tolist()
