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
from designgen.scanning.surfaces import Patch
from processor.model import Floats, UsageError

CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
)  # fmt: skip
Displacement = Callable[[Floats], Floats]  # local coordinates (n, 3) -> (n, 3)


MOST_SHARE = 0.95  # of a component's length or height that a defect may take
SIZED = (
    "dent_depth_mm", "bend_mm", "twist_mrad", "wave_mm", "loss_mm", "pit_depth_mm", "step_mm", "shift_mm", "tilt_mrad",
)  # fmt: skip
NOWHERE = np.empty((0, 4))


@dataclass(frozen=True)
class Params:
    """Sizes of defects, mm; ``size`` multiplies depths, angles and ``loss_mm``. Places on the component are drawn."""

    size: float = 1.0
    dent_depth_mm: float = 6.0
    dent_radius_mm: float = 120.0
    bend_mm: float = 8.0  # at the middle
    twist_mrad: float = 12.0  # between the ends
    wave_mm: float = 3.0  # amplitude
    wave_length_mm: float = 300.0
    loss_mm: float = 60.0  # depth and half the length of a piece lost at an edge; a missing part is three times that
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

    def sized(self, key: str) -> float:
        """Return a size as it is built: times ``size`` where that counts."""
        value: float = getattr(self, key)
        return self.size * value if key in SIZED else value


@dataclass(frozen=True)
class Defect:
    """One defect: its displacement, rectangles (k, 4) that are missing as a0, a1, b0, b1, and its truth.

    The truth is that of the front, a girder's web: the area that moved or is missing, the largest movement, and its
    integral over the area, or the steel that is missing. What goes both ways counts as inward, and both ways add up.
    """

    kind: str
    place: tuple[float, float]  # a, b of its middle
    move: Displacement
    missing: Floats
    fine: tuple[float, float]  # half width and step of the net's finer part about the place
    front_only: bool
    area_mm2: float
    depth_max_mm: float  # inward positive
    volume_mm3: float  # likewise


def extent(form: plate_row.Params) -> tuple[float, float]:
    """Return length and height of the front: of a girder, its web's between the flanges."""
    return form.length_mm, form.height_mm - (2.0 * form.flange_mm if form.form == "girder" else 0.0)


def draw(kind: str, params: Params, form: plate_row.Params, rng: np.random.Generator, name: str = "") -> Defect:
    """Draw a defect of a class on a component of a form, called ``name`` in messages.

    Raises UsageError for an unknown class and for a size that does not fit on the component.
    """
    if kind not in CLASSES:
        raise UsageError(f"structure.components: expected classes of {', '.join(CLASSES)} or none, got {kind!r}")
    _check_fits(kind, params, form, name or f"{form.form} with {kind}")
    shares = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)
    if kind in ("dent", "bulge", "pit"):
        return _bumped(kind, params, form, shares)
    if kind in ("edge-loss", "missing-part", "crack"):
        return _missing(kind, params, form, shares)
    return _whole(kind, params, form)


def _check_fits(kind: str, params: Params, form: plate_row.Params, name: str) -> None:
    L, H = extent(form)
    least = min(L, H)
    along, across = (L, H) if form.form == "plate" else (H, L)  # of the edge that loses a piece
    round_ = 0.5 * MOST_SHARE * least
    most = {
        "dent": {"dent_radius_mm": round_, "dent_depth_mm": params.dent_radius_mm},
        "bulge": {"dent_radius_mm": round_, "dent_depth_mm": params.dent_radius_mm},
        "pit": {"pit_radius_mm": round_, "pit_depth_mm": MOST_SHARE * form.plate_mm},
        "bend": {"bend_mm": 0.25 * L},
        "twist": {"twist_mrad": 1000.0},
        "waviness": {"wave_mm": 0.25 * params.wave_length_mm},
        "edge-loss": {"loss_mm": MOST_SHARE * min(0.5 * along, across)},
        "missing-part": {"loss_mm": MOST_SHARE * least / 3.0},
        "crack": {"crack_width_mm": MOST_SHARE * L, "crack_length_mm": MOST_SHARE * H},
        "step": {"step_mm": 0.25 * L},
        "misalignment": {"shift_mm": 0.25 * L, "tilt_mrad": 500.0},
    }[kind]
    front = f"{name}, {L:g} x {H:g} x {form.plate_mm:g} mm"
    for key, limit in most.items():
        value = params.sized(key)
        if not value <= limit * (1.0 + 1e-12):
            by = f" times asbuilt.size {params.size:g}" if key in SIZED and params.size != 1.0 else ""
            raise UsageError(f"asbuilt.{key}{by}: expected at most {limit:g} on {front}, got {value:g}")
    if kind == "waviness" and not params.wave_length_mm >= 4.0 * form.plate_mm:
        raise UsageError(
            f"asbuilt.wave_length_mm: expected at least {4.0 * form.plate_mm:g}, four times the thickness, on {front}, "
            f"got {params.wave_length_mm:g}"
        )


