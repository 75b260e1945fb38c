"""What is wrong with the bodies of a model, a line each: what was found, and what was done or is to be done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from processor.model import Bools, Floats, Ints

TOUCHING_MM = 0.1  # bodies that run into each other by less are in contact: chords of round faces depart by half of it
MOST_POINTS = 400  # of a body, by which it is tried whether it lies in another one
MOST_PRODUCTS, ALL_PRODUCTS = 2_000_000, 100_000_000  # points times triangles of a pair, and of all
MOST_PAIRS = 20_000  # work: bodies of one structure meet few others; what is beyond is not compared
JITTER_MM = np.array([1.3e-5, 2.1e-5, 1.7e-5])  # so that no ray meets an edge between two triangles
TINY_MM, HUGE_MM = 10.0, 1e6  # sizes of a structure beyond which its unit is doubtful


@dataclass(frozen=True)
class Named:
    """A body by its name: vertices (v, 3), mm, and triangles (f, 3)."""

    name: str
    vertices: Floats
    triangles: Ints
    closed: bool


def of_bodies(bodies: Sequence[Named]) -> list[str]:
    """Return what is wrong with shapes: bodies that overlap, and a size that no structure has."""
    found = []
    pairs = sorted(overlapping(bodies), key=lambda pair: -pair[2])
    if pairs:
        first, second, depth = pairs[0]
        more = f", and {len(pairs) - 1} more pairs of bodies overlap" if len(pairs) > 1 else ""
        found.append(
            f"{first!r} and {second!r} overlap by {depth:.1f} mm{more}: they are taken as they are, and what lies "
            "inside of another body is not seen; correct the design if they should only touch"
        )
    ends = np.array([[body.vertices.min(axis=0), body.vertices.max(axis=0)] for body in bodies])
    size = float((ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0)).max())
    if not TINY_MM <= size <= HUGE_MM:
        found.append(f"its largest side is {size:.4g} mm: is its unit right? state it by --units")
    return found


def of_names(names: Sequence[str], stem: str) -> list[str]:
    """Return what is wrong with names: shared by several bodies, or missing, so that a reader numbered them."""
    found = repeated(names)
    if unnamed := numbered(names, stem):
        found.append(f"{len(unnamed)} bodies have no names in the file: they are numbered, as {unnamed[0]}")
    return found


def numbered(names: Sequence[str], stem: str) -> list[str]:
    """Return the names that a reader of a file of this stem made for bodies without one."""
    return [name for name in names if name.startswith(f"{stem}-") and name[len(stem) + 1 :].isdigit()]


def repeated(names: Sequence[str]) -> list[str]:
    """Return a note on names that several bodies have; empty without such names."""
    shared = _shared(names)
    if not shared:
        return []
    most = max(shared, key=lambda name: shared[name])
    return [
        f"{shared_count(names)} bodies share {len(shared)} name(s), as {most!r} {shared[most]} times: they "
        f"are numbered, {most!r}, '{most} (2)', ..."
    ]


def shared_count(names: Sequence[str]) -> int:
    """Return the number of bodies with a name that others have."""
    return sum(_shared(names).values())


def _shared(names: Sequence[str]) -> dict[str, int]:
    return {name: count for name, count in Counter(names).items() if count > 1}


def of_shells(open_: Sequence[str], inverted: Sequence[str], what_for: str) -> list[str]:
    """Return notes on bodies that are not closed or were inside out, by their names; ``what_for`` ends the first."""
    found = []
    if open_:
        found.append(f"{_listed(open_)} not closed: {what_for}; check it in the CAD program")
    if inverted:
        found.append(f"{_listed(inverted)} inside out: the normals were turned outward")
    return found


def _listed(names: Sequence[str]) -> str:
    return f"{names[0]!r} is" if len(names) == 1 else f"{len(names)} bodies, {names[0]!r} first, are"


def volume(vertices: Floats, triangles: Ints) -> float:
    """Return the volume that triangles (f, 3) enclose, mm3; negative where their normals point inward."""
    corners = vertices[triangles] - vertices[triangles[0, 0]]
    return float(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum()) / 6.0


# --- Overlaps


def overlapping(bodies: Sequence[Named]) -> list[tuple[str, str, float]]:
    """Return the pairs of closed bodies that overlap by more than TOUCHING_MM, and by how much, mm.

    The depth is that of points of one body's surface in the other; a corner that is cut off between them is not found.
    """
    closed = [body for body in bodies if body.closed and len(body.triangles)]
    low = np.array([body.vertices.min(axis=0) for body in closed]).reshape(-1, 3)
    high = np.array([body.vertices.max(axis=0) for body in closed]).reshape(-1, 3)
    found, pairs = [], list(_meeting(low, high))
    most = max(1, min(MOST_PRODUCTS, ALL_PRODUCTS // max(1, 2 * len(pairs))))
    for first, second in pairs:
        box = np.maximum(low[first], low[second]), np.minimum(high[first], high[second])
        one, other = closed[first], closed[second]
        depth = max(_depth(one, other, *box, most), _depth(other, one, *box, most))
        if depth > TOUCHING_MM:
            found.append((one.name, other.name, depth))
    return found


def _meeting(low: Floats, high: Floats) -> Iterator[tuple[int, int]]:
    """Yield pairs of boxes that have more than TOUCHING_MM in common along every axis, MOST_PAIRS at most."""
    count = 0
    for first in range(len(low)):
        common = np.minimum(high[first], high[first + 1 :]) - np.maximum(low[first], low[first + 1 :])
        for k in np.flatnonzero((common > TOUCHING_MM).all(axis=1)).tolist():
            if count == MOST_PAIRS:
                return
            count += 1
            yield first, first + 1 + k


def _depth(body: Named, other: Named, low: Floats, high: Floats, most: int) -> float:
    """Return how deep points of a body's surface within a box lie in another body, mm; 0 where none does.

    ``most`` is the number of points times triangles that are tried.
    """
    points = _within(body.vertices[body.triangles], low, high)
    corners = other.vertices[other.triangles]
    near = _box_meets(corners[:, :, 1:], low[1:], high[1:])  # all that a ray along x from the box can meet
    if not len(points) or not near.any():
        return 0.0
    points = points[:: max(1, len(points) * int(near.sum()) // most)]
    inside = points[_inside(points, corners[near])]
    if not len(inside):
        return 0.0
    inside = inside[:: max(1, len(inside) // 40, len(inside) * len(corners) // most)]
    return max(float(distances(corners, point).min()) for point in inside)


def _box_meets(corners: Floats, low: Floats, high: Floats) -> Bools:
    meets: Bools = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)
    return meets


def _within(corners: Floats, low: Floats, high: Floats) -> Floats:
    """Return points (n, 3) of triangles (f, 3, 3) within a box: corners, and places spread over the triangles."""
    corners = corners[_box_meets(corners, low, high)]
    if not len(corners):
        return np.empty((0, 3))
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    ends = np.cumsum(area)
    count = 10 * MOST_POINTS
    rows = np.minimum(np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1]), len(corners) - 1)
    i = np.arange(count)
    u, v = np.sqrt((i * 0.7548776662466927) % 1.0)[:, None], ((i * 0.5698402909980532) % 1.0)[:, None]
    a, b, c = (corners[rows, k] for k in range(3))
    points = np.concatenate([corners.reshape(-1, 3), (1.0 - u) * a + u * ((1.0 - v) * b + v * c)])
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    return points[:: max(1, len(points) // MOST_POINTS)]


def _inside(points: Floats, corners: Floats) -> Bools:
    """Mark the points (n, 3) from which a ray along x meets an odd number of triangles (f, 3, 3)."""
    places = points + JITTER_MM
    y, z = places[:, 1, None], places[:, 2, None]
    edges = []
    for k in range(3):
        a, b = corners[:, k, 1:], corners[:, (k + 1) % 3, 1:]
        edges.append((b[:, 0] - a[:, 0]) * (z - a[:, 1]) - (b[:, 1] - a[:, 1]) * (y - a[:, 0]))
    e = np.stack(edges)
    row, facet = np.nonzero((e > 0.0).all(axis=0) | (e < 0.0).all(axis=0))
    share = e[:, row, facet] / e[:, row, facet].sum(axis=0)  # of the corners opposite to the edges
    x = sum(share[k] * corners[facet, (k + 2) % 3, 0] for k in range(3))
    odd: Bools = np.bincount(row[x > places[row, 0]], minlength=len(points)) % 2 == 1
    return odd


def distances(corners: Floats, point: Floats) -> Floats:
    """Return the distance (f,) of triangles (f, 3, 3) from a point (3,)."""
    nearest = np.full(len(corners), np.inf)
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        along = b - a
        share = np.einsum("ni,ni->n", point - a, along) / np.maximum(np.einsum("ni,ni->n", along, along), 1e-300)
        foot = a + np.clip(share, 0.0, 1.0)[:, None] * along
        nearest = np.minimum(nearest, np.linalg.norm(foot - point, axis=1))
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    height = np.einsum("ni,ni->n", point - a, normal)
    within = np.ones(len(corners), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        within &= np.einsum("ni,ni->n", np.cross(end - start, point - start), normal) >= 0.0
    return np.where(within, np.abs(height), nearest)
