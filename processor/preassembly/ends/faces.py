"""The outer faces of a part near a joint: how they depart from the design, with what spread.

Each departs by ``c0 + c1 x + c2 w + c3 x w + c4 x^2 + c5 x^2 w + c6 (w^2 - 1) + c7 x (w^2 - 1)``: x along the bridge
from the joint in zones, w across the face from -1 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.model import Floats, Ints
from processor.preassembly.baselines import edge_features
from processor.preassembly.ends import plate_sides
from processor.preassembly.ends.plate_sides import Bools

ZONE_MM = 500.0
REACH_MM = 80.0  # an end may depart from the design by so much
FACE = 8  # numbers of a face
LEAST_POINTS = 60
CELLS = (5, 6)  # of a face, along and across: each finds its outermost layer, and shows what the numbers do not follow
FLOOR_MM = 0.004  # of the design's mesh and of rounding: no standard deviation is smaller


@dataclass(frozen=True)
class FaceFit:
    """Numbers (8,) of a face with their covariance by the points' noise, and of the points used: basis, rest, where."""

    coefficients: Floats
    covariance: Floats
    basis: Floats
    rest: Floats
    station: Ints
    cell: Ints
    alone: bool  # nothing was seen a plate's thickness further in: which side of the plate this is, shape alone says


def fit(
    points: Floats,
    local: Floats,
    station: Ints,
    surface: MeshSurface,
    outer: MeshSurface,
    T_bridge_joint: Floats,
    half: Floats,
    outward: float,
) -> list[FaceFit] | str:
    """Fit the four faces to points (n, 3) of the joint's zone, ``local`` in its frame; or say why that cannot be.

    ``half`` (3,) is half of the section's size, ``outward`` +1 where the part ends at the joint, -1 where it starts.
    """
    faces = _on_faces(points, local, surface, outer, T_bridge_joint, half)
    margin = (
        3.0 * _noise(np.concatenate([out - np.median(out) for _, out, _, _ in faces if len(out)] or [np.empty(0)]))
        + 2.0
    )
    found = []
    for (name, axis, _), (rows, out, cell, alone) in zip(FACES, faces, strict=True):
        across = 1 if axis == 2 else 2
        clear = (np.abs(local[rows, across]) < half[across] - margin) & (-outward * local[rows, 0] > margin)
        rows = rows[clear]
        columns = basis(local[rows, 0], local[rows, across] / half[across])
        coefficients, covariance, rest, used = _least_squares(columns, out[clear])
        if not len(coefficients):
            return f"too few points on the {name} face"
        found.append(
            FaceFit(coefficients, covariance, columns[used], rest, station[rows][used], cell[clear][used], alone)
        )
    return found


def basis(x: Floats, w: Floats) -> Floats:
    """Return the terms (n, 8) of a face's departure at x in mm and w."""
    scaled = x / ZONE_MM
    bow = w * w - 1.0
    return np.stack([np.ones_like(scaled), scaled, w, scaled * w, scaled**2, scaled**2 * w, bow, scaled * bow], axis=1)


