"""The ray fit of balls against the Cramér-Rao bound, by Monte Carlo: no prior, the radius free, noise along the ray.

    python -m tests.bench.spheres.ball_fit [--draws 1000] [--seeds 3] [--likelihood]

A ball is seen from one station or from three; each ray meets a cap of the given share of the sphere, and rays are
spread evenly over the cap's outline as a scanner spreads them. Printed: error rms over bound of centre, radius and
lowest point, the radius's bias, pull rms and the share of 95 % intervals that hold. Bounds are those of the true ball
from the rays that the method admits, of incidence cosine 0.15 or more. The paper's algebraic fit of the same points
stands beside, and with --likelihood, of centre and radius, what the likeliest ball of the admitted rays reaches: found
by another library from the true ball on, told which rays are admitted. Where that misses the bound, so must any fit.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.optimize import least_squares

from processor.geometry.sphere import algebraic
from processor.space_frame import ball_catalogue
from processor.space_frame.members.records import Members, Nodes
from processor.space_frame.points.sphere_crops import Crops
from processor.space_frame.spheres import alternating_fit

DOWN = np.array([0.0, 0.0, 1.0, -1.0])
STATIONS = {
    1: np.array([[2000.0, 1000.0, -8000.0]]),
    3: np.array([[2000.0, 1000.0, -8000.0], [-9000.0, 500.0, -5000.0], [4000.0, -9000.0, -6000.0]]),
}


def draw(rng, radius, count, visible, sigma, stations):
    """Points (count, 3) of a ball about the origin and their stations, with the information (4, 4) they hold."""
    points, station, information = np.empty((count, 3)), np.sort(np.arange(count) % len(stations)), np.zeros((4, 4))
    least = 1.0 - 2.0 * visible  # cosine of the cap's half angle
    for i in range(count):
        to = -stations[station[i]]
        ahead = to / np.linalg.norm(to)
        side = np.cross(ahead, [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        off = radius * np.sqrt((1.0 - least**2) * rng.uniform())
        turn = rng.uniform(0.0, 2.0 * np.pi)
        foot = off * (np.cos(turn) * side + np.sin(turn) * np.cross(ahead, side))
        u = foot + to
        u /= np.linalg.norm(u)
        w = foot - (foot @ u) * u
        root = np.sqrt(radius**2 - w @ w)
        met = w - root * u
        J = np.append(-met / (-met @ u), -radius / root)  # of the model's range, by centre and radius
        if root >= 0.15 * radius:
            information += np.outer(J, J) / sigma**2
        points[i] = met + sigma * rng.standard_normal() * u
    return points, station, information


def trial(rng, draws, radius, count, visible, sigma, several, prior=None, likelihood=False):
    """Fit many draws at once; returns errors (n, 4), covariances, bounds (n, 4, 4), algebraic and likeliest errors."""
    stations = STATIONS[several]
    found = [draw(rng, radius, count, visible, sigma, stations) for _ in range(draws)]
    points = np.concatenate([p for p, _, _ in found])
    station = np.concatenate([s for _, s, _ in found]).astype(np.int32)
    crops = Crops(np.arange(draws + 1) * count, points, station)
    start = rng.normal(0.0, 0.5, (draws, 3))
    covariance = np.full((draws, 3, 3), np.nan) if prior is None else np.tile(prior**2 * np.eye(3), (draws, 1, 1))
    moved = Crops(crops.start, points - np.repeat(start, count, axis=0), station)
    nodes = Nodes(start, covariance, np.zeros(draws, np.int64), np.full(draws, np.nan))
    params = alternating_fit.RayFitParams(sigma_mm=2.0, process_hole_mm=0.0)
    got = alternating_fit.fit_crops(
        moved, stations, nodes, Members(), ball_catalogue.of_radii([]), None, np.zeros((len(stations), 3, 3)), params
    )
    errors = np.column_stack([got.centres, got.radii - radius])
    plain = []
    for p, _, _ in found:
        sphere = algebraic(p)
        plain.append(np.full(4, np.nan) if sphere is None else np.append(sphere.centre, sphere.radius - radius))
    best = np.full((draws, 4), np.nan)
    if likelihood:
        best = np.array([likeliest(p, stations[s], radius) for p, s, _ in found])
    return errors, got.covariance, np.linalg.inv(np.array([n for _, _, n in found])), np.array(plain), best


def likeliest(points, seen, radius):
    """Error (4,) of the likeliest ball of the rays admitted at the true one."""
    away = np.linalg.norm(points - seen, axis=1)
    u = (points - seen) / away[:, None]

    def half_chord(ball):
        along = ((ball[:3] - seen) * u).sum(1)
        return along, ball[3] ** 2 - ((ball[:3] - seen) ** 2).sum(1) + along**2

    admitted = half_chord(np.array([0.0, 0.0, 0.0, radius]))[1] >= (0.15 * radius) ** 2

    def residuals(ball):
        along, square = half_chord(ball)
        return (away - along + np.sqrt(np.maximum(square, 1e-6)))[admitted]

    return least_squares(residuals, [0.0, 0.0, 0.0, radius]).x - [0.0, 0.0, 0.0, radius]


def ratios(errors, bounds):
    """Error rms over bound of centre, radius and lowest point."""
    centre = np.sqrt((errors[:, :3] ** 2).sum(1).mean() / np.einsum("kii->k", bounds[:, :3, :3]).mean())
    radius = np.sqrt((errors[:, 3] ** 2).mean() / bounds[:, 3, 3].mean())
    lowest = np.sqrt(((errors @ DOWN) ** 2).mean() / np.einsum("i,kij,j->k", DOWN, bounds, DOWN).mean())
    return centre, radius, lowest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--likelihood", action="store_true")
    options = parser.parse_args()
    print("   r visible   n sigma st | rms/bound c     r   low | bias r  sd r | pull c    r  low | in 95 % | algebraic")
    for radius in (45.0, 150.0):
        for visible in (0.1, 0.25, 0.45):
            for count in (30, 60, 200):
                for sigma in (1.0, 2.0):
                    for several in (1, 3):
                        for seed in range(options.seeds):
                            case = (radius, count, visible, sigma, several)
                            row(np.random.default_rng(seed), options.draws, *case, options.likelihood)


def row(rng, draws, radius, count, visible, sigma, several, likelihood):
    errors, covariance, bounds, plain, best = trial(
        rng, draws, radius, count, visible, sigma, several, likelihood=likelihood
    )
    fitted = np.isfinite(errors).all(axis=1)
    e, C, B = errors[fitted], covariance[fitted], bounds[fitted]
    c, r, low = ratios(e, B)
    sd = np.sqrt(np.einsum("kii->ki", C))
    low_pull = (e @ DOWN) / np.sqrt(np.einsum("i,kij,j->k", DOWN, C, DOWN))
    pulls = np.sqrt(np.mean((e / sd) ** 2, axis=0))
    inside = np.mean(np.abs(low_pull) < 1.96)
    print(
        f"{radius:4.0f} {visible:7.0%} {count:3d} {sigma:5.1f} {several:2d} |       {c:5.3f} {r:5.3f} {low:5.3f} |"
        f" {e[:, 3].mean():+6.3f} {np.sqrt(B[:, 3, 3].mean()):5.2f} |"
        f" {np.sqrt((pulls[:3] ** 2).mean()):6.3f} {pulls[3]:4.2f} {np.sqrt(np.mean(low_pull**2)):4.2f} |"
        f" {inside:7.1%} | {ratios(plain, bounds)[0]:5.2f}"
        + (" | likeliest {:5.3f} {:5.3f}".format(*ratios(best, bounds)[:2]) if likelihood else "")
        + ("" if fitted.all() else f" ({(~fitted).sum()} not fitted)")
    )


if __name__ == "__main__":
    main()
