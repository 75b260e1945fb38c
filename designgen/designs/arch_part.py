"""What feet and ribs share: a box section carried along a curve, its faces in closed form and its CadQuery solid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from designgen.curves import Curve
from designgen.scanning.surfaces import Patch
from processor.model import Floats

if TYPE_CHECKING:
    import cadquery as cq

SECTION_STEP_MM = 250.0
EDGE_STEP_MM = 20.0
NET_STEP_MM, NET_ACROSS = 250.0, 6  # of the nets that rays hit first, before the surface itself
PAD_SIZE_MM, PAD_HEIGHT_MM = 200.0, 20.0


@dataclass(frozen=True)
class Plates:
    """Plate thicknesses in mm."""

    bottom: float
    top: float
    web: float


# From s, u, v on a wall ("" = on none) to what was built: s, u, v.
Fabrication = Callable[[Floats, Floats, Floats, str], tuple[Floats, Floats, Floats]]


@dataclass(frozen=True)
class ArchPart:
    """One part of the bridge between arc lengths s0 and s1.

    Half width ``b`` and height ``h`` of the outer section are linear between the arc lengths ``knots`` (one at every
    kink). ``closed`` names the end with a base plate ("start", "end" or ""); every other end is open.
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
        """Arc length of the start."""
        return float(self.knots[0])

    @property
    def s1(self) -> float:
        """Arc length of the end."""
        return float(self.knots[-1])

    def b(self, s: Floats) -> Floats:
        """Outer half width (n,) at s (n,)."""
        return np.interp(s, self.knots, self.half_widths)

    def h(self, s: Floats) -> Floats:
        """Outer height (n,) at s (n,)."""
        return np.interp(s, self.knots, self.heights)

    def slope(self, values: Floats, s: Floats) -> Floats:
        """Take the derivative (n,) of half_widths or heights at s (n,)."""
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
        """Middle of the orientation pad: arc length and u. Off the middle of the part both ways."""
        # On the constant section, so that the pad stands on a face that is curved one way only.
        s0, s1 = self.constant_section()
        return s0 + 0.3 * (s1 - s0), 0.5 * float(self.b(np.array(s0 + 0.3 * (s1 - s0))))

    def constant_section(self) -> tuple[float, float]:
        """Return the arc lengths between which the section stays the same."""
        flat = np.flatnonzero(np.diff(self.heights) == 0.0)
        return float(self.knots[flat[0]]), float(self.knots[flat[-1] + 1])

    def key_points(self, s: float) -> Floats:
        """P1..P8 (8, 3) of the outer section at s: corners bottom-left, bottom-right, top-right, top-left, middles."""
        b, h = float(self.b(np.array(s))), float(self.h(np.array(s)))
        u, v = np.array([b, -b, -b, b, 0.0, -b, 0.0, b]), np.array([0.0, 0.0, h, h, 0.0, 0.5 * h, h, 0.5 * h])
        return self.point(np.full(8, s), u, v)

    def bottom_edges(self) -> tuple[Floats, Floats]:
        """Outer bottom edges, left and right, (n, 3) each, from start to end, a vertex at most every 20 mm."""
        s = self.stations(self.s0, self.s1, EDGE_STEP_MM)
        b = self.b(s)
        zero = np.zeros_like(s)
        return self.point(s, b, zero), self.point(s, -b, zero)

    def point(self, s: Floats, u: Floats, v: Floats, wall: str = "") -> Floats:
        """Points (n, 3) of the part as built at the design's s, u, v (n,)."""
        if self.built is not None:
            s, u, v = self.built(s, u, v, wall)
        return self.curve.point(s, u, v)

    def stations(self, start: float, end: float, step: float) -> Floats:
        """Arc lengths from start to end, at most ``step`` apart, one at every knot between."""
        inner = self.knots[(self.knots > start) & (self.knots < end)]
        ends = np.concatenate([[start], inner, [end]])
        pieces = [np.linspace(a, z, max(2, int(np.ceil((z - a) / step)) + 1))[:-1] for a, z in pairwise(ends)]
        return np.concatenate([*pieces, [end]])


