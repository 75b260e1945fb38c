"""Signs of the normals of a cloud's surfaces: upwards where possible, else one sign for each connected surface.

The sign of a fitted normal is arbitrary. It is chosen upwards except on upright surfaces, whose normals are level
within their noise: there the sign of the vertical part is random from point to point. Those normals are turned towards
their scanner where it is known. The rest are joined to their neighbours along a minimum spanning tree (Hoppe et al.
1992), so that a surface has one sign: that of the surfaces it joins, or one by convention. The result does not depend
on the order of the points. Of more than MOST_JOINED points an even sample is joined, and the others follow the nearest
of it with a nearly parallel normal.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor.geometry.m3c2 import CloudNormals, oriented
from processor.geometry.thread_ranges import over_ranges
from processor.large_arrays import allocate, blocks, every
from processor.model import Bools, Floats, Ints

UP = np.array([0.0, 0.0, 1.0])
LEAN, MOST_LEAN = 0.2, 0.5  # least vertical part of a normal turned upwards: 12 degrees, more for noisy normals
SURE = 5.0  # standard deviations
IN_SIGHT = 0.1  # least cosine between the ray and a normal that is turned towards the scanner
NEIGHBOURS, OF_SAMPLE = 8, 4  # joined by likeness: those around a place of a surface; 4 of a thinned sample
MOST_JOINED, SAMPLE = 1 << 20, 1 << 18  # points; of a sample at least
NODE = 0.2  # of the normals' diameter: core points nearer to each other with nearly parallel normals are one node
PARALLEL = 0.7  # cosine (45 degrees): beyond it two places lie on either side of an edge
GAP = 3.0  # times the median distance of neighbours: points farther apart are not on one surface
SMOOTH = 0.3  # cosine between neighbours' normals below which their signs are not related
NO_LINK, STEPS = 65_535, 30_000.0  # weights of links, from 0 to 2, in 16 bits, which sort faster
CLEAR = 0.5  # least share by which the normals that a surface joins must agree
LEANS, FACES = 0.02, 0.1  # least mean of a surface's normals along up and along the other axes of the convention
# Not along axes and diagonals, which walls often follow: there the sign of a convention would be random.
SIDES = np.array([[1.0, 2.0, 0.0], [2.0, -1.0, 0.0]]) / np.sqrt(5.0)
CONVENTION = "towards x + 2y, round ones outward"


@dataclass(frozen=True)
class Turned:
    """Unit normals (k, 3) with their signs, the numbers by each rule, and the ``surfaces`` signed by convention."""

    normals: Floats
    up: int
    scanner: int
    neighbours: int
    convention: int
    surfaces: int

    @property
    def upright(self) -> int:
        """Number of normals that are not signed upwards."""
        return self.scanner + self.neighbours + self.convention


def undecided(fitted: CloudNormals, normal_diameter: float) -> Bools:
    """Mark (k,) the normals that are level within their noise, so that the vertical part does not give their sign.

    The direction of a plane fitted to n points within a radius r has the sd roughness / (sqrt(n) r / 2).
    """
    least = np.clip(SURE * _noise(fitted, normal_diameter), LEAN, MOST_LEAN)
    with np.errstate(invalid="ignore"):
        level: Bools = np.abs(fitted.normals[:, 2]) < least
    return level


def turned(fitted: CloudNormals, core: Floats, normal_diameter: float, scanner: Floats | None = None) -> Turned:
    """Give normals at core points (k, 3) their signs; those turned upwards are equal to :func:`m3c2.oriented`.

    ``scanner`` (k, 3) is the position that the surface was seen from at each core point, NaN = unknown.
    """
    count = len(core)
    normals, open_ = allocate(count, 3), allocate(count, dtype=np.bool_)
    up = seen = left = 0
    for rows in blocks(count):
        sight = None if scanner is None else scanner[rows] - core[rows]
        normals[rows], open_[rows], level, known = _by_direction(fitted.take(rows), normal_diameter, sight)
        now = int(open_[rows].sum())
        up, seen, left = up + known - level, seen + level - now, left + now
    if not left:
        return Turned(normals=normals, up=up, scanner=seen, neighbours=0, convention=0, surfaces=0)
    if count <= MOST_JOINED:
        follows, surfaces = _join(fitted, normals, core, open_, normal_diameter)
        joined = int((follows & open_).sum())
    else:
        step = count // SAMPLE
        columns = (fitted.normals, fitted.roughness, fitted.count, normals, core, open_)
        one, two, three, own, places, unsigned = (every(column, step) for column in columns)
        follows, surfaces = _join(CloudNormals(one, two, three), own, places, unsigned, normal_diameter)
        joined = _follow(normals, core, open_, (places[unsigned], own[unsigned], follows[unsigned]))
    return Turned(
        normals=normals, up=up, scanner=seen, neighbours=joined, convention=left - joined, surfaces=surfaces
    )  # fmt: skip


def _by_direction(fitted: CloudNormals, normal_diameter: float, sight: Floats | None) -> tuple[Floats, Bools, int, int]:
    """Turn normals (k, 3) upwards, or along the ``sight`` (k, 3) to the scanner; returns also which (k,) have no sign.

    Then the number that up does not give a sign, and that of all normals.
    """
    normals, level = oriented(fitted.normals, UP), undecided(fitted, normal_diameter)
    open_, known = level, int(np.isfinite(fitted.normals).all(axis=1).sum())
    if sight is not None and level.any():
        with np.errstate(invalid="ignore"):
            cosine = np.einsum("ni,ni->n", normals, sight) / np.linalg.norm(sight, axis=1)
            facing = level & (np.abs(cosine) >= IN_SIGHT)
            normals = np.where((facing & (cosine < 0.0))[:, None], -normals, normals)
        open_ = level & ~facing
    return normals, open_, int(level.sum()), known


def _join(
    fitted: CloudNormals, normals: Floats, core: Floats, open_: Bools, normal_diameter: float
) -> tuple[Bools, int]:
    """Turn, in place, the normals (k, 3) that are ``open_`` (k,) as those of the surface they are on.

    Returns which (k,) are on one that follows adjoining surfaces, and the number of surfaces that do not.
    """
    following = np.zeros(len(core), bool)
    if not open_.any():
        return following, 0
    rows = np.flatnonzero(np.isfinite(normals).all(axis=1))
    rows = rows[np.lexsort(core[rows].T)]  # the result must not depend on the order of the points
    first, node = _nodes(core[rows], normals[rows], open_[rows], normal_diameter)
    some = rows[first]
    noise = _noise(fitted, normal_diameter)[some]
    sign, follows, surfaces = _signs(core[some], normals[some], open_[some], noise, normal_diameter)
    alike = np.where(np.einsum("ni,ni->n", normals[rows], normals[some][node]) < 0.0, -1.0, 1.0)
    normals[rows] *= np.where(open_[rows], alike * sign[node], 1.0)[:, None]
    following[rows] = follows[node]
    return following, surfaces


def _follow(normals: Floats, core: Floats, open_: Bools, sample: tuple[Floats, Floats, Bools]) -> int:
    """Turn, in place, normals (k, 3) that are ``open_`` (k,) as the nearest of a sample that is nearly parallel.

    The sample is places (m, 3), their normals (m, 3), and which (m,) follow adjoining surfaces; returns how many
    normals do so with them. Where none near is parallel, the sign is by convention.
    """
    places, theirs, follows = sample
    near = np.arange(1, min(OF_SAMPLE, len(places)) + 1)
    tree, joined = cKDTree(places), 0
    for rows in blocks(len(core)):
        at = rows.start + np.flatnonzero(open_[rows])
        own, sign = normals[at], normals[at] @ SIDES[0]
        if len(near) and len(at):
            index = tree.query(core[at], k=near, workers=-1)[1]
            cosine = np.einsum("ni,nki->nk", own, theirs[index])
            alike = np.abs(cosine) >= PARALLEL
            one, of = np.arange(len(at)), np.argmax(alike, axis=1)
            found = alike[one, of]
            sign = np.where(found, cosine[one, of], sign)
            joined += int((found & follows[index[one, of]]).sum())
        normals[at] = own * np.where(sign < 0.0, -1.0, 1.0)[:, None]
    return joined


def _noise(fitted: CloudNormals, normal_diameter: float) -> Floats:
    """Return the standard deviation (k,) of a normal's direction, rad; for a plane through all its points MOST_LEAN."""
    noise: Floats = fitted.roughness / (np.sqrt(np.maximum(fitted.count, 1)) * 0.25 * normal_diameter)
    exact = np.isnan(noise) & np.isfinite(fitted.normals).all(axis=1)
    noise[exact] = MOST_LEAN
    return noise


