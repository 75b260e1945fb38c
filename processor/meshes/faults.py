"""Faults of triangle meshes: facets given twice or from both sides, normals that contradict, open edges.

The side of a deviation is that of the facets' normals: of a mesh that is inside out every dent would be a bulge, and of
one with facets in both orientations half the surface would be taken for its other side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import components, distinct_points
from processor.model import Bools, Floats, Ints

# Of the mesh's size: corners at open edges that are nearer to each other are one. Coordinates have seven digits in
# single precision and six as STL is commonly written; bodies that were cut differ in the last of them.
JOIN_SHARE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Mended:
    """The facets (g, 3) of a mesh with outward normals, each once, and what was wrong with them.

    ``rows`` (g,) are their numbers among the facets given. ``corners`` (g, 3) are their corners by numbers of the
    distinct ``points`` (p, 3). ``part`` (g,) is the number of the connected part that each belongs to, a cavity to the
    part around it, -1 of one without area. ``open_sides`` (g,) counts the edges of each that no other facet has.
    ``repeated`` facets were left out, and ``turned`` were turned.
    """

    faces: Ints
    rows: Ints
    points: Floats
    corners: Ints
    part: Ints
    open_sides: Ints
    repeated: int
    turned: int

    @property
    def open_edges(self) -> int:
        """Number of edges of one facet alone."""
        return int(self.open_sides.sum())

    @property
    def open_parts(self) -> int:
        """Number of parts with such edges."""
        return len(np.unique(self.part[self.open_sides > 0]))


def mended(vertices: Floats, faces: Ints, body: Ints | None = None) -> Mended:
    """Mend the facets (f, 3) of a mesh: each once, neighbours alike, and outward; ``body`` (f,) has those of each.

    Of facets given several times the first is kept, if they have both orientations too: the surface is then seen from
    the side that its neighbours show, and a sheet that is not closed from the side of most facets that come first.
    Two bodies that touch keep their faces there, opposite to each other. Closed parts that enclose a negative volume
    are turned, unless they lie within another part: they are its cavity. Facets without area are kept as they are.
    """
    points, corners, edges = _joined(vertices, faces)
    rows = np.flatnonzero(_proper(corners))
    single = _single(corners[rows], edges, None if body is None else body[rows])
    repeated = int((~single).sum())
    if repeated:
        rows = rows[single]
        edges = _Edges.of(corners[rows])
    turned, part = _outward(points, corners[rows], edges)
    every = np.sort(np.concatenate([rows, np.flatnonzero(~_proper(corners))]))
    at = np.searchsorted(every, rows)
    number, open_sides = np.full(len(every), -1), np.zeros(len(every), np.int64)
    turn = np.zeros(len(every), np.bool_)
    number[at], turn[at] = part, turned
    open_sides[at] = (edges.uses[edges.number] == 1).reshape(-1, 3).sum(axis=1)
    return Mended(
        faces=_turned(faces[every], turn),
        rows=every,
        points=points,
        corners=_turned(corners[every], turn),
        part=number,
        open_sides=open_sides,
        repeated=repeated,
        turned=int(turned.sum()),
    )


def _turned(faces: Ints, turn: Bools) -> Ints:
    return np.where(turn[:, None], faces[:, ::-1], faces) if turn.any() else faces


def joined(vertices: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Return the distinct places (p, 3) of the corners of facets (f, 3), sorted by x, y, z, and the corners by them.

    Corners are one where their coordinates are the same, and at open edges where they are nearer than JOIN_SHARE of
    the mesh's size, unless an edge joins them.
    """
    return _joined(vertices, faces)[:2]


def _joined(vertices: Floats, faces: Ints) -> tuple[Floats, Ints, _Edges]:
    """Return :func:`joined`, and the edges of the facets whose corners are three."""
    used, inverse = np.unique(faces, return_inverse=True)
    points, place = distinct_points(vertices[used] + 0.0)
    corners = place[inverse.reshape(faces.shape)]
    edges = _Edges.of(corners[_proper(corners)])
    rim = np.unique(edges.ends[edges.uses == 1])
    if not len(rim):
        return points, corners, edges
    reach = JOIN_SHARE * float(np.ptp(points, axis=0).max())
    near = rim[cKDTree(points[rim]).query_pairs(reach, output_type="ndarray")]
    along = edges.ends[:, 0] * len(points) + edges.ends[:, 1]
    near = near[~np.isin(near.min(axis=1) * len(points) + near.max(axis=1), along)]
    if not len(near):
        return points, corners, edges
    number = components(len(points), near[:, 0], near[:, 1])
    points, corners = points[np.unique(number, return_index=True)[1]], number[corners]
    return points, corners, _Edges.of(corners[_proper(corners)])


