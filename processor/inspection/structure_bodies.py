"""Inspection of the bodies of a structure with flat faces, by the deviations that step ``deviation`` measured.

A body's axes are the normals of its outermost pairs of parallel faces: length along the longest, then height and width,
the more upright one being the height. Shapes fitted to the faces give its sizes, squareness, twist, sweep, camber and
flatness. All depend on the shape of a body alone: where it is moved to or turned is no part of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from processor import scene_cloud
from processor.adjustment import scanner_class_errors, thermal
from processor.geometry import rigid
from processor.inspection import (
    characteristic,
    edge_counts,
    face_flatness,
    flat_faces,
    holes,
    narrow_faces,
    points_in_design_frame,
    polygon_sides,
)
from processor.inspection.flat_faces import Body, Fit, FlatFace, Observed, Pieces, Side
from processor.inspection.narrow_faces import Surroundings
from processor.inspection.part_geometry import off_the_chord
from processor.inspection.result import InspectedComponent, Quantity, Result
from processor.limits.judging import Measured
from processor.model import Floats, Reason, Scene, Status, reason
from processor.registration import surface_registration

PARALLEL, SQUARE = 0.9999, 0.02  # cosines between normals of opposite faces, and of different axes
SLENDER = 4.0  # length by height and width from which a body is a member with an axis
THIN_MM, THIN_SHARE = 100.0, 0.25  # the least size, alone and by the next one, below which it is a thickness
PLACES = np.linspace(-1.0, 1.0, 41)  # along a body, at which its axis is compared with its chord
COLUMNS = 20.0  # pieces along half a face count as different
DEGREES = ((6, 14), (4, 9), (2, 5))  # of the polynomial along a face, and least number of pieces along it
BOWED = 8  # pieces along a face from which its curvature is fitted as well
UP = np.array([0.0, 0.0, 1.0])
LEAST_FOUND = 3  # pieces of a face that is fitted
STRIPS = 0.3  # scatter across a narrow face from which it is of several strips, in halves of the body's size
SLOPE_SD = 2e-3  # of a face that was seen along less than half of its length


class Axis(NamedTuple):
    """A direction (3,) of a body with the rows of its outermost faces, looking backwards and forwards, and its size."""

    direction: Floats
    faces: tuple[int, int]
    size: float


Sides = Mapping[int, Side | Reason]  # by the row of the face; why it was not measured
_PART = (reason("inspect.face-not-seen"),)


def inspect(scene: Scene, deviation: Any, stitched: Any, least_mm: float, method: str) -> Result:
    """Inspect the bodies of a structure by the results of steps ``deviation`` and, if it ran, stitch."""
    if deviation is None or scene.structure is None or not len(deviation.core):
        return Result(status=Status.OK, method=method, reasons=(reason("inspect.no-deviation"),))
    seen = flat_faces.observed(scene.structure, deviation)
    if seen is None:
        return Result(status=Status.OK, method=method, reasons=(reason("inspect.no-deviation"),))
    found = list(flat_faces.bodies(scene.structure, seen, least_mm))
    T = deviation.T_design_scan if deviation.T_design_scan.size else np.eye(4)
    origin, placed = scene_cloud.local_design(scene.structure)[1], scene_cloud.stitched(scene, stitched)
    if not any(body.holes for body in found):
        # Faces without pieces are measured by the points on them.
        unmeasured = [
            face
            for body in found
            for face, pieces in zip(body.faces, body.pieces, strict=True)
            if len(pieces.value) < LEAST_FOUND
        ]
        placed = narrow_faces.near(placed, T, origin, unmeasured, deviation.max_depth)
    cloud = points_in_design_frame.of_scene(placed, T, origin)
    around = narrow_faces.surroundings(scene.structure, cloud, seen)
    unproven = surface_registration.is_unproven(deviation.reasons)
    doubtful = deviation.status is Status.AMBIGUOUS or unproven
    components = tuple(
        component for body in found if (component := _component(body, scene, seen, around, doubtful)) is not None
    )
    remarks = () if scene.tolerance is not None else (reason("inspect.no-limits"),)
    if not components:
        remarks = (reason("inspect.no-flat-bodies"), *remarks)
    if doubtful:
        why = reason("inspect.pose-unproven") if unproven else reason("inspect.pose-ambiguous")
        remarks = (why, *remarks)
    return Result.of_components(components, method, remarks)


def _component(
    body: Body, scene: Scene, seen: Observed, around: Surroundings, doubtful: bool
) -> InspectedComponent | None:
    found, sizes = measured(body, seen, scene.temperature_C, around)
    if body.holes:
        first = 1  # holes are numbered over the whole body
        for group in holes.groups(list(body.holes), [axis.direction for axis in body_axes(body)]):
            found += holes.characteristics(group, holes.fitted(around.cloud, group, scene.temperature_C), first)
            first += len(group.holes)
    if not found:
        return None
    if all(np.isnan(one.value) for one in found):
        return InspectedComponent(name=body.name, status=Status.FAILED, reasons=(reason("inspect.body-not-seen"),))
    return InspectedComponent(
        name=body.name, characteristics=characteristic.table(found, scene.tolerance, body.name, sizes, doubtful)
    )


def measured(
    body: Body, seen: Observed, temperature_C: float = float("nan"), around: Surroundings | None = None
) -> tuple[list[Measured], dict[str, float]]:
    """Return the characteristics of a body by what was ``seen``, and its sizes as designed; none without flat sides.

    Sizes are those at the reference temperature, if that of the steel is known. Faces without pieces, such as narrow
    ones, are measured by the points ``around`` them, if given.
    """
    axes = body_axes(body)
    if len(axes) < 2:
        return [], {}
    names = axis_names(axes)
    middle = np.mean([face.corners.mean(axis=0) for face in body.faces], axis=0)
    wide: Sides = {row: _side(body, row, body.pieces[row], axes, middle) for axis in axes for row in axis.faces}
    sides = wide
    if around is not None and np.isfinite(around.shared):
        sides = _with_narrow(body, wide, axes, middle, around)
    found = [*_sizes(axes, names, sides, temperature_C), *_squareness(axes, names, sides)]
    if len(axes) == 3 and axes[0].size > SLENDER * axes[1].size:
        found += [*_twist(axes, names, sides), *_bows(axes, sides)]
    else:
        found += _flatness(axes, names, sides)
    found += polygon_sides.characteristics(body, axes[0].direction, seen, temperature_C)
    return found, {str(name): axis.size for name, axis in zip(names, axes, strict=True)}


def body_axes(body: Body) -> list[Axis]:
    """Return the axes of a body, longest first: square to each other, with an outermost face on either side."""
    axes: list[Axis] = []
    if not body.faces:
        return axes
    normals = np.array([face.normal for face in body.faces])
    middles = np.array([face.corners.mean(axis=0) for face in body.faces])
    for normal in normals:
        looks = normals @ normal
        others = looks < -PARALLEL
        if not others.any() or any(abs(axis.direction @ normal) > PARALLEL for axis in axes):
            continue
        at = middles @ normal
        front = int(np.argmax(np.where(looks > PARALLEL, at, -np.inf)))
        back = int(np.argmin(np.where(others, at, np.inf)))
        if at[front] > at[back]:
            axes.append(Axis(normal, (back, front), float(at[front] - at[back])))
    square: list[Axis] = []
    for axis in sorted(axes, key=lambda one: -one.size):
        if all(abs(axis.direction @ other.direction) < SQUARE for other in square):
            square.append(axis)
    # An axis looks the way of its largest component, so that its sense does not depend on the order of faces.
    return [
        axis
        if rigid.looks_forwards(axis.direction)
        else Axis(-axis.direction, (axis.faces[1], axis.faces[0]), axis.size)
        for axis in square
    ]


def axis_names(axes: list[Axis]) -> list[Quantity]:
    """Name the sizes along the axes of a body."""
    names = [Quantity.LENGTH, Quantity.WIDTH, Quantity.HEIGHT][: len(axes)]
    if len(axes) < 3:
        return names
    if axes[2].size < THIN_MM and axes[2].size < THIN_SHARE * axes[1].size:
        return [Quantity.LENGTH, Quantity.WIDTH, Quantity.THICKNESS]
    if abs(axes[1].direction @ UP) > abs(axes[2].direction @ UP):
        return [Quantity.LENGTH, Quantity.HEIGHT, Quantity.WIDTH]
    return names


def _side(body: Body, row: int, pieces: Pieces, axes: list[Axis], middle: Floats) -> Side | Reason:
    """Fit a face of a body by its pieces; the reason where too little of it was seen.

    Places are relative to the body's middle, in halves of the body's size along the axes of the face.
    """
    if len(pieces.value) < LEAST_FOUND:
        return reason("inspect.face-not-seen")
    x, y = _places(body.faces[row].normal, pieces.places - middle, axes)
    terms = _terms(x, y)
    for count in (5, 4, 3):
        bowed = count < 5 or len(np.unique(np.round(BOWED * x))) >= BOWED
        fitted = flat_faces.fit(terms[:, :count], pieces, x, y) if bowed else None
        if fitted is not None:
            return Side(pieces, x, y, fitted)
    return reason("inspect.face-not-seen")


def _places(normal: Floats, off: Floats, axes: list[Axis]) -> list[Floats]:
    """Return places (n,) along and across a face, of places (n, 3) from the middle of its body."""
    own = [axis for axis in axes if abs(axis.direction @ normal) < SQUARE]
    return [off @ own[k].direction / (0.5 * own[k].size) if k < len(own) else np.zeros(len(off)) for k in range(2)]


def _terms(x: Floats, y: Floats) -> Floats:
    """Return the terms (n, 5) of a face's shape."""
    return np.stack([np.ones_like(x), x, y, x * y, x**2 - 1.0 / 3.0], axis=1)


