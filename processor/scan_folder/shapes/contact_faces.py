"""Plane faces of two bodies that lie opposite each other: where one part of a bridge meets the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from processor.model import Floats, Ints
from processor.scan_folder.shapes.body import Body

GAP_MM = 60.0  # largest root gap of a joint
PLANE_MM = 0.1  # a facet is in a plane if its corners are nearer
MOST_PLANES = 400  # work: the largest of a part; its ends are among them
SMALL_SHARE = 0.02  # of the largest plane's area: smaller ones are not ends
PARALLEL_COS = np.cos(np.radians(3.0))  # chosen: such a wedge opens a root by 26 mm on 0.5 m
OVERLAP_SHARE = 0.5  # of the smaller face's extents, in both directions of the plane
LARGER_MM = 200.0  # one section may project so far beyond the other
OVERLAP_MM = 10.0  # bodies that overlap more do not meet
RIVAL_SHARE = 0.5  # of the largest pair's area: smaller pairs of faces are not the joint
FITTING_SHARE = 0.4  # least area of the smaller of two ends by the larger one's
BESIDE_MM = 5.0  # a pair of faces that is hardly farther apart, in another plane, may as well be the joint


@dataclass(frozen=True)
class PlaneFace:
    """Facets of a body in one plane: its unit normal (3,), their corners (n, 3), mm, and their area, mm2."""

    normal: Floats
    points: Floats
    area: float

    @property
    def origin(self) -> Floats:
        """Mean (3,) of the corners, mm."""
        return np.asarray(self.points.mean(axis=0))


@dataclass(frozen=True)
class Contact:
    """Opposite faces of two bodies.

    ``gap_mm`` is the distance between their planes, negative where the bodies overlap; ``rival`` is true where a second
    pair of faces, in another plane, is nearly as large.
    """

    a: PlaneFace
    b: PlaneFace
    gap_mm: float
    rival: bool

    @property
    def reverse(self) -> Contact:
        """The same contact with a and b exchanged."""
        return Contact(self.b, self.a, self.gap_mm, self.rival)

    @property
    def middle(self) -> Floats:
        """Middle (3,) between both faces, mm."""
        ends = (0.5 * (face.points.min(axis=0) + face.points.max(axis=0)) for face in (self.a, self.b))
        return np.asarray(0.5 * sum(ends, np.zeros(3)))

    @property
    def sizes(self) -> tuple[Floats, Floats]:
        """Sides (2,) of the rectangle around each face, in the axes of the first, mm."""
        _, _, Vt = np.linalg.svd(self.a.points - self.a.origin, full_matrices=False)
        return np.ptp(self.a.points @ Vt[:2].T, axis=0), np.ptp(self.b.points @ Vt[:2].T, axis=0)

    @property
    def fits(self) -> bool:
        """Whether the faces are about as large, as those of a bolt's head and a flange are not."""
        areas = [float(sides.prod()) for sides in self.sizes]
        return min(areas) >= FITTING_SHARE * max(areas)


def contacts(bodies: Sequence[Body]) -> dict[tuple[int, int], Contact]:
    """Return the contact of each pair of bodies (i, k), i < k, that meet or lie GAP_MM apart at most."""
    found = {}
    for i, k in combinations(range(len(bodies)), 2):
        a, b = bodies[i].bounds, bodies[k].bounds
        if not ((a[0] - GAP_MM > b[1]) | (b[0] - GAP_MM > a[1])).any():
            one = contact(bodies[i], bodies[k], GAP_MM)
            if one is not None:
                found[i, k] = one
    return found


