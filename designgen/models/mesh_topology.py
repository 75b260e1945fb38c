"""Edges and connected components of triangle meshes."""

from __future__ import annotations

import numpy as np

from processor.model import Ints


def edges_of(triangles: Ints) -> Ints:
    """Return the edges (3f, 2) of triangles (f, 3) in turn, each as its smaller and its larger vertex."""
    edges: Ints = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return edges


def shared_edges(triangles: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the rows (k,), (k,) of triangles (f, 3) with a common edge, and the vertices (k, 2) of the edge."""
    edges = edges_of(triangles)
    key = edges[:, 0] * (int(triangles.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    first, second = order[same], order[same + 1]
    return first // 3, second // 3, edges[first]


def connected_components(count: int, a: Ints, b: Ints) -> Ints:
    """Return the component (count,) of each node of a graph with edges a, b (k,), numbered by their first nodes."""
    from scipy.sparse import coo_matrix, csgraph

    label = csgraph.connected_components(coo_matrix((np.ones(len(a), bool), (a, b)), (count, count)), directed=False)[1]
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: Ints = rank[inverse.reshape(-1)]
    return numbers