@dataclass(frozen=True)
class Hole:
    """A rectangle missing from a wall: arc lengths and, across it, u (bottom, top) or v (left, right)."""

    wall: str
    s0: float
    s1: float
    c0: float
    c1: float


@dataclass(frozen=True)
class Face:
    """A face of a part: ``at(p, q)`` maps (n,) in 0..1 to points (n, 3); ``element`` is the design's area per dp dq.

    ``along`` are the knots of its net in p; ``holes`` (k, 4) are p0, p1, q0, q1 of what is missing.
    """

    name: str
    at: Callable[[Floats, Floats], Floats]
    element: Callable[[Floats, Floats], Floats]
    along: Floats = dataclasses.field(default_factory=lambda: np.linspace(0.0, 1.0, 2))
    holes: Floats = dataclasses.field(default_factory=lambda: np.empty((0, 4)))

    def kept(self, p: Floats, q: Floats) -> np.ndarray:
        """Mark the places (n,) that no hole has taken."""
        left = np.ones(len(p), bool)
        for p0, p1, q0, q1 in self.holes:
            left &= ~((p > p0) & (p < p1) & (q > q0) & (q < q1))
        return left

    def patch(self, across: int = 1) -> Patch:
        """Return the face as rays see it, with ``across`` cells of its net in q."""
        p = np.unique([*self.along, *self.holes[:, :2].ravel()])
        q = np.unique([*np.linspace(0.0, 1.0, across + 1), *self.holes[:, 2:].ravel()])
        at_p, at_q = np.meshgrid(0.5 * (p[1:] + p[:-1]), 0.5 * (q[1:] + q[:-1]), indexing="ij")
        return Patch(self.name, self.at, p, q, self.kept(at_p.ravel(), at_q.ravel()).reshape(at_p.shape))


def faces(part: ArchPart, inner_depth_mm: float) -> list[Face]:
    """All faces of a part; the inner ones only within ``inner_depth_mm`` of an open end, where a scanner sees them."""
    found = [_wall(part, side, inner=False, start=part.s0, end=part.s1) for side in ("bottom", "top", "left", "right")]
    c0, c1 = part.cavity
    for s, end in ((part.s0, "start"), (part.s1, "end")):
        if part.closed == end:
            found.append(_plate(part, f"base-{end}", s, 0.0, 1.0, 0.0, 1.0))
            continue
        lo, hi = (c0, min(c1, c0 + inner_depth_mm)) if end == "start" else (max(c0, c1 - inner_depth_mm), c1)
        found += [_wall(part, side, inner=True, start=lo, end=hi) for side in ("bottom", "top", "left", "right")]
        b, h = float(part.b(np.array(s))), float(part.h(np.array(s)))
        t, w = part.plates, part.plates.web / (2.0 * b)
        found += [
            _plate(part, f"ring-{end}", s, 0.0, 1.0, 0.0, t.bottom / h),
            _plate(part, f"ring-{end}", s, 0.0, 1.0, 1.0 - t.top / h, 1.0),
            _plate(part, f"ring-{end}", s, 0.0, w, t.bottom / h, 1.0 - t.top / h),
            _plate(part, f"ring-{end}", s, 1.0 - w, 1.0, t.bottom / h, 1.0 - t.top / h),
        ]
        if inner_depth_mm >= c1 - c0:
            for closed, c in (("start", c0), ("end", c1)):
                if part.closed == closed:
                    b, h = float(part.b(np.array(c))), float(part.h(np.array(c)))
                    w, low, high = t.web / (2.0 * b), t.bottom / h, 1.0 - t.top / h
                    found.append(_plate(part, f"inner-base-{closed}", c, w, 1.0 - w, low, high))
    for hole in part.holes:
        found += _cut_faces(part, hole)
    return found + _pad_faces(part)


def ray_patches(part: ArchPart) -> list[Patch]:
    """Every face of a part, inside and outside, as rays see it."""
    c0, c1 = part.cavity
    depth = (c1 - c0) * (1.0 if part.closed else 0.5)  # both ends reach to the middle
    # Waves and dents need a fine net on the walls for the rays' first hit; the hit itself is exact.
    return [face.patch(NET_ACROSS if len(face.along) > 2 else 1) for face in faces(part, depth)]


