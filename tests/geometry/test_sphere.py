"""Spheres by algebraic least squares, consensus and the robust fit, against closed forms and SciPy; their crops."""

import math

import numpy as np
import pytest

from processor.geometry.nearest_neighbours import nearest_crops
from processor.geometry.sphere import (
    Sphere,
    algebraic,
    ransac,
    through_four,
    trials_needed,
    visible_fraction,
)
from processor.geometry.sphere_fit import robust_fit
from tests.support.solids import robust_sphere
from tests.support.solids.robust_sphere import cap

NOWHERE = np.zeros((4, 4))
ROUNDING_MM = 1e-8  # float64 of squares of a metre, by the condition of a cap: 1e6 * 1e-16 * 100
UTM_MM = 2e-6  # 4.3e9 mm is stored in steps of 4.8e-7 mm: the input itself moves by that
UTM = np.array([500_000_000.0, 4_300_000_000.0, 50_000.0])


def rotation(rng):
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))


# --- algebraic least squares and the four-point solve --------------------------------------------------------------


def test_algebraic_solves_the_papers_system():
    rng = np.random.default_rng(1)
    points = cap(rng, 300) + rng.normal(0.0, 2.0, (300, 3))
    A = np.column_stack([-2.0 * points, np.ones(300)])
    solution = np.linalg.lstsq(A, -np.sum(points**2, axis=1), rcond=None)[0]
    found = algebraic(points)
    np.testing.assert_allclose(found.centre, solution[:3], atol=ROUNDING_MM)
    assert found.radius == pytest.approx(math.sqrt(solution[:3] @ solution[:3] - solution[3]), abs=ROUNDING_MM)


def test_algebraic_moves_with_its_points_also_to_georeferenced_coordinates():
    rng = np.random.default_rng(3)
    points = cap(rng, 100) + rng.normal(0.0, 1.0, (100, 3))
    R, t = rotation(rng), np.array([1000.0, 2000.0, -3000.0])
    here, there, far = algebraic(points), algebraic(points @ R.T + t), algebraic(np.round(points, 3) + UTM)
    np.testing.assert_allclose(there.centre, R @ here.centre + t, atol=ROUNDING_MM)
    np.testing.assert_allclose(there.covariance[:3, :3], R @ here.covariance[:3, :3] @ R.T, atol=ROUNDING_MM)
    here = algebraic(np.round(points, 3))
    np.testing.assert_allclose([*(far.centre - UTM), far.radius], [*here.centre, here.radius], atol=UTM_MM)


def test_formal_covariance_is_the_scatter_on_a_whole_sphere():
    rng = np.random.default_rng(4)
    # A standard deviation of 400 is known to 3.5 %, three of them and a half.
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
    assert np.mean(radii) == pytest.approx(expected, abs=4.0 * np.std(radii) / math.sqrt(300))  # standard errors


def test_spheres_through_four_points():
    # (1,2,3) +- 5 along x, + 5 along y and along z: centre (1,2,3), radius 5
    quad = np.array([[6.0, 2.0, 3.0], [-4.0, 2.0, 3.0], [1.0, 7.0, 3.0], [1.0, 2.0, 8.0]])
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    skew = np.random.default_rng(6).normal(size=(50, 4, 3))
    centres, radii = through_four(np.array([quad, flat, *skew]))
    np.testing.assert_allclose([*centres[0], radii[0]], [1.0, 2.0, 3.0, 5.0], atol=1e-12)  # float64
    assert np.isnan([*centres[1], radii[1]]).all()
    for points, centre, radius in zip(skew, centres[2:], radii[2:], strict=True):
        A = 2.0 * (points[1:] - points[0])
        expected = np.linalg.solve(A, np.sum(points[1:] ** 2, axis=1) - np.sum(points[0] ** 2))
        # The flattest of fifty fours of points has a condition of some thousands.
        np.testing.assert_allclose(centre, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), radius, rtol=1e-6)


def test_visible_fraction_of_a_half_and_of_a_tenth():
    rng = np.random.default_rng(7)  # the lowest of 20,000 even heights is known to 1 / 20,000
    assert visible_fraction(cap(rng, 20_000, share=0.5) + 9.0, np.full(3, 9.0)) == pytest.approx(0.5, abs=0.001)
    assert visible_fraction(cap(rng, 20_000, share=0.1, view=(0, 0, -1)), np.zeros(3)) == pytest.approx(0.1, abs=0.001)
    assert visible_fraction(np.empty((0, 3)), np.zeros(3)) == 0.0


# --- RANSAC --------------------------------------------------------------------------------------------------------


def test_trials_needed():
    # w = 1/2: log(0.01) / log(15/16) = 4.60517 / 0.0645385
    assert trials_needed(0.99, 0.5) == pytest.approx(71.3554, abs=1e-3)  # the figures by hand
    assert trials_needed(0.99, 1.0) == 1.0
    assert trials_needed(0.99, 0.0) == math.inf