def _nodes(places: Floats, normals: Floats, open_: Bools, normal_diameter: float) -> tuple[Ints, Ints]:
    """Join places (n, 3), sorted, that are much nearer to each other than their normals' sphere is wide, to nodes.

    Returns the row of each node's first place, and the node (n,) of each place. A place whose normal is not nearly
    parallel is a node of its own. Places that are ``open_`` (n,), without a sign, do not share nodes with others.
    """
    lower, widest = places.min(axis=0), float(np.ptp(places, axis=0).max())
    cell = ((places - lower) / max(NODE * normal_diameter, widest / (1 << 20), 1e-300)).astype(np.int64)
    key = ((cell[:, 0] << 20 | cell[:, 1]) << 20 | cell[:, 2]) << 1 | open_
    _, first, node = np.unique(key, return_index=True, return_inverse=True)
    node = node.reshape(-1)
    single = np.flatnonzero(np.abs(np.einsum("ni,ni->n", normals, normals[first[node]])) < PARALLEL)
    node[single] = len(first) + np.arange(len(single))
    return np.concatenate([first, single]).astype(np.int64), node.astype(np.int64)


def _signs(places: Floats, normals: Floats, open_: Bools, noise: Floats, reach: float) -> tuple[Floats, Bools, int]:
    """Return signs (n,) of normals, which (n,) follow adjoining surfaces, and the number of surfaces that do not.

    Only the normals that are ``open_`` (n,) are turned.
    """
    rows = np.flatnonzero(open_)
    k = min(NEIGHBOURS + 1, len(places))
    far, index = cKDTree(places).query(places[rows], k=np.arange(1, k + 1), workers=-1)
    limit = max(reach, GAP * float(np.median(far[:, -1])))
    number = np.full(len(places), -1, np.int64)
    number[rows] = np.arange(len(rows))
    cosine, weight = np.empty(index.shape), np.empty(index.shape, np.uint16)
    over_ranges(
        lambda a, b: _links(places, normals, rows, index, far, limit, a, b, cosine, weight), len(rows), least=1024
    )
    other = number[index]
    inner = np.flatnonzero((other >= 0).ravel() & (weight < NO_LINK).ravel())
    order = inner[np.argsort(weight.ravel()[inner], kind="stable")]
    surface, sign = _surfaces(other, cosine, order, len(rows))
    _, surface = np.unique(surface, return_inverse=True)
    surface = surface.reshape(-1)
    outer = np.flatnonzero((other < 0).ravel() & (weight < NO_LINK).ravel())
    at, votes = outer // k, cosine.ravel()[outer]
    votes = votes * sign[at]
    count = int(surface.max()) + 1
    total, cast = np.bincount(surface[at], votes, count), np.bincount(surface[at], np.abs(votes), count)
    follows = (cast > 0.0) & (np.abs(total) >= CLEAR * cast)
    by_convention = _convention(places[rows], normals[rows] * sign[:, None], surface, noise[rows])
    of_surface = np.where(follows, np.sign(total), by_convention)
    signs, following = np.ones(len(places)), np.zeros(len(places), bool)
    signs[rows], following[rows] = sign * of_surface[surface], follows[surface]
    return signs, following, int((~follows).sum())


