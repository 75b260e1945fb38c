"""A part of an arch bridge: a box section along a curve, its faces in closed form and its CadQuery solid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from designgen.curves import Curve
from designgen.designs.parametric_face import Patch, Surface, outside
from processor.model import Bools, Floats

if TYPE_CHECKING:
    import cadquery as cq

SECTION_STEP_MM = 250.0  # of a solid: its spline is off an arch of 20 m radius by 4e-6 mm
BUILT_STEP_MM, STRIPS = 50.0, 8  # of a solid as built: sections along it, and strips of each of its sides
EDGE_STEP_MM = 20.0  # of the polyline of an edge: its sagitta is 2.5 um at a radius of 20 m
NET_STEP_MM, NET_ACROSS = 250.0, 6  # cells of the nets that rays meet before the surface itself
PAD_SIZE_MM, PAD_HEIGHT_MM = 200.0, 20.0  # of the mark that tells ends and attitudes apart


@dataclass(frozen=True)
class Plates:
    """Plate thicknesses in mm."""

    bottom: float
    top: float
    web: float


# Maps s, u, v of the design on a wall ("": on none) to s, u, v as built.
Fabrication = Callable[[Floats, Floats, Floats, str], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True)
class ArchPart:
    """One part of the bridge between arc lengths s0 and s1, mm.

    Half width ``b`` and height ``h`` of the outer section are linear between the arc lengths ``knots``. ``closed`` is
    the end with a base plate ("start", "end" or ""); any other end is open.
    """

    name: str
    curve: Curve
    plates: Plates
    knots: Floats  # (k,)
    half_widths: Floats  # (k,)
    heights: Floats  # (k,)
    closed: str = ""
    built: Fabrication | None = None  # None: as designed
    holes: tuple[Hole, ...] = ()

    @property
    def s0(self) -> float:
        """Arc length of the start, mm."""
        return float(self.knots[0])

    @property
    def s1(self) -> float:
        """Arc length of the end, mm."""
        return float(self.knots[-1])

    def b(self, s: Floats) -> Floats:
        """Return the outer half width (n,) at s (n,), mm."""
        return np.interp(s, self.knots, self.half_widths)

    def h(self, s: Floats) -> Floats:
        """Return the outer height (n,) at s (n,), mm."""
        return np.interp(s, self.knots, self.heights)

    def slope(self, values: Floats, s: Floats) -> Floats:
        """Return the derivative (n,) of half_widths or heights with respect to s at s (n,)."""
        piece = np.clip(np.searchsorted(self.knots, s, side="right") - 1, 0, len(self.knots) - 2)
        slopes: Floats = (np.diff(values) / np.diff(self.knots))[piece]
        return slopes

    @property
    def cavity(self) -> tuple[float, float]:
        """Arc lengths between which the part is hollow; a base plate is as thick as the bottom plate."""
        return (
            self.s0 + self.plates.bottom * (self.closed == "start"),
            self.s1 - self.plates.bottom * (self.closed == "end"),
        )

    @property
    def pad(self) -> tuple[float, float]:
        """Middle of the orientation pad, arc length and u: off the part's middle along and across."""
        # On the constant section the top face is curved in one direction only.
        s0, s1 = self.constant_section()
        s = s0 + 0.3 * (s1 - s0)
        return s, 0.5 * float(self.b(np.array(s)))

    def constant_section(self) -> tuple[float, float]:
        """Return the arc lengths between which the section is constant."""
        flat = np.flatnonzero(np.diff(self.heights) == 0.0)
        return float(self.knots[flat[0]]), float(self.knots[flat[-1] + 1])

    def key_points(self, s: float) -> Floats:
        """Return P1..P8 (8, 3) of the outer section at s: corners from bottom-left to top-left, then edge middles."""
        b, h = float(self.b(np.array(s))), float(self.h(np.array(s)))
        u, v = np.array([b, -b, -b, b, 0.0, -b, 0.0, b]), np.array([0.0, 0.0, h, h, 0.0, 0.5 * h, h, 0.5 * h])
        return self.point(np.full(8, s), u, v)

    def bottom_edges(self) -> tuple[Floats, Floats]:
        """Return the outer bottom edges, left and right, (n, 3) each, with vertices at most EDGE_STEP_MM apart."""
        s = self.chainages(self.s0, self.s1, EDGE_STEP_MM)
        b = self.b(s)
        zero = np.zeros_like(s)
        return self.point(s, b, zero), self.point(s, -b, zero)

    def point(self, s: Floats, u: Floats, v: Floats, wall: str = "") -> Floats:
        """Return points (n, 3) of the part as built, for s, u, v (n,) of the design."""
        if self.built is not None:
            s, u, v = self.built(s, u, v, wall)
        return self.curve.point(s, u, v)

    def chainages(self, start: float, end: float, step: float) -> Floats:
        """Return arc lengths from start to end, at most ``step`` apart, with every knot in between."""
        inner = self.knots[(self.knots > start) & (self.knots < end)]
        ends = np.concatenate([[start], inner, [end]])
        pieces = [np.linspace(a, z, max(2, int(np.ceil((z - a) / step)) + 1))[:-1] for a, z in pairwise(ends)]
        return np.concatenate([*pieces, [end]])


