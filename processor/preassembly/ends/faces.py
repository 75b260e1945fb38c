"""The outer faces of a part, and their departures from the design near a joint.

A face's departure is ``c0 + c1 x + c2 w + c3 x w + c4 x^2 + c5 x^2 w + c6 (w^2 - 1) + c7 x (w^2 - 1)``: x along the
bridge from the joint in units of ZONE_MM, w across the face from -1 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.model import Floats, Ints, Reason, Word, reason
from processor.preassembly.ends import plate_sides
from processor.preassembly.ends.joint_frame import EndPlace, end_place
from processor.preassembly.ends.plate_sides import Bools


class PlateFace(Word):
    """An outer face of a part."""

    BOTTOM = "bottom"
    RIGHT = "right"
    TOP = "top"
    LEFT = "left"


FACES = (  # axis and sense of the normal
    (PlateFace.BOTTOM, 2, -1.0),
    (PlateFace.RIGHT, 1, -1.0),
    (PlateFace.TOP, 2, 1.0),
    (PlateFace.LEFT, 1, 1.0),
)
FACE = 8  # coefficients of a face
ALONG = 0.9  # cosine between a facet's normal and an axis, above which the facet is of a face across that axis
NEAR_MM = 500.0  # of a joint, beyond the facet nearest to it
ZONE_MM = 500.0
REACH_MM = 80.0  # largest departure of an end from the design
LEAST_POINTS = 60
CELLS = (5, 6)  # of a face, along and across, for its outermost layer and its lack of fit
FLOOR_MM = 0.004  # least standard deviation: of the design's mesh and of rounding


@dataclass(frozen=True)
class RegisteredPart:
    """Points of a part, registered to its design, bridge frame, mm.

    ``points`` (n, 3) with the number of the station (n,) that each was measured from, the ``between_stations``
    variance (mm^2), the covariance (6, 6) of the registration about the bridge's origin, the design's ``surface`` and
    its ``outer`` faces.
    """

    points: Floats
    station: Ints
    between_stations: float
    pose: Floats
    surface: MeshSurface
    outer: MeshSurface

    def only(self, rows: Bools) -> RegisteredPart:
        """Return the part with some of its points (n,)."""
        return replace(self, points=self.points[rows], station=self.station[rows])


@dataclass(frozen=True)
class UsedPoints:
    """Points of a least-squares fit: basis (n, k), residuals (n,), and the station and the cell (n,) of each."""

    basis: Floats
    residual: Floats
    station: Ints
    cell: Ints


@dataclass(frozen=True)
class FaceFit:
    """Coefficients (8,) of a face, their covariance by point noise, and the points used.

    ``single_layer``: no second layer was found inside the face, so the side of the plate is known by its shape alone.
    """

    coefficients: Floats
    covariance: Floats
    used: UsedPoints
    single_layer: bool


def outer_faces(surface: MeshSurface, joints: Sequence[Floats]) -> MeshSurface:
    """Outer faces of a part that ends at ``joints``, P1..P8 (8, 3) each, in the bridge's frame.

    At a joint they are, of the smooth faces that look up, down, left and right, those nearest to the corners. The whole
    surface where one of the four directions has no face.
    """
    chosen = np.zeros(len(surface.faces), bool)
    centre = surface.vertices[surface.faces].mean(axis=1)
    for key_points in joints:
        place = end_place(key_points, 1.0)
        local = rigid.apply(rigid.invert(place.T_bridge_joint), centre)
        normal = surface.normals @ place.T_bridge_joint[:3, :3]
        for _, axis, sense in FACES:
            candidates = (np.abs(normal[:, axis]) > ALONG) & (sense * local[:, axis] > 0.0)
            if not candidates.any():
                return surface
            candidates &= np.abs(local[:, 0]) < NEAR_MM + np.abs(local[candidates, 0]).min()
            groups, group = np.unique(surface.part_of[candidates], return_inverse=True)
            off = np.abs(sense * local[candidates, axis] - place.half[axis])
            chosen |= surface.part_of == groups[np.argmin(np.bincount(group, off) / np.bincount(group))]
    return surface.only(chosen) if chosen.any() else surface


def fit(part: RegisteredPart, local: Floats, place: EndPlace) -> list[FaceFit] | Reason:
    """Fit the four faces to the points of the joint's zone, ``local`` (n, 3) in its frame; or the reason why not."""
    faces = _on_faces(part, local, place)
    centred = [out - np.median(out) for _, out, _, _ in faces if len(out)]
    margin = 3.0 * _noise(np.concatenate(centred or [np.empty(0)])) + 2.0
    fits = []
    for (name, axis, _), (rows, out, cell, single_layer) in zip(FACES, faces, strict=True):
        across = 1 if axis == 2 else 2
        clear = np.abs(local[rows, across]) < place.half[across] - margin
        clear &= -place.outward * local[rows, 0] > margin
        rows = rows[clear]
        columns = basis(local[rows, 0], local[rows, across] / place.half[across])
        coefficients, covariance, residual, inliers = _least_squares(columns, out[clear])
        if not len(coefficients):
            return reason("preassemble.few-points-on-face", face=name)
        used = UsedPoints(columns[inliers], residual, part.station[rows][inliers], cell[clear][inliers])
        fits.append(FaceFit(coefficients, covariance, used, single_layer))
    return fits