def test_ransac_leaves_a_tube_out():
    rng = np.random.default_rng(8)
    ball = cap(rng, 200) + rng.normal(0.0, 0.2, (200, 3))
    turn, along = rng.uniform(0.0, 2.0 * np.pi, 100), rng.uniform(55.0, 65.0, 100)
    tube = np.column_stack([along, 19.0 * np.cos(turn), 19.0 * np.sin(turn)])
    points = np.vstack([ball, tube])
    for seed in range(3):  # 0.2 mm by 200 points, on the share that consents
        found = ransac(points, np.random.default_rng(seed), tau_mm=1.0)
        assert found.sphere.radius == pytest.approx(45.0, abs=0.3)
        assert np.linalg.norm(found.sphere.centre) < 0.3
        assert found.inliers[200:].sum() < 5
        assert 1 <= found.trials <= math.ceil(found.needed)
    assert abs(algebraic(points).radius - 45.0) > 3.0  # a third of the points


def test_ransac_does_not_depend_on_the_order_of_the_points():
    rng = np.random.default_rng(9)
    points = np.vstack([cap(rng, 150) + rng.normal(0.0, 2.0, (150, 3)), rng.uniform(-65.0, 65.0, (80, 3))])
    order = rng.permutation(len(points))
    here = ransac(points, np.random.default_rng(1))
    there = ransac(points[order], np.random.default_rng(1))
    np.testing.assert_array_equal(there.inliers, here.inliers[order])
    np.testing.assert_allclose(there.sphere.centre, here.sphere.centre, atol=1e-9)  # sums in another order


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
    # 0.15 mm by 400 points on half a ball: 0.02 mm a coordinate
    assert np.linalg.norm(fit.sphere.centre) < 0.06
    assert fit.sphere.radius == pytest.approx(50.0, abs=0.05)
    assert fit.scale == pytest.approx(0.15, rel=0.2)
    assert fit.inliers[400:].mean() < 0.05  # those at 50.5 to 50.7 mm of 50.5 to 80
    held = robust_fit(points, Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE), 1.0, radius_mm=50.0)
    assert held.sphere.radius == 50.0
    assert not held.sphere.covariance[3].any()


def test_robust_fit_does_not_depend_on_its_start_and_moves_with_its_points():
    rng = np.random.default_rng(12)
    points = contaminated(rng)
    here = robust_fit(points, Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE), 1.0).sphere
    other = robust_fit(points, Sphere(np.array([-0.3, 0.0, 0.4]), 49.7, NOWHERE), 1.0).sphere
    # Iterations end at steps of 1e-8 of the radius.
    np.testing.assert_allclose(other.centre, here.centre, atol=1e-6)
    R = rotation(rng)
    moved = robust_fit(points @ R.T + 1000.0, Sphere(np.full(3, 1000.2), 50.3, NOWHERE), 1.0).sphere
    np.testing.assert_allclose(moved.centre, R @ here.centre + 1000.0, atol=1e-6)  # as above
    there = robust_fit(points + UTM, Sphere(UTM, 50.0, NOWHERE), 1.0).sphere
    np.testing.assert_allclose([*(there.centre - UTM), there.radius], [*here.centre, here.radius], atol=UTM_MM)


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
    assert bias["orthogonal"] < bias["ray"] - 0.1  # of a quarter of a ball and 1 mm: some tenths
    assert 0.88 <= np.mean(covered) <= 0.99  # of 200: 95 % with a standard deviation of 1.5 %, and the biweight's scale


@pytest.mark.parametrize("seen_from", [None, (0.0, 0.0, 3000.0)])
@pytest.mark.parametrize("held", [None, 50.0])
def test_robust_fit_is_that_of_its_readable_form(seen_from, held):
    for seed in range(3):
        points = contaminated(np.random.default_rng(seed))
        scanner = None if seen_from is None else np.broadcast_to(seen_from, points.shape)
        start = Sphere(np.array([0.5, -0.5, 0.3]), 50.8, NOWHERE)
        fit = robust_fit(points, start, 1.0, held, scanner)
        expected = robust_sphere.fit(points, np.append(start.centre, held or start.radius), 1.0, held is None, scanner)
        assert fit.converged
        # Both end at steps below 1e-9 mm.
        np.testing.assert_allclose([*fit.sphere.centre, fit.sphere.radius], expected.state, atol=1e-8)
        assert fit.scale == pytest.approx(expected.scale, rel=1e-9)
        np.testing.assert_array_equal(fit.inliers, expected.inliers)


def test_robust_fit_of_too_few_points_is_none():
    points = cap(np.random.default_rng(14), 5)
    assert robust_fit(points, Sphere(np.zeros(3), 45.0, NOWHERE), 1.0) is None


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
