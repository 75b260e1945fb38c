"""The outer faces of a part, and their departures from the design near a joint.

A face's departure is ``c0 + c1 x + c2 w + c3 x w + c4 x^2 + c5 x^2 w + c6 (w^2 - 1) + c7 x (w^2 - 1)``: x along the
bridge from the joint in units of ZONE_MM, w across the face from -1 to 1. What these terms do not follow, waves of the
plate, is estimated at NODES of the joint by kriging.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from processor.adjustment import kriging
from processor.adjustment.point_groups import patch_means
from processor.geometry import rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.model import Bools, Floats, Ints, Reason, reason
from processor.preassembly.ends import plate_sides, view_variance
from processor.preassembly.ends.joint_frame import EndPlace, end_place
from processor.preassembly.ends.section import EndFace
from processor.preassembly.ends.view_variance import Thickness
from processor.robust_statistics import robust_sd_about_median

FACE = 8  # coefficients of a face
PLAIN = [0, 1, 4]  # of these terms: those of a face too narrow to have a shape across
SQUARE_MM = 0.2  # standard deviation of the others there: a cut edge is off square by less over a plate's thickness
NODES = (-1.0, 0.0, 1.0)  # places w at the joint where a face's waves are estimated
PATCH_MM, PATCH_SPACINGS = 50.0, 3.0  # least size of a patch, whose mean departure is one observation of the waves
ALONG = 0.9  # cosine between a facet's normal and an axis, above which the facet is of a face across that axis
ALONG_SHARE = 0.1  # of a distance along a part that counts as one off a face
NEAR_MM = 500.0  # of a joint, beyond the facet nearest to it
ZONE_MM = 500.0  # chosen: as long as a section is wide: enough points, and terms follow the face
BESIDE_MM = 30.0  # of an edge's width, in which its points are looked for
REACH_MM = 80.0  # largest departure of an end from the design
LEAST_POINTS = 60  # seven and more a term of eight
LEAST_POINTS_OF_EDGE = 20  # of a strip of BESIDE_MM: seven a term of three
LEAST_REDUNDANCY = 0.5  # of a point in a fit, 1 less its leverage: most of an error then shows in its residual
ROUNDS = 12  # of a fit, without the points that do not belong to it
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
    """Coefficients (8,) of a face and its waves (3,) at NODES by every hypothesis of the waves, and the points used.

    ``coefficients`` (11,) are averaged over the hypotheses with their prior weights. ``plate`` is None where its inner
    side was not seen. ``single_layer``: no second layer
    was found inside the face, so the side of the plate is known by its shape alone.
    """

    coefficients: Floats
    hypotheses: kriging.Hypotheses
    used: UsedPoints
    plate: Thickness | None
    single_layer: bool


class _Sheets(NamedTuple):
    """Points on an outer face: rows, heights above the design, cells; and those behind it, if it has two layers."""

    rows: Ints
    out: Floats
    cell: Ints
    behind: Ints
    behind_out: Floats
    single_layer: bool


def outer_faces(surface: MeshSurface, joints: Sequence[Floats]) -> MeshSurface:
    """Outer faces of a part that ends at ``joints``, P1..P8 (8, 3) each, in the bridge's frame.

    At a joint they are, of the smooth faces that look up, down, left and right, those nearest to the corners. The whole
    surface where one of the four directions has no face.
    """
    chosen = np.zeros(len(surface.faces), bool)
    centre = surface.vertices[surface.faces].mean(axis=1)
    for key_points in joints:
        place = end_place(key_points, 1.0, surface)
        local = rigid.apply(rigid.invert(place.T_bridge_joint), centre)
        normal = surface.normals @ place.T_bridge_joint[:3, :3]
        for face in place.section.faces:
            candidates = (np.abs(normal[:, face.axis]) > ALONG) & (face.sense * local[:, face.axis] > 0.0)
            if not face.plate:
                candidates &= np.abs(face.w(local)) < 1.0
            if not candidates.any():
                return surface
            candidates &= np.abs(local[:, 0]) < NEAR_MM + np.abs(local[candidates, 0]).min()
            # By its places nearest to the joint: over some distance a curved plate departs by more than it is thick
            facets = np.flatnonzero(candidates)
            corners = rigid.apply(rigid.invert(place.T_bridge_joint), surface.vertices[surface.faces[facets]])
            along, off = np.abs(corners[:, :, 0]), np.abs(face.sense * corners[:, :, face.axis] - face.offset)
            score = (off + ALONG_SHARE * along).min(axis=1)
            chosen |= surface.part_of == int(surface.part_of[facets[np.argmin(score)]])
    return surface.only(chosen) if chosen.any() else surface


def fit(part: RegisteredPart, local: Floats, place: EndPlace, thickness: Floats) -> list[FaceFit] | Reason:
    """Fit the outer faces to the points of the joint's zone, ``local`` (n, 3) in its frame; or the reason why not.

    ``thickness`` (f,) is that of the faces' plates as designed; 0 = unknown.
    """
    faces = [
        _without_inner_side(sheets, local, face, float(of_plate))
        for sheets, face, of_plate in zip(_on_faces(part, local, place), place.section.faces, thickness, strict=True)
    ]
    centred = [sheets.out - np.median(sheets.out) for sheets in faces if len(sheets.out)]
    margin = 3.0 * robust_sd_about_median(np.concatenate(centred or [np.empty(0)])) + 2.0
    fits = []
    for of_design, of_plate, (rows, out, cell, behind, behind_out, single_layer) in zip(
        place.section.faces, thickness, faces, strict=True
    ):
        across, half = of_design.across, of_design.half
        clear = np.abs(of_design.from_middle(local[rows])) < half - (
            min(margin, 0.5 * half) if of_design.narrow else margin
        )
        clear &= -place.outward * local[rows, 0] > margin
        rows = rows[clear]
        columns = basis(local[rows, 0], of_design.w(local[rows]))
        coefficients, residual, inliers = _fitted(of_design, columns, out[clear])
        if not len(coefficients):
            return reason("preassemble.few-points-on-face", face=of_design.name)
        used = UsedPoints(columns[inliers], residual, part.station[rows][inliers], cell[clear][inliers])
        at = local[rows][inliers][:, [0, across]] - np.array([0.0, of_design.middle])
        hypotheses = _with_waves(coefficients, used, at, of_design)
        mean = kriging.average(hypotheses).mean
        plate = None
        if of_design.plate:
            level = basis(local[behind, 0], of_design.w(local[behind])) @ mean[:FACE]
            depth, at = level - behind_out, local[behind]
            inner = (depth > plate_sides.THINNEST_MM) & (depth < plate_sides.REACH_MM)
            inner &= np.abs(at[:, across]) < place.half[across] - np.minimum(REACH_MM, 0.5 * place.half[across])
            inner &= -place.outward * at[:, 0] > plate_sides.LAYER_MM
            inner[inner] = plate_sides.outer_layer(-depth[inner])
            both = np.concatenate([rows[inliers], behind[inner]])
            height = np.concatenate([out[clear][inliers], behind_out[inner]])
            terms = basis(local[both, 0], of_design.w(local[both]))[:, : view_variance.TERMS]
            marked = np.arange(len(both)) >= int(inliers.sum())
            plate = view_variance.thickness(terms, local[both][:, [0, across]], height, marked, float(of_plate))
        fits.append(FaceFit(mean, hypotheses, used, plate, single_layer))
    return fits


def _fitted(face: EndFace, columns: Floats, out: Floats) -> tuple[Floats, Floats, Bools]:
    """Coefficients (8,), residuals of the inliers and a mark of these; a narrow face has the PLAIN terms alone."""
    if not face.narrow:
        return least_squares(columns, out)
    plain, residual, inliers = least_squares(columns[:, PLAIN], out, LEAST_POINTS_OF_EDGE)
    if not len(plain):
        return plain, residual, inliers
    coefficients = np.zeros(FACE)
    coefficients[PLAIN] = plain
    return coefficients, residual, inliers


def _with_waves(coefficients: Floats, used: UsedPoints, at: Floats, face: EndFace) -> kriging.Hypotheses:
    """Estimate a face with its waves by points ``at`` (n, 2), along and across it from its middle."""
    half = face.half
    spacing = np.sqrt(2.0 * half * ZONE_MM / len(at))
    found = patch_means(at, used.residual, max(PATCH_MM, PATCH_SPACINGS * float(spacing)))
    terms = PLAIN if face.narrow else list(range(FACE))
    trend = basis(found.centre[:, 0], found.centre[:, 1] / half)[:, terms]
    noise = max(found.noise_variance, FLOOR_MM**2)
    dof = len(used.residual) - len(found.mean)
    means = kriging.Means(
        place=found.centre, value=found.mean, variance=noise / found.points, trend=trend, dof=dof,
        trend_mean=-coefficients[terms], trend_sd=REACH_MM,
    )  # fmt: skip
    nodes = np.stack([np.zeros(len(NODES)), half * np.array(NODES)], axis=1)
    hypotheses = kriging.by_hypotheses(means, nodes)
    if face.narrow:
        rows = np.array([*PLAIN, *range(FACE, FACE + len(NODES))])
        means_of, covariances = np.zeros((len(hypotheses.means), FACE + len(NODES))), []
        means_of[:, rows] = hypotheses.means
        for covariance in hypotheses.covariances:
            whole = SQUARE_MM**2 * np.eye(FACE + len(NODES))
            whole[np.ix_(rows, rows)] = covariance
            covariances.append(whole)
        hypotheses = hypotheses._replace(means=means_of, covariances=np.array(covariances))
    hypotheses.means[:, :FACE] += coefficients
    return hypotheses


def departures(x: Floats, w: Floats) -> Floats:
    """Terms (n, 11) of a face's departure: those of :func:`basis` and the parabola through the waves at NODES."""
    waves = np.stack([0.5 * w * (w - 1.0), 1.0 - w * w, 0.5 * w * (w + 1.0)], axis=1)
    return np.hstack([basis(x, w), waves])


