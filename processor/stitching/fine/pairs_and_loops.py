"""Single pairs of scans: pose and covariance from the pair alone, compared with the network and around loops."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from processor.adjustment import scanner_class_errors
from processor.geometry import rigid
from processor.model import Floats, Reason
from processor.stitching import poses_with_scale
from processor.stitching.fine import bundle_adjustment, direction_errors
from processor.stitching.fine.bundle_adjustment import Solution
from processor.stitching.fine.correspondences import ON_PIECE, Blocks

NAN = float("nan")
LEAST_PIECES = 6  # of a pair: as many as a pose's unknowns
GROSS_PROBABILITY = 1e-6  # that a sound pair is called gross: networks have up to some thousand pairs


@dataclass(frozen=True)
class Pair:
    """Two scans (rows a < b) registered by what they share; the frames are those of the clouds."""

    a: int
    b: int
    shared: int  # pieces, or points
    T_a_b: Floats  # with the scale of b in a where that is free
    covariance: Floats  # (6, 6), with a free scale (7, 7); along the axes of a, rotation about the origin of b
    residual: float
    chi2: float = 0.0  # of its difference from the network's pose
    overlap: float = NAN
    used: bool = True
    reasons: tuple[Reason, ...] = ()
    scale: float = NAN  # by picks alone, of b in a
    scale_sd: float = NAN

    @property
    def is_gross(self) -> bool:
        """Whether the pair's pose differs from the network's beyond chance."""
        return bool(self.chi2 > chdtri(6, GROSS_PROBABILITY))


@dataclass(frozen=True)
class Loop:
    """Scans around a loop (the first again at the end), and chi2 of its misclosure by its 6 or 7 degrees of freedom."""

    rows: tuple[int, ...]
    mm: float
    mrad: float
    ratio: float


def register_pair(blocks: Blocks, network: Solution, a: int, b: int, variance: float) -> Pair | None:
    """Register a pair by its shared pieces alone; None if these are too few.

    ``variance`` is that of errors by direction, mm2. Outliers keep their weights from the network, since two scans
    alone cannot decide which of them is wrong.
    """
    of_pair = blocks.weighted(network.weight).take(np.isin(blocks.scan, (a, b))).shared()
    if of_pair.pieces < LEAST_PIECES:
        return None
    local = replace(of_pair, scan=(of_pair.scan == b).astype(np.int64))
    start = np.stack([np.eye(4), rigid.invert(network.T[a]) @ network.T[b]])
    solution = bundle_adjustment.solve(local, start, 0, iterations=3, robust=False, tau=network.tau)
    by_unit = direction_errors.added_covariance(local, solution, 0, 1.0)[0][6:, 6:]
    own = solution.covariance[6:, 6:] + direction_errors.covariance_by_incidence(local, solution, 0)[6:, 6:]
    covariance = own + variance * by_unit
    # What something that moved makes of the variance excuses no pair.
    expected = own + min(variance, scanner_class_errors.known().view_mm ** 2) * by_unit
    d = poses_with_scale.difference(solution.T[1], start[1])[:6]
    points = local.kind == ON_PIECE
    weight = local.sums[points, 9]
    residual = float(np.sqrt((weight * solution.offset[points] ** 2).sum() / max(weight.sum(), 1e-12)))
    return Pair(
        a=a, b=b, shared=local.pieces, T_a_b=solution.T[1], covariance=covariance, residual=residual,
        chi2=float(d @ np.linalg.solve(expected, d)),
    )  # fmt: skip


def loops(pairs: list[Pair], count: int) -> list[Loop]:
    """Return the loops that pairs close over the tree of those whose shifts are known best, with their misclosures."""
    group = list(range(count))
    tree: dict[int, list[tuple[int, Pair]]] = {i: [] for i in range(count)}
    rest = []
    for pair in sorted(pairs, key=lambda pair: float(np.trace(pair.covariance[3:6, 3:6]))):
        if group[pair.a] != group[pair.b]:
            old, new = group[pair.b], group[pair.a]
            group = [new if g == old else g for g in group]
            tree[pair.a].append((pair.b, pair))
            tree[pair.b].append((pair.a, pair))
        else:
            rest.append(pair)
    return [_loop([*_path(tree, pair.b, pair.a), pair], pair.a) for pair in sorted(rest, key=lambda p: (p.a, p.b))]


def _path(tree: dict[int, list[tuple[int, Pair]]], start: int, end: int) -> list[Pair]:
    """Return the pairs along the tree from ``end`` to ``start``."""
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
    """Chain the poses and covariances of pairs around a loop, in the frame of scan ``start``."""
    size = len(path[0].covariance)
    T, C, at, rows = np.eye(4), np.zeros((size, size)), start, [start]
    for pair in path:
        forward = pair.a == at
        # With rotations about the origin of a's frame the adjoint transforms the covariance.
        covariance = rigid.about_origin(pair.covariance, pair.T_a_b[:3, 3])
        if forward:
            C = C + poses_with_scale.transformed(covariance, T)
            T = T @ pair.T_a_b
        else:
            T = T @ poses_with_scale.invert(pair.T_a_b)
            C = C + poses_with_scale.transformed(covariance, T)
        at = pair.b if forward else pair.a
        rows.append(at)
    xi = poses_with_scale.difference(T, np.eye(4))[:size]
    ratio = float(xi @ np.linalg.solve(C, xi)) / size
    return Loop(tuple(rows), float(np.linalg.norm(xi[3:6])), float(1e3 * np.linalg.norm(xi[:3])), ratio)