@dataclass(frozen=True)
class Hole:
    """A rectangle missing from a wall: arc lengths s0, s1 and, across, u (bottom, top) or v (left, right), c0, c1."""

    wall: str
    s0: float
    s1: float
    c0: float
    c1: float


@dataclass(frozen=True)
class Face:
    """A face of a part: ``at(p, q)`` maps (n,) in 0..1 to points (n, 3); ``element`` is the design's area per dp dq.

    ``along`` are the knots of its net in p; ``holes`` (k, 4) are the missing rectangles as p0, p1, q0, q1.
    """

    name: str
    at: Surface
    element: Callable[[Floats, Floats], Floats]
    along: Floats = dataclasses.field(default_factory=lambda: np.linspace(0.0, 1.0, 2))
    holes: Floats = dataclasses.field(default_factory=lambda: np.empty((0, 4)))

    def present(self, p: Floats, q: Floats) -> Bools:
        """Mark the parameters (n,) that lie outside of all holes."""
        return outside(p, q, self.holes)

    def patch(self, across: int = 1) -> Patch:
        """Return the face as a patch whose net has ``across`` cells in q."""
        p = np.unique([*self.along, *self.holes[:, :2].ravel()])
        q = np.unique([*np.linspace(0.0, 1.0, across + 1), *self.holes[:, 2:].ravel()])
        at_p, at_q = np.meshgrid(0.5 * (p[1:] + p[:-1]), 0.5 * (q[1:] + q[:-1]), indexing="ij")
        return Patch(self.name, self.at, p, q, self.present(at_p.ravel(), at_q.ravel()).reshape(at_p.shape))


def faces(part: ArchPart, inner_depth_mm: float) -> list[Face]:
    """Return all faces of a part; inner ones only within ``inner_depth_mm`` of an open end, where they are visible."""
    sides = ("bottom", "top", "left", "right")
    result = [_wall(part, side, inner=False, start=part.s0, end=part.s1) for side in sides]
    c0, c1 = part.cavity
    for s, end in ((part.s0, "start"), (part.s1, "end")):
        if part.closed == end:
            result.append(_plate(part, f"base-{end}", s, (0.0, 1.0), (0.0, 1.0)))
            continue
        lo, hi = (c0, min(c1, c0 + inner_depth_mm)) if end == "start" else (max(c0, c1 - inner_depth_mm), c1)
        result += [_wall(part, side, inner=True, start=lo, end=hi) for side in sides]
        w, low, high = _plate_fractions(part, s)
        result += [
            _plate(part, f"ring-{end}", s, (0.0, 1.0), (0.0, low)),
            _plate(part, f"ring-{end}", s, (0.0, 1.0), (high, 1.0)),
            _plate(part, f"ring-{end}", s, (0.0, w), (low, high)),
            _plate(part, f"ring-{end}", s, (1.0 - w, 1.0), (low, high)),
        ]
        if inner_depth_mm >= c1 - c0:
            for closed, c in (("start", c0), ("end", c1)):
                if part.closed == closed:
                    w, low, high = _plate_fractions(part, c)
                    result.append(_plate(part, f"inner-base-{closed}", c, (w, 1.0 - w), (low, high)))
    for hole in part.holes:
        result += _cut_faces(part, hole)
    return result + _pad_faces(part)


