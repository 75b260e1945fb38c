"""The fit of one tube: against its bound, bows, cones, stations that are off, and rays that graze."""

import numpy as np
import pytest
from scipy.stats import chi2

from processor.space_frame.members import tube_fits
from processor.space_frame.members.cylinder_fit import Errors
from processor.space_frame.members.cylinder_model import NP, circle_along, extent_of, residual
from processor.space_frame.points import line_crops
from tests.support.clouds import frame_clouds

LENGTH = 2700.0
A = np.array([1000.0, 2000.0, 6000.0])
U = np.array([0.8, 0.36, 0.48])
STATIONS = np.array([[500.0, 500.0, 1500.0], [3500.0, 1000.0, 1500.0], [2500.0, 6000.0, 1500.0]])
BOW_SHARE = 0.001


def fitted(cloud, station, scanners=STATIONS, bow_share=BOW_SHARE, off_mm=0.0, variance=(0.0, 0.0), least_cos=None):
    """Rough and final fit of the tube from A along U, started ``off_mm`` off its axis."""
    middle, direction = (A + 0.5 * LENGTH * U + off_mm * frame_clouds.across(U)[0])[None], U[None]
    half = np.array([0.5 * LENGTH + 250.0])
    near = line_crops.corridors(middle, direction, -half, half, 120.0)
    gathered = line_crops.gather([(cloud, station)], 100.0, near, 8192)
    rough = tube_fits.rough(gathered, scanners, middle, direction, half - 450.0, half, (15.0, 110.0), 256, 1)
    cos = tube_fits.least_cosine(rough, 0.2) if least_cos is None else least_cos
    errors = Errors(bow_share, cos, *variance)
    return rough, tube_fits.refined(gathered, scanners, rough, half, (15.0, 110.0), 256, errors, 1)


