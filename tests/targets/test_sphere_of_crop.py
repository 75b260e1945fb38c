"""The sphere of a crop, among what it stands on and touches, and bodies that are none."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import processor
from processor.model import NORMAL_95, Status, reason
from processor.space_frame.spheres import search_without_design, sphere_detection
from processor.targets import sphere_of_crop

RADIUS = 60.0
SCANNER = np.array([0.0, 0.0, 12_000.0])


def directions(rng, count):
    """Unit vectors (count, 3), of a sphere alike in all directions."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def seen(rng, points, normals, noise):
    """Points (n, 3) whose surface faces the scanner, with noise along their rays."""
    ray = points - SCANNER
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    facing = np.einsum("ni,ni->n", ray, normals) < 0.0
    return points[facing] + rng.normal(0.0, noise, (np.count_nonzero(facing), 1)) * ray[facing]


def tube(rng, axis, radius, count, length=110.0):
    """Points and normals (n, 3) of a tube from the middle of the ball, without those within it."""
    across = np.linalg.svd(axis[None])[2][1:]
    turn, along = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, length, count)
    normals = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    points = radius * normals + along[:, None] * axis
    outside = np.linalg.norm(points, axis=1) > RADIUS
    return points[outside], normals[outside]


def ball_with_tubes(rng, noise, count=1500):
    """Points (n, 3) of a ball of a space frame and of four tubes, cut 25 mm beyond the ball."""
    normals = directions(rng, count)
    bodies = [(RADIUS * normals, normals), *(tube(rng, axis, 25.0, 500) for axis in directions(rng, 4))]
    points = np.vstack([seen(rng, *body, noise) for body in bodies])
    return points[np.linalg.norm(points, axis=1) < RADIUS + 25.0]


@pytest.mark.parametrize(
    ("scanner", "held", "noise"),
    [
        (SCANNER, None, 2.0),
        (None, RADIUS, 2.0),
        *(pytest.param(*one, 1.0, marks=pytest.mark.slow) for one in ((None, None), (SCANNER, RADIUS))),
    ],
)
def test_balls_with_tubes_are_found_and_their_intervals_hold(scanner, held, noise):
    """Of 20 intervals of 95 %, 16 or more hold in all but 3 of 1000 series, of 60 53 (binomial)."""
    found, inside, centres = 0, 0, 0
    for seed in range(20):
        fit = processor.fit_sphere(ball_with_tubes(np.random.default_rng(seed), noise), held, scanner)
        found += fit.status is Status.OK
        sd = np.sqrt(np.diag(fit.covariance))
        inside += held is not None or abs(fit.radius - RADIUS) < NORMAL_95 * sd[3]
        centres += np.count_nonzero(np.abs(fit.centre) < NORMAL_95 * sd[:3])
        assert fit.radius == held or held is None
        assert np.linalg.norm(fit.centre) < 0.05 * RADIUS  # far from every tube
    assert found >= 16
    assert inside >= 16
    assert centres >= 52


def test_a_ball_that_tubes_hide_for_the_most_part_is_as_exact_as_what_is_seen_of_it():
    """Mean errors of 12 centres: below twice those of the ball's points alone, of which most lie beside a tube."""
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        normals, axes = directions(rng, 500), directions(rng, 6)
        hidden = (normals @ axes.T > np.sqrt(1.0 - (35.0 / RADIUS) ** 2)).any(axis=1)
        ball = seen(rng, RADIUS * normals[~hidden], normals[~hidden], 2.0)
        tubes = [seen(rng, *tube(rng, axis, 35.0, 150), 2.0) for axis in axes]
        points = np.vstack([ball, *tubes])
        fit = processor.fit_sphere(points[np.linalg.norm(points, axis=1) < RADIUS + 20.0])
        alone = least_squares(lambda s, p=ball: np.linalg.norm(p - s[:3], axis=1) - s[3], [0.0, 0.0, 0.0, RADIUS]).x
        errors.append([np.linalg.norm(fit.centre), np.linalg.norm(alone[:3])])
    ours, least = np.mean(errors, axis=0)
    assert ours < 2.0 * least


def test_a_fit_uses_the_noise_of_the_points_and_not_the_width_of_its_band():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points = (RADIUS + rng.normal(0.0, 1.5, (1000, 1))) * directions(rng, 1000)
        scale = sphere_of_crop.find(points, 40, None, None).fit.scale
        # Of a ball alone all points agree: sd of a robust scale of 1000 points 4 %, four of them.
        assert scale == pytest.approx(1.5, rel=0.15)


def test_points_in_any_order_and_anywhere_give_one_sphere():
    rng = np.random.default_rng(3)
    points = np.round(ball_with_tubes(rng, 1.0), 3)
    one = processor.fit_sphere(points)
    other = processor.fit_sphere(points[rng.permutation(len(points))])
    assert (one.radius, one.points) == (pytest.approx(other.radius, abs=1e-9), other.points)  # float64
    far = np.array([4.0e8, 5.0e9, 3.0e5])
    moved = processor.fit_sphere(points + far)
    np.testing.assert_allclose(moved.centre - far, one.centre, atol=1e-4)  # float64 at 5000 km: 1e-6


