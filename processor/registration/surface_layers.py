"""Which scanned points lie on the structure, and which on what stands against it: scaffold, boards, crates, trays.

What stands against steel lies outside its surface. Of the points about a core point, the structure is therefore the
innermost layer, and a plane is fitted to that. Where something hides the steel, the layer is that of what hides it. Its
surface does not continue that of the steel about it, and lies before where the faces of the same body about it have
moved to; steel that moved or is bent does one of the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor.adjustment.point_groups import group_means, pieces
from processor.distinct_rows import components
from processor.geometry.mesh_distance import Samples
from processor.model import Bools, Floats, Ints
from processor.robust_statistics import MAD_TO_SD

NEAREST = 3  # core points that a point counts at: as many overlap at each
FEWEST = 4  # points of a layer: as few as have a level of detection
SAME_FACE = 0.5  # least cosine between the normals of a point and of its core point
NOISE_SHARE, FLOOR_MM = 0.75, 0.05  # quantile of the noise about core points; the least, for scans without any
WITHIN = 4.0  # standard deviations of the noise from a layer's plane: one point of 16,000 is farther
PART = 0.5  # of the points of the densest layer, that the innermost one has at least: fewer are strays
STEEPEST = 0.1  # slope of steel from its design, one sd; steepest dents have twice that
CURVATURE = 0.001  # 1 / mm, of a dent 20 mm deep and 600 mm wide: 0.5 * 20 * (pi / 300)**2
LINKS, REACH = 8, 1.5  # neighbours that a layer may continue to, and how far they are, by the median of the last
# Pieces of faces about one, and of them the nearest, whose other sides show how it moved; their least side in
# diameters, and the weight of other bodies
AROUND, BEHIND, PIECE, OTHER_BODY = 96, 24, 3.0, 0.05
# Of a body that lies before its design all about, by less than boards are thick, other plates or sections were built.
LARGER_MM, HALF = 12.0, 0.5
AGREES_MM, AGREE = 3.0, 0.1  # of the movement about it, to which a surface agrees; the least share of it that does
ROUNDS = 20  # work: of least absolute residuals


@dataclass(frozen=True)
class Layers:
    """Planes of the structure's surface at places (k, 3): ``height`` (k,) over the design and ``slope`` (k, 3).

    ``structure`` (k,) is False where the layer is of something else, ``noise`` the standard deviation of points, mm.
    ``radius`` is that of the points that a plane is fitted to.
    """

    tree: cKDTree
    height: Floats
    slope: Floats
    structure: Bools
    noise: float
    radius: float

    def of_structure(self, feet: Floats, distance: Floats, *, behind: bool = True) -> Bools:
        """Mark (n,) the points with feet (n, 3) on the design and distances (n,) that do not lie before its surface.

        Those that lie ``behind`` it are what is seen past an edge or through a hole.
        """
        if not len(self.height) or not len(feet):
            return np.ones(len(feet), np.bool_)
        far, at = self.tree.query(feet, workers=-1)
        # Beyond its radius a plane says no more than that steel is not steeper.
        near = far <= self.radius
        slope = np.where(near, np.einsum("ni,ni->n", self.slope[at], feet - self.tree.data[at]), 0.0)
        allowed = WITHIN * self.noise + np.where(near, 0.5 * CURVATURE * far**2, 2.0 * STEEPEST * far)
        before = distance - self.height[at] - slope
        on: Bools = (before <= allowed) & (self.structure[at] | ~near)
        return on if behind else on & ((before >= -allowed) | ~near)


# Where no point lies near the design
NO_LAYERS = Layers(
    cKDTree(np.zeros((1, 3))), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.bool_), noise=0.0, radius=0.0
)


class _Groups(NamedTuple):
    """Points (n,) by the core point ``at`` that they count at, and by distance; ``first``, ``size`` of groups (g,)."""

    at: Ints
    row: Ints
    distance: Floats
    group: Ints
    first: Ints
    size: Ints


def of_points(
    core: Samples,
    body: Ints,
    feet: Floats,
    distance: Floats,
    normals: Floats,
    diameter_mm: float,
    piece_mm: float = 0.0,
) -> Layers:
    """Find the structure's surface by points with feet (n, 3), distances (n,) and normals (n, 3) of their facets.

    ``body`` (k,) is that of each core point.
    """
    groups = _grouped(core, feet, distance, normals, 0.5 * diameter_mm)
    if not len(groups.first):
        return NO_LAYERS
    noise = _noise(groups)
    on = _innermost(groups, 2.0 * WITHIN * noise)
    at = groups.at[groups.first]
    places, facing = core.points[at], core.normals[at]
    height, slope, known = _planes(groups, on, feet, places, noise)
    places, facing, height, slope = places[known], facing[known], height[known], slope[known]
    if not len(height):
        return NO_LAYERS
    expected, spread = _expected(places, facing, height, body[at][known], max(PIECE * diameter_mm, piece_mm), noise)
    off = height - expected
    tree = cKDTree(places)
    surface = _continued(tree, facing, height, slope, noise)
    size = np.bincount(surface)
    agreeing = np.bincount(surface, np.abs(off) <= np.maximum(AGREES_MM, WITHIN * np.maximum(spread, noise))) / size
    before = np.bincount(surface, off) > 0.0
    beside = (before & (agreeing < AGREE))[surface]
    of_body = body[at][known] - body.min()  # -1 = of none
    larger = np.bincount(of_body, beside & (off < LARGER_MM)) > HALF * np.bincount(of_body)
    beside &= ~larger[of_body]
    return Layers(tree, height, slope, ~beside, noise=noise, radius=0.5 * diameter_mm)


def _grouped(core: Samples, feet: Floats, distance: Floats, normals: Floats, radius: float) -> _Groups:
    """Sort points by their core points and distances; groups of fewer than FEWEST are left out."""
    far, at = cKDTree(core.points).query(feet, k=NEAREST, distance_upper_bound=radius, workers=-1)
    row, nth = np.nonzero(np.isfinite(far))
    at = at[row, nth]
    rows = np.flatnonzero(np.einsum("ni,ni->n", normals[row], core.normals[at]) > SAME_FACE)
    rows = rows[np.bincount(at[rows], minlength=len(core.points))[at[rows]] >= FEWEST]
    at, row = at[rows], row[rows]
    order = np.lexsort((distance[row], at))
    at, row = at[order], row[order]
    _, first, group, size = np.unique(at, return_index=True, return_inverse=True, return_counts=True)
    return _Groups(at, row, distance[row], group=group.reshape(-1), first=first, size=size)


def _noise(groups: _Groups) -> float:
    """Return the standard deviation of points about their layers, mm: by the shortest half of each group."""
    half = groups.size // 2
    end = np.arange(len(groups.at)) + half[groups.group]
    inside = end < (groups.first + groups.size)[groups.group]
    width = np.full(len(end), np.inf)
    width[inside] = groups.distance[end[inside]] - groups.distance[inside]
    least = np.minimum.reduceat(width, groups.first)
    return max(FLOOR_MM, 0.5 * float(np.quantile(least, NOISE_SHARE)) * MAD_TO_SD)


def _innermost(groups: _Groups, window: float) -> Bools:
    """Mark the points (n,) of the innermost layer of each group, a ``window`` of distances."""
    d, group, first = groups.distance, groups.group, groups.first
    key = (d - d.min() + 1.0) + group * (2.0 * (np.ptp(d) + window + 1.0))
    rows = np.arange(len(d))
    count = np.searchsorted(key, key + window, side="right") - rows
    dense = count >= PART * np.maximum.reduceat(count, first)[group]
    begin = np.minimum.reduceat(np.where(dense, rows, len(d)), first)
    near = dense & (rows >= begin[group]) & (d <= (d[begin] + window)[group])
    best = np.maximum.reduceat(np.where(near, count * len(d) - rows, -len(d)), first)
    start = np.where(best >= 0, -best % len(d), begin)
    on: Bools = (rows >= start[group]) & (d <= (d[start] + window)[group])
    return on


def _planes(groups: _Groups, on: Bools, feet: Floats, places: Floats, noise: float) -> tuple[Floats, Floats, Bools]:
    """Fit planes to the points (n,) of layers: heights (g,) at places (g, 3), slopes (g, 3), and which are known."""
    group, count = groups.group, len(places)
    A = np.hstack([np.ones((len(group), 1)), feet[groups.row] - places[group]])
    prior = np.diag([0.0, *[(noise / STEEPEST) ** 2] * 3])
    fitted, used = np.zeros((count, 4)), np.flatnonzero(on)
    for _ in range(2):  # the first plane is that of a layer without slope
        N, g = np.empty((count, 4, 4)), np.empty((count, 4))
        at, columns, d = group[used], A[used].T, groups.distance[used]
        for i in range(4):
            g[:, i] = np.bincount(at, columns[i] * d, count)
            for j in range(i + 1):
                N[:, i, j] = N[:, j, i] = np.bincount(at, columns[i] * columns[j], count)
        known = N[:, 0, 0] >= FEWEST
        fitted[known] = np.linalg.solve(N[known] + prior, g[known, :, None])[:, :, 0]
        left = groups.distance - np.einsum("ni,ni->n", A, fitted[group])
        used = np.flatnonzero(known[group] & (np.abs(left) <= WITHIN * noise))
    return fitted[:, 0], fitted[:, 1:], known


def _expected(
    places: Floats, facing: Floats, height: Floats, body: Ints, side: float, noise: float
) -> tuple[Floats, Floats]:
    """Return the heights (k,) of the translation that most of the surface about each place has, and their sd (k,).

    It is that of least absolute residuals over pieces of faces in all directions, those of the same body first.
    """
    piece = pieces(places, facing, side)
    piece = np.unique(np.column_stack([piece, body]), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((height, piece))
    size = np.bincount(piece)
    value = height[order[np.cumsum(size) - size + size // 2]]
    centre, normal = group_means(places, piece), group_means(facing, piece)
    of_body = np.zeros(len(size), np.int64)
    of_body[piece] = body
    near = cKDTree(centre).query(centre, k=min(AROUND, len(centre)), workers=-1)[1].reshape(len(centre), -1)
    weight = np.where(of_body[near] == of_body[:, None], 1.0, OTHER_BODY)
    u, spread = _translations(value[near], normal[near], weight, noise)
    expected: Floats = np.einsum("ki,ki->k", facing, u[piece])
    # What moved is moved on its other side as well, however little of the surface about it is.
    near = near[:, :BEHIND]
    cosine, own = np.einsum("pi,pki->pk", normal, normal[near]), of_body[near] == of_body[:, None]
    weight = np.where(own & (cosine < SAME_FACE), 1.0, 0.0)
    u, spread_of_others = _translations(value[near], normal[near], weight, noise)
    by_others = np.einsum("ki,ki->k", facing, u[piece])
    seen = (own & (cosine < -SAME_FACE)).any(axis=1)[piece]
    # Boards add to the thickness between both sides: that which is off by less is the steel's.
    seen &= (np.abs(height - by_others) < np.abs(height - expected)) | (np.abs(by_others) < np.abs(expected))
    return np.where(seen, by_others, expected), np.where(seen, spread_of_others[piece], spread[piece])


def _translations(value: Floats, normal: Floats, weight: Floats, noise: float) -> tuple[Floats, Floats]:
    """Return the translations (p, 3) of least absolute residuals to heights (p, k) along normals, and sd (p,) of these.

    It is infinite without any of weight.
    """
    u = np.zeros((len(value), 3))
    for _ in range(ROUNDS):
        left = np.abs(value - np.einsum("pki,pi->pk", normal, u))
        w = weight / np.maximum(left, noise)
        N = np.einsum("pk,pki,pkj->pij", w, normal, normal)
        g = np.einsum("pk,pki,pk->pi", w, normal, value)
        N += (1e-3 * np.trace(N, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3)
        u = np.linalg.solve(N, g[:, :, None])[:, :, 0]
    left = np.sort(np.where(weight > 0.0, left, np.inf), axis=1)
    middle = (np.count_nonzero(weight, axis=1) - 1) // 2
    return u, MAD_TO_SD * np.take_along_axis(left, middle[:, None], axis=1)[:, 0]


def _continued(tree: cKDTree, facing: Floats, height: Floats, slope: Floats, noise: float) -> Ints:
    """Return the number (k,) of the surface of each layer: planes beside each other that meet half way are of one."""
    places: Floats = tree.data
    far, other = tree.query(places, k=min(LINKS + 1, len(places)), workers=-1)
    far, other = far.reshape(len(places), -1), other.reshape(len(places), -1)
    a, nth = np.nonzero(far <= REACH * np.median(far[:, -1]))
    b, far = other[a, nth], far[a, nth]
    between = 0.5 * (places[b] - places[a])
    step = height[b] - height[a] - np.einsum("ni,ni->n", slope[a] + slope[b], between)
    meets = np.abs(step) <= WITHIN * noise + 0.25 * CURVATURE * far**2
    meets &= np.einsum("ni,ni->n", facing[a], facing[b]) > SAME_FACE
    return components(len(places), a[meets], b[meets])