def _plate_fractions(part: ArchPart, s: float) -> tuple[float, float, float]:
    """Return the web's fraction of the width at s, and the fractions of the height that bound the cavity."""
    b, h, t = float(part.b(np.array(s))), float(part.h(np.array(s))), part.plates
    return t.web / (2.0 * b), t.bottom / h, 1.0 - t.top / h


def ray_patches(part: ArchPart) -> list[Patch]:
    """Return every face of a part, inside and outside, as patches for rays."""
    c0, c1 = part.cavity
    depth = (c1 - c0) * (1.0 if part.closed else 0.5)  # the faces of two open ends meet in the middle
    # Walls with waves and dents need a fine net to start the search for a hit; the hit itself is exact.
    return [face.patch(NET_ACROSS if len(face.along) > 2 else 1) for face in faces(part, depth)]


def _cut_faces(part: ArchPart, hole: Hole) -> list[Face]:
    """Return the four faces through the plate thickness around a hole."""
    t = part.plates
    flat = hole.wall in ("bottom", "top")
    thick = {"bottom": t.bottom, "top": t.top}.get(hole.wall, t.web)

    def face(number: int, start: tuple[float, float], end: tuple[float, float]) -> Face:
        (s0, c0), (s1, c1) = start, end

        def at(p: Floats, q: Floats) -> Floats:
            s, c = s0 + p * (s1 - s0), c0 + p * (c1 - c0)
            b, h, depth = part.b(s), part.h(s), q * thick
            if flat:
                return part.point(s, c, depth if hole.wall == "bottom" else h - depth, wall=hole.wall)
            return part.point(s, (b - depth) * (1.0 if hole.wall == "left" else -1.0), c, wall=hole.wall)

        area = thick * float(np.hypot(s1 - s0, c1 - c0))
        return Face(f"cut-{hole.wall}-{number}", at, lambda p, q: np.full_like(p, area))

    corners = [(hole.s0, hole.c0), (hole.s1, hole.c0), (hole.s1, hole.c1), (hole.s0, hole.c1)]
    return [face(i, corners[i], corners[(i + 1) % 4]) for i in range(4)]


