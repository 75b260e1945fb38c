"""Signs for the normals of a cloud's surfaces: up where that tells, else one sign over each connected surface.

The sign of a fitted normal is arbitrary. Up decides it for all but upright surfaces, whose normals are level within
their noise: there up would draw lots for each point. Those look towards their scanner where it is known. The rest are
tied to their neighbours along a minimum spanning tree (Hoppe et al. 1992), so that a surface has one sign, which is
that of what it joins, or a convention's. Nothing depends on the order of the points.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from processor.geometry.m3c2 import CloudNormals, oriented
from processor.geometry.parallel import over_ranges
from processor.model import Floats, Ints

Bools = npt.NDArray[np.bool_]

UP = np.array([0.0, 0.0, 1.0])
LEAN, MOST_LEAN = 0.2, 0.5  # vertical part of a normal from which up decides it: 12 degrees, more where it is noisy
SURE = 5.0  # standard deviations
IN_SIGHT = 0.1  # cosine between a normal and the ray from which the scanner decides it
NEIGHBOURS = 8
NODE = 0.2  # of the normals' diameter: core points nearer to each other, with normals about parallel, are one
PARALLEL = 0.7
GAP = 3.0  # times the usual distance of neighbours: what is farther apart is not one surface
SMOOTH = 0.3  # cosine between neighbours' normals below which they do not say anything of each other
NO_LINK, STEPS = 65_535, 30_000.0  # weights of links, from 0 to 2, in 16 bits: these are sorted in one go
CLEAR = 0.5  # share by which what a surface joins must agree
LEANS, FACES = 0.02, 0.1  # least mean of a surface's normals along an axis of the convention
# Off the axes and diagonals, along which walls are built: there a convention would flip by chance.
SIDES = np.array([[1.0, 2.0, 0.0], [2.0, -1.0, 0.0]]) / np.sqrt(5.0)
CONVENTION = "towards x + 2y, round ones outward"


@dataclass(frozen=True)
class Turned:
    """Unit normals (k, 3) with their signs, and what decided how many of them; ``surfaces`` went by convention."""

    normals: Floats
    up: int
    scanner: int
    neighbours: int
    convention: int
    surfaces: int

    @property
    def upright(self) -> int:
        """Normals that up did not decide."""
        return self.scanner + self.neighbours + self.convention


def undecided(found: CloudNormals, normal_diameter: float) -> Bools:
    """Mark (k,) the normals that are level within their noise, so that up says nothing of their sign.

    A plane fitted to n points within a radius r is turned by roughness / (sqrt(n) r / 2), one standard deviation.
    """
    least = np.clip(SURE * _noise(found, normal_diameter), LEAN, MOST_LEAN)
    with np.errstate(invalid="ignore"):
        level: Bools = np.abs(found.normals[:, 2]) < least
    return level


def turned(found: CloudNormals, core: Floats, normal_diameter: float, scanner: Floats | None = None) -> Turned:
    """Give normals at core points (k, 3) their signs: those that up decides as :func:`m3c2.oriented` does, bit by bit.

    ``scanner`` (k, 3) is where the surface was seen from at each core point, NaN = unknown.
    """
    normals = oriented(found.normals, UP)
    open_, known = undecided(found, normal_diameter), int(np.isfinite(found.normals).all(axis=1).sum())
    up = known - int(open_.sum())
    seen = 0
    if scanner is not None and open_.any():
        sight = scanner - core
        with np.errstate(invalid="ignore"):
            cosine = np.einsum("ni,ni->n", normals, sight) / np.linalg.norm(sight, axis=1)
            told = open_ & (np.abs(cosine) >= IN_SIGHT)
            normals = np.where((told & (cosine < 0.0))[:, None], -normals, normals)
        open_ = open_ & ~told
        seen = int(told.sum())
    if not open_.any():
        return Turned(normals, up, seen, 0, 0, 0)
    rows = np.flatnonzero(np.isfinite(normals).all(axis=1))
    rows = rows[np.lexsort(core[rows].T)]  # the order of the points must not show
    first, node = _nodes(core[rows], normals[rows], open_[rows], normal_diameter)
    some = rows[first]
    noise = _noise(found, normal_diameter)[some]
    sign, follows, surfaces = _signs(core[some], normals[some], open_[some], noise, normal_diameter)
    alike = np.where(np.einsum("ni,ni->n", normals[rows], normals[some][node]) < 0.0, -1.0, 1.0)
    normals[rows] *= np.where(open_[rows], alike * sign[node], 1.0)[:, None]
    joined = int((follows[node] & open_[rows]).sum())
    return Turned(normals, up, seen, joined, int(open_.sum()) - joined, surfaces)


def _noise(found: CloudNormals, normal_diameter: float) -> Floats:
    """Return the standard deviation (k,) of a normal's direction, rad."""
    noise: Floats = found.roughness / (np.sqrt(np.maximum(found.count, 1)) * 0.25 * normal_diameter)
    return noise