def _spot(shares: tuple[float, float], size: tuple[float, float], half: tuple[float, float]) -> tuple[float, float]:
    """Return where the middle of something lies that reaches ``half`` to each side: all of it on the component."""
    a, b = (share * min(full, (0.5 * full - own) / 0.2) for share, full, own in zip(shares, size, half, strict=True))
    return a, b


def _bumped(kind: str, params: Params, form: plate_row.Params, shares: tuple[float, float]) -> Defect:
    pit = kind == "pit"
    radius = params.pit_radius_mm if pit else params.dent_radius_mm
    depth = params.sized("pit_depth_mm" if pit else "dent_depth_mm") * (-1.0 if kind == "bulge" else 1.0)
    at = _spot(shares, extent(form), (radius, radius))
    area = np.pi * radius**2
    move, fine = _bump(*at, depth, radius), (1.3 * radius, radius / 8.0)
    return Defect(kind, at, move, NOWHERE, fine, pit, area, depth, area * depth / 3.0)


def _whole(kind: str, params: Params, form: plate_row.Params) -> Defect:
    """Return a defect of the whole component, or of its second half: a step."""
    L, H = extent(form)
    place, step, area = (0.0, 0.0), 40.0, L * H
    if kind == "bend":
        depth = params.sized("bend_mm")
        move, volume = _out(lambda p: -depth * np.cos(np.pi * p[:, 0] / L)), area * depth * 2.0 / np.pi
    elif kind == "twist":
        turn = 1e-3 * params.sized("twist_mrad")
        move, depth = _twist(turn / L), 0.5 * H * np.sin(0.5 * turn)
        # Inward on two quarters, outward on two: |b| over the height times |sin| of the angle along the length.
        volume = 0.25 * H**2 * 2.0 * L / turn * (1.0 - np.cos(0.5 * turn))
    elif kind == "waviness":
        high, per = params.sized("wave_mm"), 2.0 * np.pi / params.wave_length_mm
        half_waves, rest = divmod(0.5 * L * per, np.pi)
        depth = high if half_waves or rest > 0.5 * np.pi else high * np.sin(rest)
        # |sin| from the middle to both ends: 2 a half wave and what is left; cos^2 over the height: half of it.
        volume = high * 2.0 * (2.0 * half_waves + 1.0 - np.cos(rest)) / per * 0.5 * H
        move, step = _out(lambda p: high * np.sin(per * p[:, 0]) * _fading(p[:, 1], H)), 0.08 * params.wave_length_mm
    elif kind == "step":
        depth = params.sized("step_mm")
        place, area = (0.25 * L, 0.0), 0.5 * area
        move, volume = _out(lambda p: np.full(len(p), -depth)), area * depth
    else:
        shift, tilt = params.sized("shift_mm"), 1e-3 * params.sized("tilt_mrad")
        reach = 0.5 * H * np.sin(tilt)
        move, depth = _rigid(shift, tilt), shift + reach
        # Tilted by more than it is shifted, its upper end stands out.
        volume = area * (shift if reach <= shift else 0.5 * (shift**2 + reach**2) / reach)
    return Defect(kind, place, move, NOWHERE, (0.5 * L, step), False, area, float(depth), float(volume))


def _fading(b: Floats, H: float) -> Floats:
    """Return 1 at the middle of the height, 0 at its ends and on a girder's flanges beyond."""
    found: Floats = np.cos(np.pi * np.clip(b / H, -0.5, 0.5)) ** 2
    return found


def _missing(kind: str, params: Params, form: plate_row.Params, shares: tuple[float, float]) -> Defect:
    L, H = extent(form)
    side, beyond = params.sized("loss_mm"), 1.0  # what reaches beyond an edge leaves no cut there
    if kind == "edge-loss" and form.form == "plate":
        a, _ = _spot(shares, (L, H), (side, 0.0))
        box = (a - side, a + side, 0.5 * H - side, 0.5 * H + beyond)
    elif kind == "edge-loss":  # a web's upper and lower edges are in its flanges: its ends are free
        _, b = _spot(shares, (L, H), (0.0, side))
        box = (0.5 * L - side, 0.5 * L + beyond, b - side, b + side)
    elif kind == "missing-part":
        box = (0.5 * L - 3.0 * side, 0.5 * L + beyond, 0.5 * H - 3.0 * side, 0.5 * H + beyond)
    else:
        wide, long = 0.5 * params.crack_width_mm, 0.5 * params.crack_length_mm
        a, b = _spot(shares, (L, H), (wide, long))
        box = (a - wide, a + wide, b - long, b + long)
    a0, a1, b0, b1 = box[0], min(box[1], 0.5 * L), box[2], min(box[3], 0.5 * H)
    area, t = (a1 - a0) * (b1 - b0), form.plate_mm
    middle = (0.5 * (a0 + a1), 0.5 * (b0 + b1))
    return Defect(kind, middle, np.zeros_like, np.array([box]), (0.0, 1.0), False, area, t, area * t)


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
