"""A lower edge of a part: the sharp edge of its mesh that begins at a corner of its end."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from processor.geometry.box_girder_mesh import Edge
from processor.model import Floats
from processor.scan_folder.shapes.body import Body

AT_CORNER_MM = 0.2  # distance of the first vertex from the corner
BEVEL_MM, BEVEL_SLOPE = 60.0, 0.02  # how far behind the corner the edge may begin, and how far aside by that
TURN_COS = np.cos(np.radians(35.0))  # an edge that turns more at a vertex has ended
STEP_MM = 100.0  # between points of a curved edge
STRAIGHT_MM = 1e-3  # rounding of a file in float32 at 10 m: an edge off its chord by less is straight


def follow(body: Body, corner: Floats, inward: Floats) -> Floats:
    """Return the vertices (n, 3) of the sharp edge from a corner (3,) into a body, until it ends; n = 0 for none.

    ``inward`` (3,) leads from the corner along the edge. Where no vertex is at the corner, as with a bevel, the edge
    begins with the next one on it. At a fork the edge goes on straight.
    """
    off = body.vertices[np.unique(body.sharp)] - corner
    inward = inward / np.linalg.norm(inward)
    along = off @ inward
    aside = np.linalg.norm(off - along[:, None] * inward, axis=1)
    beginning = (along > -AT_CORNER_MM) & (along < BEVEL_MM) & (aside < AT_CORNER_MM + BEVEL_SLOPE * np.abs(along))
    if not beginning.any():
        return np.empty((0, 3))
    first = int(np.unique(body.sharp)[beginning][np.linalg.norm(off[beginning], axis=1).argmin()])
    beside = defaultdict(list)
    for a, b in body.sharp.tolist():
        beside[a].append(b)
        beside[b].append(a)
    path, way, seen = [first], np.asarray(inward, np.float64), {first}
    while True:
        others = [other for other in beside[path[-1]] if other not in seen]
        if not others:
            break
        ways = body.vertices[others] - body.vertices[path[-1]]
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        best = int((ways @ way).argmax())
        if ways[best] @ way < TURN_COS:
            break
        path.append(others[best])
        seen.add(others[best])
        way = ways[best]
    return body.vertices[path] if len(path) > 1 else np.empty((0, 3))


def smooth(points: Floats) -> Floats:
    """Return points (m, 3) at most STEP_MM apart on the smooth curve through points (n, 3); straight edges stay."""
    if len(points) < 3:
        return points
    edge = Edge.through(points)
    between = []
    for k, (a, b) in enumerate(zip(edge.knots[:-1], edge.knots[1:], strict=True)):
        count = int(np.ceil((b - a) * edge.length / STEP_MM))
        share = np.linspace(a, b, count + 1)[:-1]
        curve = edge.at(share)
        chord = points[k] + (share - a)[:, None] / (b - a) * (points[k + 1] - points[k])
        straight = count == 1 or np.abs(curve - chord).max() < STRAIGHT_MM
        between.append(points[k : k + 1] if straight else curve)
    return np.concatenate([*between, points[-1:]])