def _with_narrow(body: Body, wide: Sides, axes: list[Axis], middle: Floats, around: Surroundings) -> Sides:
    """Return the sides of a body, those without pieces measured by the points on them."""

    def shift(places: Floats) -> Floats:
        """Return how far the body has moved at places (n, 3), by the sides that are known, along each of its axes."""
        moved = np.zeros_like(places)
        for axis in axes:
            known = [(side, sense) for row, sense in zip(axis.faces, (-1.0, 1.0), strict=True)
                     if isinstance(side := wide[row], Side)]  # fmt: skip
            if known:
                x, y = _places(axis.direction, places - middle, axes)
                terms = _terms(np.clip(x, -1.0, 1.0), np.clip(y, -1.0, 1.0))
                off = [sense * terms[:, : len(side.fit.mean)] @ side.fit.mean for side, sense in known]
                moved += np.outer(np.mean(off, axis=0), axis.direction)
        return moved

    broad = [body.faces[row] for row, side in wide.items() if isinstance(side, Side)]
    return {
        row: side if isinstance(side, Side) else _narrow_side(body.faces[row], broad, axes, middle, around, shift)
        for row, side in wide.items()
    }


def _narrow_side(
    face: FlatFace,
    broad: list[FlatFace],
    axes: list[Axis],
    middle: Floats,
    around: Surroundings,
    shift: narrow_faces.Shift,
) -> Side | Reason:
    """Fit a face without pieces by the points on it: its level, and its slope along it if it was seen along half of it.

    If it was not, the slope that it may have is an error of the level. Without enough points its level is where those
    of the ``broad`` faces end.
    """

    def across_axis(places: Floats) -> Floats:
        off = shift(places)
        flat: Floats = off - np.outer(off @ face.normal, face.normal)
        return flat

    found = narrow_faces.pieces(around, face, across_axis)
    if isinstance(found, Reason):
        shape = narrow_faces.outline(face)
        level = (
            None if found.code == "inspect.face-touches" else edge_counts.level(around, face, shape, broad, across_axis)
        )
        return found if level is None else _of_level(level)
    pieces, overhang, tilt = found
    x, y = _places(face.normal, pieces.places - middle, axes)
    terms = _terms(x, y)
    counts = [3] if np.std(y) > STRIPS and np.ptp(x) > 1.0 else []
    counts += [2] if np.ptp(x) > 1.0 else []
    for count in (*counts, 1):
        fitted = flat_faces.fit(terms[:, :count], pieces, x, y)
        if fitted is not None:
            own = [axis for axis in axes if abs(axis.direction @ face.normal) < SQUARE]
            arms = [0.5 * own[0].size * float(x.mean())] if count == 1 and own else []
            fitted.covariance[0, 0] += sum((SLOPE_SD * arm) ** 2 for arm in arms) + overhang**2
            for k in range(1, count):  # the halves of a face may be hit by beams of different stations
                fitted.covariance[k, k] += (0.5 * overhang) ** 2
            if count > 1 and own:
                fitted.covariance[1, 1] += (0.5 * own[0].size * tilt) ** 2
            return Side(pieces, x, y, fitted, narrow=True)
    return reason("inspect.face-few-points", points=len(pieces.value))


