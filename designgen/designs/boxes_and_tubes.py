"""The bodies of whole structures, boxes and tubes: patches in closed form and CadQuery solids."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from designgen.designs.parametric_face import Patch, Surface
from designgen.rigid import perpendicular
from processor.model import Bools, Floats

if TYPE_CHECKING:
    import cadquery as cq

CONTACT_MM = 1e-7  # a point no deeper inside of a body is on its surface


@dataclass(frozen=True)
class Box:
    """A box: centre (3,), unit axes (3, 3, rows) and edge lengths (3,), mm."""

    centre: Floats
    axes: Floats
    size: Floats

    def patches(self, knots: tuple[Floats, Floats, Floats] | None = None) -> list[Patch]:
        """Return the six faces, their nets oriented outward; ``knots`` are those along each axis, 0..1."""
        along = knots or tuple(np.array([0.0, 1.0]) for _ in range(3))
        hand = np.sign(np.linalg.det(self.axes))
        faces = []
        for axis in range(3):
            for sign, side in ((-1.0, "-"), (1.0, "+")):
                # p runs along i and q along j, so that i x j points outward.
                i, j = (axis + 1) % 3, (axis + 2) % 3
                if sign * hand < 0.0:
                    i, j = j, i
                corner = self.centre + 0.5 * sign * self.size[axis] * self.axes[axis]
                faces.append(Patch(f"{side}{'abn'[axis]}", self._face(corner, i, j), along[i], along[j]))
        return faces

    def _face(self, middle: Floats, i: int, j: int) -> Surface:
        edge_i, edge_j = self.size[i] * self.axes[i], self.size[j] * self.axes[j]

        def at(p: Floats, q: Floats) -> Floats:
            points: Floats = middle + np.outer(p - 0.5, edge_i) + np.outer(q - 0.5, edge_j)
            return points

        return at

    def solid(self) -> cq.Solid:
        """Return the CadQuery solid."""
        import cadquery as cq

        low = self.centre - 0.5 * self.size @ self.axes
        plane = cq.Plane(origin=tuple(low), xDir=tuple(self.axes[0]), normal=tuple(self.axes[2]))
        return cq.Solid.makeBox(*self.size.tolist()).moved(cq.Location(plane))

    def depth(self, points: Floats) -> Floats:
        """Return the depth (n,) of points (n, 3) below the surface, mm; negative outside."""
        result: Floats = (0.5 * self.size - np.abs((points - self.centre) @ self.axes.T)).min(axis=1)
        return result

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

    @cached_property
    def axis(self) -> Floats:
        """Vector (3,) from start to end."""
        return self.end - self.start

    @cached_property
    def length(self) -> float:
        """Length of the axis, mm."""
        return float(np.linalg.norm(self.axis))

    @cached_property
    def unit(self) -> Floats:
        """Direction (3,) of the axis."""
        return self.axis / self.length

    def patches(self, step_mm: float = 500.0, around: int = 48) -> list[Patch]:
        """Return the lateral surface, its net oriented outward; the ends lie inside of other tubes."""
        side = perpendicular(self.unit)
        second_side = np.cross(side, self.unit)

        def at(p: Floats, q: Floats) -> Floats:
            angle = 2.0 * np.pi * q
            ring: Floats = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), second_side)
            return self.start + np.outer(p, self.axis) + self.radius * ring

        along = np.linspace(0.0, 1.0, int(np.ceil(self.length / step_mm)) + 1)
        return [Patch("tube", at, along, np.linspace(0, 1, around + 1))]

    def solid(self) -> cq.Solid:
        """Return the CadQuery solid."""
        import cadquery as cq

        return cq.Solid.makeCylinder(self.radius, self.length, cq.Vector(*self.start), cq.Vector(*self.unit))

    def depth(self, points: Floats) -> Floats:
        """Return the depth (n,) of points (n, 3) below the surface, mm; negative outside."""
        arm = points - self.start
        along = arm @ self.unit
        radial = np.linalg.norm(arm - np.outer(along, self.unit), axis=1)
        result: Floats = np.minimum(self.radius - radial, np.minimum(along, self.length - along))
        return result

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
    """Return the component of these bodies as designed; the names of a body's faces start with its number."""
    patches = [
        dataclasses.replace(patch, name=f"{i} {patch.name}")
        for i, body in enumerate(bodies)
        for patch in body.patches()
    ]
    return Component(name, tuple(bodies), tuple(patches))


def covered(components: Sequence[Component]) -> Callable[[Floats], Bools]:
    """Return a function that marks the points (n, 3) inside of a body; points on a surface are not inside."""
    bodies = [body for component in components for body in component.bodies]
    low, high = (np.array(corner) for corner in zip(*(body.bounds() for body in bodies), strict=True))

    def inside(points: Floats) -> Bools:
        result = np.zeros(len(points), bool)
        if len(points):
            near = ((low < points.max(axis=0)) & (high > points.min(axis=0))).all(axis=1)
            for k in np.flatnonzero(near):
                result |= bodies[k].depth(points) > CONTACT_MM
        return result

    return inside


def mesh_of(components: Sequence[Component]) -> tuple[Floats, np.ndarray]:
    """Return vertices (v, 3), mm, and outward triangles (f, 3) of all faces; on tubes up to radius / 470 too far in."""
    vertices, faces, count = [], [], 0
    for component in components:
        for patch in component.patches:
            knots, triangles = patch.net()
            vertices.append(patch.at(knots[:, 0], knots[:, 1]))
            faces.append(triangles + count)
            count += len(knots)
    return np.vstack(vertices), np.vstack(faces)


def solid(components: Sequence[Component]) -> cq.Compound:
    """Return the CadQuery compound of all bodies."""
    import cadquery as cq

    return cq.Compound.makeCompound([body.solid() for component in components for body in component.bodies])
