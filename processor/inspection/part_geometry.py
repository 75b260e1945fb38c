"""The characteristics of a part of an arch bridge as functions of its ends' key points and of its bottom edges.

They depend on the shape of the part alone, and not on its pose. The nominal value is the same function of the design.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from processor.inspection.result import Quantity
from processor.model import ENDS, Floats

STEP_MM = 0.01  # of the numerical derivatives; the functions are smooth over the size of a part
# Sides and diagonals of a section by rows of P1..P4: bottom left, bottom right, top right, top left.
SIDES = (
    ("width-bottom", Quantity.WIDTH, 0, 1),
    ("width-top", Quantity.WIDTH, 3, 2),
    ("height-left", Quantity.HEIGHT, 0, 3),
    ("height-right", Quantity.HEIGHT, 1, 2),
    ("diagonal-P1-P3", Quantity.DIAGONAL, 0, 2),
    ("diagonal-P2-P4", Quantity.DIAGONAL, 1, 3),
)


class Value(NamedTuple):
    """A characteristic's id and quantity, and its function (...) of the ends (..., 2, 8, 3)."""

    id: str
    quantity: Quantity
    of: Callable[[Floats], Floats]


def of_end(end: int) -> Iterator[Value]:
    """Yield the characteristics of one end section, 0 the start and 1 the end."""
    name = ENDS[end]
    for side, quantity, a, b in SIDES:
        yield Value(f"{name}-{side}", quantity, partial(_between, (end, a), (end, b)))
    first, second = (partial(_between, (end, k), (end, k + 2)) for k in range(2))
    yield Value(f"{name}-diagonal-difference", Quantity.DIAGONAL_DIFFERENCE, lambda ends: first(ends) - second(ends))


def of_both_ends(design: Floats) -> Iterator[Value]:
    """Yield the characteristics that both ends determine together, of a part with ends (2, 8, 3) as designed.

    Twist is the rotation of the end section against the start section about the part's axis, times the section's
    height. Squareness is the tilt of an end face against the chord between the middles of both sections: about the
    section's upright axis times its width, and about its level axis times its height.
    """
    yield Value("length", Quantity.LENGTH, lambda ends: np.linalg.norm(_chord(ends), axis=-1))
    for corner in range(4):
        yield Value(f"length-P{corner + 1}", Quantity.LENGTH, partial(_between, (0, corner), (1, corner)))
    width, height = section_sizes(design)
    relative = _section(design, 1).T @ _section(design, 0)

    def twist(ends: Floats) -> Floats:
        off = np.swapaxes(_section(ends, 0), -1, -2) @ _section(ends, 1) @ relative
        turn: Floats = 0.5 * (off[..., 2, 1] - off[..., 1, 2])  # of a small angle
        return height * turn

    yield Value("twist", Quantity.TWIST, twist)
    for end, name in enumerate(ENDS):
        for side, axis, size in (("width", 1, width), ("height", 2, height)):
            tilt = partial(_tilt, end, axis, size, float(_chord_in_section(design, end)[axis]))
            yield Value(f"{name}-squareness-over-{side}", Quantity.SQUARENESS, tilt)


def deviations(design: Floats, ends: Floats) -> dict[str, float]:
    """Return the deviations of ends (2, 8, 3) from the design's, by the id of the characteristic; unknown ends NaN."""
    known = np.isfinite(ends).all(axis=(1, 2)) & np.isfinite(design).all(axis=(1, 2))
    values = chain.from_iterable(of_end(end) for end in np.flatnonzero(known).tolist())
    both = of_both_ends(design) if known.all() else ()
    return {value.id: float(value.of(ends) - value.of(design)) for value in (*values, *both)}


def section_sizes(ends: Floats) -> tuple[float, float]:
    """Mean width and height of the end sections that are known, of ends (2, 8, 3)."""
    known = ends[np.isfinite(ends).all(axis=(1, 2))]
    across, up = known[:, [0, 3]] - known[:, [1, 2]], known[:, [3, 2]] - known[:, [0, 1]]
    return float(np.linalg.norm(across, axis=2).mean()), float(np.linalg.norm(up, axis=2).mean())


def derivatives(values: Sequence[Value], ends: Floats) -> Floats:
    """Return derivatives (m, 48) of functions by the ends' coordinates, by central differences."""
    steps = STEP_MM * np.eye(ends.size).reshape(-1, *ends.shape)
    return np.stack([(value.of(ends + steps) - value.of(ends - steps)) / (2.0 * STEP_MM) for value in values])


