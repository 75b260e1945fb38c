"""Faces too narrow for core points, such as the edges of plates: measured by the scanned points on them.

Points count whose feet lie within the face, further from its rims than a footprint, and before which no other steel
stands as designed. Most of these lie on the face itself; the others (mixed pixels, clutter) scatter about it.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from processor import large_arrays, scene_cloud
from processor.distinct_rows import distinct
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import FacetGrid
from processor.inspection import bore_fit, flat_faces
from processor.inspection.bore_fit import RIM_SHARE
from processor.inspection.flat_faces import FLOOR_MM, FlatFace, Observed, Pieces
from processor.inspection.holes import REACH_MM
from processor.inspection.points_in_design_frame import DesignCloud, SeenPoints
from processor.model import (
    Bools,
    Columns,
    Floats,
    Ints,
    Reason,
    Scan,
    Scene,
    StructureDesign,
    per_point_fields,
    reason,
)
from processor.robust_statistics import robust_sd_about_median, student_factor

BELOW_MM = 2.0  # under a face, where a line that looks for other steel before it begins: bodies may overlap by less
GATE_MM = 2.0  # from the level that most points are at, within which points are of the face
ALONG_MM = 300.0  # of a long face, over which its points are at one level to within GATE_MM
FEWEST = 4  # points of a face
LEAST_SHARE = 0.5  # of the points near a face, that are at its level
SINGLE = 30  # points of a face, up to which each is a piece of its own
A_PIECE, MOST_PIECES = 6, 60  # points of a piece of other faces, and pieces of a face
COMPARED = 1_000_000  # places times edges of an outline at once
CELLS = 2**20  # along each axis, whose numbers differ
OVERHANG_SHARE = 0.25  # weight of what a beam meets beyond a rim
PARALLEL = 0.9999  # cosine between the normals of a flat face's facets
RIM_MM = 3.5  # half of the widest beams near their scanner: nearer to a rim a beam may lie on another face as well
CLIP = 3.0  # robust standard deviations from a face's level beyond which points have no weight
LEAST_NOISE_MM = 0.1  # of a point, for clouds without noise: views would be weighed by rounding

Shift = Callable[[Floats], Floats]  # places (n, 3) of a body as designed -> by how much it has moved there (n, 3)


class Facets(NamedTuple):
    """The facets (f,) of a design: a grid of them, the bodies' names, the body of each, and which are flat.

    Facets of curved surfaces are not flat.
    """

    grid: FacetGrid
    names: tuple[str, ...]
    body: Ints
    flat: Bools


class Surroundings(NamedTuple):
    """What the narrow faces of all bodies are measured in: the cloud, the design, and the shared error.

    ``shared`` is the standard deviation of what the points of one station have in common, mm; NaN if step ``deviation``
    measured nothing.
    """

    cloud: DesignCloud
    design: Facets
    shared: float


@dataclass(frozen=True)
class OnFace(Columns):
    """Points (n, 3) that may be of a face, how far outward (n,) they lie from its design, and the view (n,) of each."""

    points: Floats
    off: Floats
    view: Ints


class Outline(NamedTuple):
    """A face in its own plane: a place on it (3,), unit axes (2, 3), its outline (m, 2, 2), and about its width, mm."""

    origin: Floats
    axes: Floats
    segments: Floats
    width: float

    def flat(self, points: Floats) -> Floats:
        """Return coordinates (n, 2) of points (n, 3)."""
        flat: Floats = (points - self.origin) @ self.axes.T
        return flat

    def clearance(self, at: Floats) -> Floats:
        """Return how far places (n, 2) lie within the outline, mm; less than 0 outside of it."""
        clearance = np.empty(len(at))
        for rows in large_arrays.blocks(len(at), 1 + COMPARED // len(self.segments)):
            clearance[rows] = self._clearance(at[rows])
        return clearance

    def _clearance(self, at: Floats) -> Floats:
        start, along = self.segments[:, 0], self.segments[:, 1] - self.segments[:, 0]
        off = at[:, None] - start
        share = np.einsum("nmi,mi->nm", off, along) / np.maximum(np.einsum("mi,mi->m", along, along), 1e-12)
        distance = np.linalg.norm(off - np.clip(share, 0.0, 1.0)[..., None] * along, axis=2).min(axis=1)
        # A line towards +x crosses the outline an odd number of times from within.
        low, high = off[..., 1] < 0.0, off[..., 1] - along[:, 1] < 0.0
        rise = np.where(along[:, 1] == 0.0, 1.0, along[:, 1])
        crossed = (low != high) & (off[..., 0] < off[..., 1] / rise * along[:, 0])
        inside = crossed.sum(axis=1) % 2 == 1
        clearance: Floats = np.where(inside, distance, -distance)
        return clearance


def surroundings(design: StructureDesign, cloud: DesignCloud, seen: Observed) -> Surroundings:
    """Return what the narrow faces of a design's bodies are measured in."""
    vertices, _ = scene_cloud.local_design(design)
    names, body = flat_faces.named_bodies(design, vertices)
    cross, double = mesh_distance.double_areas(vertices, design.faces)
    normals = cross / np.maximum(double, 1e-12)[:, None]
    grid = mesh_distance.facet_grid(vertices, design.faces, normals, REACH_MM)
    part = mesh_distance.of_design(vertices, design.faces).part_of
    first = normals[np.unique(part, return_index=True)[1]][part]
    turned = np.einsum("fi,fi->f", normals, first) < PARALLEL
    flat = np.bincount(part, turned)[part] == 0
    known = seen.shared[np.isfinite(seen.deviation)]
    # At places that one station saw the shared error is the largest.
    return Surroundings(cloud, Facets(grid, names, body, flat), float(known.max()) if len(known) else float("nan"))


