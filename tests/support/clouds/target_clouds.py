"""Clouds of targets, made without designgen: patterns seen through the beam's footprint by brute force."""

import numpy as np

WHITE, BLACK = 0.9, 0.06


def checkerboard(u, v, half, border=15.0):
    """Reflectance of the pattern at (u, v) about its centre, mm; NaN off the board."""
    inside = (np.abs(u) < half) & (np.abs(v) < half)
    colour = np.where(inside & (u * v > 0.0), BLACK, WHITE)
    return np.where(np.maximum(np.abs(u), np.abs(v)) < half + border, colour, np.nan)


def board(rng, distance=10_000.0, step=0.6e-3, side=150.0, tilt=0.3, noise=0.05, sigma=0.5, beam=3.25, wall=0.55):
    """A scan of a board on a wall: points (n, 3), intensities (n,) and the true centre (3,), scanner at the origin.

    The beam's energy is Gaussian with the radius ``beam`` (1/e^2): 64 places drawn from it are averaged for each ray.
    """
    turn, yaw = rng.uniform(-0.6, 0.6), rng.uniform(-tilt, tilt)
    azimuth0, elevation0 = rng.uniform(-np.pi, np.pi), rng.uniform(-0.2, 0.2)
    ahead = np.array([np.cos(elevation0) * np.cos(azimuth0), np.cos(elevation0) * np.sin(azimuth0), np.sin(elevation0)])
    side_way = np.array([-np.sin(azimuth0), np.cos(azimuth0), 0.0])
    normal = -(np.cos(yaw) * ahead + np.sin(yaw) * side_way)
    across = np.cross([0.0, 0.0, 1.0], normal)
    across /= np.linalg.norm(across)
    up = np.cross(normal, across)
    e1, e2 = np.cos(turn) * across + np.sin(turn) * up, -np.sin(turn) * across + np.cos(turn) * up
    centre = distance * ahead + rng.uniform(-1.0, 1.0) * e1
    reach = 2.2 * side / distance
    grid = np.arange(-reach, reach, step) + rng.uniform(0.0, step)
    da, de = (one.ravel() for one in np.meshgrid(grid / np.cos(elevation0), grid, indexing="ij"))
    azimuth, elevation = azimuth0 + da, elevation0 + de
    rays = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    ranges = (centre @ normal) / (rays @ normal)
    foot = rays * ranges[:, None] - centre
    signal = np.zeros(len(rays))
    for _ in range(64):
        du, dv = 0.5 * beam * rng.standard_normal((2, len(rays)))
        seen = checkerboard(foot @ e1 + du, foot @ e2 + dv, 0.5 * side)
        signal += np.where(np.isnan(seen), wall, seen) / 64.0
    signal *= np.maximum(1.0 + noise * rng.standard_normal(len(rays)), 0.0)
    points = rays * (ranges + sigma * rng.standard_normal(len(rays)))[:, None]
    return points, signal, centre
