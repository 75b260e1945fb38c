"""Flat faces of a design's bodies, and what was measured on them.

Deviations at the core points of step ``deviation`` are combined in pieces of a face. The errors of a piece are the
noise of its points and what the points of a view share, as ``deviation`` states both. The shared error varies over a
long face, along it and across it: a web hides each half of a flange's inner side from the stations that see the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from processor import scene_cloud
from processor.adjustment import point_groups, scanner_class_errors
from processor.distinct_rows import distinct, distinct_points
from processor.geometry import mesh_bodies, mesh_distance
from processor.inspection import design_holes
from processor.inspection.design_holes import Hole
from processor.model import Floats, Ints, StructureDesign
from processor.robust_statistics import robust_sd

NORMALS, OFFSETS_MM = 1e-3, 0.5  # by which facets of one flat face may differ
PIECE_DIAMETERS = 3.0  # side of a piece, in diameters of the core points' circles
FEWEST_POINTS = 3  # of a piece
FLOOR_MM = 0.004  # least standard deviation: of the design's mesh and of rounding
SAME_PLACE_MM = 1e-3  # rounding: places of core points computed twice from one mesh
# Share of the shared variance by which the halves of a face differ, along it, across it and crosswise, if it is as
# large as FAR_MM: a smaller one is seen from the same places all over.
HALVES, FAR_MM = 0.5, 2000.0
CLIP = 4.5  # robust standard deviations from the fitted shape beyond which a piece is left out
ROUNDS = 8  # work: of leaving out pieces and of weights, at most; the first that changes nothing is the last
SAME_FORM = 0.05  # by which a variance of form may still change: weights by a twentieth hardly change a mean
LEAST_SIDE = 0.5  # side of the smallest face that a body's size is taken from, in least widths of a measured face
MOST_CONDITION = 1e6  # of a form's terms: pieces along one line tell them apart no more


@dataclass(frozen=True)
class FlatFace:
    """A flat face as designed: outward normal (3,), corners (n, 3) of its facets (n / 3,), area in mm^2."""

    normal: Floats
    corners: Floats
    area: float
    facets: Ints

    def extent(self, direction: Floats) -> tuple[float, float]:
        """Return where the face begins and ends along a unit direction (3,)."""
        along = self.corners @ direction
        return float(along.min()), float(along.max())


class Pieces(NamedTuple):
    """Pieces of a face: places (m, 3), mean deviation outward (m,), its variance by noise (m,), the shared sd, mm."""

    places: Floats
    value: Floats
    noise: Floats
    shared: float

    def covariance(self, along: Floats, across: Floats, form: float = 0.0) -> Floats:
        """Covariance (m, m) of the values at coordinates ``along`` and ``across`` the face, (m,) each.

        ``form`` is the variance of what the fitted shape does not follow.
        """
        halves = [np.where(x > 0.5 * (x.min() + x.max()), 1.0, -1.0) for x in (along, across)]
        apart = min(float(np.linalg.norm(np.ptp(self.places, axis=0))) / FAR_MM, 1.0)
        quarters = np.ones((len(along), len(along)))
        for half in (*halves, halves[0] * halves[1]):
            quarters += HALVES * apart**2 * np.outer(half, half)
        covariance: Floats = np.diag(self.noise + form) + self.shared**2 * quarters
        return covariance


class Body(NamedTuple):
    """A body's name, its flat faces as designed with the pieces measured of each, and its holes as designed.

    A face of which too little was seen has no pieces.
    """

    name: str
    faces: tuple[FlatFace, ...]
    pieces: tuple[Pieces, ...]
    holes: tuple[Hole, ...] = ()


class Fit(NamedTuple):
    """Coefficients (p,) of a shape fitted to the values of pieces, and their covariance (p, p)."""

    mean: Floats
    covariance: Floats


class Side(NamedTuple):
    """A fitted face: its pieces, their places along and across it from -1 to 1, and the shape fitted, outward.

    Coefficients are level, slope along, slope across, warp, and curvature along where it is fitted.
    """

    pieces: Pieces
    along: Floats
    across: Floats
    fit: Fit
    narrow: bool = False


class Observed(NamedTuple):
    """Deviations (k,) outward at places (k, 3) on facets (k,) of the design, with noise, in mm and mm^2.

    ``shared`` (k,) is the standard deviation of what the points of a view share; pieces have a ``side`` in mm.
    """

    places: Floats
    facet: Ints
    deviation: Floats
    noise: Floats
    shared: Floats
    side: float


def observed(design: StructureDesign, result: Any) -> Observed | None:
    """Return what a ``result`` of step ``deviation`` states of a design; None where its places are of another one."""
    vertices, _ = scene_cloud.local_design(design)
    core = result.core
    at = mesh_distance.spread(vertices, design.faces, lambda _: len(core))
    if not np.allclose(at.points, core.points, rtol=0.0, atol=SAME_PLACE_MM):
        return None
    spacing = float(np.sqrt(mesh_distance.area(vertices, design.faces) / len(core)))
    overlap = max(1.0, 0.25 * np.pi * (result.projection_diameter / spacing) ** 2)
    shared = core.std1 / np.sqrt(np.maximum(core.n1, 1))
    if any(reason.code == "deviation.views-by-class" for reason in result.reasons):
        # Two opposite faces: their sum has twice the offset of all ranges.
        by_class = scanner_class_errors.SHIFT_SD_MM**2 + 2.0 * scanner_class_errors.known().offset_mm ** 2
        shared = np.sqrt(shared**2 + by_class)
    return Observed(
        places=core.points,
        facet=at.facet,
        deviation=np.where(np.isfinite(core.lod95), core.distance, np.nan),
        noise=overlap * core.std2**2 / np.maximum(core.n2, 1),
        shared=shared,
        side=PIECE_DIAMETERS * result.projection_diameter,
    )


def bodies(design: StructureDesign, seen: Observed, least_mm: float) -> Iterator[Body]:
    """Yield the bodies of a design with what was seen of their flat faces.

    Faces narrower than ``least_mm`` are among those as designed, and without pieces.
    """
    vertices, _ = scene_cloud.local_design(design)
    names, of_facet = named_bodies(design, vertices)
    cross, double = mesh_distance.double_areas(vertices, design.faces)
    normals = cross / np.maximum(double, 1e-12)[:, None]
    plane = _planes(vertices[design.faces], normals, of_facet)
    area = 0.5 * np.bincount(plane, double)
    first = np.unique(plane, return_index=True)[1]
    facets, rows = _members(plane), _members(plane[seen.facet], len(first))
    large = np.flatnonzero(area >= (LEAST_SIDE * least_mm) ** 2)
    of_large = _members(of_facet[first[large]], len(names))
    of_body = _members(of_facet, len(names))
    for number, name in enumerate(names):
        faces, pieces_seen = [], []
        own = of_body[number]
        holes = design_holes.of_body(vertices, design.faces[own], normals[own], plane[own]) if len(own) else []
        for k in large[of_large[number]]:
            corners = vertices[design.faces[facets[k]]].reshape(-1, 3)
            faces.append(FlatFace(normals[first[k]], corners, float(area[k]), facets[k]))
            on = rows[k][np.isfinite(seen.deviation[rows[k]])]
            on = on if _width(faces[-1]) >= least_mm else on[:0]
            cubes = point_groups.pieces(seen.places[on], normals[seen.facet[on]], seen.side) if len(on) else on
            pieces_seen.append(pieces(seen, on, cubes))
        yield Body(name, tuple(faces), tuple(pieces_seen), tuple(holes))


def holes_of(vertices: Floats, faces: Ints) -> tuple[Floats, list[Hole]]:
    """Return the round holes through one body, less an origin (3,) that is returned as well."""
    vertices, origin = scene_cloud.local_design(StructureDesign("", vertices, faces))
    cross, double = mesh_distance.double_areas(vertices, faces)
    normals = cross / np.maximum(double, 1e-12)[:, None]
    plane = _planes(vertices[faces], normals, np.zeros(len(faces), np.int64))
    return origin, design_holes.of_body(vertices, faces, normals, plane)


def _members(group: Ints, count: int = 0) -> list[Ints]:
    """Return the rows of each group."""
    order = np.argsort(group, kind="stable")
    return np.split(order, np.cumsum(np.bincount(group, minlength=count))[:-1])


def named_bodies(design: StructureDesign, vertices: Floats) -> tuple[tuple[str, ...], Ints]:
    """Return the names of bodies, and the body (f,) of each facet; without names they are the connected pieces.

    A piece without a name has that of its component, as in the defects; if others touch it, with a number.
    """
    if design.bodies is not None:
        return design.bodies.names, design.bodies.of_facet
    welded, faces = mesh_bodies.welded(vertices, design.faces, None)
    component = mesh_bodies.components(welded, faces)
    places = distinct(np.column_stack([component, mesh_bodies.pieces(faces)]))
    number: Ints = places.number.reshape(-1).astype(np.int64)
    of_body = component[places.first]
    names = []
    for body, whole in enumerate(of_body):
        alike = np.flatnonzero(of_body == whole)
        part = f" body {int(np.searchsorted(alike, body)) + 1}" if len(alike) > 1 else ""
        names.append(mesh_bodies.component_name(int(whole)) + part)
    return tuple(names), number


def _planes(corners: Floats, normals: Floats, body: Ints) -> Ints:
    """Return the number (f,) of each facet's plane: facets of one body, direction and offset have the same one."""
    offset = np.einsum("fi,fi->f", normals, corners.mean(axis=1))
    # Shifted, as many designs have planes right between two steps.
    keys = np.column_stack([body, np.rint(normals / NORMALS + 0.137), np.rint(offset / OFFSETS_MM + 0.137)])
    return distinct_points(keys)[1]


