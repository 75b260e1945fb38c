"""Residuals, masks and the solution of one ball: numbers by hand, differences, Monte Carlo against the bound."""

import numpy as np
import pytest

from processor.adjustment import scanner_class_errors
from processor.geometry.sphere_fit import residual
from processor.model import reason
from processor.space_frame import ball_catalogue
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.points.sphere_crops import Crops
from processor.space_frame.result import Evidence, Flag
from processor.space_frame.spheres import alternating_fit, assessment
from processor.space_frame.spheres.ball_fit import (
    Observations,
    Prior,
    SphereMask,
    Unknowns,
    select,
    solve,
    weight,
)
from processor.space_frame.spheres.records import Spheres, StochasticModel
from processor.space_frame.spheres.stochastic_model import limb_cosine, noise_model, radius_offset
from tests.bench.spheres import ball_fit


def test_selection_depends_on_the_ray_and_not_on_the_noisy_point():
    """Rays that meet a member's flat, the process hole or the limb are left out, wherever along them the point is."""
    up = np.array([0.0, 0.0, 1.0])
    at = np.array([[0.0, 0.0], [12.0, 0.0], [20.0, 0.0], [49.8, 0.0], [60.0, 0.0], [0.0, 30.0]])
    for off in (-6.0, 0.0, 6.0):
        depth = np.sqrt(np.maximum(50.0**2 - (at**2).sum(1), 0.0))
        points = np.column_stack([at, off - depth])
        member = np.array([0.0, np.sin(0.65), -np.cos(0.65)])[None]  # its axis leaves the ball near (0, 30)
        chosen = np.zeros(len(at), np.uint8)
        state = np.array([0.0, 0.0, 0.0, 50.0])
        mask = SphereMask(np.zeros((1, 3)), member, np.array([15.0]), 15.0, 0.15)
        count = select(points, np.tile(up, (len(at), 1)), mask, state, 40.0, chosen)
        assert chosen.tolist() == [2, 2, 1, 0, 0, 2]
        assert count == 1


def test_weight_is_one_for_small_and_zero_for_large_residuals():
    assert [weight(t) for t in (0.0, -3.0, 4.5, 9.0)] == [1.0, 1.0, 0.0, 0.0]
    assert weight(3.75) == pytest.approx((1.0 - 0.25) ** 2)
    w = np.array([weight(x) for x in np.random.default_rng(2).standard_normal(10_000)])
    assert w.mean() > 0.998  # next to nothing of normal noise is lost