def basis(x: Floats, w: Floats) -> Floats:
    """Terms (n, 8) of a face's departure at x in mm and w."""
    scaled = x / ZONE_MM
    bow = w * w - 1.0
    return np.stack([np.ones_like(scaled), scaled, w, scaled * w, scaled**2, scaled**2 * w, bow, scaled * bow], axis=1)


def _on_faces(part: RegisteredPart, local: Floats, place: EndPlace) -> list[tuple[Ints, Floats, Ints, bool]]:
    """Points on each of FACES: rows, heights above the design, cells, and whether they are a single layer."""
    turn = place.T_bridge_joint[:3, :3]
    nearest = part.surface.distances(part.points, REACH_MM)[0]
    face, residual, beyond = part.outer.distances(part.points, 2.0 * REACH_MM)
    # The sense of the normals is not used: meshes come with either.
    outer_normal, normal = part.outer.normals[face] @ turn, part.surface.normals[nearest] @ turn
    near = (nearest >= 0) & on_face(face, beyond) & (np.abs(residual) < REACH_MM)
    faces = []
    for _, axis, sense in FACES:
        across = 1 if axis == 2 else 2
        looks = (np.abs(outer_normal[:, axis]) > ALONG) & (np.abs(normal[:, axis]) > ALONG)
        rows = np.flatnonzero(near & looks & (sense * local[:, axis] > 0.0))
        out = residual[rows] * np.sign(sense * outer_normal[rows, axis])
        x, w = local[rows, 0] / ZONE_MM, local[rows, across] / place.half[across]
        column, row = np.floor(CELLS[0] * np.abs(x)), np.clip(np.floor(0.5 * CELLS[1] * (w + 1.0)), 0, CELLS[1] - 1)
        cell = (column * CELLS[1] + row).astype(np.int64)
        layer = plate_sides.outer_surface(out, np.stack([np.ones_like(x), x, w, x * w], axis=1), cell)
        single_layer = len(rows) - int(layer.sum()) < plate_sides.SECOND_SHARE * len(rows)
        faces.append((rows[layer], out[layer], cell[layer], single_layer))
    return faces


def _noise(residual: Floats) -> float:
    """Return the standard deviation by the median absolute deviation; 0 of no residuals."""
    middle = np.median(residual) if len(residual) else 0.0
    return float(1.4826 * np.median(np.abs(residual - middle))) if len(residual) else 0.0


def _least_squares(basis: Floats, value: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Coefficients (k,), covariance (k, k), residuals of the inliers, and a mark of these; empty for too few points."""
    used = np.ones(len(value), bool)
    coefficients: Floats = np.empty(0, np.float64)
    for _ in range(6):
        if used.sum() < LEAST_POINTS:
            return np.empty(0), np.empty((0, 0)), np.empty(0), used
        coefficients = np.asarray(np.linalg.lstsq(basis[used], value[used], rcond=None)[0], np.float64)
        residual = value - basis @ coefficients
        now = np.abs(residual) < 4.5 * max(_noise(residual[used]), FLOOR_MM)
        if (now == used).all():
            break
        used = now
    residual = value[used] - basis[used] @ coefficients
    variance = float(residual @ residual) / max(len(residual) - len(coefficients), 1)
    return coefficients, variance * np.linalg.inv(basis[used].T @ basis[used]), residual, used