@pytest.mark.parametrize(("wrong", "scanner"), [(-2.0, SCANNER), (1.0, None), (4.0, SCANNER), (4.0, None)])
def test_a_held_radius_that_the_points_have_not_is_stated_and_far_off_never_ok(scanner, wrong):
    """Scanners make spheres larger or smaller by some 0.5 mm: a difference of 1 mm is in the interval of the centre."""
    doubted = 0
    for seed in range(4):
        fit = processor.fit_sphere(ball_with_tubes(np.random.default_rng(seed), 1.0), RADIUS + wrong, scanner)
        assert abs(wrong) < 2.0 or fit.status is not Status.OK
        if fit.status is Status.FAILED:
            doubted += 1
            continue
        assert (fit.radius, fit.covariance[3, 3]) == (RADIUS + wrong, 0.0)
        assert (np.abs(fit.centre) < NORMAL_95 * np.sqrt(np.diag(fit.covariance))[:3]).all()
        for doubt in (one.values for one in fit.reasons if one.code == "spheres.other-radius"):
            doubted += 1
            assert abs(doubt["radius"] - RADIUS) < 3.0 * doubt["ci95"] / NORMAL_95  # 3 sd
            assert (doubt["held"], doubt["shift"] > 0.5) == (RADIUS + wrong, True)
    assert doubted >= 3


def test_few_points_give_no_sphere_and_the_reason():
    fit = processor.fit_sphere(RADIUS * directions(np.random.default_rng(0), 39))
    assert (fit.status, fit.reasons) == (Status.FAILED, (reason("spheres.too-few-for-ball", points=39, least=40),))


def flattened(rng, noise):
    normals = directions(rng, 6000)
    return seen(rng, RADIUS * normals * [1.0, 0.85, 1.0], normals, noise)


def cylinder(rng, noise, length=120.0):
    turn, along = rng.uniform(0.0, 2.0 * np.pi, 6000), rng.uniform(-0.5 * length, 0.5 * length, 6000)
    normals = np.column_stack([np.zeros(6000), np.cos(turn), np.sin(turn)])
    return seen(rng, RADIUS * normals + np.column_stack([along, np.zeros((6000, 2))]), normals, noise)


def short_cylinder(rng, noise):
    return cylinder(rng, noise, 40.0)


def corner(rng, noise):
    sides = [np.insert(rng.uniform(0.0, 100.0, (1000, 2)), axis, 0.0, axis=1) for axis in range(3)]
    return np.vstack(sides) + rng.normal(0.0, noise, (3000, 3))


def torus(rng, noise):
    ring, turn = rng.uniform(0.0, np.pi, 3000), rng.uniform(0.0, 2.0 * np.pi, 3000)
    out = np.column_stack([np.cos(ring), np.sin(ring), np.zeros(3000)])
    normals = np.cos(turn)[:, None] * out + np.sin(turn)[:, None] * [0.0, 0.0, 1.0]
    return seen(rng, 70.0 * out + 40.0 * normals, normals, noise)


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 5), marks=pytest.mark.slow)], ids=["one", "more"])
@pytest.mark.parametrize("noise", [pytest.param(0.5, marks=pytest.mark.slow), 2.0])
@pytest.mark.parametrize("body", [flattened, cylinder, short_cylinder, corner, torus])
def test_other_bodies_are_no_sphere_without_a_doubt(body, noise, seeds):
    for seed in seeds:
        fit = processor.fit_sphere(body(np.random.default_rng(seed), noise))
        assert fit.status is not Status.OK
        assert fit.reasons


def test_a_volume_of_points_is_no_sphere():
    points = np.random.default_rng(0).uniform(-60.0, 60.0, (4_000, 3))
    assert processor.fit_sphere(points).status is Status.FAILED


def test_points_of_several_stations_have_a_position_each():
    rng = np.random.default_rng(9)
    points = seen(rng, RADIUS * (normals := directions(rng, 1500)), normals, 1.0)
    others = points * [1.0, 1.0, -1.0]
    stations = np.vstack([np.tile(SCANNER, (len(points), 1)), np.tile(-SCANNER, (len(points), 1))])
    fit = processor.fit_sphere(np.vstack([points, others]), scanner=stations)
    assert fit.status is Status.OK
    assert abs(fit.radius - RADIUS) < 0.3  # of 3000 points of 1 mm: sd 0.03, of a scanner of some tenths


def test_a_fit_that_fails_without_the_limb_is_a_doubt(monkeypatch):
    monkeypatch.setattr(search_without_design, "robust_fit", lambda *_: None)
    fit = processor.fit_sphere(ball_with_tubes(np.random.default_rng(0), 1.0), scanner=SCANNER, instrument="phase")
    assert (fit.status, fit.reasons) == (Status.WEAK, (reason("spheres.at-limb"),))


def test_a_likely_sphere_is_weak_and_states_why():
    fit = processor.fit_sphere(flattened(np.random.default_rng(1), 0.5))
    assert fit.status is Status.WEAK
    assert "spheres.not-only-sphere" in [one.code for one in fit.reasons]


def test_flat_surfaces_without_noise_do_not_make_a_sphere_rough(monkeypatch):
    """As of exact points beside a wall: a scale of rounding errors has no ratio to a noise of nothing."""
    monkeypatch.setattr(sphere_detection, "flat_noise", lambda *_: 0.0)
    fit = processor.fit_sphere(RADIUS * directions(np.random.default_rng(6), 1500))
    assert (fit.status, fit.radius) == (Status.OK, pytest.approx(RADIUS, abs=1e-6))  # of exact points


def test_noise_at_the_limb_does_not_show_a_wrong_scanner():
    rng = np.random.default_rng(7)
    normals = directions(rng, 2000)
    points = seen(rng, 35.0 * normals, normals, 1.7)
    turn = rng.uniform(0.0, 2.0 * np.pi, 100)
    beyond = 35.0 * np.column_stack([0.98 * np.cos(turn), 0.98 * np.sin(turn), np.full(100, -0.2)])  # one sd and a half
    fit = processor.fit_sphere(np.vstack([points, beyond]), scanner=SCANNER)
    assert fit.status is Status.OK
    assert abs(fit.radius - 35.0) < 1.0  # less than the noise of one point
