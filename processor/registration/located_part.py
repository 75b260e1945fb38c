"""A steel part among what stands about it: ground, walls, trestles, neighbours, crates, clamps, people.

A scan that is larger than its design holds more than the part. What is the part is decided by the design's surface: it
is placed on every body in the scan that may be the part, and the place where points show most of it is the part's.

Bodies are the connected pieces that are left without ground and walls: a plane with more area than the part's largest
side is none of its faces. A body may still have trestles, clamps and cables on it; a design that lies on it leaves
these off its surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from processor.distinct_rows import distinct
from processor.geometry import rigid
from processor.geometry.mesh_distance import on_face
from processor.geometry.thinning import thinned, voxel_means
from processor.geometry.thread_ranges import each
from processor.large_arrays import blocks, corners
from processor.model import Bools, Floats
from processor.registration import main_body, pose_choice, pose_search, principal, surface_registration
from processor.registration.pose_search import Candidate, DesignSurface

PART_VOXELS = (90.0, 70.0, 55.0, 40.0, 30.0)  # along the part's diagonal, the most that the points allow
PER_VOXEL = 2  # points of an occupied voxel, on average
LINKS = (1.8, 3.0)  # voxels between points of one piece: neighbours, corners included; across thin shadows
LEAST_LENGTH = 0.4  # of the part's, of a body that may be the part
LEAST_FACE, FACES = 0.3, 3  # of the part's longest by its least size, of a face that is no trestle's; of one body
# work: bodies; points that hypotheses are aligned by in each round, and those kept; points of the last, and that
# attitudes are told apart by
BODIES, START_POINTS, KEPT, POINTS, RIVAL_POINTS = 6, (150, 600, 1_500), (8, 3), 4_000, 30_000
SHOWN_MM = 10.0  # off the plane of a sample, up to which a point shows it: as of surface that tells poses apart
SHOWN_SAMPLES, SHOWN_POINTS = 4_000, 400_000  # work
PATCH_MM, PATCH_OFF = 250.0, 8.0  # a face's patch, larger than a clamp; off it, in standard deviations
BESIDE = 0.15  # of a design's length, by which a part of another shape may be longer
# Of the points on the body with most, from which on another body may be meant as well: in 30 rooms the part had 0.84 or
# more, neighbours 0.1 to 1.2.
SURE_RIVAL = 0.5
SHARED = 0.5  # of the points at a design, from which on two designs are placed on one body
AT_PART_MM = 60.0  # off the design, up to which points may be the part's: as much as parts deviate
# Share of a design's surface, inner faces included, that is shown of a part in its scan: in 29 of 30 rooms 0.49 to
# 0.89, read in feet for metres up to 0.33. Of another place, by the most that is shown, from which it is as good a
# place: the part had 0.865 of the most or more in 29 of the 30; the last got a question mark.
LEAST_SHOWN, AS_WELL = 0.3, 0.85


@dataclass(frozen=True)
class Located:
    """A place of a design in a scan: ``T`` (4, 4) maps the scan to the design, whose surface points show a share of.

    ``count`` is the number of points at the design there, of a sample.
    """

    T: Floats
    shown: float
    count: int = 0


NOT_LOCATED = Located(np.full((4, 4), np.nan), 0.0)  # nothing of the design is shown


class Body(NamedTuple):
    """A body in a scan: the numbers of the designs that it may be of, the best first, with a place of each."""

    numbers: tuple[int, ...]
    places: tuple[Located, ...]


def locate(points: Floats, designs: Sequence[DesignSurface], body: Floats | None = None) -> list[list[Located]]:
    """Locate each of several designs among points (n, 3) of a scan with surroundings, or on a ``body`` (k, 3) in it.

    Returns the places on different bodies that each is shown at about as well, the one with most points first.
    """
    size = float(np.median([design.size for design in designs])) if designs and len(points) else 0.0
    step = main_body.voxel_size(points, size, PART_VOXELS, PER_VOXEL) if size > 0.0 else 0.0
    if not step > 0.0:
        return [[] for _ in designs]
    bodies = [body] if body is not None else _bodies(points, step, [principal.sizes(one.points) for one in designs])
    if not bodies:
        return [[] for _ in designs]
    few = thinned(points, SHOWN_POINTS)
    search = _Search(few, cKDTree(few), step)
    found = [_located(search, bodies, design, pieces=False) for design in designs]
    if most_shown(found) < LEAST_SHOWN:
        found = [_located(search, bodies, design, pieces=True) for design in designs]
    return found


def most_shown(located: Sequence[Sequence[Located]]) -> float:
    """Return the largest share of a design's surface that is shown at any of its places."""
    return max((one.shown for places in located for one in places), default=0.0)


