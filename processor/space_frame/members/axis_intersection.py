"""Where axes meet: nodes from the lines of their tubes, with what their scatter says of eccentric joints."""

# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

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

    ``covariance`` (i, 5, 5) as in :class:`processor.space_frame.members.records.Tubes`, ``response`` (i, s, 4, 2) as in
    :class:`processor.space_frame.members.tubes.Fits`.
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
    e2 = _at_first(ends, k, floor_mm)
    # Twice from the start: an axis that was left out while the eccentricity was not known yet may come back.
    for _ in range(2):
        used, e2 = _agreeing(ends, e2, k, floor_mm, rounds)
    x, cov, chi2, freedom = _intersect(ends, used, e2, k)
    grown = (PRIOR_FREEDOM + chi2) / (PRIOR_FREEDOM + np.maximum(freedom, 0.0))
    count = np.bincount(ends.node[used], minlength=k)
    square = np.bincount(ends.node[used], (_miss(ends, x)[used] ** 2).sum(axis=1), k)
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.where(count > 1, np.sqrt(square / count), np.nan)
    whole = cov * grown[:, None, None] + _by_stations(ends, used, cov, e2, k)
    return Meeting(starts + x, whole, count, scatter, used, float(np.sqrt(e2)))


def _agreeing(ends: Incidence, e2: float, k: int, floor_mm: float, rounds: int) -> tuple[npt.NDArray[np.bool_], float]:
    """Which axes agree with the others of their node, and the eccentricity's variance by those."""
    used = np.ones(len(ends.node), bool)
    for _ in range(rounds):
        x, cov, _, _ = _intersect(ends, used, e2, k)
        miss = _miss(ends, x)
        size = np.einsum("ij,ijk,ik->i", miss, _inverse2(_with(ends, e2)), miss)
        count = np.bincount(ends.node[used], minlength=k)
        # The worst axis of a node goes first; the others may agree without it.
        own = np.nan_to_num(np.where(used, size / np.maximum(_share_left(ends, cov, e2), 0.1), 0.0))
        worst = np.zeros(k)
        np.maximum.at(worst, ends.node, own)
        out = used & (own > CUT_SIGMAS**2) & (own == worst[ends.node]) & (count[ends.node] > 2)
        used &= ~out
        e2 = max(_eccentricity2(ends, used, k, floor_mm), floor_mm**2)
        if not out.any():
            break
    return used, e2


def _at_first(ends: Incidence, k: int, floor_mm: float) -> float:
    """Variance of the eccentricity by the median miss, of nodes that heed strangers little."""
    weight: Floats = np.ones(len(ends.node))
    scale2 = 0.0
    for _ in range(5):
        x, _, _, _ = _intersect(ends, weight, floor_mm**2, k)
        miss = _miss(ends, x)
        size2 = np.nan_to_num((miss**2).sum(axis=1))
        several = np.bincount(ends.node, minlength=k)[ends.node] > 2
        if not several.any():
            return floor_mm**2
        # The median square of two normal numbers is 2 ln 2; and a node of n axes takes 3 of 2 n numbers with it.
        count = np.bincount(ends.node, minlength=k)
        left = 1.0 - 1.5 * (count > 2).sum() / count[count > 2].sum()
        scale2 = max(float(np.median(size2[several])) / (2.0 * np.log(2.0) * left), floor_mm**2)
        weight = 1.0 / (1.0 + size2 / (4.0 * scale2))
    return scale2


def _inverse2(M: Floats) -> Floats:
    """Inverses of matrices (i, 2, 2)."""
    det = M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0]
    found = np.stack([M[:, 1, 1], -M[:, 0, 1], -M[:, 1, 0], M[:, 0, 0]], axis=1) / det[:, None]
    return found.reshape(-1, 2, 2)


def _with(ends: Incidence, e2: float) -> Floats:
    found: Floats = ends.covariance + e2 * np.eye(2)
    return found


