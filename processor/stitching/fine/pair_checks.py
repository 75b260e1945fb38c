"""Pairs of scans by themselves: their own pose and covariance, held against the network, and around loops."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from processor.geometry import rigid
from processor.model import Floats
from processor.stitching import frames
from processor.stitching.fine import bundle_adjustment
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import Blocks

LEAST_PIECES = 6
GROSS_PROBABILITY = 1e-6


@dataclass(frozen=True)
class Pair:
    """Two scans (rows a < b) as registered by what they share; frames are the clouds' own."""

    a: int
    b: int
    pieces: int
    T_a_b: Floats
    covariance: Floats  # along a's axes, turns about b's origin
    residual: float
    chi2: float  # of its difference from the network's pose


def measure(blocks: Blocks, network: Solution, a: int, b: int) -> Pair | None:
    """Register a pair by the pieces it shares alone; None where these are too few.

    What the network found to be off keeps the weight it has there: two scans alone cannot tell.
    """
    T = network.T
    weighed = replace(blocks, sums=blocks.sums * network.weight[:, None])
    own = weighed.only((a, b))
    if own.pieces < LEAST_PIECES:
        return None
    local = Blocks(own.piece, (own.scan == b).astype(np.int64), own.sums, own.count, own.kind, own.pieces)
    start = np.stack([np.eye(4), rigid.invert(T[a]) @ T[b]])
    found = bundle_adjustment.solve(local, start, 0, iterations=3, robust=False, tau=network.tau)
    own_covariance = found.covariance[6:, 6:]
    d = frames.difference(found.T[1], start[1])
    points = local.kind == 0
    weight = local.sums[points, 9]
    residual = float(np.sqrt((weight * found.offset[points] ** 2).sum() / max(weight.sum(), 1e-12)))
    return Pair(a, b, own.pieces, found.T[1], own_covariance, residual, float(d @ np.linalg.solve(own_covariance, d)))


def is_gross(pair: Pair) -> bool:
    """Whether a pair's own pose contradicts the network's beyond chance."""
    return bool(pair.chi2 > chi2.isf(GROSS_PROBABILITY, 6))


@dataclass(frozen=True)
class Loop:
    """Scans around a loop, its misclosure, and that by what the covariances let expect."""

    rows: tuple[int, ...]
    mm: float
    mrad: float
    ratio: float


def loops(pairs: list[Pair], weights: Floats, reference: int, count: int) -> list[Loop]:
    """Misclosures of the loops that pairs close over the tree of the heaviest pairs, at the first scan of each."""
    order = np.argsort(-weights, kind="stable")
    group = list(range(count))
    tree: dict[int, list[tuple[int, Pair]]] = {i: [] for i in range(count)}
    rest = []
    for row in order:
        pair = pairs[row]
        if group[pair.a] != group[pair.b]:
            old, new = group[pair.b], group[pair.a]
            group = [new if g == old else g for g in group]
            tree[pair.a].append((pair.b, pair))
            tree[pair.b].append((pair.a, pair))
        else:
            rest.append(pair)
    return [_loop([*_path(tree, pair.b, pair.a), pair], pair.a) for pair in sorted(rest, key=lambda p: (p.a, p.b))]


def _path(tree: dict[int, list[tuple[int, Pair]]], start: int, end: int) -> list[Pair]:
    """Pairs along the tree from end to start, so that a loop can go on from there."""
    todo: list[tuple[int, list[Pair]]] = [(end, [])]
    seen = {end}
    while todo:
        at, path = todo.pop()
        if at == start:
            return path
        for other, pair in tree[at]:
            if other not in seen:
                seen.add(other)
                todo.append((other, [*path, pair]))
    raise ValueError("no path")


def _loop(path: list[Pair], start: int) -> Loop:
    T, C, at, rows = np.eye(4), np.zeros((6, 6)), start, [start]
    for pair in path:
        forward = pair.a == at
        # Covariance as turns about a's origin, which is the frame's: then it is carried along by the adjoint.
        own = rigid.about_origin(pair.covariance, pair.T_a_b[:3, 3])
        if forward:
            C = C + _carried(T, own)
            T = T @ pair.T_a_b
        else:
            T = T @ rigid.invert(pair.T_a_b)
            C = C + _carried(T, own)
        at = pair.b if forward else pair.a
        rows.append(at)
    xi = np.concatenate([rigid.vector_from_rotation(T[:3, :3]), T[:3, 3]])
    ratio = float(xi @ np.linalg.solve(C, xi)) / 6.0
    return Loop(tuple(rows), float(np.linalg.norm(xi[3:])), float(1e3 * np.linalg.norm(xi[:3])), ratio)


def _carried(T: Floats, covariance: Floats) -> Floats:
    """Covariance (6, 6) of a small motion in a frame, as one in the frame that T (4, 4) leads to."""
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = T[:3, :3]
    J[3:, :3] = rigid.cross_matrix(T[:3, 3]) @ T[:3, :3]
    found: Floats = J @ covariance @ J.T
    return found
