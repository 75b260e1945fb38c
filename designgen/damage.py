"""Defects of plates and girders, and movements of whole structures: functions of the design's coordinates, with truth.

Of a component, a runs along it, b up, and n out of its front; a displacement (n, 3) has the same axes. The classes are
those of the project's reports.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from designgen.designs import plate_row
from designgen.designs.structure import Box, Component
from designgen.surfaces import Patch
from processor.model import Floats, UsageError

CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
)  # fmt: skip
Displacement = Callable[[Floats], Floats]  # local coordinates (n, 3) -> (n, 3)


@dataclass(frozen=True)
class Params:
    """Sizes of defects, mm; ``size`` multiplies all depths. Places on the component are drawn."""

    size: float = 1.0
    dent_depth_mm: float = 6.0
    dent_radius_mm: float = 120.0
    bend_mm: float = 8.0  # at the middle
    twist_mrad: float = 12.0  # between the ends
    wave_mm: float = 3.0  # amplitude
    wave_length_mm: float = 300.0
    loss_mm: float = 60.0  # side of a piece lost at an edge; a missing part is three times as large
    pit_depth_mm: float = 3.0
    pit_radius_mm: float = 15.0
    crack_width_mm: float = 4.0
    crack_length_mm: float = 300.0
    step_mm: float = 4.0
    shift_mm: float = 6.0  # of a misaligned component, out of the front
    tilt_mrad: float = 6.0

    def __post_init__(self) -> None:
        for key in self.__dataclass_fields__:
            if not getattr(self, key) > 0.0:
                raise UsageError(f"asbuilt.{key}: expected a number above 0, got {getattr(self, key)!r}")


@dataclass(frozen=True)
class Defect:
    """One defect: its displacement, rectangles (k, 4) that are missing as a0, a1, b0, b1, and its truth."""

    kind: str
    place: tuple[float, float]  # a, b of its middle
    move: Displacement
    missing: Floats
    fine: tuple[float, float]  # half width and step of the net's finer part about the place
    front_only: bool
    area_mm2: float
    depth_max_mm: float  # inward positive
    volume_mm3: float


def draw(kind: str, params: Params, form: plate_row.Params, rng: np.random.Generator) -> Defect:
    """Draw a defect of a class on a component of a form. UsageError for an unknown class."""
    L, H = form.length_mm, form.height_mm - (2.0 * form.flange_mm if form.form == "girder" else 0.0)
    a, b = rng.uniform(-0.2, 0.2) * L, rng.uniform(-0.2, 0.2) * H
    whole = (0.0, 0.0)
    far = (0.5 * L, 40.0)
    none = np.empty((0, 4))
    if kind in ("dent", "bulge", "pit"):
        radius = params.pit_radius_mm if kind == "pit" else min(params.dent_radius_mm, 0.3 * H)
        depth = params.size * (params.pit_depth_mm if kind == "pit" else params.dent_depth_mm)
        depth = -depth if kind == "bulge" else depth
        area = np.pi * radius**2
        fine = (1.3 * radius, radius / 8.0)
        return Defect(
            kind, (a, b), _bump(a, b, depth, radius), none, fine, kind == "pit", area, depth, area * depth / 3.0
        )
    if kind == "bend":
        depth = params.size * params.bend_mm
        return Defect(
            kind,
            whole,
            _out(lambda p: -depth * np.cos(np.pi * p[:, 0] / L)),
            none,
            far,
            False,
            L * H,
            depth,
            L * H * depth * 2.0 / np.pi,
        )
    if kind == "twist":
        rate = params.size * 1e-3 * params.twist_mrad / L
        # Inward on two quarters, outward on two: the volume moved is that of both together.
        return Defect(
            kind, whole, _twist(rate), none, far, False, L * H, rate * L * H / 4.0, rate * (L * H) ** 2 / 16.0
        )
    if kind == "waviness":
        depth = params.size * params.wave_mm
        wave = _out(
            lambda p: depth * np.sin(2.0 * np.pi * p[:, 0] / params.wave_length_mm) * np.cos(np.pi * p[:, 1] / H) ** 2
        )
        return Defect(
            kind, whole, wave, none, (0.5 * L, 0.08 * params.wave_length_mm), False, L * H, depth, depth * L * H / np.pi
        )
    if kind in ("edge-loss", "missing-part", "crack"):
        return _missing(kind, params, form, (a, b), (L, H))
    if kind == "step":
        depth = params.size * params.step_mm
        return Defect(
            kind,
            (0.25 * L, 0.0),
            _out(lambda p: np.full(len(p), -depth)),
            none,
            far,
            False,
            0.5 * L * H,
            depth,
            0.5 * L * H * depth,
        )
    if kind == "misalignment":
        shift, tilt = params.size * params.shift_mm, params.size * 1e-3 * params.tilt_mrad
        return Defect(
            kind, whole, _rigid(shift, tilt), none, far, False, L * H, shift + 0.5 * H * np.sin(tilt), L * H * shift
        )
    raise UsageError(f"structure.components: expected classes of {', '.join(CLASSES)} or none, got {kind!r}")


def _missing(
    kind: str, params: Params, form: plate_row.Params, at: tuple[float, float], size: tuple[float, float]
) -> Defect:
    (a, b), (L, H) = at, size
    side = params.loss_mm * params.size
    if kind == "edge-loss":
        box = (a - side, a + side, 0.5 * H - side, 0.5 * H + 1.0)
    elif kind == "missing-part":
        box = (0.5 * L - 3.0 * side, 0.5 * L + 1.0, 0.5 * H - 3.0 * side, 0.5 * H + 1.0)
    else:
        box = (
            a - 0.5 * params.crack_width_mm,
            a + 0.5 * params.crack_width_mm,
            b - 0.5 * params.crack_length_mm,
            b + 0.5 * params.crack_length_mm,
        )
    a0, a1, b0, b1 = box[0], min(box[1], 0.5 * L), box[2], min(box[3], 0.5 * H)
    area = (a1 - a0) * (b1 - b0)
    middle = (0.5 * (a0 + a1), 0.5 * (b0 + b1))
    return Defect(
        kind, middle, np.zeros_like, np.array([box]), (0.0, 1.0), False, area, form.plate_mm, area * form.plate_mm
    )


def _out(height: Callable[[Floats], Floats]) -> Displacement:
    return lambda p: np.stack([np.zeros(len(p)), np.zeros(len(p)), height(p)], axis=1)


def _bump(a: float, b: float, depth: float, radius: float) -> Displacement:
    def height(p: Floats) -> Floats:
        away = np.minimum(((p[:, 0] - a) ** 2 + (p[:, 1] - b) ** 2) / radius**2, 1.0)
        found: Floats = -depth * (1.0 - away) ** 2
        return found

    return _out(height)


def _twist(rate: float) -> Displacement:
    def move(p: Floats) -> Floats:
        angle = rate * p[:, 0]
        b, n = p[:, 1], p[:, 2]
        up, out = b * np.cos(angle) - n * np.sin(angle) - b, b * np.sin(angle) + n * np.cos(angle) - n
        return np.stack([np.zeros(len(p)), up, out], axis=1)

    return move


def _rigid(shift: float, tilt: float) -> Displacement:
    def move(p: Floats) -> Floats:
        b, n = p[:, 1], p[:, 2]
        up, out = b * np.cos(tilt) - n * np.sin(tilt) - b, b * np.sin(tilt) + n * np.cos(tilt) - n
        return np.stack([np.zeros(len(p)), up, out - shift], axis=1)

    return move


def damaged(place: plate_row.Place, boxes: list[Box], defect: Defect, front: int = 0) -> list[Patch]:
    """Return the faces of a component with its defect; ``front`` is the body that a missing piece is taken from."""
    found = []
    for number, body in enumerate(boxes):
        local = place.local(body.centre[None])[0]
        if place.halves and local[0] < 0.0:  # the half that is where it should be
            found += [Patch(f"{number} {patch.name}", patch.at, patch.p, patch.q) for patch in body.patches()]
            continue
        holes = defect.missing if number == front else np.empty((0, 4))
        a, b, n = (_knots(local[k], body.size[k], k, defect, holes) for k in range(3))
        for patch in body.patches((a, b, n)):
            moved = not defect.front_only or (number == front and patch.name == "+n")
            at = _moved(patch.at, place, defect.move) if moved else patch.at
            found.append(Patch(f"{number} {patch.name}", at, patch.p, patch.q, _kept(patch, place, holes)))
        found += [_cut(place, body, hole, i, n) for n, hole in enumerate(holes) for i in range(4)]
    return found


def _knots(middle: float, size: float, axis: int, defect: Defect, holes: Floats) -> Floats:
    """Knots 0..1 of a box along an axis: coarse, finer about the defect, and at the edges of holes."""
    low = middle - 0.5 * size
    at = [low + size * np.linspace(0.0, 1.0, 2 if axis == 2 else max(2, int(size / 100.0)))]
    if axis < 2:
        half, step = defect.fine
        at.append(defect.place[axis] + np.arange(-half, half + step, step))
        at.append(holes[:, 2 * axis : 2 * axis + 2].ravel())
    found: Floats = np.unique(np.clip((np.concatenate(at) - low) / size, 0.0, 1.0).round(9))
    return found


def _kept(patch: Patch, place: plate_row.Place, holes: Floats) -> np.ndarray:
    p, q = np.meshgrid(0.5 * (patch.p[1:] + patch.p[:-1]), 0.5 * (patch.q[1:] + patch.q[:-1]), indexing="ij")
    local = place.local(patch.at(p.ravel(), q.ravel()))
    kept = np.ones(len(local), bool)
    for a0, a1, b0, b1 in holes:
        kept &= ~((local[:, 0] > a0) & (local[:, 0] < a1) & (local[:, 1] > b0) & (local[:, 1] < b1))
    return kept.reshape(p.shape)


def _moved(
    at: Callable[[Floats, Floats], Floats], place: plate_row.Place, move: Displacement
) -> Callable[[Floats, Floats], Floats]:
    def where(p: Floats, q: Floats) -> Floats:
        points = at(p, q)
        found: Floats = points + move(place.local(points)) @ plate_row.AXES
        return found

    return where


def _cut(place: plate_row.Place, body: Box, hole: Floats, side: int, number: int) -> Patch:
    """Return one of the four faces through the plate around a hole; none of it shows outside of the plate."""
    low, high = (place.local(body.centre[None])[0] + sign * 0.5 * body.size for sign in (-1.0, 1.0))
    a0, a1 = np.clip(hole[:2], low[0], high[0])
    b0, b1 = np.clip(hole[2:], low[1], high[1])
    corners = np.array([[a0, b0], [a1, b0], [a1, b1], [a0, b1]])
    start, end = corners[side], corners[(side + 1) % 4]
    open_edge = (side in (1, 3) and hole[1 if side == 1 else 0] != (a1, a0)[side == 3]) or (
        side in (0, 2) and hole[3 if side == 2 else 2] != (b1, b0)[side == 0]
    )

    def at(p: Floats, q: Floats) -> Floats:
        ab = start + np.outer(q, end - start)
        local = np.column_stack([ab, low[2] + p * (high[2] - low[2])])
        points: Floats = place.origin + local @ plate_row.AXES
        return points

    one = np.array([0.0, 1.0])
    return Patch(f"cut {number} {side}", at, one, one, np.array([[not open_edge]]))


# --- whole structures ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MovementParams:
    """A smooth movement of a whole structure, mm: it sags inward, leans, and ripples around."""

    sag_mm: float = 30.0
    lean_mm: float = 12.0
    ripple_mm: float = 8.0
    ripples: int = 3

    def __post_init__(self) -> None:
        if self.ripples < 0:
            raise UsageError(f"asbuilt.ripples: expected 0 or more, got {self.ripples!r}")


def movement(params: MovementParams, components: tuple[Component, ...]) -> Displacement:
    """Return the displacement (n, 3) of points (n, 3) of a structure, design's frame."""
    ends = np.vstack(
        [patch.at(*np.array([[0.0, 1.0, 0.5], [0.0, 0.5, 1.0]])) for c in components for patch in c.patches]
    )
    low, high = ends.min(axis=0), ends.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)

    def move(points: Floats) -> Floats:
        x, y, z = ((points - middle) / half).T
        away = np.minimum(np.hypot(x, y), 1.0)
        inward = 1.0 - away
        sag = (
            -params.sag_mm * inward * (2.0 - inward)
            + params.ripple_mm * np.cos(params.ripples * np.arctan2(y, x)) * inward
        )
        lean = params.lean_mm * 0.5 * (z + 1.0)
        return np.stack([lean, 0.4 * lean * x, sag], axis=1)

    return move
