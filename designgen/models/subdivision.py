"""Finer nets of bodies: triangles near a place are divided until their edges are short, without gaps between them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from designgen.cad.faults import distances
from designgen.models.mesh_topology import edges_of
from designgen.models.model import ModelBody
from processor.model import Floats, Ints

MOST_ROUNDS = 40  # of halving: edges are shorter by 2**40 then, beyond any use
# Corners and middles of edges (3: of corners 0 and 1, 4: of 1 and 2, 5: of 2 and 0) of the triangles that replace one,
# by the number of its edges that are divided; with one the first edge is divided, with two the first and second.
DIVIDED = {
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


class Spacing(NamedTuple):
    """The longest edge, mm, of triangles that come nearer to a place (3,) than ``reach``, mm."""

    centre: Floats
    reach: float
    longest: float


def subdivided(body: ModelBody, spacings: Sequence[Spacing]) -> ModelBody:
    """Return a body with a finer net. New vertices lie in the middles of edges, on the surfaces of the faces."""
    vertices, triangles, pq, face = body.vertices, body.triangles, body.pq, body.face
    for _ in range(MOST_ROUNDS):
        edges = edges_of(triangles)
        # Pairs as numbers, in the same order: rows take ten times as long to sort.
        number, which = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
        key, which = np.stack(np.divmod(number, len(vertices)), axis=1), which.reshape(-1, 3)
        split = np.zeros(len(key), bool)
        split[which[_long(vertices[triangles], spacings)]] = True
        if not split.any():
            break
        middle = np.full(len(key), -1, np.int64)
        middle[split] = len(vertices) + np.arange(int(split.sum()))
        vertices = np.concatenate([vertices, _middles(body, vertices, triangles, pq, face, key, which)[split]])
        triangles, pq, face = _divide(triangles, pq, face, middle[which])
    return dataclasses.replace(body, vertices=vertices, triangles=triangles, pq=pq, face=face)


def _long(corners: Floats, spacings: Sequence[Spacing]) -> np.ndarray:
    """Mark the edges (f, 3) to divide: those of a triangle near a place that are too long."""
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    result = np.zeros(lengths.shape, bool)
    for centre, reach, longest in spacings:
        near = np.ones(len(corners), bool) if not np.isfinite(reach) else distances(corners, centre) < reach
        result |= near[:, None] & (lengths > longest)
    return result


def _middles(
    body: ModelBody, vertices: Floats, triangles: Ints, pq: Floats, face: Ints, key: Ints, which: Ints
) -> Floats:
    """Return the middle (k, 3) of every edge: of its chord, or on the surface of a curved face that has it."""
    points: Floats = 0.5 * (vertices[key[:, 0]] + vertices[key[:, 1]])
    curved = [k for k, flat in enumerate(body.flat) if not flat]
    for k in curved:
        at = body.surfaces[k]
        rows = np.flatnonzero(face == k)
        if at is None or not len(rows):
            continue
        uv = 0.5 * (pq[rows] + np.roll(pq[rows], -1, axis=1))
        points[which[rows].ravel()] = at(*uv.reshape(-1, 2).T)
    return points


def _divide(triangles: Ints, pq: Floats, face: Ints, middle: Ints) -> tuple[Ints, Floats, Ints]:
    """Return triangles, parameters and faces after edges with a ``middle`` (f, 3), not -1, are divided."""
    count = (middle >= 0).sum(axis=1)
    kept = count == 0
    pieces = [(triangles[kept], pq[kept], face[kept])]
    for number, replacing in DIVIDED.items():
        rows = np.flatnonzero(count == number)
        # Turned so that the divided edges come first.
        pattern = middle[rows] >= 0
        first = np.argmax(pattern, axis=1) if number == 1 else (np.argmin(pattern, axis=1) + 1) % 3
        first = np.zeros(len(rows), np.int64) if number == 3 else first
        turn = (first[:, None] + np.arange(3)) % 3
        nodes = np.concatenate(
            [np.take_along_axis(triangles[rows], turn, axis=1), np.take_along_axis(middle[rows], turn, axis=1)], axis=1
        )
        at = np.take_along_axis(pq[rows], turn[:, :, None], axis=1)
        at = np.concatenate([at, 0.5 * (at + np.roll(at, -1, axis=1))], axis=1)
        for corners in replacing:
            pieces.append((nodes[:, corners], at[:, corners], face[rows]))
    joined = [np.concatenate(column) for column in zip(*pieces, strict=True)]
    return joined[0], joined[1], joined[2]
