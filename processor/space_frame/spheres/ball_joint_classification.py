"""Classification of nodes, the places where members meet: with a ball, or without as in scaffolds, pipes and purlins.

Two properties of the points about a node distinguish them. A ball's surface lies at one distance from the node, where
clamps and crossing tubes differ from a sphere by a share of their size. And members of bolted balls narrow to sleeves
before the ball: points are found nearer to the axis than the tube's radius, which a continuous tube would hide. Not all
frames have sleeves: how often nodes of either kind have them is estimated from all nodes. What a node's own points
leave open is decided by the nodes that its members lead to. What stands apart from a frame with sleeves and has none,
as a scissor lift with round joints, is no part of it.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from processor.distinct_rows import components
from processor.geometry.sphere_fit import residual
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner_ieee
from processor.model import Bools, Floats, Ints
from processor.space_frame.members.member_extraction import Measured
from processor.space_frame.points import sphere_crops
from processor.space_frame.points.source import Source
from processor.space_frame.spheres import sleeve_radii

REACH_MM = 240.0  # about a node: sleeve and cone of an ordinary ball
POINTS = 512  # of a node, at most
RADII = np.arange(25.0, 160.0, 2.5)  # of balls, mm, as of catalogues, by half of their usual step
LEAST_RATIO = 1.25  # of a ball's radius to that of its thinnest tube
LUMP = 0.12  # rms departure of a cylinder or box from the nearest sphere, in radii
BESIDE_MM = 25.0  # points this far from a surface are those of something else
STRAY, STRAY_OF_LUMP = 0.05, 0.3  # share of points on other surfaces, at a ball and at a lump
NECKS = np.array([60.0, 85.0, 110.0, 140.0, 180.0])  # lengths of sleeve and cone together, mm
SLEEVE_SHARE = 0.45  # of that length is the sleeve's
SLEEVE_SPREAD = 0.1  # sd of a sleeve's radius about the usual one, in tube radii
CLAMP = 1.6  # tube radii from the node: no sleeve begins nearer
CLEAR_MM = 5.0  # distance of a sleeve from ball or clamp
MISTAKEN = 0.01  # probability that evidence of one kind is wrong as a whole, however many points it has
UNLIKE = 0.2  # probability that a member joins a ball and something else
ITERATIONS = 50  # of the shares of kinds (expectation maximisation): work; it has settled long before


def nodes_with_ball(source: Source, measured: Measured, starts: Floats, threads: int = 0) -> Bools:
    """Return which nodes (k,) have a ball, the most likely assignment of all together; one pass over the source.

    ``starts`` (k, 3) are the places of nodes that no axes fix.
    """
    members = measured.members
    lost = ~np.isfinite(measured.nodes.positions).all(axis=1, keepdims=True)
    nodes = replace(measured.nodes, positions=np.where(lost, starts, measured.nodes.positions))
    noise = float(np.median(members.rms)) if len(members.rms) else 1.0
    sd = float(np.sqrt(noise**2 + measured.station_sd_mm**2 + sleeve_radii.AXIS_MM**2))
    near = sphere_crops.gather(source, nodes.positions, REACH_MM, threads, POINTS * nodes.count)
    crops = sphere_crops.with_rays(near, nodes.positions, np.array(source.scanners, np.float64), threads)
    sphere, neck = np.zeros(nodes.count), np.zeros(nodes.count)
    evidence_range = partial(_evidence, crops, sleeve_radii.member_ends(nodes, members), sd, sphere, neck)
    over_ranges(evidence_range, nodes.count, threads)
    joined = (members.node_a >= 0) & (members.node_b >= 0)
    pairs = np.unique(np.sort(np.stack([members.node_a, members.node_b], axis=1)[joined], axis=1), axis=0)
    pairs = pairs.reshape(-1, 2)
    return of_frame(most_likely(log_odds_of_ball(sphere, neck), pairs), neck, pairs)


def log_odds_of_ball(sphere: Floats, neck: Floats) -> Floats:
    """Log odds (k,) of a ball by the log likelihood ratios of both kinds of evidence.

    Nodes are of three kinds: balls with sleeves, balls without, and others. The shares of the kinds are estimated by
    expectation and maximization, with one node of each kind added.
    """
    sphere, neck = _bounded(sphere), _bounded(neck)
    likelihood = np.exp(np.stack([sphere + neck, sphere, np.zeros(len(sphere))], axis=1))
    share = np.full(3, 1.0 / 3.0)
    for _ in range(ITERATIONS):
        belongs = likelihood * share
        belongs /= belongs.sum(axis=1, keepdims=True)
        share = (belongs.sum(axis=0) + 1.0) / (len(sphere) + 3.0)
    weighted = likelihood * share
    odds: Floats = np.log(weighted[:, :2].sum(axis=1) / weighted[:, 2])
    return odds


def most_likely(odds: Floats, pairs: Ints) -> Bools:
    """Most likely assignment (k,) by log odds (k,) of each node, where pairs (p, 2) are mostly of one kind.

    The minimum cut of a binary Markov field (Greig, Porteous and Seheult 1989, "Exact maximum a posteriori
    estimation for binary images", Journal of the Royal Statistical Society B 51, 271-279).
    """
    k = len(odds)
    if not k:
        return np.zeros(0, bool)
    other, ball = k, k + 1
    units = 1e4  # capacities are whole numbers
    cost = np.rint(units * np.abs(odds)).astype(np.int32)
    alike = np.full(len(pairs), round(units * np.log((1.0 - UNLIKE) / UNLIKE)), np.int32)
    nodes = np.arange(k)
    start = np.concatenate([pairs[:, 0], pairs[:, 1], np.full(k, other), nodes])
    end = np.concatenate([pairs[:, 1], pairs[:, 0], nodes, np.full(k, ball)])
    room = np.concatenate([alike, alike, np.where(odds < 0.0, cost, 0), np.where(odds > 0.0, cost, 0)])
    graph = csr_matrix(coo_matrix((room, (start, end)), shape=(k + 2, k + 2)))
    left = graph - maximum_flow(graph, other, ball).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = np.zeros(k + 2, bool)
    reached[breadth_first_order(left, other, return_predecessors=False)] = True
    return ~reached[:k]


def of_frame(balls: Bools, neck: Floats, pairs: Ints) -> Bools:
    """Return the balls (k,) without those of structures that have no sleeves, where the surest structure has them.

    A structure is what pairs (p, 2) of nodes connect. Whether it has sleeves is decided by all its balls together, by
    their log likelihood ratios ``neck`` (k,).
    """
    structure = components(len(balls), *pairs.T)
    sleeves = np.bincount(structure, np.where(balls, _bounded(neck), 0.0))
    frame_has_sleeves = sleeves.size > 0 and sleeves[np.abs(sleeves).argmax()] > 0.0
    kept: Bools = balls & (sleeves[structure] > 0.0) if frame_has_sleeves else balls
    return kept


def _bounded(ratio: Floats) -> Floats:
    """Log likelihood ratios, given that evidence may be mistaken as a whole."""
    bounded: Floats = np.logaddexp(np.log1p(-MISTAKEN) + ratio, np.log(MISTAKEN)) - np.logaddexp(
        np.log1p(-MISTAKEN), np.log(MISTAKEN) + ratio
    )
    return bounded


@njit(cache=True, nogil=True, error_model="numpy")
def _evidence(crops, ends, sd, sphere, neck, first, last):  # type: ignore[no-untyped-def]
    """Fill the log likelihood ratios of nodes ``first`` to ``last``: of a sphere, and of narrowed tubes."""
    for k in range(first, last):
        about = slice(crops.start[k], crops.start[k + 1])
        points, rays = crops.points[about], crops.rays[about]
        own = slice(ends.start[k], ends.start[k + 1])
        feet, axes, tubes = ends.points[own], ends.directions[own], ends.tube_radii[own]
        if len(tubes) == 0 or RADII[-1] < LEAST_RATIO * tubes.min():
            continue
        seen = _beside_members(points, rays, feet, axes, tubes, sd)
        tried = RADII[RADII / tubes.min() >= LEAST_RATIO]
        ratios = np.zeros(len(tried))
        for m in range(len(tried)):
            ratios[m] = _sphere_ratio(points[seen], rays[seen], tried[m], sd)
        sphere[k] = _mean_of(ratios)
        radius = tried[np.argmax(ratios)] if sphere[k] > 0.0 else 0.0
        for m in range(len(tubes)):
            neck[k] += _neck_ratio(points, feet[m], axes[m], tubes[m], max(radius, CLAMP * tubes[m]) + CLEAR_MM, sd)


@inner_ieee
def _beside_members(points, rays, feet, axes, tubes, sd):  # type: ignore[no-untyped-def]
    """Rows of the points that face the scanner and are on no sleeve."""
    rows = np.empty(len(points), np.int64)
    n = 0
    for i in range(len(points)):
        x, u = points[i], rays[i]
        if x[0] * u[0] + x[1] * u[1] + x[2] * u[2] > 0.0:
            continue
        free = True
        for m in range(len(tubes)):
            along, off = _by_axis(x, feet[m], axes[m])
            free = free and (along <= 0.0 or off > sleeve_radii.SLEEVE_OF_TUBE * tubes[m] + sleeve_radii.FLAT_MM + sd)
        if free:
            rows[n] = i
            n += 1
    return rows[:n]


@inner_ieee
def _sphere_ratio(points, rays, radius, sd):  # type: ignore[no-untyped-def]
    """Log likelihood ratio of a ball of this radius about the node to a lump of about its size."""
    wide = np.sqrt(sd * sd + (LUMP * radius) ** 2)
    stray = 0.5 / BESIDE_MM
    total = 0.0
    for i in range(len(points)):
        p, u = points[i], rays[i]
        e, cosine, _, _, _, _ = residual(p[0], p[1], p[2], u[0], u[1], u[2], 0.0, 0.0, 0.0, radius)
        if cosine < 0.3 or e < -BESIDE_MM:
            continue
        if e > BESIDE_MM:
            if u[0] != 0.0 or u[1] != 0.0 or u[2] != 0.0:  # the ray passed through
                total += np.log(STRAY / STRAY_OF_LUMP)
            continue
        on_ball = (1.0 - STRAY) * _normal(e, sd) + STRAY * stray
        total += np.log(on_ball / ((1.0 - STRAY_OF_LUMP) * _normal(e, wide) + STRAY_OF_LUMP * stray))
    return total


@inner_ieee
def _neck_ratio(points, foot, axis, tube, beyond, sd):  # type: ignore[no-untyped-def]
    """Log likelihood ratio of a tube that ends in a cone and a sleeve to one that goes on towards the node.

    How far cone and sleeve reach is unknown: the likelihood is the mean over their lengths.
    """
    totals = np.zeros(len(NECKS))
    wide = np.sqrt(sd * sd + (SLEEVE_SPREAD * tube) ** 2)
    stray = 1.0 / (tube + 3.0 * sd)
    sleeve = sleeve_radii.SLEEVE_OF_TUBE * sleeve_radii.MEDIAN_OF_CORNER * tube
    for i in range(len(points)):
        along, off = _by_axis(points[i], foot, axis)
        if along < beyond or off > tube + 3.0 * sd:
            continue
        goes_on = (1.0 - STRAY) * _normal(off - tube, sd) + STRAY * stray
        for m in range(len(NECKS)):
            share = (along - beyond) / NECKS[m]
            if share < 1.0:
                cone = max(share - SLEEVE_SHARE, 0.0) / (1.0 - SLEEVE_SHARE)
                narrow = (1.0 - STRAY) * _normal(off - sleeve - (tube - sleeve) * cone, wide) + STRAY * stray
                totals[m] += np.log(narrow / goes_on)
    return _mean_of(totals)


@inner_ieee
def _mean_of(logs):  # type: ignore[no-untyped-def]
    """Logarithm of the mean of likelihoods by their logarithms."""
    most = logs.max()
    return most + np.log(np.mean(np.exp(logs - most)))


@inner_ieee
def _by_axis(point, foot, axis):  # type: ignore[no-untyped-def]
    """Distances of a point along an axis and from it."""
    x, y, z = point[0] - foot[0], point[1] - foot[1], point[2] - foot[2]
    along = x * axis[0] + y * axis[1] + z * axis[2]
    return along, np.sqrt(max(x * x + y * y + z * z - along * along, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(e, sd):  # type: ignore[no-untyped-def]
    return np.exp(-0.5 * (e / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
