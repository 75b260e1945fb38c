"""Coarse registration of a scan to its design by principal axes, over rotations alone, and how sure it is.

Paper 002, section 2.3, without the four of its eight cases that are mirror images, and with swapped axes where two
spread alike. Every case is refined a little and judged by what it leaves.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import icp, principal, rigid
from processor.geometry.mesh_distance import Samples
from processor.geometry.neighbors import thinned
from processor.model import Floats

CLOSE = 1.25  # ratio of two axes' variances below which they may be swapped
POINTS, MOST_ITERATIONS = 3_000, 12
GATE_SHARES = (0.05, 0.015, 0.005)  # of the design's size
SAME_TURN, SAME_SHIFT = 0.02, 0.01  # rad, and of the design's size: poses nearer than that are one
AMBIGUOUS = 1.3  # ratio of errors below which either of two poses could be right
NAN = float("nan")


@dataclass(frozen=True)
class Attitude:
    """``T_design_scan`` (4, 4), the rms in mm that it leaves, and the ratio of the next best pose's to it."""

    T_design_scan: Floats
    rms_mm: float
    ambiguity: float


def coarse(points: Floats, design: Samples, axes: principal.PrincipalAxes) -> Attitude:
    """Find the attitude of points (n, 3), even in density, against samples of the design with its principal axes."""
    own = principal.of_points(points)
    size = float(np.linalg.norm(np.ptp(design.points, axis=0)))
    tree = cKDTree(design.points)
    few = thinned(points, POINTS)
    found = []
    for turn in rotations(axes.variances, own.variances):
        R = axes.axes @ turn @ own.axes.T
        start = rigid.transform(R, axes.centre - R @ own.centre)
        gates = tuple(share * size for share in GATE_SHARES)
        fit = icp.point_to_plane(
            few, design.points, design.normals, start, gates_mm=gates, tree=tree, max_iterations=MOST_ITERATIONS
        )
        T = fit.T_target_source
        found.append((left(few, design, tree, T, gates[-1]), T))
    order = sorted(range(len(found)), key=lambda k: (found[k][0], k))
    error, best = found[order[0]]
    rivals = (found[k][0] for k in order[1:] if differ(found[k][1], best, own.centre, size))
    return Attitude(best, error, next(rivals, NAN) / max(error, 1e-9))


def rotations(one: Floats, other: Floats) -> list[Floats]:
    """Proper rotations (3, 3) between two sets of axes with variances (3,): 4, or up to 24 where some are alike."""
    found = []
    for order in itertools.permutations(range(3)):
        swaps = [(i, k) for i, k in enumerate(order) if i != k]
        if not all(_alike(one[i], one[k]) or _alike(other[i], other[k]) for i, k in swaps):
            continue
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0.0:
                found.append(turn)
    return found


def left(points: Floats, design: Samples, tree: cKDTree, T: Floats, most: float) -> float:
    """Rms distance along the design's normals of points (n, 3) placed by T, each ``most`` at most."""
    moved = rigid.apply(T, points)
    distance, index = tree.query(moved, distance_upper_bound=3.0 * most)
    near = np.isfinite(distance)
    r = np.full(len(points), most)
    off = np.einsum("ni,ni->n", moved[near] - design.points[index[near]], design.normals[index[near]])
    r[near] = np.minimum(np.abs(off), most)
    return float(np.sqrt(np.mean(r**2)))


def _alike(a: float, b: float) -> bool:
    return max(a, b) <= CLOSE * min(a, b)


def differ(one: Floats, other: Floats, centre: Floats, size: float) -> bool:
    """Whether two poses (4, 4) of what lies about ``centre`` (3,) and is of a ``size`` are two and not one."""
    turn = rigid.rotation_angle(one[:3, :3] @ other[:3, :3].T)
    shift = float(np.linalg.norm(rigid.apply(one, centre) - rigid.apply(other, centre)))
    return turn > SAME_TURN or shift > SAME_SHIFT * size