def _proper(corners: Ints) -> Bools:
    """Mark the facets (f,) with three corners."""
    proper: Bools = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    return proper


@dataclass(frozen=True)
class _Edges:
    """The edges (e,) of facets (f, 3): the ``number`` (3f,) of each side's edge, and whether it passes it ``forward``.

    Side 3 i + k of facet i leads from its corner k to the next. ``uses`` (e,) are the sides that an edge has, and
    ``ends`` (e, 2) its corners, the smaller first.
    """

    number: Ints
    forward: Bools
    uses: Ints
    ends: Ints

    @classmethod
    def of(cls, corners: Ints) -> _Edges:
        start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
        count = int(corners.max(initial=0)) + 1
        key, number, uses = np.unique(
            np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True, return_counts=True
        )
        return cls(number.reshape(-1), start < end, uses, np.stack(np.divmod(key, count), axis=1))

    def pairs(self) -> tuple[Ints, Ints]:
        """Return the two sides (k,), (k,) of each edge that has two."""
        order = np.argsort(self.number, kind="stable")
        order = order[self.uses[self.number[order]] == 2]
        return order[::2], order[1::2]


def _renumbered(labels: Ints) -> Ints:
    """Return labels (n,) as numbers from 0 in the order in which they first come."""
    first, number = np.unique(labels, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    result: Ints = rank[number.reshape(-1)]
    return result


# --- Facets given several times


def _single(corners: Ints, edges: _Edges, body: Ints | None) -> Bools:
    """Mark the facets (f,) to keep of those with the same three corners, within a body."""
    sides = edges.number.reshape(-1, 3)
    count = len(edges.uses)
    # Two of its edges tell which triangle it is.
    key = sides.min(axis=1) * count + sides.max(axis=1)
    if body is not None and int(body.max(initial=0)) > 0:
        key = np.unique(key, return_inverse=True)[1].reshape(-1) * (int(body.max()) + 1) + body
    _, first, group, times = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    keep = np.zeros(len(corners), np.bool_)
    keep[first] = True
    if len(first) == len(corners):
        return keep
    contact = _is_contact(edges, sides[first], times > 1)
    if contact.any():  # one more is kept, of the other orientation if there is one
        even = (np.diff(corners, axis=1) > 0).sum(axis=1) + (corners[:, 2] < corners[:, 0]) == 2
        more = np.flatnonzero(contact[group] & ~keep)
        more = more[np.argsort(even[more] == even[first][group[more]], kind="stable")]
        keep[more[np.unique(group[more], return_index=True)[1]]] = True
    return keep


def _is_contact(edges: _Edges, sides: Ints, repeated: Bools) -> Bools:
    """Mark the distinct facets (d,), given by their ``sides`` (d, 3), in which two bodies touch; they are ``repeated``.

    Around a face in which two closed bodies touch each of them goes on: every edge of its rim has two facets more.
    A surface that is modelled from both sides, or twice, has free edges, or goes on with one facet or none.
    """
    facet, edge = np.repeat(np.arange(len(sides)), 3), sides.ravel()
    doubled = np.bincount(edge, np.repeat(repeated, 3), len(edges.uses))
    others = np.bincount(edge, None, len(edges.uses)) - doubled
    order = np.argsort(edge, kind="stable")
    order = order[repeated[facet[order]]]
    follows = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    region = components(len(sides), facet[order][follows], facet[order][follows + 1])
    rim = others[edge] > 0
    wrong = np.repeat(repeated, 3) & ((others[edge] % 2 == 1) | (others[edge] + doubled[edge] == 1))
    bounded = np.bincount(region[facet], np.repeat(repeated, 3) & rim) > 0
    refuted = np.bincount(region[facet], wrong) > 0
    result: Bools = (bounded & ~refuted)[region]
    return result


# --- Normals


def _outward(points: Floats, corners: Ints, edges: _Edges) -> tuple[Bools, Ints]:
    """Return which facets (f,) to turn, and the part (f,) of each, a cavity with its host.

    Facets joined by edges of two form a sheet, within which they are made alike: the smaller share is turned. A sheet
    that is closed is a part, as are the other ones that touch.
    """
    sheet, turned = _alike(len(corners), edges)
    part = _parts(corners, edges, sheet, turned)
    closed = np.ones(int(part.max(initial=-1)) + 1, np.bool_)
    facet = np.repeat(np.arange(len(corners)), 3)
    closed[part[facet[edges.uses[edges.number] == 1]]] = False
    hosts = np.arange(len(closed))
    local = points - points.mean(axis=0) if len(points) else points
    right = _turned(corners, turned)
    # Six times the volume (f,) between each facet and the origin
    at = local[right]
    six_volumes = np.einsum("ni,ni->n", at[:, 0], np.cross(at[:, 1], at[:, 2]))
    volume = np.asarray(np.bincount(part, six_volumes, len(closed)), np.float64)
    if (volume < 0.0).any():
        hosts = _hosts(local, right, part, volume)
        inside_out = (volume < 0.0) & closed & (hosts == np.arange(len(hosts)))
        turned ^= inside_out[part]
    return turned, hosts[part]


def _alike(count: int, edges: _Edges) -> tuple[Ints, Bools]:
    """Return the sheet (f,) of each facet, and which to turn so that those of a sheet agree: the smaller share.

    Facets are nodes of a graph twice, as they are and turned; each edge of two facets connects what agrees. Of a
    surface with one side nothing is turned.
    """
    a, b = edges.pairs()
    sheet = components(count, a // 3, b // 3)
    against = edges.forward[a] == edges.forward[b]  # both pass their edge the same way: opposite normals
    if not against.any():
        return sheet, np.zeros(count, np.bool_)
    other = against * count
    rows = np.concatenate([a // 3, a // 3 + count])
    columns = np.concatenate([b // 3 + other, (b // 3 + count + other) % (2 * count)])
    side = components(2 * count, rows, columns)
    one_sided = side[:count] == side[count:]
    first = np.unique(sheet, return_index=True)[1]
    turned = (side[:count] != side[first][sheet]) & ~one_sided
    share = np.bincount(sheet, turned) / np.bincount(sheet)
    result: Bools = turned ^ ((share > 0.5)[sheet] & ~one_sided)
    return sheet, result


def _parts(corners: Ints, edges: _Edges, sheet: Ints, turned: Bools) -> Ints:
    """Return the part (f,) of each facet: its sheet where that is closed, else all sheets that touch it and are not."""
    closed = np.ones(int(sheet.max(initial=-1)) + 1, np.bool_)
    facet = np.repeat(np.arange(len(corners)), 3)
    odd = np.flatnonzero(edges.uses[edges.number] != 2)  # sides of other edges
    key = sheet[facet[odd]] * len(edges.uses) + edges.number[odd]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    forward = edges.forward[odd] ^ turned[facet[odd]]
    balance = np.bincount(which.reshape(-1), np.where(forward, 1.0, -1.0), len(first))
    closed[sheet[facet[odd[first[balance != 0.0]]]]] = False
    if closed.all():
        return sheet
    # The first corner of each facet links it to its other ones; closed sheets have corners of their own.
    count = int(corners.max(initial=-1)) + 1
    nodes = np.where(closed[sheet][:, None], sheet[:, None], len(closed) + corners)
    part = components(len(closed) + count, nodes[:, [0, 0]].ravel(), nodes[:, 1:].ravel())[nodes[:, 0]]
    return _renumbered(part)


def _hosts(points: Floats, corners: Ints, part: Ints, volume: Floats) -> Ints:
    """Return for each part (p,) itself, or for one of negative volume the smallest positive one around it."""
    low, high = np.full((len(volume), 3), np.inf), np.full((len(volume), 3), -np.inf)
    for k in range(3):
        np.minimum.at(low, part, points[corners[:, k]])
        np.maximum.at(high, part, points[corners[:, k]])
    result = np.arange(len(volume))
    first = np.unique(part, return_index=True)[1]
    for i in np.flatnonzero(volume < 0.0).tolist():
        around = (volume > 0.0) & (low < low[i]).all(axis=1) & (high > high[i]).all(axis=1)
        for k in np.flatnonzero(around)[np.argsort(volume[around], kind="stable")].tolist():
            # The winding number of a closed mesh about a point inside of it is about 1
            a, b, c = np.moveaxis(points[corners[part == k]] - points[corners[first[i]]].mean(axis=0), 1, 0)
            la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
            above = np.einsum("ni,ni->n", a, np.cross(b, c))
            below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
            if bool(np.arctan2(above, below).sum() > np.pi):
                result[i] = k
                break
    return result
