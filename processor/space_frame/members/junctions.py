"""Nodes where rough lines meet, and the pairs of nodes that a line joins, without a design."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import components
from processor.model import Floats, Ints

BEYOND_MM = 900.0  # from a line's end to its node: sphere, sleeve, cone, and the part of the tube that was not seen
INSIDE_MM = 300.0  # a line may reach past the tube's end
ENDS_MM = 1500.0  # between two lines' ends at one node
MISS_MM = 25.0  # largest distance of a rough line from its node
LEAST_SINE = 0.2  # of the angle between two lines whose crossing is used
SAME_RAY_COS = np.cos(np.deg2rad(8.0))  # rays within this angle are parts of one tube
ONE_NODE_MM = 120.0  # nodes are not closer than this
LEAST_RAYS = 3  # lines that meet: two cross anywhere
UNSEEN_MM = 4000.0  # of a member that was seen in part only
LEAST_COVER = 0.2  # share of the way between two nodes on which a line must be seen


@dataclass(frozen=True)
class Lines:
    """Lines (m,) seen from ``low`` to ``high`` along ``directions`` from ``points``, mm."""

    points: Floats
    directions: Floats
    low: Floats
    high: Floats

    def ends(self) -> Floats:
        """Both ends (2 m, 3): first all lows, then all highs."""
        ends: Floats = np.concatenate(
            [self.points + self.low[:, None] * self.directions, self.points + self.high[:, None] * self.directions]
        )
        return ends


@dataclass(frozen=True)
class Graph:
    """Nodes (k, 3), the number of rays (k,) each rests on, and the pairs (p, 2) that a line joins."""

    nodes: Floats
    rays: Ints
    pairs: Ints


def graph(lines: Lines) -> Graph:
    """Find the nodes where three lines or more end, and the pairs of nodes that one line joins.

    A place where only two lines end is a node too (a corner) if both lead to nodes and one of these has three lines.
    """
    none = Graph(np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 2), np.int64))
    starts = _crossings(lines)
    if not len(starts):
        return none
    nodes, rays = _supported(lines, starts)
    while len(nodes):
        pairs = _pairs(lines, nodes)
        strong = rays >= LEAST_RAYS
        leads = np.bincount(pairs.ravel(), minlength=len(nodes))
        to_strong = np.bincount(pairs.ravel(), strong[pairs[:, ::-1]].ravel(), len(nodes))
        supported = strong | ((leads >= 2) & (to_strong >= 1))
        if supported.all():
            return Graph(nodes, rays, pairs)
        nodes, rays = nodes[supported], rays[supported]
    return none


def _crossings(lines: Lines) -> Floats:
    """Medians (c, 3) of the clusters of crossings of two lines near their ends."""
    m = len(lines.points)
    pairs = cKDTree(lines.ends()).query_pairs(ENDS_MM, output_type="ndarray")
    if not len(pairs):
        return np.empty((0, 3))
    i, j = pairs[:, 0] % m, pairs[:, 1] % m
    di, dj = lines.directions[i], lines.directions[j]
    cos = np.einsum("ij,ij->i", di, dj)
    sine2 = 1.0 - cos * cos
    keep = (i != j) & (sine2 > LEAST_SINE**2)
    pairs, i, j, di, dj, cos, sine2 = (values[keep] for values in (pairs, i, j, di, dj, cos, sine2))
    between = lines.points[j] - lines.points[i]
    along_i, along_j = np.einsum("ij,ij->i", between, di), np.einsum("ij,ij->i", between, dj)
    ti, tj = (along_i - cos * along_j) / sine2, (cos * along_i - along_j) / sine2
    on_i, on_j = lines.points[i] + ti[:, None] * di, lines.points[j] + tj[:, None] * dj
    near = np.linalg.norm(on_i - on_j, axis=1) < 2.0 * MISS_MM
    for line, t, end in ((i, ti, pairs[:, 0] >= m), (j, tj, pairs[:, 1] >= m)):
        past = np.where(end, t - lines.high[line], lines.low[line] - t)
        near &= (past > -INSIDE_MM) & (past < BEYOND_MM)
    crossings: Floats = 0.5 * (on_i + on_j)[near]
    if not len(crossings):
        return crossings
    joined = cKDTree(crossings).query_pairs(2.0 * MISS_MM, output_type="ndarray")
    label = components(len(crossings), *joined.T)
    order = np.argsort(label, kind="stable")
    bounds = np.searchsorted(label[order], np.arange(label.max() + 2))
    return np.array([np.median(crossings[order[a:b]], axis=0) for a, b in pairwise(bounds.tolist())])


def _supported(lines: Lines, starts: Floats) -> tuple[Floats, Ints]:
    """Nodes of two rays or more, moved to where these meet; of nodes too close to each other the best remains."""
    nodes = starts
    for _ in range(3):
        node, line, t = _passing(lines, nodes)
        foot = lines.points[line] + t[:, None] * lines.directions[line]
        outer = np.eye(3) - lines.directions[line][:, :, None] * lines.directions[line][:, None, :]
        miss = np.linalg.norm(foot - nodes[node], axis=1)
        weight = 1.0 / (1.0 + (miss / (0.2 * MISS_MM)) ** 2)
        normal, right = np.zeros((len(nodes), 3, 3)), np.zeros((len(nodes), 3))
        np.add.at(normal, node, weight[:, None, None] * outer)
        np.add.at(right, node, np.einsum("i,ijk,ik->ij", weight, outer, foot - nodes[node]))
        fixed = np.linalg.eigvalsh(normal)[:, 0] > 0.02
        move = np.zeros((len(nodes), 3))
        move[fixed] = np.linalg.solve(normal[fixed], right[fixed][..., None])[..., 0]
        nodes = nodes[fixed] + np.clip(move[fixed], -2.0 * MISS_MM, 2.0 * MISS_MM)
        if not len(nodes):
            return nodes, np.empty(0, np.int64)
    node, line, t = _passing(lines, nodes)
    rays, ends = _rays(lines, nodes, node, line, t)
    good = np.flatnonzero((rays >= 2) & (ends >= 2))
    # Most rays first; equals by their coordinates, for their order must depend on the points alone.
    order = good[np.lexsort((*nodes[good].T, -rays[good]))]
    return _separate(nodes, rays, order)


def _separate(nodes: Floats, rays: Ints, order: Ints) -> tuple[Floats, Ints]:
    """Remove nodes that are too close to one before them, in an order of preference."""
    ordered = nodes[order]
    if not len(ordered):
        return ordered, rays[order]
    separate = np.ones(len(ordered), bool)
    close = cKDTree(ordered).query_pairs(ONE_NODE_MM, output_type="ndarray")
    for a, b in close[np.lexsort((close[:, 1], close[:, 0]))].tolist():
        if separate[a]:
            separate[b] = False
    rows = order[separate]
    rows = rows[np.lexsort(nodes[rows].T)]
    return nodes[rows], rays[rows]


def _passing(lines: Lines, nodes: Floats, beyond_mm: float = BEYOND_MM) -> tuple[Ints, Ints, Floats]:
    """Node, line and t of every line that passes a node closely, and ends near it or runs through it."""
    # Points along every line, dense enough that one of them is near any node on it.
    reach = 500.0
    low, high = lines.low - beyond_mm, lines.high + beyond_mm
    count = np.maximum(np.ceil((high - low) / (1.5 * reach)).astype(np.int64), 1) + 1
    line = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    t = low[line] + (high - low)[line] * step / (count[line] - 1)
    beads = lines.points[line] + t[:, None] * lines.directions[line]
    near = cKDTree(nodes).sparse_distance_matrix(cKDTree(beads), reach, output_type="coo_matrix")
    pairs = np.unique(np.stack([near.row.astype(np.int64), line[near.col]], axis=1), axis=0)
    node, line = pairs[:, 0], pairs[:, 1]
    away = nodes[node] - lines.points[line]
    t = np.einsum("ij,ij->i", away, lines.directions[line])
    miss = np.linalg.norm(away - t[:, None] * lines.directions[line], axis=1)
    keep = (miss < MISS_MM) & (t > low[line]) & (t < high[line])
    return node[keep], line[keep], t[keep]


def _rays(lines: Lines, nodes: Floats, node: Ints, line: Ints, t: Floats) -> tuple[Ints, Ints]:
    """Distinct rays (k,) of each node, and the number of lines (k,) that end there; a line through a node has two."""
    inside = (t > lines.low[line] + INSIDE_MM) & (t < lines.high[line] - INSIDE_MM)
    toward_high = t - lines.low[line] < lines.high[line] - t
    owner = np.concatenate([node, node[inside]])
    ray = np.concatenate(
        [np.where(toward_high, 1.0, -1.0)[:, None] * lines.directions[line],
         np.where(toward_high, -1.0, 1.0)[inside, None] * lines.directions[line[inside]]]
    )  # fmt: skip
    is_end = np.concatenate([~inside, np.zeros(int(inside.sum()), bool)])
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(len(nodes) + 1))
    rays, ends = np.zeros(len(nodes), np.int64), np.zeros(len(nodes), np.int64)
    for k in range(len(nodes)):
        rows = order[bounds[k] : bounds[k + 1]]
        same = np.triu(ray[rows] @ ray[rows].T > SAME_RAY_COS, 1).any(axis=0)
        rays[k], ends[k] = int((~same).sum()), int((~same & is_end[rows]).sum())
    return rays, ends


def _pairs(lines: Lines, nodes: Floats) -> Ints:
    """Pairs (p, 2) of nodes in succession on a line that is seen on LEAST_COVER of the way between them."""
    node, line, t = _passing(lines, nodes, UNSEEN_MM)
    order = np.lexsort((t, line))
    node, line, t = node[order], line[order], t[order]
    if len(node) < 2:
        return np.empty((0, 2), np.int64)
    next_ = np.flatnonzero(line[1:] == line[:-1])
    line = line[next_]
    a, b = t[next_], t[next_ + 1]
    seen = np.minimum(b, lines.high[line]) - np.maximum(a, lines.low[line])
    good = seen > LEAST_COVER * (b - a)
    pairs = np.sort(np.stack([node[next_], node[next_ + 1]], axis=1)[good], axis=1)
    return np.unique(pairs, axis=0).reshape(-1, 2)
