"""Where axes meet: nodes from the lines of their tubes, with what their scatter says of eccentric joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Floats, Ints

PRIOR_FREEDOM = 6.0  # of the scatter about one node: so much does the whole frame's scatter count there
CUT_SIGMAS = 4.5  # an axis that misses the others by more is not of this node
LEAST_AXES = 2


@dataclass(frozen=True)
class Incidence:
    """Which tube ends at which node, a row an end, sorted by node.

    ``offsets`` (i, 3) lead from the node's start to the foot on the axis, ``across`` (i, 2, 3) are unit vectors across
    the axis, ``covariance`` (i, 2, 2) is that of the axis along these, at the node, from noise alone. ``response``
    (i, s, 2, 2) is how the axis moves there with a movement of each station along these, by one standard deviation.
    """

    node: Ints
    offsets: Floats
    across: Floats
    covariance: Floats
    response: Floats


@dataclass(frozen=True)
class Meeting:
    """Nodes (k,) by their axes; ``used`` marks the rows of the incidence that agree. Positions are NaN without two."""

    positions: Floats
    covariance: Floats
    axes: Ints
    scatter: Floats
    used: npt.NDArray[np.bool_]
    eccentricity_mm: float  # of axes about their nodes, a standard deviation for each direction across


def incidence(
    node: Ints, starts: Floats, points: Floats, directions: Floats, side: Floats, covariance: Floats, response: Floats
) -> Incidence:
    """Relate axes (i,) to the nodes (k, 3) they run to; one row an end, sorted by node.

    ``covariance`` (i, 5, 5) as in :class:`processor.bolt_balls.nodes.Tubes`, ``response`` (i, s, 4, 2) as in
    :class:`processor.bolt_balls.tubes.Fits`.
    """
    away = starts[node] - points
    t = np.einsum("ij,ij->i", away, directions)
    across = np.stack([side, np.cross(directions, side)], axis=1)
    C = covariance[:, :4, :4] - np.einsum("isjk,islk->ijl", response, response)
    turned = C[:, :2, 2:]
    at = C[:, :2, :2] + t[:, None, None] * (turned + turned.transpose(0, 2, 1)) + (t * t)[:, None, None] * C[:, 2:, 2:]
    moved = response[:, :, :2] + t[:, None, None, None] * response[:, :, 2:]
    return Incidence(node, t[:, None] * directions - away, across, at, moved)


def meet(ends: Incidence, starts: Floats, floor_mm: float, rounds: int = 6) -> Meeting:
    """Weighted intersection of the axes of each node (k, 3); an axis that misses the others is left out.

    An axis misses its node by its own error and by an eccentricity of one variance for all the frame, found so that
    the misses are as large as they should be (Paule and Mandel 1982). The covariance of a node grows, or shrinks, with
    its own axes' scatter; as far as their number tells.
    """
    k = len(starts)
    used = np.ones(len(ends.node), bool)
    e2 = floor_mm**2
    x, cov, chi2, freedom = _intersect(ends, used, e2, k)
    for _ in range(rounds):
        miss = _miss(ends, x)
        size = np.einsum("ij,ijk,ik->i", miss, np.linalg.inv(_with(ends, e2)), miss)
        count = np.bincount(ends.node[used], minlength=k)
        # The worst axis of a node goes first; the others may agree without it.
        own = np.where(used, size / np.maximum(_share_left(ends, cov, e2), 0.1), 0.0)
        worst = np.zeros(k)
        np.maximum.at(worst, ends.node, own)
        out = used & (own > CUT_SIGMAS**2) & (own == worst[ends.node]) & (count[ends.node] > 2)
        used &= ~out
        e2 = max(_eccentricity2(ends, used, k, floor_mm), floor_mm**2)
        x, cov, chi2, freedom = _intersect(ends, used, e2, k)
        if not out.any():
            break
    grown = (PRIOR_FREEDOM + chi2) / (PRIOR_FREEDOM + np.maximum(freedom, 0.0))
    count = np.bincount(ends.node[used], minlength=k)
    square = np.bincount(ends.node[used], (_miss(ends, x)[used] ** 2).sum(axis=1), k)
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.where(count > 1, np.sqrt(square / count), np.nan)
    whole = cov * grown[:, None, None] + _by_stations(ends, used, cov, e2, k)
    return Meeting(starts + x, whole, count, scatter, used, float(np.sqrt(e2)))


def _with(ends: Incidence, e2: float) -> Floats:
    found: Floats = ends.covariance + e2 * np.eye(2)
    return found


def _by_stations(ends: Incidence, used: npt.NDArray[np.bool_], cov: Floats, e2: float, k: int) -> Floats:
    """Covariance (k, 3, 3) of nodes from stations that are off: all axes at a node move with them, and do not scatter."""
    W = np.linalg.inv(_with(ends, e2)) * used[:, None, None]
    found = np.zeros((k, 3, 3))
    for s in range(ends.response.shape[1]):
        pulled = np.einsum("ijk,ijl,ilm,imn->ikn", ends.across, W, ends.response[:, s], ends.across)
        total = np.zeros((k, 3, 3))
        np.add.at(total, ends.node, pulled)
        moved = cov @ total
        found += moved @ moved.transpose(0, 2, 1)
    return found


def _miss(ends: Incidence, x: Floats) -> Floats:
    """From nodes moved by x (k, 3) to the axes, across them (i, 2)."""
    found: Floats = np.einsum("ijk,ik->ij", ends.across, ends.offsets - x[ends.node])
    return found


def _share_left(ends: Incidence, cov: Floats, e2: float) -> Floats:
    """Part (i,) of an axis's variance that is left in its miss, for its node follows it."""
    follows = np.einsum("ijk,ikl,iml->ijm", ends.across, cov[ends.node], ends.across)
    share = 1.0 - 0.5 * np.einsum("ijk,ikj->i", np.linalg.inv(_with(ends, e2)), follows)
    return np.nan_to_num(share, nan=1.0)