def _wall(part: ArchPart, side: str, *, inner: bool, start: float, end: float) -> Face:
    """Return a wall along the part. At height v above a soffit of curvature k, |dP/ds| = 1 + k v."""
    t = part.plates
    web, low, high = (t.web, t.bottom, t.top) if inner else (0.0, 0.0, 0.0)
    length = end - start

    def coordinates(p: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
        s = start + p * length
        b, h = part.b(s) - web, part.h(s)
        if side in ("bottom", "top"):
            return s, (2.0 * q - 1.0) * b, np.full_like(s, low) if side == "bottom" else h - high
        return s, b if side == "left" else -b, low + q * (h - low - high)

    def element(p: Floats, q: Floats) -> Floats:
        s, _, v = coordinates(p, q)
        along = 1.0 + part.curve.curvature(s) * v
        if side in ("bottom", "top"):
            rise = part.slope(part.heights, s) if side == "top" else np.zeros_like(s)
            area: Floats = 2.0 * (part.b(s) - web) * np.hypot(along, rise) * length
        else:
            area = (part.h(s) - low - high) * np.hypot(along, part.slope(part.half_widths, s)) * length
        return area

    name = f"{'inner' if inner else 'outer'}-{side}"
    along = (part.chainages(start, end, NET_STEP_MM) - start) / length
    missing = [hole for hole in part.holes if hole.wall == side]
    if side == "top" and not inner:
        missing.append(_under_pad(part))

    def parameters(hole: Hole) -> tuple[float, float, float, float]:
        """Return p0, p1, q0, q1 of a hole in a wall of constant section, cut off at the wall's ends."""
        p0, p1 = (min(1.0, max(0.0, (s - start) / length)) for s in (hole.s0, hole.s1))
        b, h = float(part.b(np.array(hole.s0))) - web, float(part.h(np.array(hole.s0)))
        if side in ("bottom", "top"):
            return p0, p1, 0.5 * (hole.c0 / b + 1.0), 0.5 * (hole.c1 / b + 1.0)
        return p0, p1, (hole.c0 - low) / (h - low - high), (hole.c1 - low) / (h - low - high)

    holes = np.array([parameters(hole) for hole in missing]).reshape(-1, 4)
    return Face(name, lambda p, q: part.point(*coordinates(p, q), wall=side), element, along, holes)


def _under_pad(part: ArchPart) -> Hole:
    """Return the area of the top face under the pad; the top face is longer than the soffit."""
    s, u = part.pad
    half = 0.5 * PAD_SIZE_MM
    at = np.array(s)
    reach = half / (1.0 + float(part.curve.curvature(at)) * float(part.h(at)))
    return Hole("top", s - reach, s + reach, u - half, u + half)


def _plate(part: ArchPart, name: str, s: float, across: tuple[float, float], upward: tuple[float, float]) -> Face:
    """Return a rectangle in the section at s, from and to these fractions of the outer width (from -b) and height."""
    (p0, p1), (q0, q1) = across, upward
    b, h = float(part.b(np.array(s))), float(part.h(np.array(s)))

    def at(p: Floats, q: Floats) -> Floats:
        u, v = (2.0 * (p0 + p * (p1 - p0)) - 1.0) * b, (q0 + q * (q1 - q0)) * h
        return part.point(np.full_like(p, s), u, v)

    area = 2.0 * b * (p1 - p0) * h * (q1 - q0)
    return Face(name, at, lambda p, q: np.full_like(p, area))


def pad_frame(part: ArchPart) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the pad's origin on the top face and its unit axes along, left and up, (3,) each."""
    s, u = part.pad
    _, tangent, normal = part.curve.frame(np.array([s]))
    origin = part.point(np.array([s]), np.array([u]), part.h(np.array([s])), wall="top")[0]
    return origin, tangent[0], np.array([0.0, 1.0, 0.0]), normal[0]


def _pad_faces(part: ArchPart) -> list[Face]:
    origin, along, left, up = pad_frame(part)
    half = 0.5 * PAD_SIZE_MM

    def rectangle(name: str, centre: Floats, across: Floats, upward: Floats, height: float) -> Face:
        def at(p: Floats, q: Floats) -> Floats:
            points: Floats = centre + np.outer((p - 0.5) * PAD_SIZE_MM, across) + np.outer((q - 0.5) * height, upward)
            return points

        return Face(name, at, lambda p, q: np.full_like(p, PAD_SIZE_MM * height))

    result = [rectangle("pad", origin + PAD_HEIGHT_MM * up, along, left, PAD_SIZE_MM)]
    sides = [(sign, out, edge) for out, edge in ((along, left), (left, along)) for sign in (1.0, -1.0)]
    for i, (sign, out, edge) in enumerate(sides):
        centre = origin + sign * half * out + 0.5 * PAD_HEIGHT_MM * up
        result.append(rectangle(f"pad-side-{i}", centre, edge, up, PAD_HEIGHT_MM))
    return result


def solid(part: ArchPart) -> cq.Solid:
    """Return the CadQuery solid of a part: ruled faces between splines through the section corners, capped and sewn.

    A part as built has the ends, twist, bow, section, corners and plates that it was built with, but no waves, dents
    and missing pieces. Raises RuntimeError where the kernel does not make one solid of it.
    """
    import cadquery as cq

    t = part.plates
    shell: list[cq.Face] = []

    def edge(start: float, end: float, corner: int, inner: bool) -> cq.Edge:
        s = part.chainages(start, end, SECTION_STEP_MM if part.built is None else BUILT_STEP_MM)
        points = part.point(s, *_around(part, s, inner)[:, corner])
        # All splines have the arc length as parameter, so that a ruling joins points of the same section.
        return cq.Edge.makeSpline([cq.Vector(*p) for p in points], parameters=s.tolist())

    for inner, (lo, hi) in ((False, (part.s0, part.s1)), (True, part.cavity)):
        ends = np.concatenate([[lo], part.knots[(part.knots > lo) & (part.knots < hi)], [hi]])
        for start, end in pairwise(ends):
            count = _around(part, ends[:1], inner).shape[1]
            corners = [edge(start, end, corner, inner) for corner in range(count)]
            shell += [cq.Face.makeRuledSurface(corners[i], corners[(i + 1) % count]) for i in range(count)]

    for s, c, end in ((part.s0, part.cavity[0], "start"), (part.s1, part.cavity[1], "end")):
        closed = part.closed == end
        shell += _cap(part, s, c, closed=closed) if part.built is None else _strips_of_cap(part, s, c, closed=closed)
    box = cq.Solid.makeSolid(cq.Shell.makeShell(shell))
    if box.Volume() < 0.0:  # sewing does not define the orientation of the shell
        box = cq.Solid(box.wrapped.Reversed())
    origin, along, _, up = pad_frame(part)
    sunk = 0.5 * t.top  # into the plate, so that no sliver remains between the pad and the curved face
    corner = origin - 0.5 * PAD_SIZE_MM * along - np.array([0.0, 0.5 * PAD_SIZE_MM, 0.0]) - sunk * up
    plane = cq.Plane(origin=tuple(corner), xDir=tuple(along), normal=tuple(up))
    pad = cq.Solid.makeBox(PAD_SIZE_MM, PAD_SIZE_MM, PAD_HEIGHT_MM + sunk).moved(cq.Location(plane))
    solids = box.fuse(pad).Solids()
    if len(solids) != 1:
        raise RuntimeError(f"{part.name}: the CAD kernel made {len(solids)} solids of one part")
    return solids[0]


def _divisions(part: ArchPart, s: Floats, inner: bool) -> tuple[Floats, Floats]:
    """Return u (k, n) and v (l, n), at s (n,), by which the outer or inner side of a section is divided into strips.

    As built, sides are slightly curved: they are in strips, and the outer ones divided as the plates are.
    """
    b, h, t = part.b(s), part.h(s), part.plates
    low, high = np.full_like(s, t.bottom), h - t.top
    if part.built is None:
        return (np.stack([b - t.web, t.web - b]), np.stack([low, high])) if inner else (
            np.stack([b, -b]), np.stack([np.zeros_like(s), h])
        )  # fmt: skip
    share = np.linspace(0.0, 1.0, STRIPS + 1)[:, None]
    u, v = (b - t.web) * (1.0 - 2.0 * share), low + share * (high - low)
    return (u, v) if inner else (np.vstack([b, u, -b]), np.vstack([np.zeros_like(s), v, h]))


def _around(part: ArchPart, s: Floats, inner: bool) -> Floats:
    """Return u and v (2, k, n) of the divisions around a section at s (n,): bottom, right, top, left."""
    u, v = _divisions(part, s, inner)
    low, high, left, right = (np.broadcast_to(edge, shape.shape) for edge, shape in (
        (v[0], u), (v[-1], u), (u[0], v), (u[-1], v)
    ))  # fmt: skip
    sides = ((u, low), (right, v), (u[::-1], high), (left, v[::-1]))
    return np.concatenate([np.stack([across, up])[:, :-1] for across, up in sides], axis=1)


def _cap(part: ArchPart, s: float, c: float, *, closed: bool) -> list[cq.Face]:
    """Return the flat faces of an end as designed: if it is closed, outside at s and inside at c, else a ring."""
    import cadquery as cq

    wires = []
    for at, inner in ((s, False), (c if closed else s, True)):
        u, v = _around(part, np.array([at]), inner)[..., 0]
        wires.append(cq.Wire.makePolygon([cq.Vector(*p) for p in part.point(np.full(4, at), u, v)], close=True))
    return [cq.Face.makeFromWires(wire) for wire in wires] if closed else [cq.Face.makeFromWires(wires[0], wires[1:])]


def _strips_of_cap(part: ArchPart, s: float, c: float, *, closed: bool) -> list[cq.Face]:
    """Return the faces of an end as built, which are not flat: ruled ones between the divisions of the section."""
    import cadquery as cq

    faces = []
    for at, inner in ((s, False), (c, True)) if closed else ((s, False),):
        u, v = (x[:, 0] for x in _divisions(part, np.array([at]), inner))
        points = part.point(np.full(len(u) * len(v), at), np.repeat(u, len(v)), np.tile(v, len(u)))
        grid = [[cq.Vector(*p) for p in row] for row in points.reshape(len(u), len(v), 3)]
        for i, j in np.ndindex(len(u) - 1, len(v) - 1):
            if closed or i in (0, len(u) - 2) or j in (0, len(v) - 2):
                sides = (cq.Edge.makeLine(grid[k][j], grid[k][j + 1]) for k in (i, i + 1))
                faces.append(cq.Face.makeRuledSurface(*sides))
    return faces