def outline(face: FlatFace) -> Outline:
    """Return the outline of a face: the edges that one of its facets alone has."""
    axes = _axes(face)
    centred = face.corners - face.corners.mean(axis=0)
    corners = (centred @ axes.T).reshape(-1, 3, 2)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    keys = np.rint(edges / (10.0 * FLOOR_MM)).astype(np.int64)
    both = [tuple(sorted(map(tuple, key.tolist()))) for key in keys]
    number = Counter(both)
    segments = edges[np.array([number[key] == 1 for key in both])]
    around = float(np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).sum())
    return Outline(face.corners.mean(axis=0), axes, segments, 2.0 * face.area / max(around, 1e-9))


def _axes(face: FlatFace) -> Floats:
    """Return unit vectors (2, 3) along and across a face."""
    first = np.linalg.svd(face.corners - face.corners.mean(axis=0), full_matrices=False)[2][0]
    return np.stack([first, np.cross(face.normal, first)])


def near(scene: Scene, T: Floats, origin: Floats, faces: Sequence[FlatFace], depth: float) -> Scene:
    """Return a scene without the points that lie far from all of some faces, which bodies moved by up to ``depth``, mm.

    T (4, 4) places the project in the design's frame, whose points are less ``origin`` (3,).
    """
    size = float(np.sqrt(3.0) * REACH_MM) + depth
    cells = [np.empty((0, 3), np.int64)]
    for face in faces:
        axes = _axes(face)
        flat = face.corners @ axes.T
        places = _grid(flat.min(axis=0), flat.max(axis=0)) @ axes
        places += (face.corners[0] @ face.normal) * face.normal
        cells.append(distinct(np.floor(places / size).astype(np.int64)).rows)
    about = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = np.unique(_keys((np.concatenate(cells)[:, None] + about).reshape(-1, 3)))
    scans = []
    for scan in scene.scans:
        T_design_scan = rigid.between_origins(T @ scan.pose, scan.origin, origin)
        kept = np.zeros(len(scan.points), bool)
        for rows in large_arrays.blocks(len(kept)):
            at = np.floor(rigid.apply(T_design_scan, scan.points[rows]) / size).astype(np.int64)
            kept[rows] = np.isin(_keys(at), wanted)
        if not kept.any() and len(scene.scans) > 1:
            continue
        columns: dict[str, Any] = {
            name: large_arrays.chosen(getattr(scan, name), kept)
            for name in ("points", "point_station")
            if len(getattr(scan, name)) == len(kept)
        }
        bare = {name: none for name in per_point_fields(Scan) if len(none := getattr(scan, name)[:0]) == 0}
        scans.append(dataclasses.replace(scan, **{**bare, **columns}))
    return dataclasses.replace(scene, scans=tuple(scans))


