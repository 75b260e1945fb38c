"""Points on tubes as stations see them, by numpy alone: what tests of the stations' self-registration work on."""

from dataclasses import dataclass

import numpy as np

from processor.space_frame.stations.records import TubePoints


def turn(w):
    """Rotation by the matrix exponential's series: shares nothing with the code it is the oracle of."""
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.eye(3) + K + K @ K / 2.0 + K @ K @ K / 6.0


def roof(nx, ny, spacing=3000.0, depth=2100.0, height=6000.0):
    """Nodes of a double layer and the tubes' ends (m, 2, 3), 150 mm from the nodes."""
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    low = np.stack([i * spacing, j * spacing, np.full(i.shape, height)], axis=-1).astype(float)
    i, j = np.meshgrid(np.arange(nx - 1) + 0.5, np.arange(ny - 1) + 0.5, indexing="ij")
    high = np.stack([i * spacing, j * spacing, np.full(i.shape, height + depth)], axis=-1)
    pairs = []
    for layer in (low, high):
        pairs += [(layer[:-1], layer[1:]), (layer[:, :-1], layer[:, 1:])]
    pairs += [(low[a : a + nx - 1, b : b + ny - 1], high) for a in (0, 1) for b in (0, 1)]
    ends = np.concatenate([np.stack([a.reshape(-1, 3), b.reshape(-1, 3)], axis=1) for a, b in pairs])
    unit = ends[:, 1] - ends[:, 0]
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    ends[:, 0] += 150.0 * unit
    ends[:, 1] -= 150.0 * unit
    return np.vstack([low.reshape(-1, 3), high.reshape(-1, 3)]), ends


@dataclass
class Seen:
    """The points as registered, the true motions x (s, 6) that registered them wrongly, and what is true."""

    points: TubePoints
    ends: np.ndarray
    scanners: np.ndarray  # as registered
    motions: np.ndarray  # (s, 6), T_registered_true
    places: np.ndarray  # where the scanners truly stood
    radius: float


def scan(
    ends, places, rng, *, shift_mm=2.0, turn_rad=5e-5, sigma=2.0, radius=30.0, per_pair=20, reach=30_000.0, bow=0.0,
    off_mm=0.0, outliers=0.0,
):  # fmt: skip
    """Scan tubes from places (s, 3): points on the side that a station sees, noise along the ray."""
    motions = np.hstack(
        [turn_rad * rng.standard_normal((len(places), 3)), shift_mm * rng.standard_normal((len(places), 3))]
    )
    points, station, start = [], [], [0]
    for a, b in ends:
        unit, length = (b - a) / np.linalg.norm(b - a), np.linalg.norm(b - a)
        e1 = np.cross(unit, [0.3, 0.5, 0.9])
        e1 /= np.linalg.norm(e1)
        e2 = np.cross(unit, e1)
        bend = bow * length * rng.uniform(-1.0, 1.0) * e1
        count = 0
        for s, place in enumerate(places):
            if np.linalg.norm(0.5 * (a + b) - place) > reach:
                continue
            z, phi = rng.uniform(0.0, length, per_pair), rng.uniform(0.0, 2.0 * np.pi, per_pair)
            n = np.cos(phi)[:, None] * e1 + np.sin(phi)[:, None] * e2
            x = a + z[:, None] * unit + (4.0 * z * (length - z) / length**2)[:, None] * bend + radius * n
            x += off_mm * (rng.standard_normal() * e1 + rng.standard_normal() * e2)
            ray = x - place
            far = np.linalg.norm(ray, axis=1)
            seen = np.einsum("ni,ni->n", ray, n) / far < -0.05
            x = (x + sigma * rng.standard_normal((per_pair, 1)) * ray / far[:, None])[seen]
            stray = rng.uniform(size=len(x)) < outliers
            x[stray] += rng.uniform(4.0, 40.0, (stray.sum(), 1)) * (ray / far[:, None])[seen][stray]
            R = turn(motions[s, :3])
            points.append((x - place) @ R.T + place + motions[s, 3:])
            station.append(np.full(len(x), s))
            count += len(x)
        start.append(start[-1] + count)
    cloud = TubePoints(np.concatenate(points), np.concatenate(station).astype(np.int32), np.array(start))
    return Seen(cloud, ends, places + motions[:, 3:], motions, places, radius)
