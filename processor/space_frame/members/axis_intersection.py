"""Nodes from the axes of their members, with a covariance that includes eccentric joints by the axes' scatter."""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.model import Floats, Ints

PRIOR_DOF = 6.0  # degrees of freedom of the whole frame's scatter in that about one node
CUT_SIGMAS = 4.5  # an axis that misses the others by more is not of this node


@dataclass(frozen=True)
class AxisEnds:
    """Ends of members at nodes, a row an end, sorted by node.

    ``offsets`` (i, 3) lead from the node's start to the foot on the axis, ``across`` (i, 2, 3) are unit vectors across
    the axis, ``covariance`` (i, 2, 2) is that of the axis along these, at the node, from noise alone. ``response``
    (i, s, 2, 2) is the axis's change there by a shift of each station along these by one standard deviation.
    """

    node: Ints
    offsets: Floats
    across: Floats
    covariance: Floats
    response: Floats


@dataclass(frozen=True)
class Intersections:
    """Nodes (k,) from their axes; ``used`` marks the ends that agree. Positions are NaN without two axes."""

    positions: Floats
    covariance: Floats
    axis_count: Ints
    scatter: Floats
    used: npt.NDArray[np.bool_]
    eccentricity_mm: float  # of axes about their nodes, a standard deviation for each direction across


def axis_ends(
    node: Ints, starts: Floats, points: Floats, directions: Floats, side: Floats, covariance: Floats, response: Floats
) -> AxisEnds:
    """Relate axes (i,) to the nodes (k, 3) they run to; one row an end, sorted by node.

    ``covariance`` (i, 5, 5) as in :class:`processor.space_frame.members.records.Members`, ``response`` (i, s, 4, 2) as
    in :class:`processor.space_frame.members.tube_fits.Fits`.
    """
    away = starts[node] - points
    t = np.einsum("ij,ij->i", away, directions)
    across = np.stack([side, np.cross(directions, side)], axis=1)
    C = covariance[:, :4, :4] - np.einsum("isjk,islk->ijl", response, response)
    cross_terms = C[:, :2, 2:]
    both = cross_terms + cross_terms.transpose(0, 2, 1)
    at = C[:, :2, :2] + t[:, None, None] * both + (t * t)[:, None, None] * C[:, 2:, 2:]
    response_there = response[:, :, :2] + t[:, None, None, None] * response[:, :, 2:]
    return AxisEnds(node, t[:, None] * directions - away, across, at, response_there)


def intersect_axes(ends: AxisEnds, starts: Floats, floor_mm: float, rounds: int = 6) -> Intersections:
    """Weighted intersection of the axes of each node (k, 3); an axis that misses the others is left out.

    An axis misses its node by its own error and by an eccentricity of one variance for the whole frame, estimated so
    that chi squared has its expectation (Paule and Mandel 1982). The covariance of a node is scaled by the scatter of
    its own axes, weighted by their number.
    """
    k = len(starts)
    e2 = _first_eccentricity2(ends, k, floor_mm)
    # Twice from the start: an axis that was left out before the eccentricity was known may come back.
    for _ in range(2):
        used, e2 = _agreeing(ends, e2, k, floor_mm, rounds)
    x, cov, chi2, dof = _intersect(ends, used, e2, k)
    scale = (PRIOR_DOF + chi2) / (PRIOR_DOF + np.maximum(dof, 0.0))
    count = np.bincount(ends.node[used], minlength=k)
    square = np.bincount(ends.node[used], (_miss(ends, x)[used] ** 2).sum(axis=1), k)
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.where(count > 1, np.sqrt(square / count), np.nan)
    return Intersections(
        positions=starts + x,
        covariance=cov * scale[:, None, None] + _station_covariance(ends, used, cov, e2, k),
        axis_count=count,
        scatter=scatter,
        used=used,
        eccentricity_mm=float(np.sqrt(e2)),
    )


def _agreeing(ends: AxisEnds, e2: float, k: int, floor_mm: float, rounds: int) -> tuple[npt.NDArray[np.bool_], float]:
    """Find the axes that agree with the others of their node, and the variance of the eccentricity from those."""
    used = np.ones(len(ends.node), bool)
    for _ in range(rounds):
        x, cov, _, _ = _intersect(ends, used, e2, k)
        miss = _miss(ends, x)
        size = np.einsum("ij,ijk,ik->i", miss, _inverse2(_total_covariance(ends, e2)), miss)
        count = np.bincount(ends.node[used], minlength=k)
        # The worst axis of a node goes first; the others may agree without it.
        # Share (i,) of an axis's variance that remains in its miss, its node being fitted to it
        node = ends.across @ cov[ends.node] @ ends.across.transpose(0, 2, 1)
        share = 1.0 - 0.5 * np.einsum("ijk,ikj->i", _inverse2(_total_covariance(ends, e2)), node)
        redundancy: Floats = np.nan_to_num(share, nan=1.0)
        test = np.nan_to_num(np.where(used, size / np.maximum(redundancy, 0.1), 0.0))
        worst = np.zeros(k)
        np.maximum.at(worst, ends.node, test)
        out = used & (test > CUT_SIGMAS**2) & (test == worst[ends.node]) & (count[ends.node] > 2)
        used &= ~out
        e2 = max(_estimate_eccentricity2(ends, used, k, floor_mm), floor_mm**2)
        if not out.any():
            break
    return used, e2