def basis(x: Floats, w: Floats) -> Floats:
    """Terms (n, 8) of a face's departure at x in mm and w."""
    scaled = x / ZONE_MM
    bow = w * w - 1.0
    return np.stack([np.ones_like(scaled), scaled, w, scaled * w, scaled**2, scaled**2 * w, bow, scaled * bow], axis=1)


def _on_faces(part: RegisteredPart, local: Floats, place: EndPlace) -> list[_Sheets]:
    """Points on each of the section's faces."""
    turn = place.T_bridge_joint[:3, :3]
    nearest = part.surface.distances(part.points, REACH_MM)[0]
    face, residual, beyond = part.outer.distances(part.points, 2.0 * REACH_MM)
    # The sense of the normals is not used: meshes come with either.
    outer_normal, normal = part.outer.normals[face] @ turn, part.surface.normals[nearest] @ turn
    near = (nearest >= 0) & on_face(face, beyond) & (np.abs(residual) < REACH_MM)
    faces = []
    for of_design in place.section.faces:
        axis, sense = of_design.axis, of_design.sense
        looks = (np.abs(outer_normal[:, axis]) > ALONG) & (np.abs(normal[:, axis]) > ALONG)
        if not of_design.plate:  # the edges of the plates at either corner are faces of one direction
            looks &= np.abs(of_design.from_middle(local)) < of_design.half + BESIDE_MM
        rows = np.flatnonzero(near & looks & (sense * local[:, axis] > 0.0))
        out = residual[rows] * np.sign(sense * outer_normal[rows, axis])
        x, w = local[rows, 0] / ZONE_MM, of_design.w(local[rows])
        column, row = np.floor(CELLS[0] * np.abs(x)), np.clip(np.floor(0.5 * CELLS[1] * (w + 1.0)), 0, CELLS[1] - 1)
        cell = (column * CELLS[1] + row).astype(np.int64)
        layer = plate_sides.outer_surface(out, np.stack([np.ones_like(x), x, w, x * w], axis=1), cell)
        single_layer = len(rows) - int(layer.sum()) < plate_sides.SECOND_SHARE * len(rows)
        faces.append(
            _Sheets(
                rows=rows[layer],
                out=out[layer],
                cell=cell[layer],
                behind=rows[~layer],
                behind_out=out[~layer],
                single_layer=single_layer,
            )
        )
    return faces


