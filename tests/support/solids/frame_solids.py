"""Meshes of the balls and tubes of a small space frame, made with trimesh."""

import numpy as np
import trimesh

DIAMETERS = (60.0, 76.0, 89.0)


def frame(seed=0, cells=2):
    """Centres (k, 3), radii (k,), members (m, 2) and diameters (m,) of a grid of two layers, nodes moved a little."""
    rng = np.random.default_rng(seed)
    lower = [(i, j, 0.0) for i in range(cells + 1) for j in range(cells + 1)]
    upper = [(i + 0.5, j + 0.5, 0.7) for i in range(cells) for j in range(cells)]
    grid = np.array(lower + upper)
    far = np.linalg.norm(grid[:, None] - grid, axis=2)
    members = np.argwhere(np.triu((far < 1.05) & (far > 0.0)))
    centres = grid * 2400.0 + rng.uniform(-60.0, 60.0, grid.shape) + [20_000.0, -3_000.0, 8_000.0]
    return centres, rng.choice([48.0, 60.0, 75.0], len(grid)), members, rng.choice(DIAMETERS, len(members))


def lathe(profile, start, along, sides=24):
    """The surface that a profile (n, 2) of distances along and from an axis makes around it."""
    along = along / np.linalg.norm(along)
    x = np.cross(along, [0.31, 0.62, 0.72])
    x /= np.linalg.norm(x)
    y = np.cross(along, x)
    angle = 2.0 * np.pi * np.arange(sides) / sides
    rings = [start + a * along + r * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y) for a, r in profile]
    k, after = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = []
    for i in range(len(profile) - 1):
        a, b = i * sides, (i + 1) * sides
        faces += [*np.stack([k + a, after + a, after + b], axis=1), *np.stack([k + a, after + b, k + b], axis=1)]
    return np.vstack(rings), np.array(faces)


def ball(centre, radius, finer=3):
    """A geodesic sphere, its corners on it."""
    mesh = trimesh.creation.icosphere(subdivisions=finer, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def solids(seed=0, cells=2, hollow=False):
    """Name and mesh of each ball, tube, cone and sleeve, and the frame's centres, radii, members and diameters."""
    centres, radii, members, diameters = truth = frame(seed, cells)
    bodies = [(f"ball {k}", *ball(c, r)) for k, (c, r) in enumerate(zip(centres, radii, strict=True))]
    for m, ((a, b), d) in enumerate(zip(members, diameters, strict=True)):
        way = centres[b] - centres[a]
        length = np.linalg.norm(way)
        ends = [radii[a], length - radii[b]]
        tube = [(ends[0] + 100.0, d / 2), (ends[1] - 100.0, d / 2)]
        if hollow:
            tube = [*tube, (tube[1][0], d / 2 - 4.0), (tube[0][0], d / 2 - 4.0), tube[0]]
        bodies.append((f"tube {m}", *lathe(tube, centres[a], way)))
        for start, out in ((centres[a] + ends[0] * way / length, way), (centres[a] + ends[1] * way / length, -way)):
            bodies.append((f"sleeve {m}", *lathe([(0.0, 0.0), (0.0, 18.0), (40.0, 18.0), (40.0, 0.0)], start, out, 6)))
            cone = [(40.0, 0.0), (40.0, 22.0), (70.0, 11.0 + d / 4), (100.0, d / 2), (100.0, 0.0)]
            bodies.append((f"cone {m}", *lathe(cone, start, out)))
    return bodies, truth


def joined(bodies):
    """The meshes of bodies as one."""
    first = np.cumsum([0, *(len(vertices) for _, vertices, _ in bodies)])
    faces = [faces + k for (_, _, faces), k in zip(bodies, first, strict=False)]
    return np.vstack([vertices for _, vertices, _ in bodies]), np.vstack(faces)