def scan(rng, sigma=1.0, count=700, bow=(0.0, 0.0), moved=None, ends=True, stations=STATIONS):
    """Points and stations of a tube, with its cones, sleeves and balls."""
    clouds, owner = [], []
    for s, scanner in enumerate(stations):
        parts = [frame_clouds.tube(A, A + LENGTH * U, 30.0, count, scanner, sigma, rng, bow=bow)]
        for start, out in ((A, -U), (A + LENGTH * U, U)) if ends else ():
            thin = start + 50.0 * out
            parts.append(frame_clouds.tube(start, thin, 30.0, count // 20, scanner, sigma, rng, end_radius=22.0))
            parts.append(frame_clouds.tube(thin, thin + 35.0 * out, 18.0, count // 30, scanner, sigma, rng))
            parts.append(frame_clouds.ball(thin + 85.0 * out, 60.0, count // 8, scanner, sigma, rng))
        cloud = np.concatenate(parts) + (0.0 if moved is None else moved[s])
        clouds.append(cloud)
        owner.append(np.full(len(cloud), s, np.int32))
    return np.concatenate(clouds), np.concatenate(owner)


def at_ends(fit):
    """Across the tube, from the true ends to the line found (2 ends, 2), and the stated standard deviations."""
    found, sds = [], []
    side, other = fit.side[0], np.cross(fit.directions[0], fit.side[0])
    for true in (A, A + LENGTH * U):
        t = (true - fit.points[0]) @ fit.directions[0]
        gap = fit.points[0] + t * fit.directions[0] - true
        J = np.array([[1.0, 0.0, t, 0.0], [0.0, 1.0, 0.0, t]])
        found.append([gap @ side, gap @ other])
        sds.append(np.sqrt(np.diag(J @ fit.covariance[0, :4, :4] @ J.T)))
    return np.array(found), np.array(sds)


def ranges_to(p, h, start, rays):
    """Ranges at which rays (n, 3) from start (n, 3) meet a bowed cylinder, by bisection: shares no algebra."""
    p = np.asarray(p)

    def outside(t):
        x, y, z = (start + t[:, None] * rays).T
        s = z / h
        bend = 1.0 - s * s
        return np.hypot(x - p[0] - p[2] * s - p[5] * bend, y - p[1] - p[3] * s - p[6] * bend) - p[4]

    # From the point nearest to the z axis, which is inside, towards the scanner.
    flat = rays[:, :2] / np.einsum("ij,ij->i", rays[:, :2], rays[:, :2])[:, None]
    high = -np.einsum("ij,ij->i", start[:, :2], flat)
    low = high - 300.0
    good = (outside(high) < 0.0) & (outside(low) > 0.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        out = outside(middle) > 0.0
        low, high = np.where(out, middle, low), np.where(out, high, middle)
    return np.where(good, 0.5 * (low + high), np.nan)


def test_residual_is_the_range_measured_less_the_range_to_the_cylinder():
    rng = np.random.default_rng(1)
    h, p = 1300.0, np.array([0.4, -0.3, 1.2, 0.8, 30.0, 1.5, -0.7])
    for _ in range(20):
        start = np.array([[rng.uniform(-300, 300), -4000.0, rng.uniform(-2000, 2000)]])
        target = np.array([[rng.uniform(-20.0, 20.0), 0.0, rng.uniform(-1200, 1200)]])
        ray = (target - start) / np.linalg.norm(target - start)
        true = ranges_to(p, h, start, ray)[0]
        measured = true + rng.normal()
        J = np.empty(NP)
        got, cos = residual(p, h, *(start + measured * ray)[0], *ray[0], True, J)
        assert got == pytest.approx(measured - true, abs=1e-5)  # the axis's slope changes by 1e-6 over a mm
        assert 0.0 < cos < 1.0
        for k in range(NP):
            step = 0.01 * np.eye(NP)[k]
            slope = (ranges_to(p - step, h, start, ray) - ranges_to(p + step, h, start, ray))[0] / 0.02
            # The slope of the axis, 1e-3, is left out of the derivatives.
            assert J[k] == pytest.approx(slope, abs=5e-3 * max(1.0, abs(slope)))


def test_a_circle_along_a_line_is_that_of_its_points_whatever_lies_beside_it():
    """A leaning tube of exact points and strangers 75 mm from its axis on two of its sides."""
    h, true = 1000.0, np.array([0.3, -0.5, 2.0, -1.5, 30.0, 0.0, 0.0])
    z, turn = (grid.ravel() for grid in np.meshgrid(np.linspace(-h, h, 21), np.linspace(0.0, 2.0 * np.pi, 25)[1:]))
    strange = np.arange(len(z)) % 16 == 0
    turn[strange] = 0.5 * np.pi * (np.arange(strange.sum()) % 2)
    side = np.where(strange, 75.0, 30.0)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    P, p = np.column_stack([true[:2] + z[:, None] / h * true[2:4] + side, z]), np.zeros(NP)
    assert circle_along.py_func(P, -h, h, 100.0, p, h)
    np.testing.assert_allclose(p, true, atol=0.03)  # 2.5^3 / 30^2: the square of the lean is taken for its mean


def test_a_tube_extends_over_points_on_it_and_not_over_points_off_it():
    """A leaning tube by bins of 100 mm: points on it add 2, grazing rays far off it take 4, others nothing."""
    h, radius, p = 1000.0, 30.0, np.array([1.0, -2.0, 30.0, -40.0, 30.0, 0.0, 0.0])
    shift = np.array([0.5, -0.8])  # of the only station
    z = np.repeat(np.linspace(-950.0, 950.0, 20), 2)
    way = np.tile([1.0, -1.0], 20)
    axis = p[:2] + shift + z[:, None] / h * p[2:4]
    on = np.abs(z) < 600.0
    # Along the axis a ray meets no side: 10 mm off the tube it shows nothing, 13 mm off that there is none.
    off = np.where(on, 0.0, np.where(z > 0.0, 10.0, 13.0))
    side = np.where(on[:, None], [1.0, 0.0], [0.0, 1.0]) * way[:, None]
    ray = np.where(on[:, None], np.stack([-way, 0.0 * way, 0.0 * way], axis=1), [0.030, -0.040, 1.0])
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    P = np.column_stack([axis + (radius + off)[:, None] * side, z])
    bins = np.empty(20)
    seen = (P, ray, np.ones(40, bool), np.array([0, 40]))
    low, high = extent_of(p, h, seen, shift[None], 1.0, bins, 100.0)
    np.testing.assert_allclose(bins, [-8.0] * 4 + [4.0] * 12 + [0.0] * 4, atol=1e-9)  # float64
    assert (low, high) == (-600.0, 600.0)


def bound(cloud, station, sigma):
    """Cramer-Rao bound at both ends across the tube (2, 2), for noise along the rays and what the fit leaves out.

    That is rays that graze by a cosine below 0.2, what 0.4 mm of noise across the rays would hide, and the bow's prior.
    """
    side, other = frame_clouds.across(U)
    R, middle, h = np.stack([side, other, U]), A + 0.5 * LENGTH * U, 0.5 * LENGTH
    start = (STATIONS[station] - middle) @ R.T
    rays = (cloud - STATIONS[station]) @ R.T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    p = np.array([0.0, 0.0, 0.0, 0.0, 30.0, 0.0, 0.0])
    J = np.stack(
        [(ranges_to(p + d, h, start, rays) - ranges_to(p - d, h, start, rays)) / 0.02 for d in 0.01 * np.eye(NP)],
        axis=1,
    )
    cos = 1.0 / np.abs(J[:, 4])  # for dR / dr = -1 / cos
    kept = np.isfinite(J).all(axis=1) & (cos > 0.2)
    J, cos = J[kept], cos[kept]
    normal = (J.T / (sigma**2 + 0.4**2 * (1.0 / cos**2 - 1.0))) @ J
    normal[5:, 5:] += np.eye(2) / (0.5 * BOW_SHARE * LENGTH) ** 2
    C = np.linalg.inv(normal)
    return np.array([[np.sqrt(C[i, i] + 2 * e * C[i, i + 2] + C[i + 2, i + 2]) for i in (0, 1)] for e in (-1.0, 1.0)])


def test_fit_against_its_bound():
    rng = np.random.default_rng(2)
    runs, sigma = 150, 2.0
    pulls, ratios, radii = [], [], []
    for run in range(runs):
        cloud, station = scan(rng, sigma, count=150, ends=False)
        _, fine = fitted(cloud, station)
        assert fine.ok[0]
        errors, said = at_ends(fine)
        pulls.append(errors / said)
        radii.append(fine.radii[0])
        if run % 10 == 0:
            ratios.append(said.mean() / bound(cloud, station, sigma).mean())
    # 600 pulls, four by four of one run: their rms is known to some 5 %.
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.12)
    assert np.abs(np.mean(pulls, axis=0)).max() < 4.0 / np.sqrt(runs)  # four sds
    assert 0.97 < np.mean(ratios) < 1.06  # 8 mm are trimmed off either end
    assert np.mean(radii) == pytest.approx(30.0, abs=4.0 * np.std(radii) / np.sqrt(runs))  # four sds


def test_seen_from_one_side_there_is_no_bias():
    rng = np.random.default_rng(3)
    errors, radii = [], []
    for _ in range(60):
        cloud, station = scan(rng, 2.0, count=900, stations=STATIONS[:1])
        _, fine = fitted(cloud, station)
        errors.append(at_ends(fine)[0])
        radii.append(fine.radii[0])
    assert np.abs(np.mean(errors, axis=0)).max() < 4.0 * np.std(errors) / np.sqrt(60)  # four sds
    assert np.mean(radii) == pytest.approx(30.0, abs=0.06)  # 900 points of 2 mm and 60 fits: 0.02 mm


def test_cones_sleeves_and_balls_do_not_bend_the_axis():
    rng = np.random.default_rng(4)
    for _ in range(10):
        cloud, station = scan(rng, 1.0)
        _, fine = fitted(cloud, station, off_mm=20.0)
        errors, said = at_ends(fine)
        assert np.abs(errors / said).max() < 4.5  # of 40 numbers in ten fits 2.4 came
        # The cone begins at the tube's radius: it is as thick within the noise for some 10 mm at either end.
        assert fine.lengths[0] == pytest.approx(LENGTH, abs=40.0)
        assert np.abs((A + 0.5 * LENGTH * U - fine.points[0]) @ U) < 20.0


def test_the_covariance_of_a_bow_is_that_of_its_errors():
    size = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 3])
        bow = rng.normal(0.0, 1.2, 2)  # as the prior has it: a share of 0.001 of half the length
        cloud, station = scan(rng, 0.7, bow=bow)
        _, fine = fitted(cloud, station)
        side = fine.side[0]
        axes = np.stack([side, np.cross(fine.directions[0], side)])
        true = axes @ (np.array(bow) @ np.stack(frame_clouds.across(U)))
        error = fine.bow[0] - true
        size.append(error @ np.linalg.solve(fine.bow_covariance[0], error))
    # A sum of squares of 80 standard normal values; beyond these limits once in 1000 cases.
    low, high = chi2.ppf([0.0005, 0.9995], 80)
    assert low < np.sum(size) < high


@pytest.mark.parametrize("bow", [(2.7, 0.0), (-1.5, 2.0)])
def test_a_bow_is_found_and_the_ends_stay(bow):
    rng = np.random.default_rng(5)
    cloud, station = scan(rng, 0.5, bow=bow)
    _, fine = fitted(cloud, station)
    errors, said = at_ends(fine)
    assert np.abs(errors / said).max() < 4.5  # as above
    axes = np.stack([fine.side[0], np.cross(fine.directions[0], fine.side[0])])
    true = bow[0] * frame_clouds.across(U)[0] + bow[1] * frame_clouds.across(U)[1]
    # 2100 points of 0.5 mm, of which a share sees the bow: 0.05 mm.
    assert fine.bow[0] == pytest.approx(axes @ true, abs=0.2)
    # A model without bows is off at the ends by a third of it and more, and does not know.
    _, straight = fitted(cloud, station, bow_share=1e-6)
    assert np.abs(at_ends(straight)[0]).max() > 0.8


def test_covariance_of_a_tube_includes_station_shifts():
    rng = np.random.default_rng(6)
    excess, pulls, blind = np.zeros((2, 3)), [], []
    for _ in range(60):
        moved = rng.standard_normal((3, 3))
        cloud, station = scan(rng, 0.5, count=500, moved=moved)
        rough, fine = fitted(cloud, station, variance=(1.0, 0.0))
        excess += rough.scatter[0]
        errors, said = at_ends(fine)
        pulls.append(errors / said)
        blind.append(np.divide(*at_ends(fitted(cloud, station)[1])))
    sd = np.sqrt(excess[:, 0].sum() / excess[:, 1].sum())
    assert sd == pytest.approx(1.0, abs=0.25)  # 60 draws of three stations, two of six numbers used up by each fit
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.2
    assert np.sqrt(np.mean(np.square(blind))) > 3.0  # without it the covariance is wrong


def test_stations_without_errors_have_no_excess_scatter():
    rng = np.random.default_rng(7)
    excess = sum(fitted(*scan(rng, 1.0, count=500))[0].scatter[0] for _ in range(30))
    # The variance of a mean of 500 points of 1 mm is 0.002 mm2.
    assert excess[:, 0].sum() / excess[:, 1].sum() < 0.02


def test_a_wide_beam_spoils_grazing_rays_and_they_are_left_out():
    rng = np.random.default_rng(8)
    cloud, station = scan(rng, 0.5)
    middle = A + 0.5 * LENGTH * U
    ray = (cloud - STATIONS[station]) / np.linalg.norm(cloud - STATIONS[station], axis=1)[:, None]
    away = cloud - middle
    away -= np.outer(away @ U, U)
    cos = -np.einsum("ij,ij->i", away, ray) / np.linalg.norm(away, axis=1)
    spoilt = cloud + np.where(cos < 0.4, 4.0, 0.0)[:, None] * ray  # as the footprint's other part lies behind
    rough, fine = fitted(spoilt, station)
    assert tube_fits.least_cosine(rough, 0.2) == pytest.approx(0.4)
    assert tube_fits.least_cosine(fitted(cloud, station)[0], 0.2) == pytest.approx(0.2)
    assert fine.radii[0] == pytest.approx(30.0, abs=0.1)  # 0.02 mm by noise; the spoilt rays would add 1 mm


def test_too_few_points_or_no_tube_give_no_answer():
    rng = np.random.default_rng(9)
    cloud, station = scan(rng, 1.0)
    _, fine = fitted(cloud[:10], station[:10])
    assert not fine.ok[0]
    noise = A + 0.5 * LENGTH * U + rng.uniform(-100.0, 100.0, (2000, 3))
    _, fine = fitted(noise, np.zeros(2000, np.int32))
    assert not fine.ok[0]