def _without_inner_side(sheets: _Sheets, local: Floats, face: EndFace, thickness: float) -> _Sheets:
    """Put points of the inner side of a plate, taken for its outer face, behind it."""
    if not face.plate:
        return sheets
    x, w = local[sheets.rows, 0] / ZONE_MM, face.w(local[sheets.rows])
    inner = plate_sides.inner_of_two(sheets.out, np.stack([np.ones_like(x), x, w, x * w], axis=1), thickness)
    if not inner.any():
        return sheets
    return _Sheets(
        rows=sheets.rows[~inner],
        out=sheets.out[~inner],
        cell=sheets.cell[~inner],
        behind=np.concatenate([sheets.behind, sheets.rows[inner]]),
        behind_out=np.concatenate([sheets.behind_out, sheets.out[inner]]),
        single_layer=False,
    )


def least_squares(basis: Floats, value: Floats, least: int = LEAST_POINTS) -> tuple[Floats, Floats, Bools]:
    """Coefficients (k,), residuals of the inliers, and a mark of these; empty for too few points.

    Coefficients that the points do not determine, as of a face seen as one strip, are 0 within REACH_MM. A point that
    alone determines one has no residual to be tested by, so an outlier there would bend the whole face: points of less
    redundancy than LEAST_REDUNDANCY (Baarda 1968) are left out.
    """
    used = np.ones(len(value), bool)
    expected = np.eye(basis.shape[1]) / REACH_MM
    coefficients: Floats = np.empty(0, np.float64)
    tested = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        if used.sum() < least:
            return np.empty(0), np.empty(0), used
        rows = np.vstack([basis[used], expected]), np.append(value[used], np.zeros(len(expected)))
        coefficients = np.asarray(np.linalg.lstsq(*rows, rcond=None)[0], np.float64)
        residual = value - basis @ coefficients
        orthonormal = np.linalg.qr(rows[0])[0][: int(used.sum())]
        tested[used] = 1.0 - np.einsum("ij,ij->i", orthonormal, orthonormal) > LEAST_REDUNDANCY
        now = tested & (np.abs(residual) < 4.5 * max(robust_sd_about_median(residual[used]), FLOOR_MM))
        if (now == used).all():
            break
        used = now
    return coefficients, value[used] - basis[used] @ coefficients, used