def test_covariance_with_station_shifts_is_that_of_the_joint_problem():
    """The ball's covariance with unknown shifts is that of the joint problem with the shifts as unknowns."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=(40, 3)) * [0.4, 0.4, 0.0] + [0.0, 0.0, 1.0]
    u /= np.linalg.norm(u, axis=1)[:, None]
    u[20:] = u[20:, [2, 1, 0]]
    foot = rng.normal(0, 15, (40, 3))
    foot -= (foot * u).sum(1)[:, None] * u
    points = foot - np.sqrt(50.0**2 - (foot**2).sum(1))[:, None] * u
    station = np.repeat([0, 1], 20).astype(np.int32)
    T = np.tile(4.0 * np.eye(3), (2, 1, 1))
    state, covariance = np.array([0.0, 0.0, 0.0, 50.0]), np.empty((4, 4))
    used = solve(
        Observations(points, u, np.full(40, 1e4), station), np.ones(40, np.uint8),
        StochasticModel(np.array([1.0, 0.0, 0.0]), T), 1.0, Prior(np.zeros((3, 3)), 50.0, 0.0),
        Unknowns(state, np.zeros((2, 3)), np.zeros((2, 3, 8))), 1e-9, 20, covariance,
    )  # fmt: skip
    assert used == 40
    J = np.zeros((40, 10))
    for i in range(40):
        J[i, :4] = residual(*points[i], *u[i], 0.0, 0.0, 0.0, 50.0)[2:]
        J[i, 4 + 3 * station[i] : 7 + 3 * station[i]] = J[i, :3]
    joint = J.T @ J + np.diag([0.0] * 4 + [0.25] * 6)
    # Rounding, and the tolerance of the solution.
    np.testing.assert_allclose(covariance, np.linalg.inv(joint)[:4, :4], rtol=1e-9)
    np.testing.assert_allclose(state, [0, 0, 0, 50.0], atol=1e-9)


@pytest.mark.parametrize(
    ("radius", "count", "visible", "sigma", "several"),
    [
        (45.0, 60, 0.25, 2.0, 3),
        (150.0, 30, 0.1, 1.0, 1),
        pytest.param(45.0, 200, 0.25, 2.0, 1, marks=pytest.mark.slow),
        pytest.param(45.0, 30, 0.25, 2.0, 1, marks=pytest.mark.slow),
    ],
)
def test_errors_reach_the_bound_and_intervals_cover(radius, count, visible, sigma, several):
    draws = 150 if several > 1 else 300  # each of several stations takes as long as one
    errors, covariance, bounds, *_ = ball_fit.trial(
        np.random.default_rng(7), draws, radius, count, visible, sigma, several
    )
    # Balls of free radii have the offset that scanners of the class may have, which these draws have not.
    covariance = covariance - scanner_class_errors.known().offset_mm ** 2 * np.outer(
        [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]
    )
    chance = 2.5 / np.sqrt(2.0 * draws)  # of an rms, beyond which one in a hundred falls
    # The biweight's efficiency of 0.95 makes 1.03; four draws gave 0.97 to 1.11.
    assert max(ball_fit.ratios(errors, bounds)) < 1.05 + chance
    sd = np.sqrt(np.einsum("kii->ki", covariance))
    pulls = np.sqrt(np.mean((errors / sd) ** 2, axis=0))
    # The noise is estimated from as few as 30 points: 5 % too wide, 10 % too narrow, and an rms's chance.
    assert (pulls > 0.95 - chance).all()
    assert (pulls < 1.10 + chance).all()
    lowest = errors @ ball_fit.DOWN / np.sqrt(np.einsum("i,kij,j->k", ball_fit.DOWN, covariance, ball_fit.DOWN))
    # A share of 300 draws scatters by 1.3 %, of 150 by 1.8 %.
    assert 0.92 < np.mean(np.abs(lowest) < 1.96) < 0.98
    if visible == 0.25:
        # 2.5 sds of the mean, and a bias that makes an rms of at least 0.25 mm larger by at most 2 %.
        assert abs(errors[:, 3].mean()) < 0.05 + 2.5 * errors[:, 3].std() / np.sqrt(draws)


def test_the_noise_is_read_from_residuals():
    rng = np.random.default_rng(8)
    c, R = rng.uniform(0.15, 1.0, 40_000), rng.uniform(4e3, 3e4, 40_000)
    variance = 0.25 + 2e-9 * R**2 / c + 0.1 * (1 - c**2) / c**2
    e = np.sqrt(variance) * rng.standard_normal(40_000)
    e[:2000] = -30.0  # stray
    noise, believed = noise_model(e, c, R, np.ones(40_000), np.array([4.0, 0.0, 0.0]))
    model = noise[0] + noise[1] * R**2 / c + noise[2] * (1 - c**2) / c**2
    assert believed == 40_000
    # A twentieth of strays raises a median of sizes by 6.2 %; 5.7 and 6.6 % came in two draws.
    assert np.median(np.abs(np.sqrt(model / variance) - 1.0)) < 0.08
    few, worth = noise_model(e[:20], c[:20], R[:20], np.ones(20), np.array([4.0, 0.0, 0.0]))
    assert few.tolist() == [4.0, 0.0, 0.0]
    assert worth < 20


def test_radius_without_rays_is_corrected_by_half_the_noise_bias():
    rng = np.random.default_rng(12)
    draws, count, radius, sigma = 150, 200, 45.0, 2.0
    normal = rng.standard_normal((draws * count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    most = sigma**2 / radius  # by which noise in all directions lengthens distances from the centre

    def radii(noise):
        points = radius * normal + noise
        crops = Crops(np.arange(draws + 1) * count, points, np.full(len(points), -1, np.int32))
        unfixed = np.full((draws, 3, 3), np.nan)
        nodes = Nodes(np.zeros((draws, 3)), unfixed, np.zeros(draws, np.int64), np.full(draws, np.nan))
        params = alternating_fit.RayFitParams(sigma_mm=2.0, process_hole_mm=0.0)
        found = alternating_fit.fit_crops(
            crops, np.empty((0, 3)), nodes, Members(), ball_catalogue.of_radii([]), params=params
        )
        return found.radii - radius, (found.covariance - found.views.covariance)[:, 3, 3]

    chance = 4.0 * sigma / np.sqrt(draws * count)
    off, variance = radii(rng.normal(0.0, sigma, (draws * count, 3)))
    assert off.mean() == pytest.approx(0.5 * most, abs=chance)
    # A median of 150 of a few per cent.
    assert np.median(variance) == pytest.approx(sigma**2 / count + most**2 / 12.0, rel=0.06)
    off, _ = radii(rng.normal(0.0, sigma, (draws * count, 1)) * normal)
    assert off.mean() == pytest.approx(-0.5 * most, abs=chance)


def test_the_limb_is_left_out_where_it_is_biased():
    rng = np.random.default_rng(9)
    c = rng.uniform(0.15, 1.0, 30_000)
    e = rng.standard_normal(30_000)
    ones = np.ones(30_000)
    unit = np.array([1.0, 0.0, 0.0])
    assert limb_cosine(e, c, ones, ones, unit, 0.15) == 0.15
    assert limb_cosine(np.where(c < 0.28, e - 0.5, e), c, ones, ones, unit, 0.15) == pytest.approx(0.35)


def seen_by_a_wide_beam(rng, radius, station, beam_mm, step_mm, sigma):
    """Points (n, 3) of a ball about the origin: a beam that it cuts returns the mean range of the part that is met."""
    ahead = -station / np.linalg.norm(station)
    side = np.cross(ahead, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(ahead, side)
    grid = np.arange(-radius - beam_mm, radius + beam_mm, step_mm) + rng.uniform(0.0, step_mm)
    feet = np.array([(a, b) for a in grid for b in grid])
    turn, off = 2.0 * np.pi * np.arange(60) * 0.618034, beam_mm * np.sqrt((np.arange(60) + 0.5) / 60.0)
    parts = feet[:, None] + np.column_stack([off * np.cos(turn), off * np.sin(turn)])
    under = radius**2 - (parts**2).sum(axis=2)
    met = under > 0.0
    kept = met.mean(axis=1) > 0.05
    depth = np.sqrt(np.where(met, under, 0.0))[kept].sum(axis=1) / met[kept].sum(axis=1)
    along = -depth + rng.normal(0.0, sigma, len(depth))
    rays = feet[kept, :1] * side + feet[kept, 1:] * up - station
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return feet[kept, :1] * side + feet[kept, 1:] * up + along[:, None] * rays


def test_a_beam_cut_at_the_limb_does_not_raise_the_size():
    """A beam of 8 mm makes a ball look wider by up to 8 mm, where the next size of the catalogue is 5 mm larger."""
    rng = np.random.default_rng(21)
    true = np.repeat([60.0, 65.0], 10)
    stations = 2.0 * ball_fit.STATIONS[3]
    views = [[seen_by_a_wide_beam(rng, r, s, 8.0, 8.0, 2.5) for s in stations] for r in true]
    start = np.cumsum([0, *(sum(map(len, of_ball)) for of_ball in views)])
    station = np.concatenate([np.full(len(view), i, np.int32) for of_ball in views for i, view in enumerate(of_ball)])
    crops = Crops(start, np.concatenate([view for of_ball in views for view in of_ball]), station)
    covariance = np.tile(0.7**2 * np.eye(3), (len(true), 1, 1))
    nodes = Nodes(rng.normal(0.0, 0.7, (len(true), 3)), covariance, np.full(len(true), 3), np.full(len(true), 0.5))
    moved = Crops(start, crops.points - np.repeat(nodes.positions, np.diff(start), axis=0), station)
    params = alternating_fit.RayFitParams(sigma_mm=2.5, process_hole_mm=0.0)
    catalogue = ball_catalogue.of_radii([50.0, 55.0, 60.0, 65.0, 70.0, 75.0])
    found = alternating_fit.fit_crops(moved, stations, nodes, Members(), catalogue, params=params)
    np.testing.assert_array_equal(found.sizes, true)


def test_an_offset_that_all_radii_share_is_found_with_its_standard_deviation():
    """Radii fused with a prior about their sizes: the mean of the fitted radii, by its standard deviation."""
    rng = np.random.default_rng(4)
    pulls = []
    for shared in (0.0, -0.25):
        for _ in range(200):
            sizes = rng.choice([45.0, 60.0, 80.0], 80)
            own = rng.uniform(0.1, 0.5, 80)
            points = sizes + shared + 0.3 * rng.standard_normal(80) + own * rng.standard_normal(80)
            weight = 1.0 / own**2 + 1.0 / 0.3**2
            fused = (points / own**2 + sizes / 0.3**2) / weight
            found, sd = radius_offset(fused, 1.0 / weight, sizes, 0.3, 0.3)
            pulls.append((found - shared) / sd)
    assert 0.88 < np.sqrt(np.mean(np.square(pulls))) < 1.12  # 400 draws: 3.5 %
    assert radius_offset(np.empty(0), np.empty(0), np.empty(0), 0.3, 0.3) == (0.0, np.inf)


def test_another_size_is_a_doubt_where_an_error_common_to_all_ranges_may_explain_it():
    names = "radii", "lowest_sd", "bound_lowest_sd", "visible_fraction", "rms", "scale", "margin", "nominal"
    names += "sizes", "second_sizes", "efficiency_centre", "efficiency_radius", "efficiency_lowest"
    numbers = dict.fromkeys(names, np.full(3, 0.3))
    counts = dict.fromkeys(("points", "stations", "axes"), np.full(3, 9))
    other = reason("spheres.other-size", size=65.0, nominal=60.0)
    spheres = Spheres(
        **numbers, **counts, centres=np.zeros((3, 3)), lowest=np.zeros((3, 3)), covariance=np.zeros((3, 4, 4)),
        bound=np.zeros((3, 4, 4)), noise=np.zeros(3), evidence=(Evidence.FUSED,) * 3,
        flag=(Flag.OK, Flag.WRONG_SIZE, Flag.WRONG_SIZE),
        reasons=((), (other,), (other,)),
    )  # fmt: skip
    common = np.zeros((3, 3, 3))
    common[:2, 2, 2] = 1.8**2
    found = assessment.with_shared_offset(spheres, common)
    assert found.flag == (Flag.LOW_CONFIDENCE, Flag.LOW_CONFIDENCE, Flag.WRONG_SIZE)
    assert [[one.code for one in row] for row in found.reasons] == [
        ["spheres.common-offset"],
        ["spheres.common-offset", "spheres.other-size"],
        ["spheres.other-size"],
    ]
