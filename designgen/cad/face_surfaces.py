"""The surfaces of a CAD body's faces as functions of two parameters, evaluated without the CAD kernel.

A face has a form: a kind of surface and its numbers, as they come from the kernel in :mod:`designgen.cad.brep_faces`.
Parameters are those of the kernel, so that the parameters of a mesh's vertices belong to the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from processor.model import Floats, Ints

PLANE, CYLINDER, CONE, SPHERE, TORUS = "plane", "cylinder", "cone", "sphere", "torus"
SPLINE, EXTRUSION, REVOLUTION, FACETS = "spline", "extrusion", "revolution", "facets"
LINE, ELLIPSE, CURVE = 0.0, 1.0, 2.0  # basis curves of extrusions and revolutions

Surface = Callable[[Floats, Floats], Floats]  # parameters u, v (n,) -> points (n, 3)
Curve = Callable[[Floats], Floats]  # parameters (n,) -> points (n, 3)


class Form(NamedTuple):
    """The surface of a face: its name, kind and numbers; see the functions below for their order. Lengths in mm."""

    name: str
    kind: str
    numbers: Floats


@dataclass(frozen=True)
class Forms:
    """The forms of a body's faces, the row of the form (f,) of each triangle, and its corners' parameters (f, 3, 2)."""

    forms: tuple[Form, ...]
    of_triangle: Ints
    corner_uv: Floats


def surface_of(form: Form) -> Surface | None:
    """Return the surface of a form, u, v (n,) -> points (n, 3), mm; None for facets, which have no other surface.

    Raises ValueError for a kind or numbers that do not describe a surface.
    """
    if form.kind == FACETS:
        return None
    makers = {PLANE: _plane, SPLINE: _spline_surface, EXTRUSION: _extrusion, REVOLUTION: _revolution}
    maker = makers.get(form.kind, _of_revolved_circle_or_line)
    return maker(form)


def _frame(numbers: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return origin, x, y and z (3,) of a surface's frame, which may be left-handed."""
    return numbers[0:3], numbers[3:6], numbers[6:9], numbers[9:12]


def _plane(form: Form) -> Surface:
    """Origin, x, y, z."""
    origin, x, y, _ = _frame(form.numbers)

    def at(u: Floats, v: Floats) -> Floats:
        points: Floats = origin + np.outer(u, x) + np.outer(v, y)
        return points

    return at


def _of_revolved_circle_or_line(form: Form) -> Surface:
    """Origin, x, y, z, then: cylinder radius; cone radius, half angle; sphere radius; torus its two radii."""
    origin, x, y, z = _frame(form.numbers)
    a, b = (*form.numbers[12:], 0.0)[:2]
    meridians: dict[str, Callable[[Floats], tuple[Floats, Floats]]] = {
        CYLINDER: lambda v: (np.full_like(v, a), v),
        CONE: lambda v: (a + v * np.sin(b), v * np.cos(b)),
        SPHERE: lambda v: (a * np.cos(v), a * np.sin(v)),
        TORUS: lambda v: (a + b * np.cos(v), b * np.sin(v)),
    }
    if form.kind not in meridians:
        raise ValueError(f"no surface of kind {form.kind}")
    meridian = meridians[form.kind]

    def at(u: Floats, v: Floats) -> Floats:
        radius, height = meridian(v)
        points: Floats = (
            origin + (radius * np.cos(u))[:, None] * x + (radius * np.sin(u))[:, None] * y + height[:, None] * z
        )
        return points

    return at


def _spline_surface(form: Form) -> Surface:
    """Degrees (2), numbers of knots (2), knots in u, in v, then poles times weights and weights, 4 each, v fastest."""
    degrees, counts = form.numbers[:2].astype(int), form.numbers[2:4].astype(int)
    knots_u = form.numbers[4 : 4 + counts[0]]
    knots_v = form.numbers[4 + counts[0] : 4 + counts.sum()]
    poles = form.numbers[4 + counts.sum() :].reshape(counts[0] - degrees[0] - 1, counts[1] - degrees[1] - 1, 4)

    def at(u: Floats, v: Floats) -> Floats:
        # Beyond its knots a spline goes on as its last polynomial, as in the kernel.
        rows, weights_u = _basis(knots_u, degrees[0], u)
        columns, weights_v = _basis(knots_v, degrees[1], v)
        near = poles[rows[:, :, None], columns[:, None, :]]
        sums = np.einsum("ni,nj,nijk->nk", weights_u, weights_v, near)
        points: Floats = sums[:, :3] / sums[:, 3:]
        return points

    return at


def _basis(knots: Floats, degree: int, x: Floats) -> tuple[Ints, Floats]:
    """Return the rows (n, degree + 1) of the B-splines that do not vanish at x (n,), and their values there.

    The recursion of Cox and de Boor, for all points at once.
    """
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, len(knots) - degree - 2)
    values = np.zeros((len(x), degree + 1))
    values[:, 0] = 1.0
    for d in range(1, degree + 1):
        carried = np.zeros(len(x))
        for r in range(d):
            right, left = knots[span + r + 1], knots[span + r + 1 - d]
            share = values[:, r] / np.where(right > left, right - left, 1.0)
            values[:, r] = carried + (right - x) * share
            carried = (x - left) * share
        values[:, d] = carried
    return span[:, None] - degree + np.arange(degree + 1), values


def _curve(numbers: Floats) -> Curve:
    """Kind, then: line origin, direction; ellipse origin, x, y, both times their radii; spline degree, knots, poles."""
    kind, rest = numbers[0], numbers[1:]
    if kind == LINE:
        return lambda t: rest[0:3] + np.outer(t, rest[3:6])
    if kind == ELLIPSE:
        return lambda t: rest[0:3] + np.outer(np.cos(t), rest[3:6]) + np.outer(np.sin(t), rest[6:9])
    if kind != CURVE:
        raise ValueError(f"no curve of kind {kind:g}")
    from scipy.interpolate import BSpline  # loaded in a third of a second, which most files spare

    degree, count = int(rest[0]), int(rest[1])
    spline = BSpline(rest[2 : 2 + count], rest[2 + count :].reshape(-1, 4), degree, extrapolate=True)

    def at(t: Floats) -> Floats:
        weighted = spline(t)
        points: Floats = weighted[:, :3] / weighted[:, 3:]
        return points

    return at


def _extrusion(form: Form) -> Surface:
    """Direction (3), then the curve."""
    direction, curve = form.numbers[0:3], _curve(form.numbers[3:])
    return lambda u, v: curve(u) + np.outer(v, direction)


def _revolution(form: Form) -> Surface:
    """Origin and direction of the axis (3 each), then the curve; u is the angle."""
    origin, axis, curve = form.numbers[0:3], form.numbers[3:6], _curve(form.numbers[6:])

    def at(u: Floats, v: Floats) -> Floats:
        arm = curve(v) - origin
        along = np.outer(arm @ axis, axis)
        radial = arm - along
        points: Floats = origin + along + np.cos(u)[:, None] * radial + np.sin(u)[:, None] * np.cross(axis, radial)
        return points

    return at