def which(
    points: Floats, designs: Sequence[DesignSurface], located: Sequence[Sequence[Located]], named: int = -1
) -> list[Body]:
    """Return the bodies in a scan's points (n, 3) that may be the part that is meant; () of none.

    It is the body with most points of those that show a design well, or the one that is of the design that is
    ``named``. Others follow that have SURE_RIVAL of its points or more.
    """
    most = most_shown(located)
    if most < LEAST_SHOWN:
        return []
    few, groups = thinned(points, SHOWN_POINTS), list[tuple[Bools, dict[int, Located]]]()  # by points that are shared
    every = [(k, one) for k, places in enumerate(located) for one in places]
    for k, one in sorted(every, key=lambda item: -item[1].count):
        at = at_design(few, one.T, designs[k])
        known = next((places for marked, places in groups if (marked & at).sum() > SHARED * at.sum()), None)
        if known is None:
            groups.append((at, {k: one}))
        else:
            known.setdefault(k, one)
    most_of = [most_shown([list(g.values())]) for _, g in groups]
    shown = [
        {k: one for k, one in g.items() if one.shown >= AS_WELL * of_body}
        for of_body, (_, g) in zip(most_of, groups, strict=True)
        if of_body >= AS_WELL * most
    ]
    counts = [max(one.count for one in g.values()) for g in shown]
    # A design with few of a body's points leaves the rest of it unexplained.
    shown = [{k: one for k, one in g.items() if one.count >= AS_WELL * n} for g, n in zip(shown, counts, strict=True)]
    bodies = [_body(points, designs, g) for g, n in zip(shown, counts, strict=True) if n >= SURE_RIVAL * max(counts)]
    return sorted(bodies, key=lambda body: (named not in body.numbers, -body.places[0].count))


def _body(points: Floats, designs: Sequence[DesignSurface], places: dict[int, Located]) -> Body:
    """Decide which of the designs placed on one body in points (n, 3) it is of."""
    numbers, near, poses = list(places), np.zeros(len(points), bool), []
    if len(numbers) == 1:
        return Body(tuple(numbers), tuple(places.values()))
    for k, one in places.items():
        at = at_design(points, one.T, designs[k])
        near |= at
        T = attitude(thinned(points[at], RIVAL_POINTS), designs[k], one.T)
        poses.append((designs[k].mesh, T))
    chosen = [numbers[k] for k in pose_choice.choose(points[near], poses)]
    return Body(tuple(chosen), tuple(places[k] for k in chosen))


def attitude(points: Floats, design: DesignSurface, T: Floats) -> Floats:
    """Return the pose (4, 4) of all that turn a design onto itself that points (n, 3) at it show best."""
    few, box = thinned(points, POINTS), pose_search.box_of(points)
    turned = [Candidate(turn @ T, T) for turn in pose_search.symmetries(design)]
    aligned = each(partial(pose_search.align, few, design), turned)
    rivals = pose_search.rivals_of(pose_search.distinct(aligned, box))
    best = surface_registration.decide(points, design, rivals)[0]
    # Plates that are seen from one side may lie on their other side: nothing but rings and marks shows it then.
    shifted = pose_search.on_other_sides(pose_search.evenly(points, design), design, [best], box)
    found = pose_search.distinct([best, *shifted], box)
    best = surface_registration.decide(points, design, pose_search.rivals_of(found))[0]
    fewer = thinned(points, surface_registration.RIVAL_POINTS)
    return surface_registration.fine(fewer, design.mesh, design.axes, best.T).T_design_scan


