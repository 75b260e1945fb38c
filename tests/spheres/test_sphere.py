import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from processor.geometry.nearest_neighbours import nearest_crops
from processor.geometry.sphere import (
    Sphere,
    algebraic,
    ransac,
    through_four,
    trials_needed,
    visible_fraction,
)
from processor.geometry.sphere_robust_fit import robust_fit
from processor.model import Scan, Scene
from processor.space_frame import step as space_frame_step
from processor.space_frame.spheres.sphere_detection import LEAST_POINTS, find_balls
from tests.support.clouds import street_clouds
from tests.support.solids import robust_sphere

NOWHERE = np.zeros((4, 4))
UTM = np.array([500_000_000.0, 4_300_000_000.0, 50_000.0])


def cap(rng, n, radius=45.0, share=0.45, view=(0.0, 0.0, 1.0)):
    """Directions evenly over the share of the sphere that faces ``view``, times the radius."""
    view = np.asarray(view) / np.linalg.norm(view)
    height = rng.uniform(1.0 - 2.0 * share, 1.0, n)
    turn = rng.uniform(0.0, 2.0 * np.pi, n)
    across = np.linalg.svd(view[None])[2][1:]
    ring = np.sqrt(1.0 - height**2)
    return radius * (
        height[:, None] * view + (ring * np.cos(turn))[:, None] * across[0] + (ring * np.sin(turn))[:, None] * across[1]
    )


def rotation(rng):
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))


# --- algebraic least squares and the four-point solve --------------------------------------------------------------


def test_algebraic_is_exact_on_exact_points():
    points = cap(np.random.default_rng(0), 50, 75.0, 0.1) + np.array([3.0, -4.0, 5.0])
    found = algebraic(points)
    np.testing.assert_allclose(found.centre, [3.0, -4.0, 5.0], atol=1e-8)
    assert found.radius == pytest.approx(75.0, abs=1e-8)


def test_algebraic_solves_the_papers_system():
    rng = np.random.default_rng(1)
    points = cap(rng, 300) + rng.normal(0.0, 2.0, (300, 3))
    solution = np.linalg.lstsq(np.column_stack([-2.0 * points, np.ones(300)]), -np.sum(points**2, axis=1), rcond=None)[
        0
    ]
    found = algebraic(points)
    np.testing.assert_allclose(found.centre, solution[:3], atol=1e-9)
    assert found.radius == pytest.approx(math.sqrt(solution[:3] @ solution[:3] - solution[3]), abs=1e-9)


def test_algebraic_keeps_its_digits_at_georeferenced_coordinates():
    rng = np.random.default_rng(2)
    points = np.round(cap(rng, 200) + rng.normal(0.0, 1.0, (200, 3)), 3)
    here, there = algebraic(points), algebraic(points + UTM)
    # 4.3e9 mm is stored in steps of 4.8e-7 mm: the input itself moves by that
    np.testing.assert_allclose(there.centre - UTM, here.centre, atol=2e-6)
    assert there.radius == pytest.approx(here.radius, abs=1e-6)


def test_algebraic_moves_with_its_points():
    rng = np.random.default_rng(3)
    points = cap(rng, 100) + rng.normal(0.0, 1.0, (100, 3))
    R, t = rotation(rng), np.array([1000.0, 2000.0, -3000.0])
    here, there = algebraic(points), algebraic(points @ R.T + t)
    np.testing.assert_allclose(there.centre, R @ here.centre + t, atol=1e-8)
    np.testing.assert_allclose(there.covariance[:3, :3], R @ here.covariance[:3, :3] @ R.T, atol=1e-8)


