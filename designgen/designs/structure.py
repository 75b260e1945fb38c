"""What whole structures are built of: boxes and tubes as patches in closed form, and as CadQuery solids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from designgen.scanning.surfaces import Bools, Patch
from processor.model import Floats

if TYPE_CHECKING:
    import cadquery as cq

CONTACT_MM = 1e-7  # what lies no deeper in a body is on its surface


@dataclass(frozen=True)
class Box:
    """A box: centre (3,), unit axes (3, 3, rows) and edge lengths (3,), mm."""

    centre: Floats
    axes: Floats
    size: Floats

    def patches(self, knots: tuple[Floats, Floats, Floats] | None = None) -> list[Patch]:
        """Six faces, their nets outward; ``knots`` are those along each axis, 0..1."""
        along = knots or tuple(np.array([0.0, 1.0]) for _ in range(3))
        hand = np.sign(np.linalg.det(self.axes))
        found = []
        for axis in range(3):
            for sign, side in ((-1.0, "-"), (1.0, "+")):
                # p along i and q along j, so that i x j points out.
                i, j = (axis + 1) % 3, (axis + 2) % 3
                if sign * hand < 0.0:
                    i, j = j, i
                corner = self.centre + 0.5 * sign * self.size[axis] * self.axes[axis]
                found.append(Patch(f"{side}{'abn'[axis]}", self._face(corner, i, j), along[i], along[j]))
        return found

    def _face(self, middle: Floats, i: int, j: int) -> Callable[[Floats, Floats], Floats]:
        one, two = self.size[i] * self.axes[i], self.size[j] * self.axes[j]

        def at(p: Floats, q: Floats) -> Floats:
            points: Floats = middle + np.outer(p - 0.5, one) + np.outer(q - 0.5, two)
            return points

        return at

    def solid(self) -> cq.Solid:
        """CadQuery solid."""
        import cadquery as cq

        low = self.centre - 0.5 * self.size @ self.axes
        plane = cq.Plane(origin=tuple(low), xDir=tuple(self.axes[0]), normal=tuple(self.axes[2]))
        return cq.Solid.makeBox(*self.size.tolist()).moved(cq.Location(plane))

    @property
    def volume(self) -> float:
        """Volume, mm3."""
        return float(np.prod(self.size))

    def depth(self, points: Floats) -> Floats:
        """Return how far inside (n,) points (n, 3) lie, mm; negative outside."""
        found: Floats = (0.5 * self.size - np.abs((points - self.centre) @ self.axes.T)).min(axis=1)
        return found

    def bounds(self) -> tuple[Floats, Floats]:
        """Return the lowest and highest coordinates (3,)."""
        reach = 0.5 * self.size @ np.abs(self.axes)
        return self.centre - reach, self.centre + reach


@dataclass(frozen=True)
class Tube:
    """A closed round tube from ``start`` to ``end`` (3,), mm."""

    start: Floats
    end: Floats
    radius: float

    def patches(self, step_mm: float = 500.0, around: int = 48) -> list[Patch]:
        """Return the tube's mantle, its net outward; its ends lie inside of other tubes."""
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        unit = axis / length
        side = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
        side = side / np.linalg.norm(side)
        other = np.cross(side, unit)

        def at(p: Floats, q: Floats) -> Floats:
            turn = 2.0 * np.pi * q
            ring: Floats = np.outer(np.cos(turn), side) + np.outer(np.sin(turn), other)
            return self.start + np.outer(p, axis) + self.radius * ring

        return [
            Patch("tube", at, np.linspace(0.0, 1.0, int(np.ceil(length / step_mm)) + 1), np.linspace(0, 1, around + 1))
        ]

    def solid(self) -> cq.Solid:
        """CadQuery solid."""
        import cadquery as cq

        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        return cq.Solid.makeCylinder(self.radius, length, cq.Vector(*self.start), cq.Vector(*(axis / length)))

    @property
    def volume(self) -> float:
        """Volume, mm3."""
        return float(np.pi * self.radius**2 * np.linalg.norm(self.end - self.start))

    def depth(self, points: Floats) -> Floats:
        """Return how far inside (n,) points (n, 3) lie, mm; negative outside."""
        axis = self.end - self.start
        length = float(np.linalg.norm(axis))
        arm = points - self.start
        along = arm @ (axis / length)
        away = np.linalg.norm(arm - np.outer(along, axis / length), axis=1)
        found: Floats = np.minimum(self.radius - away, np.minimum(along, length - along))
        return found

    def bounds(self) -> tuple[Floats, Floats]:
        """Return the lowest and highest coordinates (3,)."""
        ends = np.stack([self.start, self.end])
        return ends.min(axis=0) - self.radius, ends.max(axis=0) + self.radius


@dataclass(frozen=True)
class Component:
    """A named component: its bodies, and their faces as designed."""

    name: str
    bodies: tuple[Box | Tube, ...]
    patches: tuple[Patch, ...]


def component(name: str, bodies: Sequence[Box | Tube]) -> Component:
    """Make a component of bodies with their plain faces; a body's faces are named by its number."""
    found = [
        Patch(f"{i} {patch.name}", patch.at, patch.p, patch.q, patch.kept)
        for i, body in enumerate(bodies)
        for patch in body.patches()
    ]
    return Component(name, tuple(bodies), tuple(found))


def covered(components: Sequence[Component]) -> Callable[[Floats], Bools]:
    """Return a function that says which of points (n, 3) lie inside of a body; those on its surface do not."""
    bodies = [body for one in components for body in one.bodies]
    low, high = (np.array(corner) for corner in zip(*(body.bounds() for body in bodies), strict=True))

    def inside(points: Floats) -> Bools:
        found = np.zeros(len(points), bool)
        if len(points):
            near = ((low < points.max(axis=0)) & (high > points.min(axis=0))).all(axis=1)
            for k in np.flatnonzero(near):
                found |= bodies[k].depth(points) > CONTACT_MM
        return found

    return inside


def mesh_of(components: Sequence[Component]) -> tuple[Floats, np.ndarray]:
    """Vertices (v, 3) and triangles (f, 3) of all faces, outward; exact if flat, on tubes inside by radius / 470."""
    vertices, faces, count = [], [], 0
    for one in components:
        for patch in one.patches:
            knots, triangles = patch.net()
            vertices.append(patch.at(knots[:, 0], knots[:, 1]))
            faces.append(triangles + count)
            count += len(knots)
    return np.vstack(vertices), np.vstack(faces)


def solid(components: Sequence[Component]) -> cq.Compound:
    """CadQuery compound of all bodies."""
    import cadquery as cq

    return cq.Compound.makeCompound([body.solid() for one in components for body in one.bodies])
