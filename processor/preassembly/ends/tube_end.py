"""The end of a round tube at a joint: its outer wall and its end face fitted to their residuals against the design.

At the angle a about the tube's axis, from left towards up, and x along the bridge from the joint, in units of ZONE_MM,
the wall departs outward by ``(1, cos a, sin a, cos 2a, sin 2a) (1, x)`` and ``x^2 (cos a, sin a)``: radius, place,
ovality, their changes along the tube, and its bend. The end face departs by ``1, u, v, u^2 - v^2, 2 u v``, with u and v
the place in units of the radius. Key point k is on the outer edge at its angle about the axis as built: the place of
the axis moves all eight of them, as a shift moves the corners of a box.

Which material point that is depends on the turn of the tube about its axis. Where nothing shows the turn, the intervals
of the key points contain all of them. The change by a turn r is ``sin r t + (cos r - 1) q`` with the changes t and q of
all coordinates, so any linear combination of coordinates changes by ``(2 / sqrt 3) sqrt(t^2 + (2 q)^2)`` at most: the
place of the axis and the mean gap, which no turn changes, keep their intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from processor.adjustment import variance_components
from processor.adjustment.point_groups import group_sums
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.model import NORMAL_95, Bools, Floats, Ints, Reason, reason
from processor.preassembly.ends import end_ring, joint_end, plate_sides, section, view_variance
from processor.preassembly.ends.joint_end import JointEnd
from processor.preassembly.ends.joint_frame import EndPlace
from processor.preassembly.ends.outer_faces import (
    FLOOR_MM,
    LEAST_POINTS,
    REACH_MM,
    ZONE_MM,
    RegisteredPart,
    least_squares,
)
from processor.preassembly.ends.view_variance import Thickness, Variances
from processor.robust_statistics import robust_sd

WALL, RING = 12, 5  # coefficients of the wall and of the end face
CELLS = (5, 12)  # of the wall, along and around, for its lack of fit
QUADRANTS = 4  # of the wall, each a plate whose two sides are compared
AXIS_MM = 120.0  # of the end, in which the design's axis is straight
ACROSS = 0.5  # cosine between a facet's normal and the axis, below which it is of a wall
HALF_WALL = 0.5  # of the wall's thickness: larger departures may be of its other side
# The ellipse of the two changes with half axes TURN_BOUND and twice that is the least that holds (sin r, cos r - 1) of
# every turn r: sin^2 r + (cos r - 1)^2 / 4 is at most 4 / 3, at cos r = -1 / 3.
TURN_BOUND = 2.0 / np.sqrt(3.0)
SECOND = slice(3, 5)  # coefficients of wall and end face twice round


@dataclass(frozen=True)
class FittedTube:
    """Coefficients (17,) of the wall and the end face of a tube's end, with their covariance (17, 17).

    ``pose`` (6, 6) is the covariance of the part's registration; ``turn_known``: what the tube's turn about its axis is
    was seen. ``plates`` are its quadrants, none where the points' stations are known.
    """

    coefficients: Floats
    covariance: Floats
    pose: Floats
    place: EndPlace
    turn_known: bool
    plates: tuple[Thickness | None, ...]
    ring_noise: float
    doubts: tuple[Reason, ...] = ()
    remarks: tuple[Reason, ...] = ()


def wall_of(surface: MeshSurface, place: EndPlace) -> Bools:
    """Mark the facets (f,) of the outer wall of a round tube that ends at a joint; none where there is no such wall."""
    corners = rigid.apply(rigid.invert(place.T_bridge_joint), surface.vertices[surface.faces])
    normals = surface.normals @ place.T_bridge_joint[:3, :3]
    away = np.hypot(corners[:, :, 1], corners[:, :, 2]) - place.section.radius
    score = (np.abs(away) + 0.1 * np.abs(corners[:, :, 0])).min(axis=1)
    score[np.abs(normals[:, 0]) > ACROSS] = np.inf
    nearest = int(np.argmin(score))
    if not score[nearest] < REACH_MM:
        return np.zeros(len(score), bool)
    marked: Bools = surface.part_of == surface.part_of[nearest]
    return marked


def fit(part: RegisteredPart, place: EndPlace, turn_known: bool) -> FittedTube | JointEnd:
    """Fit one end of a tube; a JointEnd without an answer is final."""
    local = rigid.apply(rigid.invert(place.T_bridge_joint), part.points)
    depth = -place.outward * local[:, 0]
    zone = (depth < ZONE_MM) & (depth > -REACH_MM)
    zone &= np.hypot(local[:, 1], local[:, 2]) < place.section.radius + 2.0 * REACH_MM
    wall = wall_of(part.surface, place)
    if zone.sum() < 5 * LEAST_POINTS or not wall.any():
        return joint_end.unknown(reason("preassemble.few-points-at-joint"))
    part, local = part.only(zone), local[zone]
    outer = part.surface.only(wall)
    local[:, 1:] -= local[:, :1] * _slope(outer, place)
    out, on_outer = _outward(part, outer, wall, local, place)
    angle = np.arctan2(local[:, 2], local[:, 1])
    thickness = _thickness(part.surface, place)
    rows = np.flatnonzero(on_outer & (-place.outward * local[:, 0] > 3.0))
    coefficients, residual, inliers = least_squares(_wall_basis(local[rows, 0], angle[rows]), out[rows])
    if not len(coefficients):
        return joint_end.unknown(reason("preassemble.few-points-on-wall"))
    rows = rows[inliers]
    sigma = float(np.sqrt(residual @ residual / max(len(residual) - WALL, 1)))
    covariance = _wall_covariance(part, local[rows, 0], angle[rows], rows, residual)
    level = _wall_basis(local[:, 0], angle) @ coefficients
    ring, of_ring, noise = _ring(part, local, level - out, place, thickness, sigma)
    if not len(ring):
        return joint_end.unknown(reason("preassemble.few-points-on-end-face"))
    departure = np.abs(_wall_basis(np.zeros(72), np.linspace(-np.pi, np.pi, 72)) @ coefficients).max()
    other_side = 0.0 < HALF_WALL * thickness < departure
    single = (part.station == part.station[0]).all()
    return FittedTube(
        coefficients=np.concatenate([coefficients, ring]),
        covariance=block_diag(covariance, of_ring),
        pose=part.pose,
        place=place,
        turn_known=turn_known,
        plates=_quadrants(local, level - out, on_outer, thickness) if single else (),
        ring_noise=noise,
        doubts=(reason("preassemble.wall-side", mm=float(departure), wall=thickness),) if other_side else (),
    )


def estimate(end: FittedTube, between: Variances = view_variance.NONE) -> JointEnd:
    """Return the key points of a tube's end; ``between`` are the variances between viewpoints."""
    covariance = end.covariance + (np.diag(_of_views(between)) if end.plates else 0.0)
    departure, derivative = _key_points(end.place, end.coefficients)
    second_order = joint_end.SECOND_ORDER * np.linalg.norm(departure, axis=1)
    spread = derivative @ covariance @ derivative.T + np.diag(FLOOR_MM**2 + np.repeat(second_order, 3) ** 2)
    by_pose = np.zeros((24, 6))
    if end.turn_known:
        tangent = end.place.section.radius * _tangents()
        by_pose[:, :3] = tangent.reshape(24, 1) * end.place.T_bridge_joint[:3, 0]
        spread = spread + by_pose @ end.pose @ by_pose.T
    else:
        modes = _turned(end.place, end.coefficients)
        spread = spread + modes @ modes.T
    return JointEnd(departure, spread, by_pose, end.doubts, end.remarks)