def _by_stations(ends: Incidence, used: npt.NDArray[np.bool_], cov: Floats, e2: float, k: int) -> Floats:
    """Covariance (k, 3, 3) of nodes from stations that are off: axes that move with them do not scatter."""
    weighed = ends.across.transpose(0, 2, 1) @ (_inverse2(_with(ends, e2)) * used[:, None, None])
    found = np.zeros((k, 3, 3))
    for s in range(ends.response.shape[1]):
        total = np.zeros((k, 3, 3))
        add_responses(ends.node, weighed, ends.response[:, s], ends.across, total)
        moved = cov @ total
        found += moved @ moved.transpose(0, 2, 1)
    return found


@njit(cache=True, nogil=True)
def add_responses(node, weighed, response, across, total):  # type: ignore[no-untyped-def]
    """Add weighed (i, 3, 2) @ response (i, 2, 2) @ across (i, 2, 3) of every end to its node's total (k, 3, 3)."""
    for i in range(len(node)):
        if not response[i].any():
            continue
        for a in range(3):
            for c in range(2):
                v = weighed[i, a, 0] * response[i, 0, c] + weighed[i, a, 1] * response[i, 1, c]
                for b in range(3):
                    total[node[i], a, b] += v * across[i, c, b]


def _miss(ends: Incidence, x: Floats) -> Floats:
    """From nodes moved by x (k, 3) to the axes, across them (i, 2)."""
    found: Floats = np.einsum("ijk,ik->ij", ends.across, ends.offsets - x[ends.node])
    return found


def _share_left(ends: Incidence, cov: Floats, e2: float) -> Floats:
    """Part (i,) of an axis's variance that is left in its miss, for its node follows it."""
    follows = ends.across @ cov[ends.node] @ ends.across.transpose(0, 2, 1)
    share = 1.0 - 0.5 * np.einsum("ijk,ikj->i", _inverse2(_with(ends, e2)), follows)
    found: Floats = np.nan_to_num(share, nan=1.0)
    return found


def _intersect(
    ends: Incidence, used: npt.NDArray[np.bool_] | Floats, e2: float, k: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Movements (k, 3), covariances, chi squared and degrees of freedom (k,); NaN where axes fix no point."""
    W = _inverse2(_with(ends, e2)) * used[:, None, None]
    normal, right, chi2 = np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros(k)
    add_ends(ends.node, ends.offsets, ends.across, W, normal, right)
    regular = np.linalg.eigvalsh(normal)[:, 0] > 1e-9
    cov: Floats = np.full((k, 3, 3), np.nan)
    cov[regular] = np.linalg.inv(normal[regular])
    x: Floats = np.einsum("kij,kj->ki", cov, right)
    add_squares(ends.node, _miss(ends, x), W, chi2)
    freedom = 2.0 * np.bincount(ends.node[used > 0.0], minlength=k).astype(np.float64) - 3.0
    return x, cov, chi2, freedom


@njit(cache=True, nogil=True)
def add_ends(node, offsets, across, W, normal, right):  # type: ignore[no-untyped-def]
    """Add what every end tells to the normal equations of its node; W (i, 2, 2) are the weights."""
    for i in range(len(node)):
        k = node[i]
        for a in range(2):
            along = 0.0
            for c in range(3):
                along += across[i, a, c] * offsets[i, c]
            for b in range(2):
                for c in range(3):
                    v = W[i, b, a] * across[i, b, c]
                    right[k, c] += v * along
                    for d in range(3):
                        normal[k, c, d] += v * across[i, a, d]


@njit(cache=True, nogil=True)
def add_squares(node, miss, W, chi2):  # type: ignore[no-untyped-def]
    """Add the weighted square of every end's miss to that of its node; a miss that is not known counts for nothing."""
    for i in range(len(node)):
        x, y = miss[i, 0], miss[i, 1]
        v = W[i, 0, 0] * x * x + 2.0 * W[i, 0, 1] * x * y + W[i, 1, 1] * y * y
        if np.isfinite(v):
            chi2[node[i]] += v


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
    for _ in range(14):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return float(np.sqrt(low * high))
