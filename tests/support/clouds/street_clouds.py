"""A street as a scanner with few lines sees it, cast ray by ray: ground, fronts, poles, a person, and a ball."""

import numpy as np

HEIGHT = 1800.0  # of the scanner


def lines(elevations_deg, step_deg):
    """Unit rays (n, 3) of a scanner whose lines have these elevations, and the line (n,) of each."""
    azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(0.0, 360.0, step_deg)), np.deg2rad(elevations_deg))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    return rays, np.repeat(np.arange(len(elevations_deg)), azimuth.shape[1])


def to_sphere(rays, centre, radius):
    """Ranges (n,) of a sphere; infinite where it is missed."""
    along = rays @ centre
    under = along**2 - centre @ centre + radius**2
    return np.where((under > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(under, 0.0)), np.inf)


def to_pole(rays, foot, radius, low, high):
    """Ranges (n,) of an upright cylinder."""
    a, b = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ foot
    under = b * b - a * (foot @ foot - radius**2)
    t = (b - np.sqrt(np.maximum(under, 0.0))) / a
    met = (under > 0.0) & (t > 0.0) & (t * rays[:, 2] > low) & (t * rays[:, 2] < high)
    return np.where(met, t, np.inf)


def street(rng, centre, radius, sigma=8.0, rays=None):
    """Points (n, 3) from the origin, and which lie on the ball; without a ball where ``centre`` is None."""
    rays, line = rays or lines(np.linspace(-15.0, 15.0, 16), 0.2)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[:, 2] < 0.0, -HEIGHT / rays[:, 2], np.inf)
        fronts = [side / rays[:, 1] for side in (8500.0, -9500.0)]
    fronts = [np.where((t > 0.0) & (np.clip(t, 0.0, 1e6) * rays[:, 2] < 6000.0), t, np.inf) for t in fronts]
    poles = [
        to_pole(rays, rng.uniform(3000.0, 9000.0, 2) * rng.choice([-1.0, 1.0], 2), r, -HEIGHT, 4000.0)
        for r in (60.0, 110.0, 180.0, 300.0)
    ]
    if centre is not None:
        person = centre[:2] * (1.0 + 100.0 / np.linalg.norm(centre[:2])) + [-centre[1] / 8.0, centre[0] / 8.0]
        poles += [
            to_pole(rays, person, 190.0, -HEIGHT + 800.0, -HEIGHT + 1500.0),
            to_pole(rays, centre[:2], 30.0, -HEIGHT, centre[2] - 0.9 * radius),
        ]
    ball = np.full(len(rays), np.inf) if centre is None else to_sphere(rays, centre, radius)
    t = np.min([ground, *fronts, *poles, ball], axis=0)
    seen = t < 60_000.0
    noise = rng.normal(0.0, sigma, len(t)) + rng.normal(0.0, 0.4 * sigma, line.max() + 1)[line]
    return (t + noise)[seen, None] * rays[seen], (t == ball)[seen]
