"""Clouds of balls with round sleeves and tubes, cast ray by ray with numpy: what the tests of balls are made of."""

import numpy as np

from processor.space_frame.members.records import Members, Nodes
from tests.support.clouds.memory_source import InMemory

SLEEVE, TUBE, HOLE = 18.0, 30.0, 10.0
MEMBERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0.55, 0.55, 0.63], [-0.55, -0.55, 0.63]], float)
MEMBERS /= np.linalg.norm(MEMBERS, axis=1)[:, None]


def first_hit(origin, rays, centre, radius, sleeve=SLEEVE, members=MEMBERS, hole=HOLE):
    """Ranges (n,) of rays (n, 3) at a ball with its members; infinite where all is missed."""
    w = centre - origin
    along = rays @ w
    foot = w - along[:, None] * rays
    under = radius**2 - (foot**2).sum(1)
    t = np.where(under > 0, along - np.sqrt(np.maximum(under, 0)), np.inf)
    met = origin + np.where(np.isfinite(t), t, 0)[:, None] * rays - centre
    flat = sleeve + 1.0
    cut = (met[:, 2] < 0) & (np.hypot(met[:, 0], met[:, 1]) < hole)
    for unit in members:
        cut |= met @ unit > np.sqrt(radius**2 - flat**2)
    best = np.where(cut, np.inf, t)
    height = np.sqrt(radius**2 - flat**2)
    for unit in members:
        for low, high, r in ((height, height + 35.0, sleeve), (height + 85.0, 800.0, TUBE)):
            d = rays - (rays @ unit)[:, None] * unit
            o = (origin - centre) - ((origin - centre) @ unit) * unit
            a, b, c = (d**2).sum(1), d @ o, o @ o - r * r
            inside = b * b - a * c
            s = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
            x = (origin - centre) @ unit + np.where(np.isfinite(s), s, 0) * (rays @ unit)
            best = np.minimum(best, np.where((s > 0) & (x > low) & (x < high), s, np.inf))
    return best


def frame(rng, centres, radii, stations, step_mrad=1.2, sigma=2.0, node_sd=0.5, shifts=None, **kinds):
    """A cloud of balls seen from stations, and nodes and members as their axes would give them."""
    points, station = [], []
    for s, at in enumerate(stations):
        for centre, radius in zip(centres, radii, strict=True):
            to = centre - at
            far = np.linalg.norm(to)
            ahead = to / far
            side = np.cross(ahead, [0.0, 0.0, 1.0])
            side /= np.linalg.norm(side)
            up = np.cross(side, ahead)
            reach = 260.0 / far
            grid = np.arange(-reach, reach, 1e-3 * step_mrad) + rng.uniform(0, 1e-3 * step_mrad)
            a, b = (x.ravel() for x in np.meshgrid(grid, grid))
            rays = ahead + a[:, None] * side + b[:, None] * up
            rays /= np.linalg.norm(rays, axis=1)[:, None]
            t = first_hit(at, rays, centre, radius, **kinds)
            seen = np.isfinite(t)
            t = t[seen] + sigma * rng.standard_normal(seen.sum())
            shift = np.zeros(3) if shifts is None else shifts[s]
            points.append(at + shift + t[:, None] * rays[seen])
            station.append(np.full(seen.sum(), s, np.int32))
    source = InMemory(np.concatenate(points), np.concatenate(station), np.asarray(stations, float))
    k, units = len(centres), kinds.get("members", MEMBERS)
    positions = centres + rng.normal(0, node_sd, (k, 3)) if node_sd else centres
    nodes = Nodes(positions, np.tile(node_sd**2 * np.eye(3), (k, 1, 1)), np.full(k, len(units)), np.full(k, 0.5))
    m = len(units) * k
    axis, node = np.tile(units, (k, 1)), np.repeat(np.arange(k), len(units))
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=1)]) if m else np.empty((0, 3))
    side = side / np.linalg.norm(side, axis=1)[:, None] if m else side
    places = {"points": centres[node] + 500.0 * axis, "directions": axis, "side": side, "node_a": node}
    return source, nodes, tubes(m, 800.0, TUBE, **places, rms=np.full(m, 2.0))


def tubes(m, length, radius, **columns):
    """Straight tubes along x about the origin whose axes are known exactly, but for the columns that are given."""
    known = {
        "points": np.zeros((m, 3)), "directions": np.tile([1.0, 0.0, 0.0], (m, 1)),
        "side": np.tile([0.0, 1.0, 0.0], (m, 1)), "lengths": np.full(m, length), "radii": np.full(m, radius),
        "bow": np.zeros((m, 2)), "covariance": np.zeros((m, 5, 5)), "bow_covariance": np.zeros((m, 2, 2)),
        "node_a": np.zeros(m, int), "node_b": np.full(m, -1), "count": np.full(m, 100), "rms": np.zeros(m),
        "around": np.zeros((m, 24)),
    }  # fmt: skip
    return Members(**{**known, **columns})


def grid_of_balls(k, radii, height=6000.0):
    """Centres (k, 3) in rows of four, 3 m apart, and radii (k,) in turn."""
    centres = np.array([[3000.0 * (i % 4), 3000.0 * (i // 4), height + 40.0 * (i % 3)] for i in range(k)])
    return centres, np.resize(np.asarray(radii, float), k)