def test_formal_covariance_is_the_scatter_on_a_whole_sphere():
    rng = np.random.default_rng(4)
    fits = [algebraic(cap(rng, 60, 100.0, 0.6) + rng.normal(0.0, 0.2, (60, 3))) for _ in range(400)]
    scatter = np.cov(np.array([[*fit.centre, fit.radius] for fit in fits]).T)
    stated = np.mean([fit.covariance for fit in fits], axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(stated)), np.sqrt(np.diag(scatter)), rtol=0.12)
    assert np.sign(stated[2, 3]) == np.sign(scatter[2, 3])
    lowest = np.std([fit.centre[2] - fit.radius for fit in fits])
    assert np.mean([fit.lowest_sd for fit in fits]) == pytest.approx(lowest, rel=0.12)


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.eye(3),
        np.ones((10, 3)),
        np.column_stack([np.random.default_rng(0).random((20, 2)), np.zeros(20)]),
    ],
    ids=["none", "three", "one place", "one plane"],
)
def test_algebraic_fit_of_degenerate_points_is_none(points):
    assert algebraic(points) is None


@pytest.mark.parametrize(("radius", "share"), [(45.0, 0.45), (45.0, 0.25), (150.0, 0.15)])
def test_algebraic_bias_is_that_of_the_estimator(radius, share):
    # Noise s = 2 mm along parallel rays, on a cap evenly covered: heights z are uniform, and eq. 14 becomes the
    # straight line of p.p + 2 z e + e^2 on z + e. By hand, with E[e^2] = s^2 and odd moments 0: covariance
    # 2 s^2 E[z], so c = s^2 E[z] / (Var[z] + s^2), and r'^2 = c^2 + r^2 + s^2 - 2 c E[z]. At 45 mm and 45 %: 44.662 mm.
    mean, variance = radius * (1.0 - share), (2.0 * radius * share) ** 2 / 12.0
    c = 4.0 * mean / (variance + 4.0)
    expected = math.sqrt(c**2 + radius**2 + 4.0 - 2.0 * c * mean)
    rng = np.random.default_rng(5)
    radii = []
    for _ in range(300):
        points = cap(rng, 400, radius, share)
        points[:, 2] += rng.normal(0.0, 2.0, 400)
        radii.append(algebraic(points).radius)
    assert expected < radius - 0.3
    assert np.mean(radii) == pytest.approx(expected, abs=4.0 * np.std(radii) / math.sqrt(300))