def _of_level(level: edge_counts.Level) -> Side:
    """Return a side of which the level alone is known."""
    none = np.empty(0)
    fit = Fit(np.array([level.value]), np.array([[level.variance]]))
    return Side(Pieces(np.empty((0, 3)), none, none, 0.0), none, none, fit, narrow=True)


def _best(sides: Sequence[tuple[Side | Reason, float]]) -> list[tuple[Side, float]]:
    """Return the sides that are known, with their senses; narrow ones where no other is."""
    known = [(side, sense) for side, sense in sides if isinstance(side, Side)]
    return [one for one in known if not one[0].narrow] or known


def _unseen(*sides: Side | Reason) -> list[Reason]:
    """Return why sides were not measured."""
    found: list[Reason] = []
    for side in sides:
        if isinstance(side, Reason) and side not in found:
            found.append(side)
    return found


def _term(side: Side, k: int) -> tuple[float, float]:
    """Coefficient of a fitted face and its variance; NaN where it was not fitted."""
    if k >= len(side.fit.mean):
        return float("nan"), float("nan")
    return float(side.fit.mean[k]), float(side.fit.covariance[k, k])


def _sizes(axes: list[Axis], names: list[Quantity], sides: Sides, temperature_C: float) -> Iterator[Measured]:
    """Yield the distances of opposite faces at the body's middle."""
    expansion = thermal.expansion(temperature_C)
    for axis, name in zip(axes, names, strict=True):
        pair = [sides[row] for row in axis.faces]
        if unseen := _unseen(*pair):
            yield characteristic.absent(str(name), name, axis.size, *unseen)
            continue
        (back, of_back), (front, of_front) = (_term(side, 0) for side in pair if isinstance(side, Side))
        deviation = (axis.size + back + front) / expansion - axis.size
        variance = of_back + of_front + scanner_class_errors.scale_variance(axis.size)
        yield characteristic.normal(str(name), name, axis.size, deviation, variance)


