"""Tubes in a mesh: facets that turn about parallel edges, whatever else is fused with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.distinct_rows import components, rows_by_label
from processor.geometry import circle
from processor.model import Floats, Ints
from processor.scan_folder.shapes.body import Body

FLAT_COS = np.cos(np.radians(0.5))  # facets that turn less at an edge are one plane piece
TURN_COS = np.cos(np.radians(50.0))  # a tube has 8 sides or more, a hexagonal sleeve 6
PARALLEL = 2e-3  # rad: a cone's edges differ by more
FEWEST_EDGES = 6  # of eight that turn: one side may be hidden
FEWEST_FACETS = 12  # two triangles a side of six
ACROSS, ABOUT, AXIAL_COS = 1e-3, 0.3, 0.98  # mean squares of the normals along the axis and across; of an edge along it
ROUND = 5e-3  # of the radius: rms of the edges' distances from the axis
LEAST_TURN = np.pi  # of the directions of the edges about the axis


@dataclass(frozen=True)
class Tubes:
    """Ends (k, 2, 3) of the axes, mm, and radii (k,)."""

    ends: Floats
    radii: Floats


def find(body: Body) -> Tubes:
    """Find the cylinders of a mesh."""
    ends, sides = body.edges
    two = np.flatnonzero(sides[:, 0] >= 0)
    cosine = np.zeros(len(ends))
    cosine[two] = np.abs(np.einsum("ei,ei->e", body.normals[sides[two, 0]], body.normals[sides[two, 1]]))
    flat = two[cosine[two] > FLAT_COS]
    pieces = components(len(body.faces), *sides[flat].T)
    turning = two[(cosine[two] <= FLAT_COS) & (cosine[two] > TURN_COS)]
    ways = body.vertices[ends[turning, 1]] - body.vertices[ends[turning, 0]]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    axes, used = [], [np.empty(0, np.int64)]
    for rows in rows_by_label(_parallel(pieces[sides[turning]], ways)):
        one = _fitted(body.vertices[ends[turning[rows]]], ways[rows]) if len(rows) >= FEWEST_EDGES else None
        if one is not None:
            axes.append(one)
            used.append(sides[turning[rows]].reshape(-1))
    axes += _of_rounded(body, np.concatenate(used))
    return Tubes(np.array([axis for axis, _ in axes]).reshape(-1, 2, 3), np.array([radius for _, radius in axes]))


def _of_rounded(body: Body, used: Ints) -> list[tuple[Floats, float]]:
    """Return the cylinders among the faces without a facet in ``used`` (n,), whose normals turn about an axis.

    Where coordinates are rounded by more than a facet bulges, single edges are too uncertain: the whole face is used.
    """
    label, (count, _, square) = body.faces_between, body.normals_of_faces
    values, vectors = np.linalg.eigh(square)
    turns = (values[:, 0] < ACROSS) & (values[:, 1] > ABOUT) & (count >= FEWEST_FACETS)
    turns[label[used]] = False
    found = []
    for face in np.flatnonzero(turns).tolist():
        facets = body.faces[label == face]
        edges = body.vertices[facets[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
        ways = edges[:, 1] - edges[:, 0]
        lengths = np.linalg.norm(ways, axis=1)
        along = np.abs(ways @ vectors[face, :, 0]) > AXIAL_COS * lengths
        if along.sum() >= FEWEST_EDGES:
            one = _fitted(edges[along], ways[along] / lengths[along, None])
            found += [one] if one is not None else []
    return found


def _parallel(pieces: Ints, ways: Floats) -> Ints:
    """Return a number (n,) for each edge between plane pieces (n, 2): parallel edges of a piece have the same."""
    rows = np.repeat(np.arange(len(pieces)), 2)
    order = np.argsort(pieces.reshape(-1), kind="stable")
    of_piece, rows = pieces.reshape(-1)[order], rows[order]
    links = [np.empty((0, 2), np.int64)]
    step = 1
    while True:
        same = of_piece[step:] == of_piece[:-step]
        if not same.any() or step > 12:  # a side of a tube has few edges; planes of other bodies have many
            break
        a, b = rows[:-step][same], rows[step:][same]
        across = np.linalg.norm(np.cross(ways[a], ways[b]), axis=1)
        links.append(np.stack([a, b], axis=1)[across < PARALLEL])
        step += 1
    return components(len(pieces), *np.concatenate(links).T)


def _fitted(edges: Floats, ways: Floats) -> tuple[Floats, float] | None:
    """Return axis (2, 3) and radius of the cylinder through parallel edges (n, 2, 3); None where they lie on none."""
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    way = ways[lengths.argmax()]
    signs = np.where(ways @ way > 0, 1.0, -1.0)
    way = ((signs * lengths)[:, None] * ways).sum(axis=0)
    way /= np.linalg.norm(way)
    x = np.linalg.svd(way[None])[2][1:]
    middle = edges.mean(axis=(0, 1))
    flat = (edges.reshape(-1, 3) - middle) @ x.T
    fitted = circle.algebraic(flat)
    if fitted is None:
        return None
    centre, radius = fitted
    off = flat - centre
    if np.sqrt(((np.linalg.norm(off, axis=1) - radius) ** 2).mean()) > ROUND * radius:
        return None
    angles = np.sort(np.arctan2(off[:, 1], off[:, 0]))
    if 2.0 * np.pi - np.diff(angles, append=angles[0] + 2.0 * np.pi).max() < LEAST_TURN:
        return None
    along = (edges.reshape(-1, 3) - middle) @ way
    on_axis = middle + centre @ x
    return np.stack([on_axis + along.min() * way, on_axis + along.max() * way]), radius
