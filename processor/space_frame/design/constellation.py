"""Search for the rigid motions that map found nodes onto a design's, by the pattern of the nodes.

A triangle of three found nodes is mapped onto every triangle of the design with the same sides. Each such pose is then
tested on successively more of the found nodes around it and fitted to them; poses that few nodes support are dropped.
One triangle of true nodes gives all poses that map it onto the design: a repetitive pattern gives all its answers. A
triangle with a node that the design lacks gives only wrong ones, so that the number of triangles follows from the share
of nodes that the best pose leaves over (Fischler and Bolles 1981).
The search is deterministic: triangles are tried in a fixed order, from the middle of the cloud and then all over it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Floats, Ints

NEIGHBOURS = 12  # of a node, for triangles
CORNERS = 24  # triangles tried at most
ENOUGH = 2  # triangles with a supported pose, at least: more of them give no new poses
MISSED = 1e-3  # probability that each of the triangles has a node that is not in the design
FLAT = 0.35  # least sine of a triangle's angle
STAGES = (12, 36, 108)  # found nodes about the triangle that a pose is tested on, one after another
FEW, SPREAD = 32, 128  # then nodes all over the cloud
MANY = 1000  # poses that agree with a neighbourhood
BLOCK = 4096  # poses tested together
LEAST_SHARE = 0.5  # of the nodes that must lie on the design's at each stage
KEPT_SHARE = 0.8  # of the best pose's
MOST = 64  # poses that are tested on all nodes
SAME_SHARE = 0.5  # of the shortest distance of two nodes: poses that differ less are one


def poses(nodes: Floats, design: Floats, tolerance_mm: float) -> Floats:
    """Poses T_design_found (h, 4, 4) under which many of the found nodes (k, 3) lie on nodes of the design (d, 3).

    ``tolerance_mm`` is the largest deviation of a node from its place. Best first by the number of nodes that agree;
    coordinates are relative to their origin, which should be near.
    """
    tree, node_tree = cKDTree(design), cKDTree(nodes)
    around = _neighbours(design, tree)
    middle = np.median(nodes, axis=0)
    outward = np.argsort(np.linalg.norm(nodes - middle, axis=1), kind="stable")
    spread = _spread_out(nodes, SPREAD)
    # Nodes that the design lacks may be neighbours: after the first triangles they are taken from all over the cloud.
    seeds = dict.fromkeys([*outward[:ENOUGH].tolist(), *spread.tolist(), *outward.tolist()])
    answers: list[Floats] = []
    best, successful, tried = 0, 0, 0
    distance = SAME_SHARE * float(np.min(tree.query(design, k=2)[0][:, 1]))
    for seed in seeds:
        corner = _corner(nodes, node_tree, seed)
        if corner is None:
            continue
        tried += 1
        start = _starts(nodes, corner, design, around, tolerance_mm)
        near = node_tree.query(nodes[seed], k=min(STAGES[-1], len(nodes)))[1]
        T = _grown(start, nodes, np.atleast_1d(near), spread, design, tree, tolerance_mm)
        for pose in T:
            count = int((tree.query(rigid.apply(pose, nodes))[0] < tolerance_mm).sum())
            if count < LEAST_SHARE * min(len(nodes), len(design)):
                continue
            if not any(_same(pose, other, nodes, distance) for other in answers):
                answers.append(pose)
                best = max(best, count)
        successful += len(T) > 0 and best > 0
        if (successful >= ENOUGH and tried >= _needed(best / len(nodes))) or tried >= CORNERS:
            break
    return np.array(answers).reshape(-1, 4, 4)


def _needed(share: float) -> float:
    """Return how many triangles have one of true nodes alone, where nodes are true with probability ``share``."""
    clean = share**3
    return 1.0 if clean >= 1.0 else float(np.log(MISSED) / np.log1p(-clean))


def _neighbours(points: Floats, tree: cKDTree) -> Ints:
    """Rows (n, NEIGHBOURS) of the nearest other points."""
    k = min(NEIGHBOURS, len(points) - 1)
    rows: Ints = tree.query(points, k=k + 1)[1][:, 1:].astype(np.int64)
    return rows


def _corner(nodes: Floats, tree: cKDTree, seed: int) -> Ints | None:
    """Rows (3,) of a seed and two of its neighbours that form a triangle with a wide angle at it; None without one."""
    near = tree.query(nodes[seed], k=min(NEIGHBOURS + 1, len(nodes)))[1][1:]
    out = nodes[near] - nodes[seed]
    length = np.linalg.norm(out, axis=1)
    sine = np.linalg.norm(np.cross(out[:, None], out[None]), axis=2) / np.maximum(length[:, None] * length, 1e-300)
    # The nearest two with a wide enough angle.
    reach = np.where(sine > max(FLAT, 0.0), np.maximum(length[:, None], length), np.inf)
    a, b = np.unravel_index(np.argmin(reach), reach.shape)
    if not np.isfinite(reach[a, b]):
        return None
    return np.array([seed, near[a], near[b]])


def _starts(nodes: Floats, corner: Ints, design: Floats, around: Ints, tolerance_mm: float) -> Floats:
    """Poses (h, 4, 4) that map a triangle of found nodes onto each triangle of the design with the same sides."""
    u, v = nodes[corner[1]] - nodes[corner[0]], nodes[corner[2]] - nodes[corner[0]]
    sides = design[around] - design[:, None]
    length = np.linalg.norm(sides, axis=2)
    slack = 2.0 * tolerance_mm
    at, a = np.nonzero(np.abs(length - np.linalg.norm(u)) < slack)
    b_fits = np.abs(length - np.linalg.norm(v)) < slack
    row, b = np.nonzero(b_fits[at])
    at, a = at[row], a[row]
    third = np.linalg.norm(sides[at, a] - sides[at, b], axis=1)
    keep = (a != b) & (np.abs(third - np.linalg.norm(u - v)) < slack)
    at, a, b = at[keep], a[keep], b[keep]
    target = np.stack([design[at], design[around[at, a]], design[around[at, b]]], axis=1)
    return fitted(np.broadcast_to(nodes[corner], target.shape), target, np.ones(target.shape[:2]))


def fitted(source: Floats, target: Floats, weight: Floats) -> Floats:
    """Rigid poses (h, 4, 4) of least squares of h sets of weighted pairs (h, n, 3), (h, n); never a reflection."""
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    s0 = np.einsum("hn,hni->hi", weight, source) / total
    t0 = np.einsum("hn,hni->hi", weight, target) / total
    H = np.einsum("hn,hni,hnj->hij", weight, source - s0[:, None], target - t0[:, None])
    U, _, Vt = np.linalg.svd(H)
    sign = np.ones((len(H), 3))
    sign[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = np.einsum("hji,hj,hkj->hik", Vt, sign, U)
    T = np.zeros((len(H), 4, 4))
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    T[:, :3, 3] = t0 - np.einsum("hij,hj->hi", R, s0)
    return T


def _grown(
    T: Floats, nodes: Floats, near: Ints, spread: Ints, design: Floats, tree: cKDTree, tolerance_mm: float
) -> Floats:
    """Return the poses among T (h, 4, 4) that remain through all stages, fitted; best first, MOST at most."""
    stages = [(near[:count], 1.5) for count in STAGES] + [(spread[:FEW], 2.5), (spread, 2.0)]
    number, error = np.empty(0), np.empty(0)
    for rows, wide in stages:
        # Where many poses agree with a neighbourhood, a larger one does not separate them either.
        if len(T) > MANY and len(rows) > STAGES[1] and rows is not spread:
            continue
        # A pose from few nodes with deviations is turned: the gate is wider than the largest deviation of a node.
        gate = wide * tolerance_mm
        for refit in (True, False):
            parts = [
                _supported(T[first : first + BLOCK], nodes[rows], design, tree, gate, tolerance_mm, refit=refit)
                for first in range(0, len(T), BLOCK)
            ]
            if not parts:
                return T
            T, number, error = (np.concatenate([part[k] for part in parts]) for k in range(3))
            good = number >= max(LEAST_SHARE * len(rows), KEPT_SHARE * number.max())
            T, number, error = T[good], number[good], error[good]
    return T[np.lexsort((error, -number))][:MOST]


def _supported(
    T: Floats, nodes: Floats, design: Floats, tree: cKDTree, gate: float, tolerance_mm: float, *, refit: bool
) -> tuple[Floats, Floats, Floats]:
    """Poses (h, 4, 4), fitted again with ``refit``; number (h,) of nodes (n, 3) that supported each, and error."""
    placed = np.einsum("hij,nj->hni", T[:, :3, :3], nodes) + T[:, None, :3, 3]
    distance, index = tree.query(placed, distance_upper_bound=gate, workers=-1)
    on = np.isfinite(distance)
    size = np.where(on, distance, 0.0)
    number = on.sum(axis=1)
    if refit:
        weight = on / (1.0 + (size / (0.5 * tolerance_mm)) ** 2)
        T = fitted(np.broadcast_to(nodes, placed.shape), design[np.where(on, index, 0)], weight)
    return T, number.astype(np.float64), size.sum(axis=1)


def _spread_out(points: Floats, count: int) -> Ints:
    """Rows of points (n, 3) far from each other, chosen one after another; at most ``count``."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def _same(a: Floats, b: Floats, points: Floats, distance: float) -> bool:
    corners = np.array([points.min(axis=0), points.max(axis=0), points[0], points[-1]])
    return bool(np.abs(rigid.apply(a, corners) - rigid.apply(b, corners)).max() < distance)