def _convention(places: Floats, normals: Floats, surface: Ints, noise: Floats) -> Floats:
    """Return the sign (s,) by convention of each surface, from its points' normals (n, 3), which agree.

    Upwards if the surface leans as a whole, else towards x + 2y, or 2x - y for one along that; outwards if closed.
    """
    number = np.bincount(surface)

    def mean(values: Floats) -> Floats:
        by_surface: Floats = np.bincount(surface, values) / number
        return by_surface

    middle = np.stack([mean(places[:, i]) for i in range(3)], axis=1)
    off = places - middle[surface]
    outward = mean(np.einsum("ni,ni->n", normals, off))
    looks = np.stack([mean(normals[:, i]) for i in range(3)], axis=1)
    leans = np.maximum(LEANS, SURE * mean(noise) / np.sqrt(number))
    sign = np.where(outward < 0.0, -1.0, 1.0)
    for along, least in ((SIDES[1], FACES), (SIDES[0], FACES), (UP, leans)):  # the last that applies has priority
        towards = looks @ along
        sign = np.where(np.abs(towards) > least, np.sign(towards), sign)
    return sign


@njit(cache=True, nogil=True)
def _links(places, normals, rows, index, far, limit, start, stop, cosine, weight):  # type: ignore[no-untyped-def]
    """Fill weights of the links (m, k) of places in ``rows`` (m,) to their neighbours, and cosines of their normals.

    The weight is least for neighbours on one smooth surface: parallel normals, and each in the other's plane.
    """
    for row in range(start, stop):
        i = rows[row]
        for link in range(index.shape[1]):
            j, gap = index[row, link], far[row, link]
            weight[row, link], cosine[row, link] = NO_LINK, 0.0
            if i == j or not gap <= limit:
                continue
            dot, off_i, off_j = 0.0, 0.0, 0.0
            for axis in range(3):
                step = places[j, axis] - places[i, axis]
                dot += normals[i, axis] * normals[j, axis]
                off_i += normals[i, axis] * step
                off_j += normals[j, axis] * step
            if abs(dot) < SMOOTH:
                continue
            off = 0.5 * (abs(off_i) + abs(off_j)) / gap if gap > 0.0 else 0.0
            cosine[row, link] = dot
            weight[row, link] = int(STEPS * max(0.0, 1.0 - abs(dot) + off))


