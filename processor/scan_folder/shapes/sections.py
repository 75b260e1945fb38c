"""The corners P1 to P4 of a section, and the key points made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from processor.model import Floats, Reason, reason
from processor.scan_folder.shapes.body import Body

COLLINEAR_MM = 1e-3  # the same where sides are to be continued beyond rounded corners
STRAIGHT_MM = 0.1  # a corner of the hull that is nearer to the line of its neighbours is none
CHORDS_MM = 1.0  # the same of a section behind the end, which cuts facets of curved faces
SQUARE_RAD = np.radians(35.0)  # largest departure of a corner from a right angle
LEVEL_RAD = np.radians(20.0)  # largest slope of the lower and upper edges across the bridge
DEPTHS_MM = np.array([60.0, 120.0, 180.0])  # of the sections that the skin is followed from to the end
# Left and up of P1..P8 of a round tube: on its outer edge at 45 degrees, and below, right, above, left of its axis.
ROUND = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1], [0, -1], [-1, 0], [0, 1], [1, 0]], np.float64)
ROUND_MM = (
    0.2  # between an outline and a circle or an ellipse, beyond that by which a side may be off its corners' line
)
FEWEST_OF_ROUND, GAP_RAD = 12, np.radians(46.0)  # corners of an outline that may be round, and the angle between two
OVAL_SHARE = 0.02  # of the radius: more than that of a mitre of 16 degrees
ROUNDS = 4  # of the fit of a circle
ROUNDED_SIDES, LONGER = 3, 1.5  # of a rounded corner; a straight side by the longest of these
ALIKE_MM, MOST_ROUNDED_MM = 2.0, 60.0  # difference of the corners' roundings, and the greatest
LEFT = np.array([0.0, 1.0, 0.0])  # +Y, to the left of parts that follow each other along X
LEFT_COS = 0.5  # least cosine between the way to the left and the plane of a section


@dataclass(frozen=True)
class SectionPlane:
    """Plane of a section: a point (3,), the unit normal along the chain, left (+Y) and up in the plane."""

    origin: Floats
    normal: Floats
    left: Floats
    up: Floats

    @staticmethod
    def across(origin: Floats, normal: Floats, way: Floats = LEFT) -> SectionPlane | None:
        """Return the plane; None where ``way`` (3,), to the left, is too far from it to say which side is left."""
        left = way - (way @ normal) * normal
        size = float(np.linalg.norm(left))
        if size < LEFT_COS:
            return None
        left /= size
        return SectionPlane(origin, normal, left, np.cross(normal, left))

    def moved(self, depth_mm: float) -> SectionPlane:
        """Return the parallel plane at a distance along the normal."""
        return SectionPlane(self.origin + depth_mm * self.normal, self.normal, self.left, self.up)

    def flat(self, points: Floats) -> Floats:
        """Return left and up (n, 2) of points (n, 3)."""
        off = points - self.origin
        return np.stack([off @ self.left, off @ self.up], axis=1)

    def space(self, places: Floats) -> Floats:
        """Return the points (n, 3) in the plane at left and up (n, 2)."""
        return self.origin + places[:, :1] * self.left + places[:, 1:] * self.up


def corners(places: Floats, straight_mm: float = STRAIGHT_MM) -> tuple[Floats, Reason | None] | None:
    """Return the corners of the hull of points (n, 2) in a section's plane; None where they enclose no area.

    They are P1..P4 (4, 2), left and up, with the doubt why they are not clear; P1..P8 (8, 2) of a round section, P1..P4
    at 45 degrees on its edge. A side whose points are within ``straight_mm`` of a line is straight.
    """
    if len(places) < 3:
        return None
    try:
        hull = places[ConvexHull(places).vertices]
    except QhullError:
        return None
    of_round = _round(hull, ROUND_MM + straight_mm)
    if of_round is not None:
        return of_round, None
    sharp = _of_rounded_corners(_without_straight(hull, COLLINEAR_MM))
    hull = _without_straight(hull, straight_mm) if sharp is None else sharp
    if len(hull) < 4:
        return None
    size = np.ptp(hull, axis=0)
    unit = (hull - hull.min(axis=0)) / size
    ways = np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    chosen = (unit @ ways.T).argmax(axis=0)
    if len(set(chosen.tolist())) < 4:
        return hull[chosen], reason("init.no-corners-of-box", corners=len(hull))
    return hull[chosen], _doubt(hull[chosen], len(hull))


def _round(hull: Floats, tolerance_mm: float) -> Floats | None:
    """Return P1..P8 (8, 2) of a round tube's outline, a convex polygon (n, 2); None of any other.

    The outline is a circle, or the ellipse in which a mitre cuts a tube.
    """
    if len(hull) < FEWEST_OF_ROUND:
        return None
    low, high = hull.min(axis=0), hull.max(axis=0)
    terms, middle = np.empty((0, 0)), 0.5 * (low + high)
    radii: Floats = np.zeros(5)
    for _ in range(ROUNDS):
        off = hull - middle
        angle, away = np.arctan2(off[:, 1], off[:, 0]), np.linalg.norm(off, axis=1)
        terms = _harmonics(angle)
        radii = np.linalg.lstsq(terms, away, rcond=None)[0]
        middle = middle + radii[1:3]
    gaps = np.diff(np.sort(angle), append=np.sort(angle)[0] + 2.0 * np.pi)
    ovality = float(np.linalg.norm(radii[3:]))
    if gaps.max() > GAP_RAD or ovality > OVAL_SHARE * radii[0] or np.abs(terms @ radii - away).max() > tolerance_mm:
        return None
    at = np.arctan2(ROUND[:, 1], ROUND[:, 0])
    places: Floats = middle + (_harmonics(at) @ radii)[:, None] * np.stack([np.cos(at), np.sin(at)], axis=1)
    return places


def _harmonics(angle: Floats) -> Floats:
    """Terms (n, 5) of a radius at an angle (n,)."""
    return np.stack([np.ones_like(angle), *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))], axis=1)


def _of_rounded_corners(hull: Floats) -> Floats | None:
    """Return the points (4, 2) in which the sides of a hollow section with rounded corners meet; None of any other.

    Its four corners are rounded alike, each by ROUNDED_SIDES sides of the polygon (n, 2) or more.
    """
    if len(hull) < 4 * (ROUNDED_SIDES + 1):
        return None
    sides = np.roll(hull, -1, axis=0) - hull
    length = np.linalg.norm(sides, axis=1)
    straight = np.sort(np.argsort(-length)[:4])
    between = np.diff(straight, append=straight[0] + len(hull)) - 1
    if between.min() < ROUNDED_SIDES or length[straight].min() < LONGER * np.delete(length, straight).max():
        return None
    found, rounding = np.zeros((4, 2)), np.zeros((4, 2))
    for k, (one, other) in enumerate(zip(straight, np.roll(straight, -1), strict=True)):
        a, b = hull[(one + 1) % len(hull)], hull[other]
        solved = np.stack([sides[one] / length[one], sides[other] / length[other]], axis=1)
        if abs(np.linalg.det(solved)) < np.cos(SQUARE_RAD):
            return None
        along, back = np.linalg.solve(solved, b - a)
        found[k], rounding[k] = a + along * solved[:, 0], (along, back)
    if np.ptp(rounding) > ALIKE_MM or rounding.min() <= 0.0 or rounding.max() > MOST_ROUNDED_MM:
        return None
    return found


def _without_straight(hull: Floats, straight_mm: float) -> Floats:
    """Return a convex polygon (n, 2) without vertices on the line of their neighbours."""
    while len(hull) > 3:
        before, after = np.roll(hull, 1, axis=0), np.roll(hull, -1, axis=0)
        chord = after - before
        off = hull - before
        distance = np.abs(chord[:, 0] * off[:, 1] - chord[:, 1] * off[:, 0]) / np.linalg.norm(chord, axis=1)
        least = int(distance.argmin())
        if distance[least] > straight_mm:
            break
        hull = np.delete(hull, least, axis=0)
    return hull


def _doubt(four: Floats, count: int) -> Reason | None:
    if count > 4:
        return reason("init.not-four-corners", corners=count)
    sides = np.roll(four, -1, axis=0) - four
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    turn = np.abs(np.einsum("ki,ki->k", sides, np.roll(sides, 1, axis=0)))
    if turn.max() > np.sin(SQUARE_RAD):
        return reason("init.not-square", degrees=np.degrees(np.arcsin(turn.max())))
    level = np.arcsin(np.abs(sides[[0, 2], 1]).max())
    if level > LEVEL_RAD:
        return reason("init.edge-slopes", degrees=np.degrees(level))
    return None


def key_points(plane: SectionPlane, places: Floats) -> Floats:
    """Return P1..P8 (8, 3) of a section's corners in its plane: P1..P4 (4, 2), or P1..P8 (8, 2) of a round one."""
    middles = 0.5 * (places + np.roll(places, -1, axis=0))
    return plane.space(np.vstack([places, middles])[:8])


