"""Points spread over triangle meshes, and areas and normals of the triangles."""

from __future__ import annotations

import numpy as np

from designgen.low_discrepancy import in_square
from designgen.models.model import ModelBody
from processor.model import Floats


def sample_surface(corners: Floats, count: int) -> tuple[Floats, Floats]:
    """Return points (count, 3) spread evenly over triangles (f, 3, 3), by their areas, and unit normals (count, 3).

    The points are those of a low-discrepancy sequence: the same every time.
    """
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    ends = np.cumsum(area)
    rows = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1])
    u, v = in_square(np.arange(count)).T
    root = np.sqrt(u)[:, None]
    a, b, c = (corners[rows, i] for i in range(3))
    points = (1.0 - root) * a + root * ((1.0 - v)[:, None] * b + v[:, None] * c)
    return points, across[rows] / area[rows, None]


def triangle_areas(body: ModelBody) -> Floats:
    """Return the areas (f,) of a body's triangles, mm^2."""
    a, b, c = np.moveaxis(body.vertices[body.triangles], 1, 0)
    areas: Floats = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def triangle_normals(body: ModelBody) -> Floats:
    """Return the unit normals (f, 3) of a body's triangles."""
    a, b, c = np.moveaxis(body.vertices[body.triangles], 1, 0)
    normals: Floats = np.cross(b - a, c - a) / np.maximum(2.0 * triangle_areas(body), 1e-300)[:, None]
    return normals