def _first_eccentricity2(ends: AxisEnds, k: int, floor_mm: float) -> float:
    """Variance of the eccentricity from the median miss, of nodes fitted with robust weights."""
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
    inverse = np.stack([M[:, 1, 1], -M[:, 0, 1], -M[:, 1, 0], M[:, 0, 0]], axis=1) / det[:, None]
    return inverse.reshape(-1, 2, 2)


def _total_covariance(ends: AxisEnds, e2: float) -> Floats:
    covariance: Floats = ends.covariance + e2 * np.eye(2)
    return covariance


def _station_covariance(ends: AxisEnds, used: npt.NDArray[np.bool_], cov: Floats, e2: float, k: int) -> Floats:
    """Covariance (k, 3, 3) of nodes by the stations' shifts: they move axes together, without scatter."""
    weighted = ends.across.transpose(0, 2, 1) @ (_inverse2(_total_covariance(ends, e2)) * used[:, None, None])
    covariance = np.zeros((k, 3, 3))
    for s in range(ends.response.shape[1]):
        total = np.zeros((k, 3, 3))
        add_responses(ends.node, weighted, ends.response[:, s], ends.across, total)
        change = cov @ total
        covariance += change @ change.transpose(0, 2, 1)
    return covariance


@njit(cache=True, nogil=True)
def add_responses(node, weighted, response, across, total):  # type: ignore[no-untyped-def]
    """Add weighted (i, 3, 2) @ response (i, 2, 2) @ across (i, 2, 3) of every end to its node's total (k, 3, 3)."""
    for i in range(len(node)):
        if not response[i].any():
            continue
        for a in range(3):
            for c in range(2):
                v = weighted[i, a, 0] * response[i, 0, c] + weighted[i, a, 1] * response[i, 1, c]
                for b in range(3):
                    total[node[i], a, b] += v * across[i, c, b]


def _miss(ends: AxisEnds, x: Floats) -> Floats:
    """Offsets (i, 2) from nodes moved by x (k, 3) to the axes, across them."""
    miss: Floats = np.einsum("ijk,ik->ij", ends.across, ends.offsets - x[ends.node])
    return miss


def _intersect(
    ends: AxisEnds, used: npt.NDArray[np.bool_] | Floats, e2: float, k: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """Movements (k, 3), covariances, chi squared and degrees of freedom (k,); NaN where axes fix no point."""
    W = _inverse2(_total_covariance(ends, e2)) * used[:, None, None]
    normal, right = np.zeros((k, 3, 3)), np.zeros((k, 3))
    add_ends(ends.node, ends.offsets, ends.across, W, normal, right)
    regular = np.linalg.eigvalsh(normal)[:, 0] > 1e-9
    cov: Floats = np.full((k, 3, 3), np.nan)
    cov[regular] = np.linalg.inv(normal[regular])
    x: Floats = np.einsum("kij,kj->ki", cov, right)
    miss = _miss(ends, x)
    square = np.einsum("ij,ijk,ik->i", miss, W, miss)
    # An unknown miss (NaN) is left out.
    chi2 = np.bincount(ends.node, np.where(np.isfinite(square), square, 0.0), k).astype(np.float64)
    dof = 2.0 * np.bincount(ends.node[used > 0.0], minlength=k).astype(np.float64) - 3.0
    return x, cov, chi2, dof


@njit(cache=True, nogil=True)
def add_ends(node, offsets, across, W, normal, right):  # type: ignore[no-untyped-def]
    """Add every end's equations to the normal equations of its node; W (i, 2, 2) are the weights."""
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


def _estimate_eccentricity2(ends: AxisEnds, used: npt.NDArray[np.bool_], k: int, floor_mm: float) -> float:
    """Variance e2 for which chi squared over all nodes has its expectation; a tenth is trimmed on either side."""
    low, high = floor_mm**2, 100.0

    def excess(e2: float) -> float:
        _, _, chi2, dof = _intersect(ends, used, e2, k)
        redundant = dof >= 3.0
        if not redundant.any():
            return -1.0
        chi2, dof = chi2[redundant], dof[redundant]
        # Trimmed: a false node must not change the variance of all others.
        order = np.argsort(chi2 / dof, kind="stable")
        cut = len(order) // 10
        rows = order[cut : len(order) - cut]
        return float(chi2[rows].sum() / dof[rows].sum() - 1.0)

    if excess(low) <= 0.0:
        return low
    for _ in range(14):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return float(np.sqrt(low * high))
