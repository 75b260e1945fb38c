"""The design of a space frame from its surfaces: balls as nodes, tubes between two of them as members."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from processor.model import Floats, FrameDesign, Ints, Reason, reason
from processor.scan_folder.shapes import balls, tubes
from processor.scan_folder.shapes.balls import Balls
from processor.scan_folder.shapes.body import Body, Unsure
from processor.scan_folder.shapes.tubes import Tubes

FEWEST_BALLS, FEWEST_MEMBERS = 3, 2  # a triangle's balls, and two of its members
OFF_AXIS = 0.3  # of a ball's radius: its centre may lie so far from the axis of a tube that ends there
TRUE_AXIS = 0.05  # of the radius: with more the design is eccentric, or the ball another's
SHORT = 0.3  # of the clear distance between two balls: a shorter cylinder is a sleeve, a bolt or a bore
LONG = 10.0  # a tube that leads to no two balls, this many radii long, is reported
OTHER_SHARE = 0.01  # of the surface that may be neither a ball nor along a member
NEAR_BALL, NEAR_AXIS = 1.3, 2.5  # radii within which a facet belongs to a ball or a member
SAMPLE = 40_000  # facets
PLAUSIBLE_MM = (20.0, 600.0)  # radii of balls


def find(body: Body) -> tuple[FrameDesign, tuple[Reason, ...], tuple[Unsure, ...]] | None:
    """Return the design of a space frame whose surfaces are one mesh in mm; None without balls and tubes between.

    With it the doubts about it, and the nodes, and the members by their middles, that are not sure.
    """
    nodes = balls.find(body)
    if len(nodes.radii) < FEWEST_BALLS:
        return None
    pipes = tubes.find(body)
    a, b, which, off = _members(nodes, pipes)
    if len(a) < FEWEST_MEMBERS:
        return None
    doubts, unsure = _doubts(nodes, a, b, off)
    aside = _aside(body, nodes, pipes.ends[which], pipes.radii[which])
    if aside > OTHER_SHARE:
        doubts.append(reason("init.surface-aside", percent=100.0 * aside))
    if body.step_mm:
        doubts.append(reason("init.rounded-frame"))
    lengths = np.linalg.norm(pipes.ends[:, 1] - pipes.ends[:, 0], axis=1)
    used = np.isin(np.arange(len(lengths)), which)
    inside = _coaxial(pipes, which)
    others = int((~used & ~inside & (lengths > LONG * pipes.radii)).sum())
    if others:
        doubts.append(reason("init.tubes-left-out", tubes=others))
    ids = np.arange(len(nodes.radii))
    diameters = 2.0 * pipes.radii[which]
    design = FrameDesign(ids, nodes.centres, nodes.radii, member_a=ids[a], member_b=ids[b], tube_diameters=diameters)
    return design, tuple(doubts), unsure


def _members(nodes: Balls, pipes: Tubes) -> tuple[Ints, Ints, Ints, Floats]:
    """Return for each member (m,) its two balls, its tube, and how far the balls are off its axis by their radii."""
    tree = cKDTree(nodes.centres)
    longest: dict[tuple[int, int], tuple[float, float, int, float]] = {}
    lengths = np.linalg.norm(pipes.ends[:, 1] - pipes.ends[:, 0], axis=1)
    for tube in np.flatnonzero(lengths > 0.0).tolist():
        way = (pipes.ends[tube, 1] - pipes.ends[tube, 0]) / lengths[tube]
        first, second = (_ball_at(nodes, tree, pipes.ends[tube, k], sign * way) for k, sign in ((0, -1.0), (1, 1.0)))
        if first is None or second is None or first[0] == second[0]:
            continue
        (i, off_i), (k, off_k) = first, second
        clear = np.linalg.norm(nodes.centres[i] - nodes.centres[k]) - nodes.radii[i] - nodes.radii[k]
        if lengths[tube] < SHORT * clear:
            continue
        pair = (min(i, k), max(i, k))
        entry = (float(lengths[tube]), float(pipes.radii[tube]), tube, max(off_i, off_k))
        # Of an outer and an inner wall the outer counts: about as long, and thicker.
        best = longest.get(pair)
        if best is None or entry[0] > 1.1 * best[0] or (entry[0] > best[0] / 1.1 and entry[1] > best[1]):
            longest[pair] = entry
    pairs = sorted(longest)
    a, b = (np.array([pair[k] for pair in pairs], np.int64) for k in (0, 1))
    which = np.array([longest[pair][2] for pair in pairs], np.int64)
    return a, b, which, np.array([longest[pair][3] for pair in pairs])


def _ball_at(nodes: Balls, tree: cKDTree, end: Floats, out: Floats) -> tuple[int, float] | None:
    """Return the ball that an axis leads to from a tube's end (3,), and its distance from the axis by its radius."""
    for ball in tree.query(end, k=min(6, len(nodes.radii)))[1].tolist():
        away = nodes.centres[ball] - end
        along = float(away @ out)
        off = float(np.linalg.norm(away - along * out)) / nodes.radii[ball]
        if off < OFF_AXIS and along > -nodes.radii[ball]:
            return ball, off
    return None