def test_four_points_by_hand():
    # (1,2,3) +- 5 along x, + 5 along y and along z: centre (1,2,3), radius 5
    quad = np.array([[6.0, 2.0, 3.0], [-4.0, 2.0, 3.0], [1.0, 7.0, 3.0], [1.0, 2.0, 8.0]])
    # circumscribed about the corner of a box 2 x 4 x 6: centre (1, 2, 3), radius sqrt(14)
    corner = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 6.0]])
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    centres, radii = through_four(np.array([quad, corner, flat]))
    np.testing.assert_allclose(centres[:2], [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(radii[:2], [5.0, math.sqrt(14.0)])
    assert np.isnan(centres[2]).all()
    assert np.isnan(radii[2])


def test_four_skew_points_agree_with_a_general_solver():
    quads = np.random.default_rng(6).normal(size=(50, 4, 3))
    centres, radii = through_four(quads)
    for quad, centre, radius in zip(quads, centres, radii, strict=True):
        A = 2.0 * (quad[1:] - quad[0])
        expected = np.linalg.solve(A, np.sum(quad[1:] ** 2, axis=1) - np.sum(quad[0] ** 2))
        np.testing.assert_allclose(centre, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(np.linalg.norm(quad - centre, axis=1), radius, rtol=1e-6)


def test_visible_fraction_of_a_half_and_of_a_tenth():
    rng = np.random.default_rng(7)
    assert visible_fraction(cap(rng, 20_000, share=0.5) + 9.0, np.full(3, 9.0)) == pytest.approx(0.5, abs=0.001)
    assert visible_fraction(cap(rng, 20_000, share=0.1, view=(0, 0, -1)), np.zeros(3)) == pytest.approx(0.1, abs=0.001)
    assert visible_fraction(np.empty((0, 3)), np.zeros(3)) == 0.0


# --- RANSAC --------------------------------------------------------------------------------------------------------


def test_trials_needed():
    # w = 1/2: log(0.01) / log(15/16) = 4.60517 / 0.0645385
    assert trials_needed(0.99, 0.5) == pytest.approx(71.3554, abs=1e-3)
    assert trials_needed(0.99, 1.0) == 1.0
    assert trials_needed(0.99, 0.0) == math.inf


def test_ransac_leaves_a_tube_out():
    rng = np.random.default_rng(8)
    ball = cap(rng, 200) + rng.normal(0.0, 0.2, (200, 3))
    turn, along = rng.uniform(0.0, 2.0 * np.pi, 100), rng.uniform(55.0, 65.0, 100)
    tube = np.column_stack([along, 19.0 * np.cos(turn), 19.0 * np.sin(turn)])
    points = np.vstack([ball, tube])
    for seed in range(5):
        found = ransac(points, np.random.default_rng(seed), tau_mm=1.0)
        assert found.sphere.radius == pytest.approx(45.0, abs=0.3)
        assert np.linalg.norm(found.sphere.centre) < 0.3
        assert found.inliers[200:].sum() < 5
        assert 1 <= found.trials <= math.ceil(found.needed)
    assert abs(algebraic(points).radius - 45.0) > 3.0


def test_ransac_does_not_depend_on_the_order_of_the_points():
    rng = np.random.default_rng(9)
    points = np.vstack([cap(rng, 150) + rng.normal(0.0, 2.0, (150, 3)), rng.uniform(-65.0, 65.0, (80, 3))])
    order = rng.permutation(len(points))
    here = ransac(points, np.random.default_rng(1))
    there = ransac(points[order], np.random.default_rng(1))
    np.testing.assert_array_equal(there.inliers, here.inliers[order])
    np.testing.assert_allclose(there.sphere.centre, here.sphere.centre, atol=1e-9)


def test_ransac_keeps_its_bounds():
    rng = np.random.default_rng(10)
    assert ransac(rng.uniform(-100.0, 100.0, (200, 3)), rng, tau_mm=0.01, max_trials=57).trials == 57
    assert ransac(np.eye(3), rng) is None
    assert ransac(np.ones((20, 3)), rng, max_trials=50) is None


# --- the robust fit ------------------------------------------------------------------------------------------------


def contaminated(rng):
    ball = cap(rng, 400, 50.0) + rng.normal(0.0, 0.15, (400, 3))
    outside = cap(rng, 300, 1.0, 0.2, (1, 0, 0)) * rng.uniform(50.5, 80.0, 300)[:, None]
    return np.vstack([ball, outside])


def test_robust_fit_withstands_contamination_on_one_side():
    points = contaminated(np.random.default_rng(11))
    fit = robust_fit(points, Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE), 1.0)
    assert fit.converged
    assert np.linalg.norm(fit.sphere.centre) < 0.06
    assert fit.sphere.radius == pytest.approx(50.0, abs=0.05)
    assert fit.scale == pytest.approx(0.15, rel=0.2)
    assert fit.inliers[400:].mean() < 0.05
    held = robust_fit(points, Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE), 1.0, radius_mm=50.0)
    assert held.sphere.radius == 50.0
    assert not held.sphere.covariance[3].any()


def test_robust_fit_does_not_depend_on_its_start_and_moves_with_its_points():
    rng = np.random.default_rng(12)
    points = contaminated(rng)
    here = robust_fit(points, Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE), 1.0).sphere
    other = robust_fit(points, Sphere(np.array([-0.3, 0.0, 0.4]), 49.7, NOWHERE), 1.0).sphere
    np.testing.assert_allclose(other.centre, here.centre, atol=1e-6)
    R = rotation(rng)
    moved = robust_fit(points @ R.T + 1000.0, Sphere(np.full(3, 1000.2), 50.3, NOWHERE), 1.0).sphere
    np.testing.assert_allclose(moved.centre, R @ here.centre + 1000.0, atol=1e-6)
    there = robust_fit(points + UTM, Sphere(UTM, 50.0, NOWHERE), 1.0).sphere
    np.testing.assert_allclose(there.centre - UTM, here.centre, atol=2e-6)
    assert there.radius == pytest.approx(here.radius, abs=1e-6)


