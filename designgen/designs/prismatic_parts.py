"""Prismatic parts: straight branches of one section each, with open ends at joints, as patches in closed form.

A part as built is the design with the points near each of its ends displaced: see :class:`EndErrors`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from designgen.designs.bolt_holes import Bore
from designgen.designs.parametric_face import Patch
from designgen.designs.sections import Section
from processor.model import Bools, Floats, Ints

NET_MM = 250.0  # work: of the net that rays meet before the plane itself, which is exact for any step
PAD_SIZE_MM, PAD_HEIGHT_MM = 200.0, 20.0  # of the mark that tells a part's ends and attitudes apart
JOINED_MM = 1e-6  # vertices this near to each other are one
FADES_MM = 1500.0  # from an end, over which its errors fade out


@dataclass(frozen=True)
class EndErrors:
    """Errors of an end: its plane by length (mm) and skews (rad) about z and y, and corners P1..P4 (4, 3), mm.

    All are in the axes of the joint, whose x points out of the left part.
    """

    plane: Floats
    corners: Floats


@dataclass(frozen=True)
class End:
    """An end of a part at a joint: T_bridge_joint (4, 4), with x from the left to the right part; ``outward`` along x.

    ``errors`` are None as designed.
    """

    joint: str
    T: Floats
    outward: float
    section: Section
    reach: float
    errors: EndErrors | None = None

    def key_points(self) -> Floats:
        """P1..P8 (8, 3) as designed, also those that are not on steel."""
        b, h = 0.5 * self.section.width, 0.5 * self.section.height
        yz = np.array([[b, -h], [-b, -h], [-b, h], [b, h], [0.0, -h], [-b, 0.0], [0.0, h], [b, 0.0]])
        return np.asarray(np.column_stack([np.zeros(8), yz]) @ self.T[:3, :3].T + self.T[:3, 3])

    def displacement(self, points: Floats) -> Floats:
        """Displacements (n, 3) of points (n, 3) by the errors of this end."""
        if self.errors is None:
            return np.zeros_like(points)
        R = self.T[:3, :3]
        x, y, z = ((points - self.T[:3, 3]) @ R).T
        length, about_z, about_y = self.errors.plane
        a, c = 0.5 + y / self.section.width, 0.5 + z / self.section.height
        shares = np.stack([a * (1.0 - c), (1.0 - a) * (1.0 - c), (1.0 - a) * c, a * c], axis=1)
        local = shares @ self.errors.corners
        local[:, 0] += length + about_z * y + about_y * z
        near = np.clip(-self.outward * x / self.reach, 0.0, 1.0)
        fading = (1.0 - near) ** 2 * (1.0 + 2.0 * near)
        return np.asarray((fading[:, None] * local) @ R.T)


@dataclass(frozen=True)
class Girder:
    """A girder along x of T (4, 4), with the mark on its top at x ``mark`` (mm) and its bolt holes."""

    T: Floats
    length: float
    section: Section
    mark: float
    bores: tuple[Bore, ...] = ()


@dataclass(frozen=True)
class Node:
    """A node with its middle at T: stubs of ``stub`` mm along x to both sides, one of ``upright`` mm along z.

    The mark is on its top at x ``mark`` (mm).
    """

    T: Floats
    stub: float
    upright: float
    section: Section
    mark: float


@dataclass(frozen=True)
class Part:
    """A part: its faces, its ends, and what it is made of."""

    name: str
    patches: tuple[Patch, ...]
    ends: tuple[End, ...]
    made_of: Girder | Node

    @property
    def girder(self) -> Girder | None:
        """What the part is made of if it is a girder."""
        return self.made_of if isinstance(self.made_of, Girder) else None

    def displacement(self, points: Floats) -> Floats:
        """Displacements (n, 3) of points (n, 3) of the design, as built."""
        result: Floats = np.sum([end.displacement(points) for end in self.ends], axis=0)
        return result

    def built(self) -> list[Patch]:
        """Return the faces as built."""
        return [patch.displaced(self.displacement) for patch in self.patches]

    def with_errors(self, errors: Sequence[EndErrors]) -> Part:
        """Return the part with errors of its ends."""
        ends = (dataclasses.replace(end, errors=of_end) for end, of_end in zip(self.ends, errors, strict=True))
        return dataclasses.replace(self, ends=tuple(ends))

    def mesh(self) -> tuple[Floats, Ints]:
        """Vertices (v, 3) and triangles (f, 3) of the design, equal vertices joined."""
        vertices, faces, count = [], [], 0
        for patch in self.patches:
            knots, triangles = patch.net()
            vertices.append(patch.at(knots[:, 0], knots[:, 1]))
            faces.append(triangles + count)
            count += len(knots)
        every = np.vstack(vertices)
        _, first, number = np.unique(np.round(every / JOINED_MM), axis=0, return_index=True, return_inverse=True)
        return every[first], number.reshape(-1)[np.vstack(faces)]


def walls(
    T: Floats, x0: float, x1: float, outline: Floats, name: str = "wall", skip: Sequence[int] = ()
) -> list[Patch]:
    """Return walls of a prism along x of T (4, 4) from x0 to x1 over edges of an outline (n, 2), without ``skip``.

    q runs from the end of an edge to its start, because the material lies to the left of an outline.
    """
    p = np.linspace(0.0, 1.0, max(2, int(np.ceil((x1 - x0) / NET_MM)) + 1))
    q, along = np.array([0.0, 1.0]), np.array([x1 - x0, 0.0, 0.0])
    return [
        _plane(f"{name}-{edge}", T, np.array([x0, *b]), along, np.array([0.0, *(a - b)]), p, q)
        for edge, (a, b) in enumerate(zip(outline, np.roll(outline, -1, axis=0), strict=True))
        if edge not in skip
    ]


def marked(T: Floats, x0: float, x1: float, edge: tuple[Floats, Floats], at: float) -> list[Patch]:
    """Return a wall over an edge at the top of a section, with a pad on its left half at x ``at``."""
    b, a = edge  # as in walls
    half = 0.5 * np.array([-PAD_SIZE_MM, PAD_SIZE_MM])
    middle = np.array([at, b[0] + 0.25 * (a[0] - b[0]), b[1]])
    of_pad = ((at + half - x0) / (x1 - x0), np.sort((middle[1] + half - a[0]) / (b[0] - a[0])))
    along = np.linspace(0.0, 1.0, max(2, int(np.ceil((x1 - x0) / NET_MM)) + 1))
    p, under_p = _knots_about(along, *of_pad[0])
    q, under_q = _knots_about(np.array([0.0, 1.0]), *of_pad[1])
    origin, of_p, of_q = np.array([x0, *a]), np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, *(b - a)])
    wall = _plane("top", T, origin, of_p, of_q, p, q, ~np.outer(under_p, under_q))
    return [wall, *_pad(T, middle)]


def _knots_about(knots: Floats, low: float, high: float) -> tuple[Floats, Bools]:
    """Return knots with none inside of low to high but these two, and which intervals between knots lie inside."""
    knots = np.unique([*knots[(knots < low) | (knots > high)], low, high])
    middle = 0.5 * (knots[1:] + knots[:-1])
    return knots, (middle > low) & (middle < high)


def end_face(T: Floats, x: float, section: Section, name: str) -> list[Patch]:
    """Rectangles of the end face of a prism at ``x``, facing outward: back at its "start", else forwards."""
    ends = np.array([0.0, 1.0])
    faces = []
    for y0, y1, z0, z1 in section.plates:
        first, last = (y1, y0) if name == "start" else (y0, y1)
        across, up = np.array([0.0, last - first, 0.0]), np.array([0.0, 0.0, z1 - z0])
        faces.append(_plane(name, T, np.array([x, first, z0]), across, up, ends, ends))
    return faces


def _plane(
    name: str,
    T: Floats,
    origin: Floats,
    along: Floats,
    across: Floats,
    p: Floats,
    q: Floats,
    present: Bools | None = None,
) -> Patch:
    def at(s: Floats, t: Floats) -> Floats:
        points = origin + s[:, None] * along + t[:, None] * across
        return np.asarray(points @ T[:3, :3].T + T[:3, 3])

    return Patch(name, at, p, q, present)


def _pad(T: Floats, middle: Floats) -> list[Patch]:
    """Faces of a pad on the top at ``middle`` (3,)."""
    half, up = 0.5 * PAD_SIZE_MM, np.array([0.0, 0.0, PAD_HEIGHT_MM])
    corner = middle + half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    ends = np.array([0.0, 1.0])
    faces = [_plane("pad", T, corner[0] + up, corner[1] - corner[0], corner[3] - corner[0], ends, ends)]
    for a, b in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        faces.append(_plane("pad-side", T, a, b - a, up, ends, ends))
    return faces
