"""Sides of a body of polygonal section, such as a column bent of a plate: width, angles between neighbours, flatness.

The sides go around the body's longest axis. A plane is fitted to each, in the mean over its length; its width lies
between the lines in which it meets the planes of its neighbours, as of a section with sharp corners: where a plate is
bent, its round corner is part of no side.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from processor.adjustment import point_groups, scanner_class_errors, thermal
from processor.geometry import rigid
from processor.inspection import characteristic, face_flatness, flat_faces
from processor.inspection.flat_faces import Body, FlatFace, Observed, Side
from processor.inspection.result import Quantity
from processor.limits.judging import Measured
from processor.model import NORMAL_95, Floats, Ints, reason

LENGTHWISE = 0.02  # cosine between a side's normal and the body's axis, at most
MEET_MM = 1.0  # between the rims of neighbours as designed and the line in which their planes meet
FEWEST_SIDES = 5  # fewer are a plate, a box or a wedge, which are measured along their axes
COLUMNS = 4.0  # pieces across a side
FEWEST_PIECES = 6  # of a side that has a plane
ROUNDS = 3  # of fits: the rims follow from the planes, and which points are within them from the rims
STEP = 1e-5  # mm, and mm by mm: of the numerical derivatives of a width, which is smooth over some mm


class SectionSide(NamedTuple):
    """A side as designed, the direction (3,) along its width, counterclockwise, the places (2,) of its rims along it.

    ``distance`` is that of its plane along its normal, from the origin.
    """

    face: FlatFace
    along: Floats
    rims: Floats
    distance: float

    def plane(self, level: float = 0.0, slope: float = 0.0) -> Floats:
        """Return normal and distance (4,) of its plane, raised by a level in its middle and a slope along its width."""
        return np.append(self.face.normal - slope * self.along, self.distance + level - slope * self.rims.mean())


def characteristics(body: Body, axis: Floats, seen: Observed, temperature_C: float) -> Iterator[Measured]:
    """Yield width, angle and flatness of each side around a body's longest ``axis`` (3,); none of a plate or box.

    An angle is that by which the next side is turned against a side. Lengths are those at the reference temperature.
    """
    sides = of_section(body, axis)
    count = len(sides)
    # A side with the one before and the one after it.
    triples = [[(k - 1) % count, k, (k + 1) % count] for k in range(count)]
    rows_of = [np.flatnonzero(np.isin(seen.facet, side.face.facets) & np.isfinite(seen.deviation)) for side in sides]
    rims = [side.rims for side in sides]
    fitted: list[Side | None] = []
    for _ in range(ROUNDS):
        fitted = [_fitted(*one, axis, seen) for one in zip(sides, rims, rows_of, strict=True)]
        shapes = [np.zeros(2) if one is None else one.fit.mean[:2] for one in fitted]
        planes = [side.plane(*shape) for side, shape in zip(sides, shapes, strict=True)]
        threes = [(planes[before], planes[own], planes[after]) for before, own, after in triples]
        rims = [
            np.array([_corner(axis, *pair) @ side.along for pair in itertools.pairwise(three)])
            for side, three in zip(sides, threes, strict=True)
        ]
    for k, (before, own, after) in enumerate(triples):
        three = [one for row in (before, own, after) if (one := fitted[row]) is not None]
        yield _width(f"side-{k + 1}-width", axis, [sides[row] for row in triples[k]], three, temperature_C)
        yield _angle(f"side-{k + 1}-angle", sides[own], sides[after], fitted[own], fitted[after])
        side = fitted[own]
        if side is not None and len(side.pieces.value) >= face_flatness.FEWEST_PIECES:
            yield face_flatness.peak_to_valley(f"side-{k + 1}-flatness", side.pieces, side.along, side.across)


def of_section(body: Body, axis: Floats) -> list[SectionSide]:
    """Return the sides around a body's longest ``axis`` (3,), counterclockwise, if they are more than four and convex.

    They are counted from the one that looks most along the axis's first direction across. Faces that look inward, as
    of a hollow section, are no sides; where neighbours do not meet there are none.
    """
    across = rigid.axes_across(axis)
    corners = np.concatenate([face.corners for face in body.faces]) @ across.T
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) @ across
    sides = []
    for face in body.faces:
        distance = float((face.corners @ face.normal).mean())
        if abs(face.normal @ axis) < LENGTHWISE and distance > middle @ face.normal:
            along = np.cross(axis, face.normal)
            sides.append(SectionSide(face, along, np.array(face.extent(along)), distance))
    sides.sort(key=lambda side: np.arctan2(*(across @ side.face.normal)[::-1]) % (2.0 * np.pi - 1e-9))
    for one, other in itertools.pairwise([*sides, *sides[:1]]):
        turn = one.along @ other.face.normal
        if turn < LENGTHWISE:
            return []
        corner = _corner(axis, one.plane(), other.plane())
        if max(abs(one.along @ corner - one.rims[1]), abs(other.along @ corner - other.rims[0])) > MEET_MM:
            return []
    return sides if len(sides) >= FEWEST_SIDES else []


def _corner(axis: Floats, one: Floats, other: Floats) -> Floats:
    """Return where the planes (4,) of two sides and the plane across the axis through the origin meet."""
    planes = np.stack([one, other, [*axis, 0.0]])
    return np.asarray(np.linalg.solve(planes[:, :3], planes[:, 3]), np.float64)


def _fitted(side: SectionSide, rims: Floats, rows: Ints, axis: Floats, seen: Observed) -> Side | None:
    """Fit a plane to the ``rows`` seen of a side between ``rims`` (2,); None where they do not determine it.

    It is the plane of the whole side, which heat has drawn beside a weld, and so no piece of it is left out. Core
    points whose circle reaches over a rim are: the circle holds points of two sides, and of a corner that is round.
    """
    reach = 0.5 * seen.side / flat_faces.PIECE_DIAMETERS
    low, high = rims + np.array([reach, -reach])
    at = seen.places[rows] @ side.along
    inside = (at > low) & (at < high)
    rows, at = rows[inside], at[inside]
    if len(rows) < FEWEST_PIECES:
        return None
    place = np.stack([seen.places[rows] @ axis, at - low], axis=1)
    pieces = flat_faces.pieces(seen, rows, point_groups.patch_numbers(place, (high - low) / COLUMNS))
    x = pieces.places @ axis - 0.5 * sum(side.face.extent(axis))
    y = pieces.places @ side.along - side.rims.mean()
    fit = flat_faces.fit(np.stack([np.ones_like(x), y, x], axis=1), pieces, x, y, np.inf)
    return None if fit is None or len(x) < FEWEST_PIECES else Side(pieces, x, y, fit)


def _width(
    id_: str, axis: Floats, sides: Sequence[SectionSide], planes: Sequence[Side], temperature_C: float
) -> Measured:
    """Return the width of the middle one of three sides, between those of their ``planes`` that are known."""
    nominal = float(np.ptp(sides[1].rims))
    if len(planes) < len(sides):
        return characteristic.absent(id_, Quantity.WIDTH, nominal, reason("inspect.face-not-seen"))
    mean = np.array([plane.fit.mean[:2] for plane in planes])

    def width(shapes: Floats) -> float:
        corners = itertools.pairwise(side.plane(*shape) for side, shape in zip(sides, shapes, strict=True))
        return float(np.linalg.norm(np.subtract(*(_corner(axis, *pair) for pair in corners))))

    variance = scanner_class_errors.scale_variance(nominal)
    for k, plane in enumerate(planes):
        steps = np.zeros((2, 3, 2))
        steps[:, k] = STEP * np.eye(2)
        slope = np.array([width(mean + step) - width(mean - step) for step in steps]) / (2.0 * STEP)
        variance += float(slope @ plane.fit.covariance[:2, :2] @ slope)
    deviation = width(mean) / thermal.expansion(temperature_C) - nominal
    return characteristic.normal(id_, Quantity.WIDTH, nominal, deviation, variance)


def _angle(id_: str, side: SectionSide, after: SectionSide, one: Side | None, other: Side | None) -> Measured:
    """Return the angle from a side to the one after, degrees: a slope turns a side's normal the other way."""
    nominal = float(np.degrees(np.arccos(np.clip(side.face.normal @ after.face.normal, -1.0, 1.0))))
    if one is None or other is None:
        absent = characteristic.absent(id_, Quantity.ANGLE, nominal, reason("inspect.face-not-seen"))
        return dataclasses.replace(absent, unit="deg")
    turned = np.degrees(np.arctan(one.fit.mean[1]) - np.arctan(other.fit.mean[1]))
    half = NORMAL_95 * np.degrees(np.sqrt(one.fit.covariance[1, 1] + other.fit.covariance[1, 1]))
    return Measured.within(id_, float(turned), float(half), what=Quantity.ANGLE, unit="deg", nominal=nominal)
