"""The search for balls in whole clouds: every ball and no other, of all shapes that are none."""

import numpy as np
import pytest

from processor.model import Scan, Scene
from processor.space_frame import step as space_frame_step
from processor.space_frame.spheres.sphere_detection import LEAST_POINTS, find_balls
from tests.support.clouds import street_clouds
from tests.support.solids.robust_sphere import cap


def test_search_finds_every_ball_and_no_other():
    rng = np.random.default_rng(16)
    centres = np.array([[0.0, 0.0, 0.0], [400.0, 0.0, 50.0], [100.0, 500.0, -20.0]])
    radii = [50.0, 72.5, 40.0]
    balls = [
        c + cap(rng, 700, r, 0.4, (0, -1, 0.3)) + rng.normal(0, 0.3, (700, 3))
        for c, r in zip(centres, radii, strict=True)
    ]
    wall = np.column_stack([rng.uniform(-300.0, 700.0, 3000), np.full(3000, 700.0), rng.uniform(-300.0, 300.0, 3000)])
    points = np.vstack([*balls, wall + rng.normal(0.0, 0.3, (3000, 3))])
    found = find_balls(points, np.random.default_rng(0), most=10)
    # 0.3 mm by 700 points on 40 % of a ball: 0.03 mm
    order = np.argsort([one.fit.sphere.radius for one in found])
    np.testing.assert_allclose([found[i].fit.sphere.radius for i in order], [40.0, 50.0, 72.5], atol=0.2)
    np.testing.assert_allclose([found[i].fit.sphere.centre for i in order], centres[[2, 0, 1]], atol=0.2)
    assert found[order[1]].fit.inliers[:700].mean() > 0.95  # within 4.7 standard deviations but strays
    assert found[order[1]].fit.inliers[700:].mean() < 0.01  # other bodies
    shuffled = rng.permutation(len(points))
    again = find_balls(points[shuffled], np.random.default_rng(0), most=10)
    centres = [[one.fit.sphere.centre for one in of] for of in (again, found)]
    np.testing.assert_allclose(*centres, atol=1e-9)  # sums in another order


def plane(rng, sigma):
    return np.column_stack([rng.uniform(-300.0, 300.0, (4000, 2)), rng.normal(0.0, sigma, 4000)])


def tube(rng, sigma, length=600.0):
    turn, r = rng.uniform(0.0, np.pi, 4000), 30.0 + rng.normal(0.0, sigma, 4000)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), rng.uniform(0.0, length, 4000)])


def box_corner(rng, sigma):
    flat = np.column_stack([rng.uniform(0.0, 300.0, (4000, 2)), np.zeros(4000)])
    return np.vstack([np.roll(flat[k::3], k, axis=1) for k in range(3)]) + rng.normal(0.0, sigma, (4000, 3))


NO_BALLS = {
    "plane": lambda rng: plane(rng, 0.5),
    "rough plane": lambda rng: plane(rng, 5.0),
    "exact plane": lambda rng: plane(rng, 0.0),
    "tube": lambda rng: tube(rng, 0.5),
    "short tube": lambda rng: tube(rng, 1.0, 40.0),
    "corner": lambda rng: box_corner(rng, 0.5),
    "volume": lambda rng: rng.uniform(-100.0, 100.0, (4000, 3)),
    "sparse volume": lambda rng: rng.uniform(-100.0, 100.0, (300, 3)),
    "cluster": lambda rng: rng.normal(0.0, 50.0, (2000, 3)),
    "few": lambda rng: cap(rng, LEAST_POINTS - 1),
    "line": lambda rng: np.linspace(0.0, 1.0, 200)[:, None] * np.ones(3),
    "one place": lambda rng: np.ones((100, 3)),
    "nothing": lambda rng: np.empty((0, 3)),
}


@pytest.mark.parametrize("shape", NO_BALLS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))])
def test_search_invents_no_ball(shape, seed):
    points = NO_BALLS[shape](np.random.default_rng(seed))
    assert find_balls(points, np.random.default_rng(seed), most=10) == []


CENTRES = {"near": (2500.0, 600.0, -200.0), "far": (-1800.0, 2700.0, 100.0), "low": (400.0, -2600.0, -350.0)}


@pytest.mark.parametrize(("place", "radius"), [("near", None), ("far", 300.0), ("low", None)])
def test_a_ball_of_a_hundredth_of_a_street_is_found(place, radius):
    centre = np.array(CENTRES[place])
    points, on = street_clouds.street(np.random.default_rng(len(place)), centre, 300.0)
    assert 200 <= on.sum() < 0.02 * len(points)
    (one,) = find_balls(points, np.random.default_rng(0), most=10, radius_mm=radius)
    # Noise of 8 mm a point and 3 mm a line, by some ten lines
    assert np.linalg.norm(one.fit.sphere.centre - centre) < 10.0
    assert one.fit.sphere.radius == pytest.approx(300.0, abs=10.0)
    assert one.fit.inliers[on].mean() > 0.9  # within 4.7 sds but strays


@pytest.mark.parametrize("radius", [None, 300.0])
def test_a_ball_in_four_lines_of_a_scanner_is_found(radius):
    """A tenth of the points of the ball lies on one line, and has no normal."""
    centre, rays = np.array([2900.0, 700.0, -250.0]), street_clouds.lines(np.linspace(-25.0, 15.0, 16), 0.2)
    points, on = street_clouds.street(np.random.default_rng(0), centre, 300.0, sigma=4.0, rays=rays)
    assert len(np.unique(np.round(np.degrees(np.arcsin(points[on, 2] / np.linalg.norm(points[on], axis=1))), 1))) <= 5
    (one,) = find_balls(points, np.random.default_rng(0), most=10, radius_mm=radius)
    assert np.linalg.norm(one.fit.sphere.centre - centre) < 10.0  # as above


def test_a_street_without_a_ball_has_none():
    points, _ = street_clouds.street(np.random.default_rng(4), None, 300.0)
    assert find_balls(points, np.random.default_rng(0), most=10) == []
    assert find_balls(points, np.random.default_rng(0), most=10, radius_mm=300.0) == []


def test_rough_tree_crown_has_low_confidence_and_a_smooth_ball_is_ok():
    rng = np.random.default_rng(3)
    rays = street_clouds.lines(np.linspace(-25.0, 20.0, 40), 0.3)
    street, _ = street_clouds.street(rng, None, 300.0, sigma=3.0, rays=rays)
    out = rng.normal(size=(400, 3))
    out /= np.linalg.norm(out, axis=1)[:, None]
    out = out[out @ np.array([0.7, 0.7, 0.0]) < 0.2]
    crown = np.array([4000.0, 4000.0, 900.0]) + (600.0 + rng.normal(0.0, 25.0, (len(out), 1))) * out
    ball = np.array([2500.0, 600.0, -200.0]) + (300.0 + rng.normal(0.0, 5.0, (len(out), 1))) * out
    for body, radius, flag in ((crown, 600.0, "low-confidence"), (ball, 300.0, "ok")):
        scene = Scene("street", "structure", (Scan("S1", np.vstack([street, body])),))
        result = space_frame_step.run(scene, space_frame_step.Params())
        near = [f for f, r in zip(result.balls.flag, result.balls.radii, strict=True) if abs(r - radius) < 0.1 * radius]
        assert near == [flag]