def _turn(axes: list[Axis], k: int, sides: Sides) -> tuple[float, float]:
    """Angle by which the body's longest axis leans towards axis ``k``, by the faces across that, and its variance."""
    half = 0.5 * axes[0].size
    found = []
    for side, sense in _best([(sides[row], sense) for row, sense in zip(axes[k].faces, (-1.0, 1.0), strict=True)]):
        slope, variance = _term(side, 1)
        if np.isfinite(slope):
            found.append((sense * slope / half, variance / half**2))
    if not found:
        return float("nan"), float("nan")
    value, variance = np.mean(found, axis=0)
    return float(value), float(variance) / len(found)


def _squareness(axes: list[Axis], names: list[Quantity], sides: Sides) -> Iterator[Measured]:
    """Yield the tilt of each end face against the long faces, times the size that it is tilted over."""
    for end, (row, sense) in enumerate(zip(axes[0].faces, (-1.0, 1.0), strict=True)):
        side = sides[row]
        for k in range(1, len(axes)):
            if names[k] is Quantity.THICKNESS:
                continue
            name = f"{('start', 'end')[end]}-squareness-over-{names[k]}"
            turn, of_turn = _turn(axes, k, sides)
            slope, variance = _term(side, k) if isinstance(side, Side) else (float("nan"), float("nan"))
            if not (np.isfinite(turn) and np.isfinite(slope)):  # the slope is over half the size
                unseen = _unseen(side, *(() if np.isfinite(turn) else (sides[row] for row in axes[k].faces)))
                yield characteristic.absent(name, Quantity.SQUARENESS, 0.0, *(unseen or _PART))
                continue
            tilt = 2.0 * slope + sense * turn * axes[k].size
            yield characteristic.normal(
                name, Quantity.SQUARENESS, 0.0, tilt, 4.0 * variance + of_turn * axes[k].size ** 2
            )