def about_design(points: Floats, T: Floats, design: DesignSurface, margin: float | None = None) -> Bools:
    """Mark the points (n, 3) that, placed by T (4, 4), are in a design's box or a ``margin`` beside it, by BESIDE."""
    margin = BESIDE * design.size if margin is None else margin
    low, high = corners(design.mesh.vertices)
    marked = np.empty(len(points), bool)
    for rows in blocks(len(points)):
        placed = rigid.apply(T, points[rows])
        marked[rows] = ((placed > low - margin) & (placed < high + margin)).all(axis=1)
    return marked


def at_design(points: Floats, T: Floats, design: DesignSurface) -> Bools:
    """Mark the points (n, 3) that, placed by T (4, 4), lie at a design: the part's, and what touches it."""
    marked = about_design(points, T, design, AT_PART_MM)
    for rows in blocks(len(points)):
        near = np.flatnonzero(marked[rows]) + rows.start
        face, off, beyond = design.mesh.distances(rigid.apply(T, points[near]), AT_PART_MM)
        marked[near] = (face >= 0) & (np.hypot(off, beyond) < AT_PART_MM)
    return marked


def consistent(points: Floats, T: Floats, design: DesignSurface, sigma_mm: float) -> Bools:
    """Mark the points (n, 3) at a design, placed by T (4, 4), that lie as far off its faces as most about them.

    What touches the part, a trestle, clamp or cable, is off the face that the points about it show. ``sigma_mm`` is the
    scatter of points about the faces. Points beyond the faces' edges stay: they may be of ends that are longer.
    """
    placed = rigid.apply(T, points)
    face, off, beyond = design.mesh.distances(placed, AT_PART_MM)
    on = on_face(face, beyond)
    normals = design.mesh.normals[face[on]] @ design.axes
    axis = np.argmax(np.abs(normals), axis=1)
    side = 2 * axis + (normals[np.arange(len(axis)), axis] > 0.0)
    cells = distinct(np.column_stack([np.floor(placed[on] @ design.axes / PATCH_MM).astype(np.int64), side])).number
    order = np.lexsort((off[on], cells))
    starts = np.searchsorted(cells[order], np.arange(cells.max(initial=-1) + 2))
    typical = off[on][order][(starts[:-1] + starts[1:]) // 2]  # the median of each patch
    marked: Bools = ~on
    marked[on] = np.abs(off[on] - typical[cells]) < max(PATCH_OFF * sigma_mm, SHOWN_MM / 2.0)
    return marked


class _Search(NamedTuple):
    """Points (n, 3) of a scan, their tree, and the size of its voxels."""

    few: Floats
    tree: cKDTree
    step: float


def _located(search: _Search, bodies: Sequence[Floats], design: DesignSurface, *, pieces: bool) -> list[Located]:
    """Return the places of a design on those of the bodies that show it well, the one with most points at it first."""
    found = [_on_body(search, body, design, pieces=pieces) for body in bodies]
    first = int(np.argmax([one.shown for one in found]))
    size = principal.sizes(design.points)
    for body, one in zip(bodies, found.copy(), strict=True):
        # Trestles turn the principal axes of a part that they stand under: its large faces show these without.
        if len(body) > len(bodies[first]) and one.shown < AS_WELL * found[first].shown:
            faces = _large_faces(body, search.step, LEAST_FACE * float(size[0] * size[2]))
            found += [_on_body(search, face, design, pieces=True) for face in faces]
    most = max(one.shown for one in found)
    found = [one for one in found if one.shown > 0.0 and one.shown >= AS_WELL * most]
    found = [replace(one, count=int(at_design(search.few, one.T, design).sum())) for one in found]
    places: list[Located] = []
    # In a wrong unit samples may be shown by points that are all beyond the faces' edges
    for one in sorted((one for one in found if one.count), key=lambda one: (-one.count, -one.shown)):
        known = next((k for k, place in enumerate(places) if _near(one, place, design)), None)
        if known is None:
            places.append(one)
        elif one.shown > places[known].shown:
            places[known] = replace(one, count=places[known].count)
    places = [one for one in places if one.count >= SURE_RIVAL * places[0].count]
    return [_best_slide(search, one, design) for one in places]


def _best_slide(search: _Search, one: Located, design: DesignSurface) -> Located:
    """Return a place slid along the part to where most is shown; see :func:`pose_search.slid`."""
    near = thinned(search.few[at_design(search.few, one.T, design)], POINTS)
    slides = pose_search.slid(near, design, Candidate(one.T, one.T), pose_search.box_of(near))
    best = max((_shown(search, design, c) for c in slides), key=lambda slid: slid.shown, default=one)
    return replace(best, count=one.count) if best.shown > one.shown else one


def _on_body(search: _Search, body: Floats, design: DesignSurface, *, pieces: bool) -> Located:
    """Place a design on a body, with the pose that shows most of its surface."""
    found = NOT_LOCATED
    for start in _starts(body, design, pieces=pieces):
        one = _shown(search, design, pose_search.align(thinned(body, START_POINTS[2]), design, start))
        found = one if one.shown > found.shown else found
    near = search.few[at_design(search.few, found.T, design)] if found.shown > 0.0 else search.few[:0]
    if len(near) >= main_body.FEWEST:  # what stands about the part draws the first pose
        again = _shown(search, design, pose_search.align(thinned(near, POINTS), design, Candidate(found.T, found.T)))
        found = again if again.shown > found.shown else found
    return found


def _starts(body: Floats, design: DesignSurface, *, pieces: bool) -> list[Candidate]:
    """Return the few most promising of all hypotheses of a body, aligned by more points from round to round."""
    even = pose_search.evenly(body, design)[0]
    by_axes = pose_search.by_principal_axes(body, design)
    hypotheses = by_axes + [pose_search.at_extents(even, design, T) for T in by_axes]
    hypotheses += pose_search.of_pieces(even, design) if pieces else []
    gates = design.gates(pose_search.COARSE_GATES_MM, pose_search.COARSE_GATE_SHARES)
    found, box = [Candidate(T, T) for T in hypotheses], pose_search.box_of(body)
    for count, gate, kept in zip(START_POINTS, (gates[:1], gates), KEPT, strict=False):
        few = thinned(even, count)
        aligned = each(partial(pose_search.align, few, design, gates_mm=gate), found)
        found = pose_search.distinct(aligned, box)[:kept]
    return found


def _shown(search: _Search, design: DesignSurface, c: Candidate) -> Located:
    """Return a pose with the share of the design's samples that points show there."""
    samples, normals = (thinned(one, SHOWN_SAMPLES) for one in (design.points, design.normals))
    placed = rigid.apply(rigid.invert(c.T), samples)
    distance, nearest = search.tree.query(placed, distance_upper_bound=2.0 * search.step)
    found = np.isfinite(distance)
    off = np.einsum("ni,ni->n", search.few[nearest[found]] - placed[found], normals[found] @ c.T[:3, :3])
    return Located(c.T, float((np.abs(off) < SHOWN_MM).sum()) / len(samples))


def _near(one: Located, other: Located, design: DesignSurface) -> bool:
    """Whether two places of a design are on one body: they overlap by half along each of its axes."""
    moved = rigid.apply(one.T @ rigid.invert(other.T), design.centre[None])[0] - design.centre
    return bool((np.abs(moved @ design.axes) < 0.5 * np.ptp(design.mesh.vertices @ design.axes, axis=0)).all())


def _bodies(points: Floats, step: float, sizes: Sequence[Floats]) -> list[Floats]:
    """Return the points of bodies that may be a part of one of ``sizes``: those left without ground and walls."""
    even = voxel_means(points, step)
    rest = even[main_body.without_planes(even, step, sizes)]
    least, found = LEAST_LENGTH * min(size[0] for size in sizes), list[Floats]()
    for link in LINKS:
        if not found and len(rest):
            pieces = (rest[rows] for rows in main_body.connected(rest, link * step)[: 2 * BODIES])
            found = [piece for piece in pieces if principal.sizes(piece)[0] > least][:BODIES]
    return found


def _large_faces(body: Floats, step: float, least: float) -> list[Floats]:
    """Return the points of the largest planes of a body, each larger than ``least``, mm^2."""
    left, faces = np.ones(len(body), bool), list[Floats]()
    while (
        len(faces) < FACES
        and left.sum() >= main_body.FEWEST
        and (on := main_body.large_plane(body[left], step, least)) is not None
    ):
        rows = np.flatnonzero(left)[on]
        left[rows] = False
        faces += [body[rows][piece] for piece in main_body.connected(body[rows], LINKS[1] * step)[:1]]
    return faces