def _slope(outer: MeshSurface, place: EndPlace) -> Floats:
    """Return by how much (2,) the design's axis goes left and up with x, beside the joint."""
    local = rigid.apply(rigid.invert(place.T_bridge_joint), outer.vertices[outer.faces])
    near = np.abs(local[:, :, 0]).min(axis=1) < AXIS_MM
    normals = outer.normals[near] @ place.T_bridge_joint[:3, :3]
    axis = np.linalg.svd(normals, full_matrices=False)[2][2]
    slope: Floats = axis[1:] / axis[0]
    return slope


def _outward(
    part: RegisteredPart, outer: MeshSurface, wall: Bools, local: Floats, place: EndPlace
) -> tuple[Floats, Bools]:
    """Distances (n,) of points outward from the design's outer wall, and a mark of those that are on it."""
    nearest, _, _ = part.surface.distances(part.points, REACH_MM)
    facet, off, beyond = outer.distances(part.points, 2.0 * REACH_MM)
    feet = part.points - off[:, None] * outer.normals[facet]
    off = off - mesh_distance.of_surface(outer).heights(np.nan_to_num(feet), facet)
    normal = outer.normals[facet] @ place.T_bridge_joint[:3, :3]
    out = off * np.sign(np.einsum("ni,ni->n", normal[:, 1:], local[:, 1:]))
    of_wall = (nearest >= 0) & wall[nearest] & on_face(facet, beyond) & (np.abs(off) < REACH_MM)
    return np.where(facet >= 0, out, np.nan), of_wall