def cut(body: Body, plane: SectionPlane) -> Floats:
    """Return left and up (n, 2) of the points in which a plane cuts the edges of a body."""
    side = (body.vertices - plane.origin) @ plane.normal
    ends, _ = body.edges
    a, b = side[ends[:, 0]], side[ends[:, 1]]
    crossed = (a < 0) != (b < 0)
    share = a[crossed] / (a[crossed] - b[crossed])
    first, last = body.vertices[ends[crossed, 0]], body.vertices[ends[crossed, 1]]
    return plane.flat(first + share[:, None] * (last - first))


def skin_at_end(body: Body, plane: SectionPlane, inward: float) -> tuple[Floats, Floats] | None:
    """Return P1..P4 (4, 2) at a plane, extrapolated from sections inside, and their change (4, 2) a mm outward.

    Of a round section P1..P8 (8, 2).

    None where the sections have no corners. ``inward`` is 1 where the body lies on the side of the plane's normal, else
    -1. A bevel, or a flange around the end, has other corners than the skin.
    """
    inside = [corners(cut(body, plane.moved(inward * depth)), CHORDS_MM) for depth in DEPTHS_MM]
    clear = [one[0] for one in inside if one is not None and one[1] is None]
    if len(clear) < len(inside) or len({len(one) for one in clear}) > 1:
        return None
    places = np.array(clear)
    at_end = 3.0 * places[0] - 3.0 * places[1] + places[2]
    return at_end, (at_end - places[0]) / DEPTHS_MM[0]