def _keys(cells: Ints) -> Ints:
    """Return a number (n,) of each cell (n, 3); cells a million apart may share it."""
    keys: Ints = ((cells % CELLS) * np.array([1, CELLS, CELLS**2])).sum(axis=1)
    return keys


def pieces(around: Surroundings, face: FlatFace, shift: Shift) -> tuple[Pieces, float, float] | Reason:
    """Return what was measured of a face, with errors of its level and of its tilt, or why it was not.

    Both errors are standard deviations, mm and rad. That of the level is of class B: in the middle half of a face
    narrower than four half beams a beam reaches over the rim by up to the difference. What it meets there lies deeper
    by about as much, and weighs about a quarter. ``shift`` moves the face in its own plane to where its body is as
    built.
    """
    if not around.design.flat[face.facets].all():
        return reason("inspect.face-not-seen")
    shape = outline(face)
    free = free_places(around, face, shape)
    if isinstance(free, Reason):
        return free
    seen = _on_face(around, face, shape, free, shift)
    if not len(seen.off):
        return reason("inspect.face-hidden")
    at = shape.flat(seen.points)[:, 0]
    used = _of_level(at, seen.off)
    if used.sum() < FEWEST or used.sum() < LEAST_SHARE * len(used):
        return reason("inspect.face-few-points", points=int(used.sum()))
    combined, tilt = _combined(seen.take(used), at[used], around.shared)
    return combined, OVERHANG_SHARE * (RIM_MM - _margin(shape)), tilt


def _margin(shape: Outline) -> float:
    """Return how far from its rims points of a face count, mm."""
    return min(RIM_MM, RIM_SHARE * shape.width)


def free_places(around: Surroundings, face: FlatFace, shape: Outline) -> Floats | Reason:
    """Return places (k, 3) all over a face that no other steel stands before, or which body touches it."""
    low, high = shape.segments.min(axis=(0, 1)), shape.segments.max(axis=(0, 1))
    at = _grid(low, high)
    corners = face.corners.reshape(-1, 3, 3)
    at = np.concatenate([at, shape.flat(corners.mean(axis=1)), shape.flat(0.5 * (corners[:, 0] + corners[:, 1]))])
    at = at[shape.clearance(at) >= _margin(shape)]
    places = shape.origin + at @ shape.axes
    before = stands_before(around, face, places)
    if len(before) and (before >= 0).all():
        touching = around.design.names[int(around.design.body[np.bincount(before).argmax()])]
        return reason("inspect.face-touches", body=touching)
    return places[before < 0]


def _grid(low: Floats, high: Floats) -> Floats:
    """Return places (k, 2) that lie all over a rectangle, at most two reaches apart."""
    sides = [
        np.linspace(a, b, max(3, int(np.ceil((b - a) / (2.0 * REACH_MM))) + 1)) for a, b in zip(low, high, strict=True)
    ]
    inner = [0.5 * (side[1:] + side[:-1]) for side in sides]
    return np.stack(np.meshgrid(*inner, indexing="ij"), axis=-1).reshape(-1, 2)


def stands_before(around: Surroundings, face: FlatFace, feet: Floats) -> Ints:
    """Return a facet (n,) of other steel, or of the body's own, that stands before places of a face; -1 = none."""
    found = np.full(len(feet), -1, np.int64)
    if not len(feet):
        return found
    row, facet, _ = mesh_distance.crossings(
        around.design.grid, feet - BELOW_MM * face.normal, feet + REACH_MM * face.normal, False
    )
    other = ~np.isin(facet, face.facets)
    found[row[other]] = facet[other]
    return found


