"""Clouds of frames by closed forms: points on tubes, sleeves and balls as scanners see them, noise along the ray."""

from dataclasses import dataclass

import numpy as np


def across(direction):
    """Two unit vectors across a unit vector."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    return side, np.cross(direction, side)


def seen(points, normals, scanner, sigma, rng, least_cos=0.05):
    """Of points with outward normals those that face the scanner, moved along their rays by normal noise."""
    ray = points - scanner
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    cos = -np.einsum("ij,ij->i", ray, normals)
    kept = (cos > least_cos) & (rng.random(len(points)) < cos)  # a grid of rays meets a surface so densely
    return points[kept] + sigma * rng.standard_normal(int(kept.sum()))[:, None] * ray[kept]


def tube(a, b, radius, count, scanner, sigma, rng, bow=(0.0, 0.0), end_radius=None):
    """Points of a tube (or of a cone) from a to b, bowed as a parabola by ``bow`` at its middle."""
    length = np.linalg.norm(b - a)
    u = (b - a) / length
    side, other = across(u)
    q, angle = rng.random(count), rng.uniform(0.0, 2.0 * np.pi, count)
    normal = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    r = radius if end_radius is None else radius + (end_radius - radius) * q
    bend = (4.0 * q * (1.0 - q))[:, None] * (bow[0] * side + bow[1] * other)
    points = a + (q * length)[:, None] * u + np.broadcast_to(r, count)[:, None] * normal + bend
    return seen(points, normal, scanner, sigma, rng)


def ball(centre, radius, count, scanner, sigma, rng):
    """Points of a sphere."""
    normal = rng.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return seen(centre + radius * normal, normal, scanner, sigma, rng)


@dataclass
class Frame:
    """A square-on-square grid: nodes (k, 3), members (m, 2)."""

    nodes: np.ndarray
    members: np.ndarray


def grid(nx=4, ny=3, spacing=2500.0, depth=1600.0, height=5000.0, rng=None):
    """Two layers of a frame; nodes are moved by some mm where there is a generator."""
    lower = {(i, j): k for k, (i, j) in enumerate(np.ndindex(nx, ny))}
    upper = {(i, j): len(lower) + k for k, (i, j) in enumerate(np.ndindex(nx - 1, ny - 1))}
    nodes = np.array(
        [[i * spacing, j * spacing, height] for i, j in lower]
        + [[(i + 0.5) * spacing, (j + 0.5) * spacing, height + depth] for i, j in upper]
    )
    members = []
    for layer in (lower, upper):
        for (i, j), k in layer.items():
            members += [(k, layer[n]) for n in ((i + 1, j), (i, j + 1)) if n in layer]
    for (i, j), k in upper.items():
        members += [(lower[n], k) for n in ((i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1))]
    if rng is not None:
        nodes = nodes + 5.0 * rng.standard_normal(nodes.shape)
    return Frame(nodes, np.array(members))


STATIONS = np.array(
    [[800.0, 600.0, 1600.0], [6500.0, 700.0, 1600.0], [3000.0, 4800.0, 1600.0], [7000.0, 5000.0, 1600.0]]
)


def scanned(
    frame, rng, sigma=2.0, per_tube=400, radius=30.0, ball_radius=55.0, bow_share=0.0, stations=STATIONS, moved=None
):
    """Points and stations of a frame with balls, sleeves, cones and tubes; ``moved`` (s, 3) are errors of stations."""
    clouds, owner = [], []
    bows = [
        rng.uniform(0.0, bow_share) * np.array([np.cos(t), np.sin(t)]) for t in rng.uniform(0, 6.28, len(frame.members))
    ]
    for s, scanner in enumerate(stations):
        parts = [ball(c, ball_radius, per_tube // 8, scanner, sigma, rng) for c in frame.nodes]
        for (i, j), share in zip(frame.members, bows, strict=True):
            a, b = frame.nodes[i], frame.nodes[j]
            length = np.linalg.norm(b - a)
            u = (b - a) / length
            ends = []
            for start, out in ((a, u), (b, -u)):
                flat, sleeve = start + (ball_radius - 5.0) * out, start + (ball_radius + 30.0) * out
                parts.append(tube(flat, sleeve, 18.0, per_tube // 50, scanner, sigma, rng))
                ends.append(start + (ball_radius + 80.0) * out)
                parts.append(tube(sleeve, ends[-1], 22.0, per_tube // 30, scanner, sigma, rng, end_radius=radius))
            tube_length = length - 2.0 * (ball_radius + 80.0)
            parts.append(tube(*ends, radius, per_tube, scanner, sigma, rng, bow=share * tube_length))
        cloud = np.concatenate(parts)
        clouds.append(cloud + (0.0 if moved is None else moved[s]))
        owner.append(np.full(len(cloud), s, np.int32))
    return np.concatenate(clouds), np.concatenate(owner)
