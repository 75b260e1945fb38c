"""A row of plates as designed, seen by two stations; damage is a function of the place on the fronts."""

import numpy as np

from processor.model import Scan, Scene, StructureDesign

SIDE, THICK, GAP = 600.0, 12.0, 300.0
BOX_FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
     [2, 3, 7], [2, 7, 6], [1, 2, 6], [1, 6, 5], [0, 4, 7], [0, 7, 3]]
)  # fmt: skip


def box(low, high):
    """Vertices and outward faces of an upright box."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    corners = [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]]
    corners += [[x, y, z1] for x, y, _ in corners]
    return np.array(corners), BOX_FACES


def design_of(count):
    """A row of plates with their fronts in y = 0, looking to -y."""
    parts = [box((i * (SIDE + GAP), 0.0, 0.0), (i * (SIDE + GAP) + SIDE, THICK, SIDE)) for i in range(count)]
    faces = [own + 8 * i for i, (_, own) in enumerate(parts)]
    return StructureDesign("plates", np.vstack([corners for corners, _ in parts]), np.vstack(faces))


def scene_of(count, inward, missing=lambda x, z: x < -1e9, seed=1, sigma=0.4, clutter=None, spacing=8.0):
    """Scans of a row of plates from two stations; ``inward`` and ``missing`` are functions of x and z.

    ``clutter``: x, y, z and radius of a ball between the stations and the plates.
    """
    design = design_of(count)
    rng = np.random.default_rng(seed)
    width = count * (SIDE + GAP)
    scans = []
    for name, station in (("S1", (0.2 * width, -4000.0, 700.0)), ("S2", (0.8 * width, -4500.0, 800.0))):
        parts = []
        for i in range(count):
            n = int((SIDE / spacing) ** 2)
            x, z = i * (SIDE + GAP) + rng.uniform(0.0, SIDE, n), rng.uniform(0.0, SIDE, n)
            there = ~missing(x, z)
            parts.append(np.stack([x, inward(x, z), z], axis=1)[there])
        points = np.vstack(parts)
        ray = points - station
        away = np.linalg.norm(ray, axis=1)
        ray /= away[:, None]
        if clutter is not None:
            centre, radius = np.array(clutter[:3]) - station, clutter[3]
            along = ray @ centre
            hit = (centre @ centre - along**2 < radius**2) & (along > 0.0)
            away = np.where(hit, along - np.sqrt(np.maximum(radius**2 - centre @ centre + along**2, 0.0)), away)
        points = station + ray * (away + rng.normal(0.0, sigma, len(away)))[:, None]
        scans.append(Scan(name, points, position=np.array(station), T_project_scan=np.eye(4)))
    return Scene("plates", "structure", tuple(scans), structure=design)


def flat(x, z):
    return np.zeros(len(x))


def bump(depth, radius, at):
    return lambda x, z: depth * np.maximum(1.0 - ((x - at[0]) ** 2 + (z - at[1]) ** 2) / radius**2, 0.0) ** 2