def test_robust_fit_of_clean_points_is_scipys():
    rng = np.random.default_rng(13)
    points = cap(rng, 300, 50.0) + rng.normal(0.0, 0.1, (300, 3))
    expected = least_squares(
        lambda x: np.linalg.norm(points - x[:3], axis=1) - x[3], [0, 0, 0, 50.0], loss="soft_l1", f_scale=1.0
    ).x
    fit = robust_fit(points, Sphere(np.zeros(3), 50.0, NOWHERE), 1.0).sphere
    # both near the same maximum of likelihood: apart by a fraction of the standard deviation
    difference = np.append(fit.centre, fit.radius) - expected
    assert difference @ np.linalg.solve(fit.covariance, difference) < 1.0


def test_robust_intervals_cover_and_ranges_take_the_bias_away():
    # noise along rays from a scanner 10 m below, 25 % of the ball seen: orthogonal distances make it too small
    scanner = np.array([0.0, 0.0, 10_000.0])
    errors, covered = {"orthogonal": [], "ray": []}, []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        points = cap(rng, 200, 45.0, 0.25)
        ray = points - scanner
        points = points + ray / np.linalg.norm(ray, axis=1)[:, None] * rng.normal(0.0, 1.0, (200, 1))
        start = Sphere(np.zeros(3), 45.0, NOWHERE)
        errors["orthogonal"].append(robust_fit(points, start, 2.0).sphere.radius - 45.0)
        fit = robust_fit(points, start, 2.0, scanner=np.broadcast_to(scanner, points.shape)).sphere
        errors["ray"].append(fit.radius - 45.0)
        covered.append(abs(fit.radius - 45.0) < 1.96 * math.sqrt(fit.covariance[3, 3]))
    bias = {name: np.mean(values) for name, values in errors.items()}
    standard_error = np.std(errors["ray"]) / math.sqrt(200)
    assert abs(bias["ray"]) < 3.5 * standard_error
    assert bias["orthogonal"] < bias["ray"] - 0.1
    assert 0.88 <= np.mean(covered) <= 0.99


@pytest.mark.parametrize("seen_from", [None, (0.0, 0.0, 3000.0)])
@pytest.mark.parametrize("held", [None, 50.0])
def test_robust_fit_is_that_of_its_readable_form(seen_from, held):
    for seed in range(5):
        points = contaminated(np.random.default_rng(seed))
        scanner = None if seen_from is None else np.broadcast_to(seen_from, points.shape)
        start = Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE)
        fit = robust_fit(points, start, 1.0, held, scanner)
        expected = robust_sphere.fit(points, np.append(start.centre, held or start.radius), 1.0, held is None, scanner)
        assert fit.converged
        np.testing.assert_allclose([*fit.sphere.centre, fit.sphere.radius], expected.state, atol=1e-8)
        assert fit.scale == pytest.approx(expected.scale, rel=1e-9)
        np.testing.assert_array_equal(fit.inliers, expected.inliers)


def test_robust_fit_of_too_few_points_is_none():
    points = cap(np.random.default_rng(14), 5)
    assert robust_fit(points, Sphere(np.zeros(3), 45.0, NOWHERE), 1.0) is None


# --- the search ----------------------------------------------------------------------------------------------------


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
    order = np.argsort([one.fit.sphere.radius for one in found])
    np.testing.assert_allclose([found[i].fit.sphere.radius for i in order], [40.0, 50.0, 72.5], atol=0.2)
    np.testing.assert_allclose([found[i].fit.sphere.centre for i in order], centres[[2, 0, 1]], atol=0.2)
    assert found[order[1]].fit.inliers[:700].mean() > 0.95
    assert found[order[1]].fit.inliers[700:].mean() < 0.01
    shuffled = rng.permutation(len(points))
    again = find_balls(points[shuffled], np.random.default_rng(0), most=10)
    np.testing.assert_allclose(
        [one.fit.sphere.centre for one in again], [one.fit.sphere.centre for one in found], atol=1e-9
    )