def _cut_faces(part: ArchPart, hole: Hole) -> list[Face]:
    """Return the four faces through the plate around a hole."""
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
    """Make a face along the part; by the curve's curvature k the area element has dP/ds = (1 + k v) t."""
    t = part.plates
    web, low, high = (t.web, t.bottom, t.top) if inner else (0.0, 0.0, 0.0)
    length = end - start

    def place(p: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
        s = start + p * length
        b, h = part.b(s) - web, part.h(s)
        if side in ("bottom", "top"):
            return s, (2.0 * q - 1.0) * b, np.full_like(s, low) if side == "bottom" else h - high
        return s, b if side == "left" else -b, low + q * (h - low - high)

    def element(p: Floats, q: Floats) -> Floats:
        s, _, v = place(p, q)
        along = 1.0 + part.curve.curvature(s) * v
        if side in ("bottom", "top"):
            rise = part.slope(part.heights, s) if side == "top" else np.zeros_like(s)
            area: Floats = 2.0 * (part.b(s) - web) * np.hypot(along, rise) * length
        else:
            area = (part.h(s) - low - high) * np.hypot(along, part.slope(part.half_widths, s)) * length
        return area

    name = f"{'inner' if inner else 'outer'}-{side}"
    along = (part.stations(start, end, NET_STEP_MM) - start) / length
    missing = [hole for hole in part.holes if hole.wall == side]
    if side == "top" and not inner:
        missing.append(_under_pad(part))
    holes = [_in_wall(hole, part, start, length, low, high, web) for hole in missing]
    return Face(name, lambda p, q: part.point(*place(p, q), wall=side), element, along, np.array(holes).reshape(-1, 4))


def _under_pad(part: ArchPart) -> Hole:
    """Return what the pad hides of the top face, which is longer than the soffit by its height over the curve."""
    s, u = part.pad
    half = 0.5 * PAD_SIZE_MM
    at = np.array(s)
    reach = half / (1.0 + float(part.curve.curvature(at)) * float(part.h(at)))
    return Hole("top", s - reach, s + reach, u - half, u + half)


def _in_wall(
    hole: Hole, part: ArchPart, start: float, length: float, low: float, high: float, web: float
) -> tuple[float, float, float, float]:
    """Return a hole's p0, p1, q0, q1 on a wall of constant section, cut at the wall's ends."""
    p0, p1 = (min(1.0, max(0.0, (s - start) / length)) for s in (hole.s0, hole.s1))
    b, h = float(part.b(np.array(hole.s0))) - web, float(part.h(np.array(hole.s0)))
    if hole.wall in ("bottom", "top"):
        return p0, p1, 0.5 * (hole.c0 / b + 1.0), 0.5 * (hole.c1 / b + 1.0)
    return p0, p1, (hole.c0 - low) / (h - low - high), (hole.c1 - low) / (h - low - high)


def _plate(part: ArchPart, name: str, s: float, p0: float, p1: float, q0: float, q1: float) -> Face:
    """Make a rectangle in the section at s, in fractions of the outer width (from -b) and height."""
    b, h = float(part.b(np.array(s))), float(part.h(np.array(s)))

    def at(p: Floats, q: Floats) -> Floats:
        u, v = (2.0 * (p0 + p * (p1 - p0)) - 1.0) * b, (q0 + q * (q1 - q0)) * h
        return part.point(np.full_like(p, s), u, v)

    area = 2.0 * b * (p1 - p0) * h * (q1 - q0)
    return Face(name, at, lambda p, q: np.full_like(p, area))


def pad_frame(part: ArchPart) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the origin on the top face and the axes along, left and up of the pad, (3,) each."""
    s, u = part.pad
    _, tangent, normal = part.curve.frame(np.array([s]))
    origin = part.point(np.array([s]), np.array([u]), part.h(np.array([s])), wall="top")[0]
    return origin, tangent[0], np.array([0.0, 1.0, 0.0]), normal[0]


def _pad_faces(part: ArchPart) -> list[Face]:
    origin, along, left, up = pad_frame(part)
    half = 0.5 * PAD_SIZE_MM

    def rectangle(name: str, centre: Floats, one: Floats, two: Floats, length: float, width: float) -> Face:
        def at(p: Floats, q: Floats) -> Floats:
            points: Floats = centre + np.outer((p - 0.5) * length, one) + np.outer((q - 0.5) * width, two)
            return points

        return Face(name, at, lambda p, q: np.full_like(p, length * width))

    sides = [(sign, axis, other) for axis, other in ((along, left), (left, along)) for sign in (1.0, -1.0)]
    return [rectangle("pad", origin + PAD_HEIGHT_MM * up, along, left, PAD_SIZE_MM, PAD_SIZE_MM)] + [
        rectangle(
            f"pad-side-{i}",
            origin + sign * half * axis + 0.5 * PAD_HEIGHT_MM * up,
            other,
            up,
            PAD_SIZE_MM,
            PAD_HEIGHT_MM,
        )
        for i, (sign, axis, other) in enumerate(sides)
    ]


def solid(part: ArchPart) -> cq.Solid:
    """CadQuery solid of a part: ruled faces between splines through the section corners, capped and sewn."""
    import cadquery as cq

    t = part.plates
    found: list[cq.Face] = []
    sides = ((1.0, False), (-1.0, False), (-1.0, True), (1.0, True))

    def edge(start: float, end: float, side: float, top: bool, inner: bool) -> cq.Edge:
        s = part.stations(start, end, SECTION_STEP_MM)
        b, h = part.b(s) - (t.web if inner else 0.0), part.h(s)
        v = (h - (t.top if inner else 0.0)) if top else np.full_like(s, t.bottom if inner else 0.0)
        points = part.curve.point(s, side * b, v)
        # The arc length is every spline's parameter, so that a ruling joins points of one section.
        return cq.Edge.makeSpline([cq.Vector(*p) for p in points], parameters=s.tolist())

    for inner, (lo, hi) in ((False, (part.s0, part.s1)), (True, part.cavity)):
        ends = np.concatenate([[lo], part.knots[(part.knots > lo) & (part.knots < hi)], [hi]])
        for start, end in pairwise(ends):
            corners = [edge(start, end, side, top, inner) for side, top in sides]
            found += [cq.Face.makeRuledSurface(corners[i], corners[(i + 1) % 4]) for i in range(4)]

    def rectangle(s: float, inner: bool) -> cq.Wire:
        b = float(part.b(np.array(s))) - (t.web if inner else 0.0)
        h = float(part.h(np.array(s)))
        low, high = (t.bottom, h - t.top) if inner else (0.0, h)
        corners = part.curve.point(np.full(4, s), np.array([b, -b, -b, b]), np.array([low, low, high, high]))
        return cq.Wire.makePolygon([cq.Vector(*p) for p in corners], close=True)

    for s, c, end in ((part.s0, part.cavity[0], "start"), (part.s1, part.cavity[1], "end")):
        if part.closed == end:
            found += [cq.Face.makeFromWires(rectangle(s, False)), cq.Face.makeFromWires(rectangle(c, True))]
        else:
            found.append(cq.Face.makeFromWires(rectangle(s, False), [rectangle(s, True)]))
    box = cq.Solid.makeSolid(cq.Shell.makeShell(found))
    if box.Volume() < 0.0:  # sewing leaves the faces' sense to chance
        box = cq.Solid(box.wrapped.Reversed())
    origin, along, _, up = pad_frame(part)
    sunk = 0.5 * t.top  # into the plate, so that the pad meets a curved face without a sliver
    corner = origin - 0.5 * PAD_SIZE_MM * along - np.array([0.0, 0.5 * PAD_SIZE_MM, 0.0]) - sunk * up
    plane = cq.Plane(origin=tuple(corner), xDir=tuple(along), normal=tuple(up))
    pad = cq.Solid.makeBox(PAD_SIZE_MM, PAD_SIZE_MM, PAD_HEIGHT_MM + sunk).moved(cq.Location(plane))
    joined = box.fuse(pad)
    solids = joined.Solids()
    if len(solids) != 1:
        raise RuntimeError(f"{part.name}: the CAD kernel made {len(solids)} solids of one part")
    return solids[0]