def _on_faces(
    points: Floats, local: Floats, surface: MeshSurface, outer: MeshSurface, T_bridge_joint: Floats, half: Floats
) -> list[tuple[Ints, Floats, Ints, bool]]:
    """Return the rows of the points (n, 3) on each of FACES, how far out of the design they lie, and their cells.

    Also whether no layer was seen inside of them.
    """
    nearest = surface.distances(points, REACH_MM)[0]
    face, residual, beyond = outer.distances(points, 2.0 * REACH_MM)
    # Not by the sense of the normals: meshes come with either.
    normal, on = outer.normals[face] @ T_bridge_joint[:3, :3], surface.normals[nearest] @ T_bridge_joint[:3, :3]
    near = (nearest >= 0) & on_face(face, beyond) & (np.abs(residual) < REACH_MM)
    found = []
    for _, axis, sense in FACES:
        across = 1 if axis == 2 else 2
        own = near & (np.abs(normal[:, axis]) > ALONG) & (np.abs(on[:, axis]) > ALONG) & (sense * local[:, axis] > 0.0)
        rows = np.flatnonzero(own)
        out = residual[rows] * np.sign(sense * normal[rows, axis])
        x, w = local[rows, 0] / ZONE_MM, local[rows, across] / half[across]
        column, row = np.floor(CELLS[0] * np.abs(x)), np.clip(np.floor(0.5 * CELLS[1] * (w + 1.0)), 0, CELLS[1] - 1)
        cell = (column * CELLS[1] + row).astype(np.int64)
        plane = np.stack([np.ones_like(x), x, w, x * w], axis=1)
        layer = plate_sides.outer_surface(out, plane, cell)
        alone = len(rows) - int(layer.sum()) < plate_sides.SECOND_SHARE * len(rows)
        found.append((rows[layer], out[layer], cell[layer], alone))
    return found


def _noise(residual: Floats) -> float:
    middle = np.median(residual) if len(residual) else 0.0
    return float(1.4826 * np.median(np.abs(residual - middle))) if len(residual) else 0.0


def _least_squares(basis: Floats, residual: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Coefficients (k,), covariance (k, k), rests of the used points, and which they are; outliers are left out.

    Empty for too few points.
    """
    used = np.ones(len(residual), bool)
    coefficients: Floats = np.empty(0, np.float64)
    for _ in range(6):
        if used.sum() < LEAST_POINTS:
            return np.empty(0), np.empty((0, 0)), np.empty(0), used
        coefficients = np.asarray(np.linalg.lstsq(basis[used], residual[used], rcond=None)[0], np.float64)
        rest = residual - basis @ coefficients
        limit = 4.5 * max(_noise(rest[used]), FLOOR_MM)
        now = np.abs(rest) < limit
        if (now == used).all():
            break
        used = now
    rest = residual[used] - basis[used] @ coefficients
    variance = float(rest @ rest) / max(len(rest) - len(coefficients), 1)
    normal = basis[used].T @ basis[used]
    return coefficients, variance * np.linalg.inv(normal), rest, used


# --- The outer faces of a part, those that its corners and bottom edges lie on, apart from the walls' inner sides.


FACES = (("bottom", 2, -1.0), ("right", 1, -1.0), ("top", 2, 1.0), ("left", 1, 1.0))  # axis and sense of the normal
ALONG = 0.9  # cosine: a facet that looks this much along an axis is of a face across it
NEAR_MM = 500.0  # of a joint, beyond the facet nearest to it


def of_part(surface: MeshSurface, joints: Sequence[Floats]) -> MeshSurface:
    """Return the outer faces of a part that ends at ``joints``, P1..P8 (8, 3) each, in the bridge's frame.

    At a joint these are, of the smooth faces that look up, down, left and right, those that lie nearest to the corners.
    The whole surface where there is none of one of them.
    """
    chosen = np.zeros(len(surface.faces), bool)
    centre = surface.vertices[surface.faces].mean(axis=1)
    for corners in joints:
        frame = edge_features.joint_frame(corners)
        half = 0.5 * np.ptp(rigid.apply(rigid.invert(frame), corners[:4]), axis=0)
        local, normal = rigid.apply(rigid.invert(frame), centre), surface.normals @ frame[:3, :3]
        for _, axis, sense in FACES:
            own = (np.abs(normal[:, axis]) > ALONG) & (sense * local[:, axis] > 0.0)
            if not own.any():
                return surface
            own &= np.abs(local[:, 0]) < NEAR_MM + np.abs(local[own, 0]).min()
            groups, which = np.unique(surface.part_of[own], return_inverse=True)
            off = np.bincount(which, np.abs(sense * local[own, axis] - half[axis])) / np.bincount(which)
            chosen |= surface.part_of == groups[np.argmin(off)]
    return surface.only(chosen) if chosen.any() else surface
