"""Faults of a design's mesh: facets that point inward, which are turned, and open edges, which are counted.

The side of a deviation is that of the facets' normals: of a mesh that is inside out every dent would be a bulge.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from processor.distinct_rows import distinct_points
from processor.model import Bools, DesignFaults, Floats, Ints

JOIN_SHARE = 1e-9  # of the mesh's size: vertices nearer to each other are one, as STL repeats them


def mended(vertices: Floats, faces: Ints) -> tuple[Ints, DesignFaults | None]:
    """Return the facets (f, 3) of a mesh with outward normals, and what was wrong with them; None for nothing.

    Facets that touch are one part. Parts that are closed and enclose a negative volume are turned, unless they lie
    within another part: they are its cavity. Within a part, facets that contradict their neighbours are turned first.
    """
    joined = _joined(vertices, faces)
    kept = (joined != np.roll(joined, 1, axis=1)).all(axis=1)  # others have no area
    start, end = joined[kept].ravel(), np.roll(joined[kept], -1, axis=1).ravel()
    facet = np.repeat(np.flatnonzero(kept), 3)
    count = int(joined.max(initial=0)) + 1
    forward = start < end
    _, edge, uses = np.unique(
        np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    edge = edge.reshape(-1)
    parts, of_vertex = connected_components(
        coo_array((np.ones(len(start), np.int8), (start, end)), (count, count)), directed=False
    )
    of_facet = of_vertex[joined[:, 0]]
    turned = np.zeros(len(faces), np.bool_)
    # Two facets that pass their edge the same way have opposite normals.
    if (np.bincount(edge, np.where(forward, 1.0, -1.0))[uses == 2] != 0.0).any():
        turned = _against_neighbours(facet, edge, forward, uses, of_facet)
    open_ = uses == 1
    holed = np.zeros(parts, np.bool_)
    holed[of_facet[facet[open_[edge]]]] = True
    mended_faces = np.where(turned[:, None], faces[:, ::-1], faces)
    inside_out = _inside_out(vertices, mended_faces, of_facet, parts) & ~holed
    turned ^= inside_out[of_facet]
    if not turned.any() and not open_.any():
        return faces, None
    found = DesignFaults(turned=int(turned.sum()), open_edges=int(open_.sum()), open_parts=int(holed.sum()))
    return np.where(turned[:, None], faces[:, ::-1], faces), found


def _joined(vertices: Floats, faces: Ints) -> Ints:
    """Return the facets by numbers of distinct vertices."""
    size = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    grid = np.round(vertices / max(JOIN_SHARE * size, 1e-300))
    joined: Ints = distinct_points(grid)[1][faces]
    return joined


def _against_neighbours(facet: Ints, edge: Ints, forward: Bools, uses: Ints, of_facet: Ints) -> Bools:
    """Mark the facets (f,) to turn so that those of each part agree: the smaller share of a part.

    ``facet`` (3f,) has the ``edge`` (3f,), and passes it ``forward`` or backward. Facets are nodes of a graph twice, as
    they are and turned; each edge of two facets connects what agrees. Of a surface with one side nothing is turned.
    """
    order = np.argsort(edge, kind="stable")
    order = order[uses[edge[order]] == 2]
    a, b = order[::2], order[1::2]
    count = len(of_facet)
    against = (forward[a] == forward[b]).astype(np.int64) * count
    rows = np.concatenate([facet[a], facet[a] + count])
    columns = np.concatenate([facet[b] + against, (facet[b] + count + against) % (2 * count)])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), (2 * count, 2 * count))
    side = connected_components(graph, directed=False)[1]
    one_sided = side[:count] == side[count:]
    first = np.unique(of_facet, return_index=True)[1]
    turned = (side[:count] != side[first][of_facet]) & ~one_sided
    share = np.bincount(of_facet, turned) / np.bincount(of_facet)
    result: Bools = turned ^ ((share > 0.5)[of_facet] & ~one_sided)
    return result


def _inside_out(vertices: Floats, faces: Ints, of_facet: Ints, parts: int) -> Bools:
    """Mark the parts (p,) with a negative volume that lie within no other part's box."""
    corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
    volume = np.bincount(of_facet, np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])), parts)
    low, high = np.full((parts, 3), np.inf), np.full((parts, 3), -np.inf)
    for k in range(3):
        np.minimum.at(low, of_facet, corners[:, k])
        np.maximum.at(high, of_facet, corners[:, k])
    inward: Bools = volume < 0.0
    hosts = np.flatnonzero(volume > 0.0)
    for part in np.flatnonzero(inward).tolist():
        within = (low[hosts] < low[part]).all(axis=1) & (high[hosts] > high[part]).all(axis=1)
        inward[part] = not within.any()
    return inward
