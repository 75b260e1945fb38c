"""Balls in a mesh: facets whose neighbours lie on one sphere with them, however much is cut off or fused with it.

The corners of two facets at an edge determine a sphere. On a ball these spheres are the same from edge to edge. On a
tube or a cone they are, too, between two rings of corners, but there an edge has hardly a neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import components, rows_by_label
from processor.model import Floats, Ints
from processor.scan_folder.shapes.body import Body, Mask

SPAN = 0.62  # largest radius of a facet's circle by the sphere's: an icosahedron has 0.607
SAME = 0.03  # of the radius: spheres of neighbouring edges that differ less in centre and radius are one
FEWEST_EDGES = 6  # 1.5 times the four that determine a sphere
NET = 1.3  # least number of edges by their ends: 2 to 3 on a ball, 1 or 0.5 between two rings of a cone
ON_SPHERE = 2e-3  # of the radius: distance of a corner from the sphere that it is on
SURE_RESIDUAL = 1e-3  # of the radius, rms
SURE_COVER = 0.15  # of the sphere's area: a fillet or a domed cap covers less
LEAST_COVER = 0.05  # of the sphere's area: a ball with less left of it is a fillet
THIN = 0.03  # of the radius: least thickness of what is there of a ball
TURNING, FEWEST_FACETS = 0.02, 24  # least variance of a ball's normals in any direction; a sphere has 0.33
RADIAL, LOOSE = 0.95, 0.01  # cosine of its normals from the radius; rms by the radius
FLATTEST = 1e-5  # volume of four corners by the cube of their size


@dataclass(frozen=True)
class Balls:
    """Centres (k, 3) and radii (k,) in mm, the share (k,) of each sphere that is there, and the rms (k,) in mm."""

    centres: Floats
    radii: Floats
    cover: Floats
    rms: Floats

    @property
    def sure(self) -> Mask:
        """Whether each (k,) is a ball beyond doubt."""
        return np.asarray((self.cover >= SURE_COVER) & (self.rms <= SURE_RESIDUAL * self.radii))


def find(body: Body) -> Balls:
    """Find the balls of a mesh, each once: of concentric spheres the outer one."""
    ends, edges, centres, radii = _spheres_of_edges(body)
    used = list[Ints]()
    found = []
    for rows in rows_by_label(_alike(edges, centres, radii)):
        if len(rows) >= FEWEST_EDGES and len(rows) > NET * len(np.unique(ends[rows])):
            ball = _fitted(
                body, np.unique(edges[rows]), np.median(centres[rows], axis=0), float(np.median(radii[rows]))
            )
            if ball is not None:
                found.append(ball)
                used.append(edges[rows].reshape(-1))
    found += _of_rounded(body, np.concatenate([np.empty(0, np.int64), *used]))
    return _each_once(np.array(found).reshape(-1, 7))


def _spheres_of_edges(body: Body) -> tuple[Ints, Ints, Floats, Floats]:
    """Return ends (n, 2) and facets (n, 2) of edges, and centre (n, 3) and radius (n,) of the spheres through both."""
    ends, sides = body.edges
    two = sides[:, 0] >= 0
    ends, sides = ends[two], sides[two]
    across = [body.faces[sides[:, k]].sum(axis=1) - ends.sum(axis=1) for k in (0, 1)]
    a, b, c, d = (body.vertices[rows] for rows in (ends[:, 0], ends[:, 1], *across))
    p, q, r = b - a, c - a, d - a
    normal = np.cross(p, q)
    volume = np.einsum("ni,ni->n", normal, r)
    size = np.max([np.linalg.norm(x, axis=1) for x in (p, q, r)], axis=0)
    solid = np.abs(volume) > FLATTEST * size**3
    ends, sides, a, p, q, r, volume = ends[solid], sides[solid], a[solid], p[solid], q[solid], r[solid], volume[solid]
    squared = [np.einsum("ni,ni->n", x, x)[:, None] for x in (p, q, r)]
    off = squared[0] * np.cross(q, r) + squared[1] * np.cross(r, p) + squared[2] * np.cross(p, q)
    off /= 2.0 * volume[:, None]
    radii = np.linalg.norm(off, axis=1)
    # The distance of a facet's plane from the centre gives the radius of its circle.
    span = np.zeros(len(off))
    for k in (0, 1):
        corner = body.vertices[body.faces[sides[:, k], 0]]
        away = np.abs(np.einsum("ni,ni->n", a + off - corner, body.normals[sides[:, k]]))
        span = np.maximum(span, np.sqrt(np.maximum(radii**2 - away**2, 0.0)))
    small = span <= SPAN * radii
    return ends[small], sides[small], (a + off)[small], radii[small]


def _alike(edges: Ints, centres: Floats, radii: Floats) -> Ints:
    """Return a number (n,) for each edge: edges of one facet whose spheres are alike have the same."""
    facets, rows = edges.reshape(-1), np.repeat(np.arange(len(edges)), 2)
    order = np.argsort(facets, kind="stable")
    facets, rows = facets[order], rows[order]
    links = []
    for step in (1, 2):  # a facet has three edges at most
        same = facets[step:] == facets[:-step]
        links.append(np.stack([rows[:-step][same], rows[step:][same]], axis=1))
    a, b = np.concatenate(links).T
    limit = SAME * np.minimum(radii[a], radii[b])
    alike = (np.linalg.norm(centres[a] - centres[b], axis=1) < limit) & (np.abs(radii[a] - radii[b]) < limit)
    return components(len(edges), a[alike], b[alike])


def _of_rounded(body: Body, used: Ints) -> list[list[float]]:
    """Return the spheres among the faces without a facet in ``used`` (n,), whose normals turn in all directions.

    Where coordinates are rounded by more than a facet bulges, single edges are too uncertain: the whole face is used.
    """
    label, (count, mean, square) = body.faces_between, body.normals_of_faces
    round_ = np.linalg.eigvalsh(square - mean[:, :, None] * mean[:, None])[:, 0] > TURNING
    round_ &= count >= FEWEST_FACETS
    round_[label[used]] = False
    found = []
    for face in np.flatnonzero(round_).tolist():
        facets = np.flatnonzero(label == face)
        points = body.vertices[np.unique(body.faces[facets])]
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        ball = _fitted(body, facets, centre, float(np.median(np.linalg.norm(points - centre, axis=1))))
        if ball is not None and _radial(body, facets, np.array(ball[:3])) > RADIAL and ball[5] < LOOSE * ball[3]:
            found.append(ball)
    return found


def _radial(body: Body, facets: Ints, centre: Floats) -> float:
    """Return the median cosine between the normals of facets (n,) and their directions from a centre (3,)."""
    ways = body.vertices[body.faces[facets]].mean(axis=1) - centre
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return float(np.median(np.abs(np.einsum("ni,ni->n", ways, body.normals[facets]))))


def _fitted(body: Body, facets: Ints, centre: Floats, radius: float) -> list[float] | None:
    """Return centre, radius, cover, rms and first facet of the sphere of facets (n,), by least squares; else None."""
    for _ in range(3):
        corners = body.vertices[body.faces[facets]]
        off = np.abs(np.linalg.norm(corners - centre, axis=2) - radius).max(axis=1)
        facets = facets[off < max(10.0 * ON_SPHERE * radius, 3.0 * float(np.median(off)))]
        points = body.vertices[np.unique(body.faces[facets])] - centre
        # All on one circle they are on many spheres.
        if len(points) < 5 or _thickness(points) < THIN * radius:
            return None
        unknown = np.linalg.lstsq(
            np.column_stack([2.0 * points, np.ones(len(points))]), (points**2).sum(axis=1), rcond=None
        )[0]
        square = unknown[3] + unknown[:3] @ unknown[:3]
        if square <= 0.0:
            return None
        centre, radius = centre + unknown[:3], float(np.sqrt(square))
    residual = np.linalg.norm(points - unknown[:3], axis=1) - radius
    cover = float(body.areas[facets].sum() / (4.0 * np.pi * radius**2))
    if cover < LEAST_COVER:
        return None
    return [*centre.tolist(), radius, cover, float(np.sqrt((residual**2).mean())), float(facets.min())]


def _thickness(points: Floats) -> float:
    """Return the least extent of points (n, 3) along their principal axes."""
    centred = points - points.mean(axis=0)
    return float(np.ptp(centred @ np.linalg.eigh(centred.T @ centred)[1][:, 0]))


def _each_once(found: Floats) -> Balls:
    """Return found spheres (n, 7) in the order of their first facets; one within another's radius is part of it."""
    order = np.argsort(-found[:, 3] * np.sqrt(found[:, 4]), kind="stable")
    left = np.ones(len(found), bool)
    kept = []
    tree = cKDTree(found[:, :3]) if len(found) else None
    for row in order:
        if not left[row] or tree is None:
            continue
        near = tree.query_ball_point(found[row, :3], found[row, 3])
        same = [k for k in near if left[k] and abs(found[k, 3] - found[row, 3]) < SAME * found[row, 3]]
        found[row, 4] = min(1.0, found[same, 4].sum())
        left[near] = False
        kept.append(row)
    balls = found[sorted(kept, key=lambda row: float(found[row, 6]))]
    return Balls(balls[:, :3], balls[:, 3], balls[:, 4], rms=balls[:, 5])