def _wall_basis(x: Floats, angle: Floats) -> Floats:
    """Terms (n, 12) of the wall's departure at x (n,) mm and an angle (n,)."""
    scaled = (x / ZONE_MM)[:, None]
    around = np.stack([np.ones_like(angle), *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))], axis=1)
    return np.hstack([around, scaled * around, scaled**2 * around[:, 1:3]])


def _face_basis(u: Floats, v: Floats) -> Floats:
    """Terms (n, 5) of the end face's departure at u, v (n,), in units of the radius."""
    return np.stack([np.ones_like(u), u, v, u * u - v * v, 2.0 * u * v], axis=1)


def _wall_covariance(part: RegisteredPart, x: Floats, angle: Floats, rows: Ints, residual: Floats) -> Floats:
    basis = _wall_basis(x, angle)
    along = np.floor(CELLS[0] * np.minimum(np.abs(x) / ZONE_MM, 0.999))
    around = np.floor(CELLS[1] * np.clip(0.5 + angle / (2.0 * np.pi), 0.0, 0.999))
    cell = (along * CELLS[1] + around).astype(np.int64)
    noise = float(residual @ residual) / max(len(residual) - WALL, 1)
    expected = np.eye(WALL) / REACH_MM**2  # coefficients that the points do not determine
    covariance = by_noise = np.linalg.inv(basis.T @ basis / max(noise, FLOOR_MM**2) + expected)
    lack_of_fit = variance_components.lack_of_fit_variance([(residual, cell)], WALL)
    for group, variance in ((cell, lack_of_fit), (part.station[rows], part.between_stations)):
        gain = group_sums(basis, group) @ by_noise / max(noise, FLOOR_MM**2)
        covariance = covariance + variance * gain.T @ gain
    return covariance


def _ring(
    part: RegisteredPart, local: Floats, inward: Floats, place: EndPlace, thickness: float, sigma: float
) -> tuple[Floats, Floats, float]:
    """Coefficients (5,) of the end face, their covariance, and the variance of its points; none where it was not seen.

    ``inward`` (n,) from the wall's outer side.
    """
    x = place.outward * local[:, 0]
    near = (np.abs(x) < REACH_MM) & (inward < thickness + 60.0) & (inward > -60.0)
    radius = place.section.radius
    basis = _face_basis(local[near, 1] / radius, local[near, 2] / radius)
    at, e, station = x[near], inward[near], part.station[near]
    wall = plate_sides.plate_thickness(at, e, sigma, thickness)
    ring = end_ring.fit(at, e, np.full(len(at), wall), basis, sigma)
    if not len(ring.coefficients):
        return np.empty(0), np.empty((0, 0)), 0.0
    residual = at - basis @ ring.coefficients
    margin = min(2.0 * sigma, 0.35 * wall)
    surely = (e > margin) & (e < wall - margin)
    surely &= np.abs(residual) < end_ring.REACH * max(sigma, FLOOR_MM)
    rest, sector = residual[surely], end_ring.sectors(basis[surely])
    lack_of_fit = variance_components.lack_of_fit_variance([(rest, sector)], RING)
    covariance = ring.covariance + variance_components.group_covariance(basis[surely], sector, lack_of_fit)
    by_station = variance_components.group_covariance(basis[surely], station[surely], part.between_stations)
    return ring.coefficients, covariance + by_station, robust_sd(rest) ** 2


def _thickness(surface: MeshSurface, place: EndPlace) -> float:
    """Thickness of the wall by the design's end face, mm; 0 = unknown."""
    corners = rigid.apply(rigid.invert(place.T_bridge_joint), surface.vertices[surface.faces])
    normals = np.abs(surface.normals @ place.T_bridge_joint[:3, 0])
    nearest = np.abs(corners[:, :, 0]).max(axis=1)
    radius = np.hypot(corners[:, :, 1], corners[:, :, 2])
    at_end = (normals > 0.9) & (nearest < REACH_MM) & (radius.max(axis=1) < 1.02 * place.section.radius)
    if not at_end.any():
        return 0.0
    at_end &= nearest < nearest[at_end].min() + 5.0
    return float(max(place.section.radius - radius[at_end].min(), 0.0))


