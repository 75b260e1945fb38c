"""Bolt holes near the ends of I girders: their pattern, and faces with round holes as patches in closed form.

A hole is a bore square to a plate. The face around it is a square with the circle cut out, mapped ray by ray, so that
points lie in the plane of the face and on the cylinder of the bore exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from designgen.checks import expect
from designgen.designs.parametric_face import Patch
from designgen.designs.sections import Section
from processor.model import Bools, Floats

AROUND = 64  # knots of the net around a hole; a multiple of 8, so that the corners of the square are among them
SQUARE = 1.4  # half the side of the square around a hole, in radii
ON_MM = 1e-6  # rounding: holes are placed on the edge of a face by the same numbers


@dataclass(frozen=True)
class Params:
    """Bolts of each end of a girder at a joint, sizes in mm: two rows in each half flange, two in the web.

    ``flange_bolts`` and ``web_bolts`` are those of a row, along the girder in flanges and upright in the web. ``edge``
    is the distance of the first from the end of the girder, ``pitch`` that of neighbours.
    """

    flange_bolts: int = 1
    web_bolts: int = 4
    hole_mm: float = 24.0
    pitch_mm: float = 75.0
    edge_mm: float = 45.0

    def __post_init__(self) -> None:
        expect(0 <= self.flange_bolts <= 20, "bolts.flange_bolts", self.flange_bolts, "0 to 20")
        expect(0 <= self.web_bolts <= 40, "bolts.web_bolts", self.web_bolts, "0 to 40")
        least = 2.0 * SQUARE * 0.5 * self.hole_mm
        expect(self.hole_mm > 0.0, "bolts.hole_mm", self.hole_mm, "above 0")
        expect(self.pitch_mm > least, "bolts.pitch_mm", self.pitch_mm, f"above {least:g}, for holes of this size")
        expect(self.edge_mm > 0.5 * least, "bolts.edge_mm", self.edge_mm, f"above {0.5 * least:g}")


@dataclass(frozen=True)
class Bore:
    """A hole of a girder: ``x`` along it, from ``start`` to ``end`` (2,), y and z of its section, and its radius; mm.

    ``shift`` (3,) is by how much the hole as drilled lies off its place, across the bore.
    """

    x: float
    start: Floats
    end: Floats
    radius: float
    shift: Floats

    @property
    def middle(self) -> Floats:
        """Middle (3,) of the bore as designed, in the girder's axes."""
        return np.array([self.x, *(0.5 * (self.start + self.end))])


def of_girder(params: Params, section: Section, length: float, ends: Sequence[bool]) -> list[Bore]:
    """Return the holes of a girder at its start and end, at those of ``ends`` that are joints, as designed.

    Raises UsageError where the holes do not fit into the section.
    """
    outer = section.outlines[0]
    b, h = 0.5 * section.width, 0.5 * section.height
    flange, web = float(outer[1, 1] + h), float(outer[2, 0] * 2.0)
    radius = 0.5 * params.hole_mm
    gauge = 0.5 * (b + 0.5 * web)  # of the row in each half flange
    expect(gauge - 0.5 * web > SQUARE * radius, "bolts.hole_mm", params.hole_mm, "holes that fit into half a flange")
    high = (params.web_bolts - 1) * params.pitch_mm + 2.0 * SQUARE * radius
    expect(high < 2.0 * (h - flange), "bolts.web_bolts", params.web_bolts, "holes that fit into the web's height")
    bores = []
    for at_end, joint in enumerate(ends):
        if not joint:
            continue
        rows = params.edge_mm + params.pitch_mm * np.arange(max(params.flange_bolts, 2))
        along = length - rows if at_end else rows
        for x in along[: params.flange_bolts]:
            for side in (-gauge, gauge):
                for low in (-h, h - flange):
                    bores.append(_bore(x, [side, low], [side, low + flange], radius))
        for x in along[:2] if params.web_bolts else ():
            for z in params.pitch_mm * (np.arange(params.web_bolts) - 0.5 * (params.web_bolts - 1)):
                bores.append(_bore(x, [-0.5 * web, z], [0.5 * web, z], radius))
    return bores


def _bore(x: float, start: list[float], end: list[float], radius: float) -> Bore:
    return Bore(float(x), np.array(start), np.array(end), radius, np.zeros(3))


