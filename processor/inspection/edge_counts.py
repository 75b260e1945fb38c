"""Edges seen from the broad face alone: where the scanned points of that face end.

The points of one station on a strip of the face that ends at the edge are as many as it is wide, in the density of the
strip beside it. A beam that lies in part on the face is measured or not, by the scanner and what is behind: the edge
is known to half a beam.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from processor.geometry import mesh_distance
from processor.inspection import bore_fit, narrow_faces
from processor.inspection.flat_faces import FlatFace
from processor.inspection.holes import REACH_MM
from processor.inspection.narrow_faces import RIM_MM, Outline, Shift, Surroundings
from processor.inspection.points_in_design_frame import SeenPoints
from processor.model import Bools, Floats

# From the edge as designed inward: points are counted to the first, their density is that up to the second.
STRIP_MM, BESIDE_MM = 10.0, 25.0
GATE_MM = 1.5  # of points from the broad face
FEWEST = 40  # points of one station in the strip beside
MOST_INWARD_MM = 7.0  # of an edge: of one further in it is not known whether the scan or the steel ends there
CORNER_MM = 10.0  # at the ends of an edge that are left out
TOUCHES_MM, SQUARE = 1.0, 0.02  # of the broad face at the edge, and cosine between their normals
LINE_MM, ABOVE_MM, PLACES = 20_000.0, 5.0, 12  # lines towards a station from places on the strip, to see what hides it
MOST_HIDDEN = 0.1  # of these


class Level(NamedTuple):
    """How far outward an edge lies from its design, mm, and the variance of that."""

    value: float
    variance: float


def level(
    around: Surroundings, face: FlatFace, shape: Outline, faces: Sequence[FlatFace], shift: Shift
) -> Level | None:
    """Return the level of an edge ``face`` by the points on those ``faces`` of its body that end at it; None without.

    ``shift`` is the movement of the body as far as it is known. A station measures a beam of which at least a share
    lies on the face. If all shares are as likely, the place of the beam's middle has the semicircle law about the edge:
    its standard deviation is a quarter of the beam's width.
    """
    free = narrow_faces.free_places(around, face, shape)
    if not isinstance(free, np.ndarray) or not len(free):
        return None
    edge = float(shape.origin @ face.normal)
    broad = [
        beside
        for beside in faces
        if abs(beside.normal @ face.normal) < SQUARE and abs(beside.extent(face.normal)[1] - edge) < TOUCHES_MM
    ]
    found: list[Level] = []
    for beside in broad:

        def on_face(some: SeenPoints, beside: FlatFace = beside) -> Bools:
            return _is_on(beside, some.points - shift(some.points))

        seen = around.cloud.near(free + shift(free), 2.0 * REACH_MM, on_face)
        found += _of_views(around, face, beside, seen, shift)
    if not found:
        return None
    value, variance = np.array(found).T
    mean = float(np.average(value, weights=1.0 / variance))
    if mean < -MOST_INWARD_MM:
        return None
    return Level(mean, float(1.0 / (1.0 / variance).sum()) + (0.5 * RIM_MM) ** 2 + around.shared**2)


def _of_views(
    around: Surroundings, face: FlatFace, beside: FlatFace, seen: SeenPoints, shift: Shift
) -> Iterator[Level]:
    """Yield the level of an edge by each station's points on the face ``beside`` it."""
    out = face.normal
    points = seen.points - shift(seen.points)
    edge = face.corners[0] @ out
    off, at = points @ out - edge, points @ np.cross(out, beside.normal)
    low, high = face.extent(np.cross(out, beside.normal))
    on = _is_on(beside, points)
    on &= ~(-seen.ray @ beside.normal < bore_fit.LEAST_SLOPE)
    on &= (at > low + CORNER_MM) & (at < high - CORNER_MM) & (np.abs(off) < BESIDE_MM)
    on[on] = _free(around, face, beside, points[on])
    for view in np.unique(seen.view[on]):
        own = np.flatnonzero(on & (seen.view == view))
        inner, outer = (off[own] < -STRIP_MM).sum(), (off[own] >= -STRIP_MM).sum()
        if inner < FEWEST or _hidden(around, points[own], off[own], seen.ray[own], (out, beside.normal)):
            continue
        density = inner / (BESIDE_MM - STRIP_MM)
        # Both counts as of points at random: those of a grid scatter less.
        yield Level(outer / density - STRIP_MM, (max(outer, 1) + outer**2 / inner) / density**2)


def _is_on(face: FlatFace, points: Floats) -> Bools:
    """Mark the points (n, 3) that lie in the plane of a face."""
    on: Bools = np.abs((points - face.corners[0]) @ face.normal) < GATE_MM
    return on


def _free(around: Surroundings, face: FlatFace, beside: FlatFace, points: Floats) -> Bools:
    """Mark the points (n, 3) before whose places on the edge no other steel stands."""
    feet = points - np.outer((points - face.corners[0]) @ face.normal, face.normal)
    feet += np.outer(np.mean(face.extent(beside.normal)) - feet @ beside.normal, beside.normal)
    free: Bools = narrow_faces.stands_before(around, face, feet) < 0
    return free


def _hidden(around: Surroundings, points: Floats, off: Floats, rays: Floats, normals: tuple[Floats, Floats]) -> bool:
    """Whether other steel, as designed, hides part of the strip at the edge from the station of some points."""
    if not np.isfinite(rays).all():
        return False
    out, up = normals
    some = np.linspace(0, len(points) - 1, PLACES).astype(np.int64)
    places = points[some] - np.outer(off[some] + np.linspace(1.0, STRIP_MM, PLACES), out) + ABOVE_MM * up
    row = mesh_distance.crossings(around.design.grid, places, places - LINE_MM * rays[some], True)[0]
    return len(np.unique(row)) > MOST_HIDDEN * PLACES