def _quadrants(local: Floats, inward: Floats, on_outer: Bools, thickness: float) -> tuple[Thickness | None, ...]:
    """Compare the outer and the inner side of the wall in four quadrants."""
    angle, found = np.arctan2(local[:, 2], local[:, 1]), list[Thickness | None]()
    depth = np.where(np.isfinite(inward), inward, np.inf)
    inner = ~on_outer & (np.abs(depth - thickness) < plate_sides.LAYER_MM) & (thickness > plate_sides.THINNEST_MM)
    deep = np.abs(local[:, 0]) > plate_sides.LAYER_MM + REACH_MM
    for quadrant in range(QUADRANTS):
        off = np.angle(np.exp(1j * (angle - 0.5 * np.pi * quadrant)))
        rows = np.flatnonzero((np.abs(off) < 0.25 * np.pi) & deep & ((on_outer & (np.abs(depth) < 30.0)) | inner))
        if not inner[rows].any() or inner[rows].all():
            found.append(None)
            continue
        x, w = local[rows, 0], off[rows] / (0.25 * np.pi)
        at = np.stack([x, np.hypot(local[rows, 1], local[rows, 2]).mean() * off[rows]], axis=1)
        trend = np.stack([np.ones_like(x), x / ZONE_MM, w], axis=1)
        found.append(view_variance.thickness(trend, at, -depth[rows], inner[rows], thickness))
    return tuple(found)


def _of_views(between: Variances) -> Floats:
    """Variances (17,) of the coefficients by views from four sides, of which each has errors of its own."""
    level, along = (of * np.array([0.25, 0.5, 0.5, 0.25, 0.25]) for of in (between.level, between.along))
    level[SECOND] += between.across
    return np.array([*level, *along, 0.0, 0.0, between.ring, between.across, between.across, 0.0, 0.0])


def _tangents() -> Floats:
    """Return unit vectors (8, 3) at the key points along a turn about the axis."""
    angle = np.array(section.ANGLES)
    return np.stack([np.zeros(8), -np.sin(angle), np.cos(angle)], axis=1)


def _key_points(place: EndPlace, coefficients: Floats) -> tuple[Floats, Floats]:
    """Departures (8, 3) of P1..P8, and the derivative (24, 17) of their coordinates."""
    angle, radius = np.array(section.ANGLES), place.section.radius
    out = np.stack([np.zeros(8), np.cos(angle), np.sin(angle)], axis=1)
    derivative, departure = np.zeros((8, 3, WALL + RING)), np.zeros((8, 3))
    for _ in range(joint_end.ITERATIONS):
        wall = _wall_basis(departure[:, 0], angle)
        u, v = ((radius * out[:, k] + departure[:, k]) / radius for k in (1, 2))
        derivative[:, 0, WALL:] = place.outward * _face_basis(u, v)
        # What changes the radius acts along it; the place of the axis moves all points alike.
        radial = wall.copy()
        radial[:, [1, 2, 6, 7, 10, 11]] = 0.0
        derivative[:, 1:, :WALL] = out[:, 1:, None] * radial[:, None, :]
        x = (departure[:, 0] / ZONE_MM)[:, None]
        powers = np.hstack([np.ones_like(x), x, x**2])
        derivative[:, 1, [1, 6, 10]] = powers
        derivative[:, 2, [2, 7, 11]] = powers
        departure = derivative @ coefficients
    return departure, derivative.reshape(24, WALL + RING)


def _turned(place: EndPlace, coefficients: Floats) -> Floats:
    """Return changes (24, m) of the key points by any turn about the axis, each as a standard deviation."""
    angle, radius = np.array(section.ANGLES), place.section.radius
    out = np.stack([np.zeros(8), np.cos(angle), np.sin(angle)], axis=1)
    tilt = place.outward * coefficients[WALL + 1 : WALL + 3]
    t, q = radius * _tangents(), radius * out
    t[:, 0], q[:, 0] = _tangents()[:, 1:] @ tilt, out[:, 1:] @ tilt
    modes = [TURN_BOUND * t.ravel(), 2.0 * TURN_BOUND * q.ravel()]
    oval, face = (float(np.linalg.norm(coefficients[rows])) for rows in (SECOND, slice(WALL + 3, WALL + 5)))
    for twice in (np.cos(2.0 * angle), np.sin(2.0 * angle)):
        modes += [2.0 * face * (twice[:, None] * np.eye(3)[0]).ravel(), 2.0 * oval * (twice[:, None] * out).ravel()]
    return np.stack(modes, axis=1) / NORMAL_95