def _twist(axes: list[Axis], names: list[Quantity], sides: Sides) -> Iterator[Measured]:
    """Yield the rotation of the end against the start about the body's axis, times its height.

    A rotation by w per unit of length moves a face at the side outward by w x times the place across it.
    """
    height = axes[names.index(Quantity.HEIGHT)].size if Quantity.HEIGHT in names else axes[1].size
    right_handed = float(np.sign(np.linalg.det(np.stack([axis.direction for axis in axes]))))
    found = []
    for k, other in ((1, 2), (2, 1)):
        for row, sense in zip(axes[k].faces, (-1.0, 1.0), strict=True):
            side = sides[row]
            if not isinstance(side, Side) or side.narrow or len(side.fit.mean) < 4:
                continue
            # About the first axis the second turns towards the third: points at the third move against the second.
            handed = right_handed * sense * (1.0 if k == 2 else -1.0)
            warp, variance = _term(side, 3)
            arm = 0.5 * axes[other].size
            found.append((2.0 * handed * warp / arm, 4.0 * variance / arm**2))
    if not found:
        yield characteristic.absent("twist", Quantity.TWIST, 0.0, *_PART)
        return
    value, variance = np.array(found).T
    weight = 1.0 / np.maximum(variance, 1e-18)
    mean, of_mean = float(weight @ value / weight.sum()), float(1.0 / weight.sum())
    yield characteristic.normal("twist", Quantity.TWIST, 0.0, height * mean, height**2 * of_mean)


def _bows(axes: list[Axis], sides: Sides) -> Iterator[Measured]:
    """Yield the greatest departures of the axis from straight along both other axes."""
    upright = 1 if abs(axes[1].direction @ UP) > abs(axes[2].direction @ UP) else 2
    for k in (1, 2):
        quantity = Quantity.CAMBER if k == upright else Quantity.SWEEP
        seen = [(sides[row], sense) for row, sense in zip(axes[k].faces, (-1.0, 1.0), strict=True)]
        curve = _axis_curve(_best(seen))
        if curve is None:
            yield characteristic.absent(str(quantity), quantity, 0.0, *(_unseen(*(side for side, _ in seen)) or _PART))
            continue
        yield characteristic.greatest(quantity, *curve)


def _axis_curve(sides: list[tuple[Side, float]]) -> tuple[Floats, Floats] | None:
    """Departures (p,) of the axis from the chord between its ends at PLACES, and their covariance.

    Along each face a Legendre polynomial is fitted together with its slope across and its warp. None where no face
    has enough pieces along it for a curve.
    """
    values, covariances = [], []
    for side, sense in sides:
        columns = len(np.unique(np.round(side.along * COLUMNS)))
        degree = next((degree for degree, least in DEGREES if columns >= least), 0)
        if not degree:
            continue
        terms = [legvander(side.along, degree), side.across[:, None], (side.along * side.across)[:, None]]
        fitted = flat_faces.fit(np.hstack(terms), side.pieces, side.along, side.across)
        if fitted is not None:
            curve = legvander(PLACES, degree)
            values.append(sense * curve @ fitted.mean[: degree + 1])
            covariances.append(curve @ fitted.covariance[: degree + 1, : degree + 1] @ curve.T)
    if not values:
        return None
    off = off_the_chord(PLACES)
    return off @ np.mean(values, axis=0), off @ np.sum(covariances, axis=0) @ off.T / len(values) ** 2


def _flatness(axes: list[Axis], names: list[Quantity], sides: Sides) -> Iterator[Measured]:
    """Yield the flatness of the outermost faces."""
    for axis, name in zip(axes, names, strict=True):
        for row, sign in zip(axis.faces, "-+", strict=True):
            side = sides[row]
            if not isinstance(side, Side) or side.narrow or len(side.pieces.value) < face_flatness.FEWEST_PIECES:
                continue
            yield face_flatness.peak_to_valley(f"flatness-{name}{sign}", side.pieces, side.along, side.across)