@njit(cache=True, nogil=True)
def _surfaces(others, cosine, order, count):  # type: ignore[no-untyped-def]
    """Join items 0 to ``count`` - 1 along links in an order (Kruskal): root (count,) of each, sign relative to it.

    Link l of the ``order`` joins item l // k and ``others`` (count, k) of it, column l % k.
    """
    k = others.shape[1]
    root, odd = np.arange(count), np.zeros(count, np.bool_)
    size = np.ones(count, np.int64)
    ends = np.empty(2, np.int64)
    parity = np.empty(2, np.bool_)
    for link in order:
        ends[0], ends[1] = link // k, others[link // k, link % k]
        for side in range(2):
            at, turn = ends[side], False
            while root[at] != at:
                up = root[at]
                # Path halving: an item then points to its grandparent, with its sign. A root is never odd.
                odd[at] = odd[at] != odd[up]
                root[at] = root[up]
                turn = turn != odd[at]
                at = root[at]
            ends[side], parity[side] = at, turn
        a, b = ends[0], ends[1]
        if a == b:
            continue
        if size[a] < size[b] or (size[a] == size[b] and b < a):
            a, b = b, a
        root[b] = a
        odd[b] = (parity[0] != parity[1]) != (cosine[link // k, link % k] < 0.0)
        size[a] += size[b]
    sign = np.ones(count)
    for item in range(count):
        at, turn = item, False
        while root[at] != at:
            turn = turn != odd[at]
            at = root[at]
        sign[item] = -1.0 if turn else 1.0
        odd[item], root[item] = turn, at
    return root, sign