def _nodes(places: Floats, normals: Floats, open_: Bools, normal_diameter: float) -> tuple[Ints, Ints]:
    """Gather places (n, 3), sorted, that are much nearer to each other than their normals' sphere is wide.

    Returns the row of each node's first place, and the node (n,) of each place. Where normals are not about parallel
    a place is a node of its own; those that are ``open_`` (n,) are apart from others.
    """
    lower, widest = places.min(axis=0), float(np.ptp(places, axis=0).max())
    cell = ((places - lower) / max(NODE * normal_diameter, widest / (1 << 20), 1e-300)).astype(np.int64)
    key = ((cell[:, 0] << 20 | cell[:, 1]) << 20 | cell[:, 2]) << 1 | open_
    _, first, node = np.unique(key, return_index=True, return_inverse=True)
    node = node.reshape(-1)
    alone = np.flatnonzero(np.abs(np.einsum("ni,ni->n", normals, normals[first[node]])) < PARALLEL)
    node[alone] = len(first) + np.arange(len(alone))
    return np.concatenate([first, alone]).astype(np.int64), node.astype(np.int64)


def _signs(places: Floats, normals: Floats, open_: Bools, noise: Floats, reach: float) -> tuple[Floats, Bools, int]:
    """Return the sign (n,) for each normal, which of them (n,) follow what they join, how many surfaces a convention.

    Only those that are ``open_`` (n,) are turned.
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
    said, cast = np.bincount(surface[at], votes, count), np.bincount(surface[at], np.abs(votes), count)
    follows = (cast > 0.0) & (np.abs(said) >= CLEAR * cast)
    else_ = _convention(places[rows], normals[rows] * sign[:, None], surface, noise[rows])
    whole = np.where(follows, np.sign(said), else_)
    every, following = np.ones(len(places)), np.zeros(len(places), bool)
    every[rows], following[rows] = sign * whole[surface], follows[surface]
    return every, following, int((~follows).sum())


def _convention(places: Floats, normals: Floats, surface: Ints, noise: Floats) -> Floats:
    """Return the sign (s,) of each surface that nothing else decides, from its points' (n,) normals, which agree.

    Up where the surface leans as a whole, else towards x + 2y, or 2x - y of one along that; a closed one outward.
    """
    number = np.bincount(surface)

    def mean(of: Floats) -> Floats:
        found: Floats = np.bincount(surface, of) / number
        return found

    middle = np.stack([mean(places[:, i]) for i in range(3)], axis=1)
    off = places - middle[surface]
    outward = mean(np.einsum("ni,ni->n", normals, off))
    looks = np.stack([mean(normals[:, i]) for i in range(3)], axis=1)
    leans = np.maximum(LEANS, SURE * mean(noise) / np.sqrt(number))
    found = np.where(outward < 0.0, -1.0, 1.0)
    for along, least in ((SIDES[1], FACES), (SIDES[0], FACES), (UP, leans)):  # the last to hold goes first
        towards = looks @ along
        found = np.where(np.abs(towards) > least, np.sign(towards), found)
    return found


@njit(cache=True, nogil=True)
def _links(places, normals, rows, index, far, limit, start, stop, cosine, weight):  # type: ignore[no-untyped-def]
    """Weigh the links (m, k) of places in ``rows`` (m,) to their neighbours, and give the cosines of their normals.

    Neighbours on one smooth surface weigh least: parallel normals, and neither off the other's plane.
    """
    for row in range(start, stop):
        i = rows[row]
        for link in range(index.shape[1]):
            j, gap = index[row, link], far[row, link]
            weight[row, link], cosine[row, link] = NO_LINK, 0.0
            if i == j or not gap <= limit:
                continue
            dot, one, other = 0.0, 0.0, 0.0
            for axis in range(3):
                step = places[j, axis] - places[i, axis]
                dot += normals[i, axis] * normals[j, axis]
                one += normals[i, axis] * step
                other += normals[j, axis] * step
            if abs(dot) < SMOOTH:
                continue
            off = 0.5 * (abs(one) + abs(other)) / gap if gap > 0.0 else 0.0
            cosine[row, link] = dot
            weight[row, link] = int(STEPS * max(0.0, 1.0 - abs(dot) + off))


@njit(cache=True, nogil=True)
def _surfaces(others, cosine, order, count):  # type: ignore[no-untyped-def]
    """Join items 0 to ``count`` along links in an order (Kruskal): root of each (count,), and sign against it.

    Link l of the ``order`` is that of item l // k with ``others`` (count, k), column l % k.
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
                # Halve the path: an item then points to its grandparent, with the sign against that; no root is odd.
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