def plane(rng, sigma):
    return np.column_stack([rng.uniform(-300.0, 300.0, (4000, 2)), rng.normal(0.0, sigma, 4000)])


def tube(rng, sigma, length=600.0):
    turn, r = rng.uniform(0.0, np.pi, 4000), 30.0 + rng.normal(0.0, sigma, 4000)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), rng.uniform(0.0, length, 4000)])


def box_corner(rng, sigma):
    points = np.column_stack([rng.uniform(0.0, 300.0, (4000, 2)), np.zeros(4000)])
    for i in range(4000):
        points[i] = np.roll(points[i], i % 3)
    return points + rng.normal(0.0, sigma, (4000, 3))


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
@pytest.mark.parametrize("seed", [0, 1])
def test_search_invents_no_ball(shape, seed):
    points = NO_BALLS[shape](np.random.default_rng(seed))
    assert find_balls(points, np.random.default_rng(seed), most=10) == []


CENTRES = {"near": (2500.0, 600.0, -200.0), "far": (-1800.0, 2700.0, 100.0), "low": (400.0, -2600.0, -350.0)}


@pytest.mark.parametrize("radius", [None, 300.0])
@pytest.mark.parametrize("place", CENTRES)
def test_a_ball_of_a_hundredth_of_a_street_is_found(place, radius):
    centre = np.array(CENTRES[place])
    points, on = street_clouds.street(np.random.default_rng(len(place)), centre, 300.0)
    assert 200 <= on.sum() < 0.02 * len(points)
    (one,) = find_balls(points, np.random.default_rng(0), most=10, radius_mm=radius)
    assert np.linalg.norm(one.fit.sphere.centre - centre) < 10.0
    assert one.fit.sphere.radius == pytest.approx(300.0, abs=10.0)
    assert one.fit.inliers[on].mean() > 0.9


@pytest.mark.parametrize("radius", [None, 300.0])
def test_a_ball_in_four_lines_of_a_scanner_is_found(radius):
    """A tenth of the points of the ball lies on one line, and has no normal."""
    centre, rays = np.array([2900.0, 700.0, -250.0]), street_clouds.lines(np.linspace(-25.0, 15.0, 16), 0.2)
    points, on = street_clouds.street(np.random.default_rng(0), centre, 300.0, sigma=4.0, rays=rays)
    assert len(np.unique(np.round(np.degrees(np.arcsin(points[on, 2] / np.linalg.norm(points[on], axis=1))), 1))) <= 5
    (one,) = find_balls(points, np.random.default_rng(0), most=10, radius_mm=radius)
    assert np.linalg.norm(one.fit.sphere.centre - centre) < 10.0


def test_a_street_without_a_ball_has_none():
    points, _ = street_clouds.street(np.random.default_rng(4), None, 300.0)
    assert find_balls(points, np.random.default_rng(0), most=10) == []
    assert find_balls(points, np.random.default_rng(0), most=10, radius_mm=300.0) == []


# --- crops ---------------------------------------------------------------------------------------------------------


def test_crops_agree_with_every_distance():
    rng = np.random.default_rng(17)
    points, centres = rng.uniform(0.0, 1000.0, (3000, 3)), rng.uniform(0.0, 1000.0, (12, 3))
    reaches = rng.uniform(100.0, 250.0, 12)
    distance = np.linalg.norm(points[:, None] - centres, axis=2)
    nearest = distance.argmin(axis=1)
    crops = nearest_crops(points, centres, reaches)
    for i, rows in enumerate(crops):
        expected = np.flatnonzero((nearest == i) & (distance[:, i] <= reaches[i]))
        np.testing.assert_array_equal(rows, expected)
    assert sum(map(len, crops)) > 100
    assert [len(rows) for rows in nearest_crops(np.empty((0, 3)), centres, reaches)] == [0] * 12


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