def holed(wall: Patch, T: Floats, length: float, a: Floats, b: Floats, bores: Sequence[Bore]) -> list[Patch]:
    """Return a flat wall of a girder over the edge from ``a`` to ``b`` (2,) of its section, holes cut out, and rims.

    The wall's own knots and the cells that it has stay. T maps the girder's axes to the wall's frame.
    """
    holes = [(bore.x, s, bore) for bore, s in _on_edge(bores, b, a)]  # q of a wall runs from b to a
    if not holes:
        return [wall]
    size = length, float(np.linalg.norm(b - a))  # mm along p and q
    p, q = wall.p, wall.q
    for u, v, bore in holes:
        half = SQUARE * bore.radius
        p = np.append(p, [(u - half) / size[0], (u + half) / size[0]])
        q = np.append(q, [(v - half) / size[1], (v + half) / size[1]])
    p, q = _distinct(p), _distinct(q)
    middle_p, middle_q = 0.5 * (p[1:] + p[:-1]), 0.5 * (q[1:] + q[:-1])
    present: Bools = np.ones((len(middle_p), len(middle_q)), bool)
    if wall.present is not None:
        i = np.searchsorted(wall.p, middle_p) - 1
        j = np.searchsorted(wall.q, middle_q) - 1
        present = wall.present[np.ix_(i, j)].copy()
    rims = []
    for k, (u, v, bore) in enumerate(holes):
        half = SQUARE * bore.radius
        inside = np.outer(np.abs(middle_p * size[0] - u) < half, np.abs(middle_q * size[1] - v) < half)
        present &= ~inside
        rims.append(_rim(f"{wall.name}-rim{k}", wall, size, (u, v), bore, T[:3, :3] @ bore.shift))
    return [Patch(wall.name, wall.at, p, q, present), *rims]


def _on_edge(bores: Sequence[Bore], a: Floats, b: Floats) -> list[tuple[Bore, float]]:
    """Return the bores that come out at an edge of a section from ``a`` to ``b`` (2,), and how far along it."""
    along = b - a
    length = float(np.linalg.norm(along))
    unit = along / length
    found = []
    for bore in bores:
        for at in (bore.start, bore.end):
            s = float((at - a) @ unit)
            across = abs(float((at - a) @ np.array([-unit[1], unit[0]])))
            square = abs(float((bore.end - bore.start) @ unit)) < ON_MM
            if square and across < ON_MM and 0.0 < s < length:
                found.append((bore, s))
    return found


def _distinct(knots: Floats) -> Floats:
    """Return knots in order, those that are equal but for rounding once."""
    ordered = np.sort(knots)
    distinct: Floats = ordered[np.append(True, np.diff(ordered) > 1e-9)]
    return distinct


def _rim(
    name: str, wall: Patch, size: tuple[float, float], place: tuple[float, float], bore: Bore, shift: Floats
) -> Patch:
    """Return the part of a wall between a hole as drilled and the square around its place as designed."""
    origin = wall.at(np.array([0.0]), np.array([0.0]))[0]
    axes = np.stack(
        [
            (wall.at(np.array([1.0]), np.array([0.0]))[0] - origin) / size[0],
            (wall.at(np.array([0.0]), np.array([1.0]))[0] - origin) / size[1],
        ]
    )
    middle = origin + np.array(place) @ axes
    half = SQUARE * bore.radius

    def at(p: Floats, q: Floats) -> Floats:
        turn = 2.0 * np.pi * q
        ray = np.column_stack([np.cos(turn), np.sin(turn)])
        square = half * ray / np.abs(ray).max(axis=1)[:, None]
        outer, inner = middle + square @ axes, middle + shift + bore.radius * ray @ axes
        points: Floats = inner + p[:, None] * (outer - inner)
        return points

    return Patch(name, at, np.array([0.0, 1.0]), np.linspace(0.0, 1.0, AROUND + 1))


def bore_patch(name: str, T: Floats, bore: Bore) -> Patch:
    """Return the wall of a hole as drilled, facing its axis, of a girder with the frame T (4, 4)."""
    start, end = (np.array([bore.x, *at]) + bore.shift for at in (bore.start, bore.end))
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.array([1.0, 0.0, 0.0])
    other = np.cross(axis, side)

    def at(p: Floats, q: Floats) -> Floats:
        turn = 2.0 * np.pi * q
        off = bore.radius * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
        points = start + p[:, None] * (end - start) + off
        return np.asarray(points @ T[:3, :3].T + T[:3, 3])

    return Patch(name, at, np.array([0.0, 1.0]), np.linspace(0.0, 1.0, AROUND + 1))