def contact(a: Body, b: Body, limit_mm: float) -> Contact | None:
    """Return the nearest of the large pairs of opposite faces of two bodies, ``limit_mm`` apart at most; else None."""
    near_a, near_b = _facets_near(a, b, limit_mm), _facets_near(b, a, limit_mm)
    if not len(near_a) or not len(near_b):
        return None
    found = []
    faces_b = _planes(b, near_b)
    for face_a in _planes(a, near_a):
        for face_b in faces_b:
            gap = _gap(face_a, face_b, a, b)
            if gap is not None and gap <= limit_mm and _overlap(face_a, face_b):
                found.append((min(face_a.area, face_b.area), gap, face_a, face_b))
    if not found:
        return None
    largest = max(pair[0] for pair in found)
    large = [pair for pair in found if pair[0] > RIVAL_SHARE * largest]
    # A diaphragm or the back of an end plate lies behind the end.
    _, gap, face_a, face_b = min(large, key=lambda pair: (pair[1], -pair[0]))
    rival = any(pair[1] < gap + BESIDE_MM and not _same_plane(pair[2], face_a) for pair in large)
    return Contact(face_a, face_b, gap, rival)


def _facets_near(body: Body, other: Body, limit_mm: float) -> Ints:
    """Return the facets of a body that lie in the other's bounding box, grown by the limit."""
    reach = limit_mm + LARGER_MM
    low, high = other.bounds[0] - reach, other.bounds[1] + reach
    inside = ((body.vertices >= low) & (body.vertices <= high)).all(axis=1)
    return np.flatnonzero(inside[body.faces].all(axis=1))


def _planes(body: Body, facets: Ints) -> list[PlaneFace]:
    """Return the plane faces that facets (n,) of a body make up, the largest first."""
    tolerance = max(PLANE_MM, 2.0 * body.step_mm)
    label = body.faces_between[facets]
    area = np.bincount(label, weights=body.areas[facets])
    left = np.ones(len(facets), bool)
    faces: list[PlaneFace] = []
    for face in np.argsort(-area, kind="stable")[:MOST_PLANES].tolist():
        seed = left & (label == face)
        if not area[face] > SMALL_SHARE * area.max() or not seed.any():
            continue
        points = body.vertices[np.unique(body.faces[facets[seed]])]
        normal, origin = _normal(points), points.mean(axis=0)
        if np.abs((points - origin) @ normal).max() > tolerance:
            continue  # curved
        inside = left & (np.abs((body.vertices - origin) @ normal) <= tolerance)[body.faces[facets]].all(axis=1)
        left &= ~inside
        points = body.vertices[np.unique(body.faces[facets[inside]])]
        faces.append(PlaneFace(_normal(points), points, float(body.areas[facets[inside]].sum())))
    faces.sort(key=lambda face: -face.area)
    return faces


def _normal(points: Floats) -> Floats:
    """Return the normal of the plane through points (n, 3) by least squares."""
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2])


def _gap(a: PlaneFace, b: PlaneFace, body_a: Body, body_b: Body) -> float | None:
    """Return the distance between two faces; None if they are not parallel, or the bodies not on either side."""
    if abs(a.normal @ b.normal) < PARALLEL_COS:
        return None
    out = a.normal if a.normal @ (a.origin - body_a.centre) > 0 else -a.normal
    if out @ (body_b.centre - b.origin) <= 0 or out @ (body_a.centre - a.origin) >= 0:
        return None
    gap = float(out @ (b.origin - a.origin))
    return gap if gap > -OVERLAP_MM else None


def _overlap(a: PlaneFace, b: PlaneFace) -> bool:
    _, _, Vt = np.linalg.svd(a.points - a.origin, full_matrices=False)
    x, y = a.points @ Vt[:2].T, b.points @ Vt[:2].T
    low, high = np.maximum(x.min(axis=0), y.min(axis=0)), np.minimum(x.max(axis=0), y.max(axis=0))
    smaller = np.minimum(np.ptp(x, axis=0), np.ptp(y, axis=0))
    return bool((high - low > OVERLAP_SHARE * smaller).all())


def same_place(a: PlaneFace, b: PlaneFace) -> bool:
    """Whether two faces of a body lie in one plane and overlap."""
    return _same_plane(a, b) and _overlap(a, b)


def _same_plane(a: PlaneFace, b: PlaneFace) -> bool:
    return bool(np.abs((a.points - b.origin) @ b.normal).max() < 10.0 * PLANE_MM)