def _on_face(around: Surroundings, face: FlatFace, shape: Outline, places: Floats, shift: Shift) -> OnFace:
    """Return the points that may be of a face."""

    def in_front(some: SeenPoints) -> Bools:
        near = np.abs((some.points - shape.origin) @ face.normal) < REACH_MM
        # Seen from the front, so that the footprint lies on the face; of unknown rays all count.
        return near & ~(-some.ray @ face.normal < bore_fit.LEAST_SLOPE)

    seen = around.cloud.near(places + shift(places), float(np.sqrt(3.0) * REACH_MM), in_front)
    off = (seen.points - shape.origin) @ face.normal
    feet = seen.points - np.outer(off, face.normal) - shift(seen.points)
    inside = shape.clearance(shape.flat(feet)) >= _margin(shape)
    inside[inside] = stands_before(around, face, feet[inside]) < 0
    return OnFace(seen.points, off, seen.view).take(inside)


def _of_level(at: Floats, off: Floats) -> Bools:
    """Mark the points (n,), at places along a face, that lie at the level that most of them are at."""
    used = np.zeros(len(off), bool)
    part = np.floor((at - at.min()) / ALONG_MM) if np.ptp(at) > 2.0 * ALONG_MM else np.zeros(len(at))
    for number in np.unique(part):
        rows = np.flatnonzero(part == number)
        level = np.sort(off[rows])
        first, last = np.searchsorted(level, level - GATE_MM), np.searchsorted(level, level + GATE_MM, side="right")
        best = level[last - first == (last - first).max()]
        middle = best[len(best) // 2]  # levels with as many points may lie far apart
        middle = float(np.median(level[np.abs(level - middle) < GATE_MM]))
        used[rows] = np.abs(off[rows] - middle) < GATE_MM
    return used


def _combined(seen: OnFace, at: Floats, shared: float) -> tuple[Pieces, float]:
    """Combine points of a face, ``at`` places along it, into pieces of neighbours along it.

    Several views may see different lengths of it: what they differ by is taken off, as it would tilt the face. The
    error that this leaves in its tilt is returned as well, one standard deviation, rad.
    """
    rest, by_view, tilt = _levelled(seen, at, shared)
    sd = max(robust_sd_about_median(rest), LEAST_NOISE_MM)
    near = np.abs(rest - np.median(rest)) <= CLIP * sd
    points, at, off = seen.points[near], at[near], (seen.off - by_view)[near]
    count = len(at)
    order = np.argsort(at, kind="stable")
    groups = np.array_split(order, count if count <= SINGLE else int(np.clip(count // A_PIECE, 2, MOST_PIECES)))
    noise = (sd * float(student_factor(count - 1))) ** 2
    pieces = Pieces(
        places=np.array([points[group].mean(axis=0) for group in groups]),
        value=np.array([off[group].mean() for group in groups]),
        noise=np.array([noise / len(group) for group in groups]) + FLOOR_MM**2,
        shared=shared,
    )
    return pieces, tilt


def _levelled(seen: OnFace, at: Floats, shared: float) -> tuple[Floats, Floats, float]:
    """Return what is left (n,) of points' distances less a straight line, and what their views differ by (n,).

    Also the error of the line's tilt by the views, one standard deviation, rad.
    """
    length = max(float(np.ptp(at)), 1.0)
    line = np.stack([np.ones_like(at), (at - at.mean()) / length], axis=1)
    line = line[:, : 2 if len(at) > FEWEST else 1]
    views, view = np.unique(seen.view, return_inverse=True)
    several = (view[:, None] == np.arange(len(views))).astype(float)
    terms = np.hstack([line, several - several.mean(axis=0)])
    sd = max(robust_sd_about_median(seen.off), LEAST_NOISE_MM)
    prior = np.r_[np.zeros(line.shape[1]), np.full(len(views), (sd / max(shared, LEAST_NOISE_MM)) ** 2)]
    solved = np.linalg.lstsq(terms.T @ terms + np.diag(prior), terms.T @ seen.off, rcond=None)[0]
    by_view: Floats = terms[:, line.shape[1] :] @ solved[line.shape[1] :]
    if line.shape[1] < 2:
        return seen.off - terms @ solved, by_view, 0.0
    variance = np.linalg.pinv(terms.T @ terms + np.diag(prior))[1, 1] - 1.0 / max(float((line[:, 1] ** 2).sum()), 1e-9)
    return seen.off - terms @ solved, by_view, sd * float(np.sqrt(max(variance, 0.0))) / length