def _intersect(
    ends: Incidence, used: npt.NDArray[np.bool_], e2: float, k: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Movements (k, 3), covariances, chi squared and degrees of freedom (k,); NaN where axes fix no point."""
    W = np.linalg.inv(_with(ends, e2)) * used[:, None, None]
    AW = np.einsum("ijk,ijl->ikl", ends.across, W)
    normal, right = np.zeros((k, 3, 3)), np.zeros((k, 3))
    np.add.at(normal, ends.node, np.einsum("ikj,ijl->ikl", AW, ends.across))
    np.add.at(right, ends.node, np.einsum("ikj,ijl,il->ik", AW, ends.across, ends.offsets))
    regular = np.linalg.eigvalsh(normal)[:, 0] > 1e-9
    cov = np.full((k, 3, 3), np.nan)
    cov[regular] = np.linalg.inv(normal[regular])
    x = np.einsum("kij,kj->ki", cov, right)
    miss = _miss(ends, x)
    chi2 = np.bincount(ends.node, np.nan_to_num(np.einsum("ij,ijk,ik->i", miss, W, miss)), k)
    freedom = 2.0 * np.bincount(ends.node[used], minlength=k) - 3.0
    return x, cov, chi2, freedom


def _eccentricity2(ends: Incidence, used: npt.NDArray[np.bool_], k: int, floor_mm: float) -> float:
    """Variance e2 for which chi squared is what it should be, over nodes whose own chi squared is not the largest."""
    low, high = floor_mm**2, 100.0

    def excess(e2: float) -> float:
        _, _, chi2, freedom = _intersect(ends, used, e2, k)
        told = freedom >= 3.0
        if not told.any():
            return -1.0
        ratio = chi2[told] / freedom[told]
        # One in ten from either side is left out: a node that is something else must not tell of all others.
        order = np.argsort(ratio, kind="stable")
        cut = len(order) // 10
        kept = order[cut : len(order) - cut]
        return float(chi2[told][kept].sum() / freedom[told][kept].sum() - 1.0)

    if excess(low) <= 0.0:
        return low
    for _ in range(24):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return float(np.sqrt(low * high))