def _aside(body: Body, nodes: Balls, ends: Floats, radii: Floats) -> float:
    """Return the share of the surface that is neither near a ball nor along a member with ends (m, 2, 3)."""
    step = max(1, len(body.faces) // SAMPLE)
    middles, areas = body.vertices[body.faces[::step]].mean(axis=1), body.areas[::step]
    near = cKDTree(nodes.centres).query(middles, k=1)
    other = near[0] > NEAR_BALL * nodes.radii[near[1]]
    # From ball to ball: sleeves and cones lie beyond the tube's ends.
    way = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=1)
    thick = float(radii.max())
    count = np.ceil(1.6 * length / thick).astype(np.int64) + 1
    member = np.repeat(np.arange(len(ends)), count)
    share = (np.arange(len(member)) - np.repeat(np.cumsum(count) - count, count)) / np.repeat(count - 1, count)
    axis = ends[member, 0] + (1.6 * share - 0.3)[:, None] * way[member]
    away, which = cKDTree(axis).query(middles[other], k=1)
    other[other] = away > NEAR_AXIS * np.maximum(radii[member[which]], 0.4 * thick)
    return float(areas[other].sum() / areas.sum())


def _coaxial(pipes: Tubes, which: Ints) -> np.ndarray:
    """Whether each tube lies on the axis of one of the tubes ``which``: its inner wall, or a sleeve."""
    used = pipes.ends[which].mean(axis=1)
    way = pipes.ends[which, 1] - pipes.ends[which, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    middle = pipes.ends.mean(axis=1)
    near = cKDTree(used).query(middle, k=min(12, len(used)))[1].reshape(len(middle), -1)
    off = middle[:, None] - used[near]
    off = off - np.einsum("nki,nki->nk", off, way[near])[..., None] * way[near]
    result: np.ndarray = (np.linalg.norm(off, axis=2) < pipes.radii[which][near]).any(axis=1)
    return result


def _doubts(nodes: Balls, a: Ints, b: Ints, off: Floats) -> tuple[list[Reason], tuple[Unsure, ...]]:
    """Return the doubts about nodes and members, and the places of these."""
    doubts = list[Reason]()
    doubtful = np.flatnonzero(~nodes.sure)
    if len(doubtful):
        percent, rms_mm = 100.0 * nodes.cover[doubtful[0]], nodes.rms[doubtful[0]]
        doubts.append(
            reason("init.doubtful-balls", count=len(doubtful), nodes=_first(doubtful), percent=percent, rms_mm=rms_mm)
        )
    odd = np.flatnonzero((nodes.radii < PLAUSIBLE_MM[0]) | (nodes.radii > PLAUSIBLE_MM[1]))
    if len(odd):
        radius_mm = nodes.radii[odd[0]]
        doubts.append(reason("init.unusual-radii", count=len(odd), nodes=_first(odd), radius_mm=radius_mm))
    alone = np.setdiff1d(np.arange(len(nodes.radii)), np.concatenate([a, b]))
    if len(alone):
        doubts.append(reason("init.nodes-alone", count=len(alone), nodes=_first(alone)))
    eccentric = np.flatnonzero(off > TRUE_AXIS)
    if len(eccentric):
        pairs = tuple(f"{a[m]}-{b[m]}" for m in eccentric[:6])
        doubts.append(reason("init.eccentric-members", count=len(eccentric), pairs=pairs))
    ids = np.unique(np.concatenate([doubtful, odd, alone])).astype(np.int64)
    places = [Unsure(str(k), nodes.centres[k]) for k in ids.tolist()]
    places += [Unsure(f"{a[m]}-{b[m]}", 0.5 * (nodes.centres[a[m]] + nodes.centres[b[m]])) for m in eccentric.tolist()]
    return doubts, tuple(places)


def _first(which: Ints) -> tuple[int | str, ...]:
    """Return the first six numbers, and dots for all others."""
    return (*which[:6].tolist(), *(["..."] if len(which) > 6 else []))