def _width(face: FlatFace) -> float:
    """Return the least width of a face, by the second principal direction of its corners."""
    centred = face.corners - face.corners.mean(axis=0)
    second = np.linalg.svd(centred, full_matrices=False)[2][1]
    return float(np.ptp(centred @ second))


def pieces(seen: Observed, rows: Ints, piece: Ints) -> Pieces:
    """Combine what was seen at ``rows`` (k,) of a face into pieces, by the number (k,) of the piece of each."""
    if not len(rows):
        return Pieces(np.empty((0, 3)), np.empty(0), np.empty(0), 0.0)
    count = np.bincount(piece)
    enough = count >= FEWEST_POINTS
    return Pieces(
        places=point_groups.group_means(seen.places[rows], piece)[enough],
        value=(np.bincount(piece, seen.deviation[rows]) / count)[enough],
        noise=(np.bincount(piece, seen.noise[rows]) / count**2)[enough] + FLOOR_MM**2,
        shared=float(np.median(seen.shared[rows])),
    )


def fit(basis: Floats, pieces: Pieces, along: Floats, across: Floats, clip: float = CLIP) -> Fit | None:
    """Fit a shape with ``basis`` (m, p) to pieces at (m,) along and across a face; None where it is not determined.

    Pieces off the shape by more than ``clip`` robust standard deviations (dents, other steel) have no weight. What the
    shape does not follow is a variance of the pieces: the mean square of the residuals less the part by noise (Cochran
    1954, Biometrics 10, 101-129).
    """
    used, form = np.ones(len(basis), bool), 0.0
    for _ in range(ROUNDS):
        kept, dof = used, int(used.sum()) - basis.shape[1]
        if dof < 1 or np.linalg.cond(basis[kept]) > MOST_CONDITION:
            return None
        root = 1.0 / np.sqrt(pieces.noise[kept] + form)
        solve = np.linalg.pinv(basis[kept] * root[:, None]) * root
        mean = solve @ pieces.value[kept]
        rest = pieces.value - basis @ mean
        weighed_by = form
        form = max(float((rest[kept] ** 2).sum()) / dof - float(pieces.noise[kept].mean()), 0.0)
        used = np.abs(rest) <= clip * np.maximum(robust_sd(rest[kept]), np.sqrt(pieces.noise))
        if (used == kept).all() and abs(form - weighed_by) <= SAME_FORM * form:
            break
    covariance = pieces.covariance(along, across, form)[np.ix_(kept, kept)]
    return Fit(mean, solve @ covariance @ solve.T)