def off_the_chord(chainage: Floats) -> Floats:
    """Matrix (m, m) that takes the straight line between the first and the last of values at chainages (m,) off."""
    share = (chainage - chainage[0]) / (chainage[-1] - chainage[0])
    off = np.eye(len(chainage))
    off[:, 0] -= 1.0 - share
    off[:, -1] -= share
    return off


def axis_of_shape(left: Floats, right: Floats) -> Floats:
    """Matrix (2, k, 4 k) from departures of two edges to those of the axis between them that are the part's own.

    ``left``, ``right`` (k, 3) are points of both edges as designed, from start to end. Columns are the departures of
    the left and of the right edge sideways, then of both up; the result is sideways and up. A motion of the part is
    taken off: then the axis departs nowhere at its first and last point, and the edges' departures up show no roll
    about the chord on the mean. A straight part that rolls keeps its axis, the middle of a curved one goes aside.
    """
    axis, width = 0.5 * (left + right), np.linalg.norm(left - right, axis=1)
    count, chord = len(axis), _unit(axis[-1] - axis[0])
    sideways = (left - right) / width[:, None]
    up = _unit(np.cross(np.gradient(axis, axis=0, edge_order=2), sideways))
    sideways_of_chord = _unit(np.cross(np.cross(chord, sideways.mean(axis=0)), chord))
    ways = np.stack([chord, sideways_of_chord, np.cross(chord, sideways_of_chord)])
    moved = [np.broadcast_to(way, (2, count, 3)) for way in ways[1:]]
    moved += [np.cross(way, np.stack([left, right]) - axis[0]) for way in ways]
    by_motion = np.stack(
        [np.einsum("ski,aki->ask", d, np.stack([sideways, up])).ravel() for d in moved], axis=1
    )  # (4 k, 5)
    half = 0.5 * np.eye(count)
    mean = np.kron(np.eye(2), np.hstack([half, half]))  # (2 k, 4 k)
    roll = np.concatenate([np.zeros(2 * count), 1.0 / width, -1.0 / width]) / count
    fixed = np.vstack([mean[[0, count - 1, count, 2 * count - 1]], roll])
    own = np.eye(4 * count) - by_motion @ np.linalg.solve(fixed @ by_motion, fixed)
    result: Floats = (mean @ own).reshape(2, count, 4 * count)
    return result


def _between(a: tuple[int, int], b: tuple[int, int], ends: Floats) -> Floats:
    """Distance (...) of two key points of the ends (..., 2, 8, 3)."""
    distance: Floats = np.linalg.norm(ends[..., b[0], b[1], :] - ends[..., a[0], a[1], :], axis=-1)
    return distance


def _chord(ends: Floats) -> Floats:
    """Vector (..., 3) from the middle of the start section to that of the end section."""
    middle = ends[..., :4, :].mean(axis=-2)
    chord: Floats = middle[..., 1, :] - middle[..., 0, :]
    return chord


def _tilt(end: int, axis: int, size: float, as_designed: float, ends: Floats) -> Floats:
    """Tilt (...) of an end face against the chord beyond that designed, times a size of the section."""
    return size * (_chord_in_section(ends, end)[..., axis] - as_designed)


def _section(ends: Floats, end: int) -> Floats:
    """Axes (..., 3, 3) of an end's section by its corners: columns along the part, to the left, up.

    Left and up have equal shares in them, as a section may be a parallelogram.
    """
    p1, p2, p3, p4 = np.moveaxis(ends[..., end, :4, :], -2, 0)
    y, z = _unit((p1 - p2) + (p4 - p3)), _unit((p4 - p1) + (p3 - p2))
    x, between = _unit(np.cross(y, z)), _unit(y + z)
    beside = np.cross(x, between)
    return np.stack([x, np.sqrt(0.5) * (between - beside), np.sqrt(0.5) * (between + beside)], axis=-1)


def _chord_in_section(ends: Floats, end: int) -> Floats:
    """Return the unit chord (..., 3) between the middles of both sections, in the axes of one of them."""
    chord: Floats = np.einsum("...i,...ij->...j", _unit(_chord(ends)), _section(ends, end))
    return chord


def _unit(vectors: Floats) -> Floats:
    unit: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit
