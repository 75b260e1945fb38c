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
# work: bodies; points that hypotheses are aligned by in each round, and those kept; points of the last
BODIES, START_POINTS, KEPT, POINTS = 6, (150, 600, 1_500), (8, 3), 4_000
SHOWN_MM = 10.0  # off the plane of a sample, up to which a point shows it: as of surface that tells poses apart
SHOWN_SAMPLES, SHOWN_POINTS = 4_000, 400_000  # work
PATCH_MM, PATCH_OFF = 250.0, 8.0  # a face's patch, larger than a clamp; off it, in standard deviations
BESIDE = 0.15  # of a design's length, by which a part of another shape may be longer
SURE_RIVAL = 0.5  # of the part's points, from which on another body of its shape may be meant as well
AT_PART_MM = 60.0  # off the design, up to which points may be the part's: as much as parts deviate
# Share of a design's surface, inner faces included, that is shown of a part in its scan; of another's place, by the
# most that is shown, from which it is as good a place; between places of one body, by the design's size.
LEAST_SHOWN, AS_WELL, SAME_PLACE = 0.3, 0.85, 0.08


@dataclass(frozen=True)
class Located:
    """``T`` (4, 4) maps the scan to the design; ``shown`` is the share of its surface that points show there.

    ``count`` is the number of points at the design, of a sample; ``rival`` that at another place of a body of the same
    shape, as a share of it: 0 without one.
    """

    T: Floats
    shown: float
    count: int = 0
    rival: float = 0.0


NOT_LOCATED = Located(np.full((4, 4), np.nan), 0.0)  # nothing of the design is shown


def locate(points: Floats, designs: Sequence[DesignSurface], body: Floats | None = None) -> list[Located]:
    """Locate each of several designs among points (n, 3) of a scan with surroundings, or on a ``body`` (k, 3) in it."""
    size = float(np.median([design.size for design in designs])) if designs and len(points) else 0.0
    step = main_body.voxel_size(points, size, PART_VOXELS, PER_VOXEL) if size > 0.0 else 0.0
    if not step > 0.0:
        return [NOT_LOCATED] * len(designs)
    bodies = [body] if body is not None else _bodies(points, step, [principal.sizes(one.points) for one in designs])
    if not bodies:
        return [NOT_LOCATED] * len(designs)
    few = thinned(points, SHOWN_POINTS)
    search = _Search(few, cKDTree(few), step)
    found = [_located(search, bodies, design, pieces=False) for design in designs]
    if max(one.shown for one in found) < LEAST_SHOWN:
        found = [_located(search, bodies, design, pieces=True) for design in designs]
    return found


def which(points: Floats, designs: Sequence[DesignSurface], located: Sequence[Located], named: int = -1) -> list[int]:
    """Return the designs that the body in a scan's points (n, 3) may be of, the best first; () of none.

    It is the body with most points of those that show a design well. Where the design that is ``named`` is shown nearly
    as well as any, it is that one.
    """
    most = max(one.shown for one in located)
    if most < LEAST_SHOWN:
        return []
    well = [k for k, one in enumerate(located) if one.shown >= AS_WELL * most]
    first = named if named in well else max(well, key=lambda k: located[k].count)
    place = _place(located[first], designs[first])
    same = [k for k in well if k == first or _near(_place(located[k], designs[k]), place, designs[k])]
    near, poses = np.zeros(len(points), bool), []
    for k in same:
        at = at_design(points, located[k].T, designs[k])
        near |= at
        fewer = thinned(points[at], surface_registration.RIVAL_POINTS)
        fine = surface_registration.fine(fewer, designs[k].mesh, designs[k].axes, located[k].T).T_design_scan
        poses.append((designs[k].mesh, fine))
    return [same[k] for k in pose_choice.choose(points[near], poses)]


def about_design(points: Floats, T: Floats, design: DesignSurface) -> Bools:
    """Mark the points (n, 3) that, placed by T (4, 4), are in the box of a design or a share of its length beside."""
    low, high = corners(design.mesh.vertices)
    margin, marked = BESIDE * design.size, np.empty(len(points), bool)
    for rows in blocks(len(points)):
        placed = rigid.apply(T, points[rows])
        marked[rows] = ((placed > low - margin) & (placed < high + margin)).all(axis=1)
    return marked


def at_design(points: Floats, T: Floats, design: DesignSurface) -> Bools:
    """Mark the points (n, 3) that, placed by T (4, 4), lie at a design: the part's, and what touches it."""
    marked = np.empty(len(points), bool)
    low, high = corners(design.mesh.vertices)
    for rows in blocks(len(points)):
        placed = rigid.apply(T, points[rows])
        near = ((placed > low - AT_PART_MM) & (placed < high + AT_PART_MM)).all(axis=1)
        face, off, beyond = design.mesh.distances(placed[near], AT_PART_MM)
        near[near] = (face >= 0) & (np.hypot(off, beyond) < AT_PART_MM)
        marked[rows] = near
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


def _located(search: _Search, bodies: Sequence[Floats], design: DesignSurface, *, pieces: bool) -> Located:
    """Locate a design on the one of the bodies that shows it well and has most points at it."""
    found = [_on_body(search, body, design, pieces=pieces) for body in bodies]
    first = int(np.argmax([one.shown for one in found]))
    size = principal.sizes(design.points)
    for body, one in zip(bodies, found.copy(), strict=True):
        # Trestles turn the principal axes of a part that they stand under: its large faces show these without.
        if len(body) > len(bodies[first]) and one.shown < AS_WELL * found[first].shown:
            faces = _large_faces(body, search.step, LEAST_FACE * float(size[0] * size[2]))
            found += [_on_body(search, face, design, pieces=True) for face in faces]
    most = max(one.shown for one in found)
    if not most > 0.0:
        return NOT_LOCATED
    found = [one for one in found if one.shown >= AS_WELL * most]
    found = [replace(one, count=int(at_design(search.few, one.T, design).sum())) for one in found]
    best = max(found, key=lambda one: (one.count, one.shown))
    place = _place(best, design)
    best = max((one for one in found if _near(_place(one, design), place, design)), key=lambda one: one.shown)
    others = [one.count for one in found if not _near(_place(one, design), place, design)]
    # Few points constrain a part of even curvature along its length: see :func:`pose_search.slid`.
    near = thinned(search.few[at_design(search.few, best.T, design)], POINTS)
    slides = pose_search.slid(near, design, Candidate(best.T, best.T), pose_search.box_of(near))
    slid = max((_shown(search, design, c) for c in slides), key=lambda one: one.shown, default=best)
    T, shown = (slid.T, slid.shown) if slid.shown > best.shown else (best.T, best.shown)
    return Located(T, shown, best.count, max(others, default=0) / max(best.count, 1))


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


def _place(located: Located, design: DesignSurface) -> Floats:
    """Return where the centre of a design's surface lies in the scan, (3,)."""
    place: Floats = rigid.apply(rigid.invert(located.T), design.centre[None])[0]
    return place


def _near(place: Floats, other: Floats, design: DesignSurface) -> bool:
    """Whether two places (3,) of a design are on one body: bodies beside each other are farther apart."""
    return float(np.linalg.norm(place - other)) < SAME_PLACE * design.size


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
