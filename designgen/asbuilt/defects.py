"""Defects of plates and girders, and displacements of whole structures, as functions of the design's coordinates.

The axes of a component are a along it, b upward, and n out of its front; its displacements (n, 3) have the same axes.
The classes of defects are those of the project's reports.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from designgen.checks import expect
from designgen.designs import defect_specimens
from designgen.designs.boxes_and_tubes import Box, Component
from designgen.designs.parametric_face import Displacement, Patch, outside
from processor.model import Bools, Floats, UsageError

CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
)  # fmt: skip
LEAST_MM = 0.01  # displacement of a surface that belongs to a defect
MOST_SHARE = 0.95  # largest fraction of a component's length or height that a defect may cover
SIZED = (
    "dent_depth_mm", "bend_mm", "twist_mrad", "wave_mm", "loss_mm", "pit_depth_mm", "step_mm", "shift_mm", "tilt_mrad",
)  # fmt: skip


@dataclass(frozen=True)
class Params:
    """Sizes of defects; ``size`` multiplies depths, angles and ``loss_mm``. Places on the component are random."""

    size: float = 1.0
    dent_depth_mm: float = 6.0
    dent_radius_mm: float = 120.0
    bend_mm: float = 8.0  # at the middle
    twist_mrad: float = 12.0  # between the ends
    wave_mm: float = 3.0  # amplitude
    wave_length_mm: float = 300.0
    loss_mm: float = 60.0  # depth and half length of a piece lost at an edge; a missing part is three times as large
    pit_depth_mm: float = 3.0
    pit_radius_mm: float = 15.0
    crack_width_mm: float = 4.0
    crack_length_mm: float = 300.0
    step_mm: float = 4.0
    shift_mm: float = 6.0  # of a misaligned component, out of the front
    tilt_mrad: float = 6.0

    def __post_init__(self) -> None:
        for key in self.__dataclass_fields__:
            expect(getattr(self, key) > 0.0, f"asbuilt.{key}", getattr(self, key), "a number above 0")

    def sized(self, key: str) -> float:
        """Return a size as built: multiplied by ``size`` if it is in SIZED."""
        value: float = getattr(self, key)
        return self.size * value if key in SIZED else value


@dataclass(frozen=True)
class Defect:
    """One defect: its displacement, the missing rectangles (k, 4) as a0, a1, b0, b1, and its truth.

    The truth is that of the front (of a girder, the web): the displaced or missing area, the largest displacement, and
    the integral of the displacement over the area or the missing volume. A displacement that goes inward and outward
    has the sign of inward, and its integral is that of the absolute value.
    """

    kind: str
    place: tuple[float, float]  # a, b of its middle
    displacement: Displacement
    area_mm2: float
    depth_max_mm: float  # positive inward
    volume_mm3: float  # positive inward
    fine: tuple[float, float]  # half width and step of the finer part of the net about the place
    missing: Floats = dataclasses.field(default_factory=lambda: np.empty((0, 4)))
    front_only: bool = False

    def displaces(self, points: Floats) -> Bools:
        """Mark the points (n, 3), in the component's axes, where the surface is displaced by LEAST_MM or more."""
        displaced: Bools = np.linalg.norm(self.displacement(points), axis=1) >= LEAST_MM
        return displaced


def extent(form: defect_specimens.Params) -> tuple[float, float]:
    """Return length and height of the front, mm; of a girder, those of the web between the flanges."""
    return form.length_mm, form.height_mm - (2.0 * form.flange_mm if form.form == "girder" else 0.0)


def draw(kind: str, params: Params, form: defect_specimens.Params, rng: np.random.Generator, name: str = "") -> Defect:
    """Draw a defect of a class on a component; ``name`` is the component's name in messages.

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


def _check_fits(kind: str, params: Params, form: defect_specimens.Params, name: str) -> None:
    L, H = extent(form)
    least = min(L, H)
    along, across = (L, H) if form.form == "plate" else (H, L)  # with respect to the edge that loses a piece
    radius = 0.5 * MOST_SHARE * least
    most = {
        "dent": {"dent_radius_mm": radius, "dent_depth_mm": params.dent_radius_mm},
        "bulge": {"dent_radius_mm": radius, "dent_depth_mm": params.dent_radius_mm},
        "pit": {"pit_radius_mm": radius, "pit_depth_mm": MOST_SHARE * form.plate_mm},
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


def _middle(shares: tuple[float, float], size: tuple[float, float], half: tuple[float, float]) -> tuple[float, float]:
    """Return the middle of a rectangle of half sizes ``half`` such that all of it is on the component."""
    a, b = (
        share * min(length, (0.5 * length - half_length) / 0.2)
        for share, length, half_length in zip(shares, size, half, strict=True)
    )
    return a, b


def _bumped(kind: str, params: Params, form: defect_specimens.Params, shares: tuple[float, float]) -> Defect:
    pit = kind == "pit"
    radius = params.pit_radius_mm if pit else params.dent_radius_mm
    depth = params.sized("pit_depth_mm" if pit else "dent_depth_mm") * (-1.0 if kind == "bulge" else 1.0)
    a, b = _middle(shares, extent(form), (radius, radius))
    area = np.pi * radius**2

    def height(x: Floats) -> Floats:
        result: Floats = -depth * (1.0 - np.minimum(((x[:, 0] - a) ** 2 + (x[:, 1] - b) ** 2) / radius**2, 1.0)) ** 2
        return result

    return Defect(
        kind=kind,
        place=(a, b),
        displacement=_out(height),
        area_mm2=area,
        depth_max_mm=depth,
        volume_mm3=area * depth / 3.0,
        fine=(1.3 * radius, radius / 8.0),
        front_only=pit,
    )


def _whole(kind: str, params: Params, form: defect_specimens.Params) -> Defect:
    """Return a defect of the whole component, or a step, which is one of its second half."""
    L, H = extent(form)
    place, step, area = (0.0, 0.0), 40.0, L * H
    if kind == "bend":
        depth = params.sized("bend_mm")
        displacement, volume = _out(lambda x: -depth * np.cos(np.pi * x[:, 0] / L)), area * depth * 2.0 / np.pi
    elif kind == "twist":
        angle = 1e-3 * params.sized("twist_mrad")
        displacement, depth = _rotation(0.0, angle / L), 0.5 * H * np.sin(0.5 * angle)
        # Two quarters inward, two outward: integral of |b| over the height times |sin| of the angle along the length.
        volume = 0.25 * H**2 * 2.0 * L / angle * (1.0 - np.cos(0.5 * angle))
    elif kind == "waviness":
        high, wave_number = params.sized("wave_mm"), 2.0 * np.pi / params.wave_length_mm
        half_waves, rest = divmod(0.5 * L * wave_number, np.pi)
        depth = high if half_waves or rest > 0.5 * np.pi else high * np.sin(rest)
        # The integral of |sin| from the middle to both ends (2 for each half wave, and the rest) and of cos^2 over H.
        volume = high * 2.0 * (2.0 * half_waves + 1.0 - np.cos(rest)) / wave_number * 0.5 * H
        # 1 at the middle of the height, falling to 0 at its ends; 0 on a girder's flanges beyond
        displacement = _out(
            lambda x: high * np.sin(wave_number * x[:, 0]) * (np.cos(np.pi * np.clip(x[:, 1] / H, -0.5, 0.5)) ** 2)
        )
        step = 0.08 * params.wave_length_mm
    elif kind == "step":
        depth = params.sized("step_mm")
        place, area = (0.25 * L, 0.0), 0.5 * area
        displacement, volume = _out(lambda x: np.full(len(x), -depth)), area * depth
    else:
        shift, tilt = params.sized("shift_mm"), 1e-3 * params.sized("tilt_mrad")
        reach = 0.5 * H * np.sin(tilt)
        displacement, depth = _rotation(tilt, 0.0, shift), shift + reach
        # If the tilt exceeds the shift, one end is displaced outward.
        volume = area * (shift if reach <= shift else 0.5 * (shift**2 + reach**2) / reach)
    return Defect(
        kind=kind,
        place=place,
        displacement=displacement,
        area_mm2=area,
        depth_max_mm=float(depth),
        volume_mm3=float(volume),
        fine=(0.5 * L, step),
    )


def _missing(kind: str, params: Params, form: defect_specimens.Params, shares: tuple[float, float]) -> Defect:
    L, H = extent(form)
    side, beyond = params.sized("loss_mm"), 1.0  # a rectangle that extends beyond an edge leaves no cut face there
    if kind == "edge-loss" and form.form == "plate":
        a, _ = _middle(shares, (L, H), (side, 0.0))
        box = (a - side, a + side, 0.5 * H - side, 0.5 * H + beyond)
    elif kind == "edge-loss":  # only the ends of a web are free: its upper and lower edges join the flanges
        _, b = _middle(shares, (L, H), (0.0, side))
        box = (0.5 * L - side, 0.5 * L + beyond, b - side, b + side)
    elif kind == "missing-part":
        box = (0.5 * L - 3.0 * side, 0.5 * L + beyond, 0.5 * H - 3.0 * side, 0.5 * H + beyond)
    else:
        wide, long = 0.5 * params.crack_width_mm, 0.5 * params.crack_length_mm
        a, b = _middle(shares, (L, H), (wide, long))
        box = (a - wide, a + wide, b - long, b + long)
    a0, a1, b0, b1 = box[0], min(box[1], 0.5 * L), box[2], min(box[3], 0.5 * H)
    area, t = (a1 - a0) * (b1 - b0), form.plate_mm
    return Defect(
        kind=kind,
        place=(0.5 * (a0 + a1), 0.5 * (b0 + b1)),
        displacement=np.zeros_like,
        area_mm2=area,
        depth_max_mm=t,
        volume_mm3=area * t,
        fine=(0.0, 1.0),
        missing=np.array([box]),
    )


def _out(height: Callable[[Floats], Floats]) -> Displacement:
    """Return a displacement out of the front by a height (n,) at local coordinates (n, 3)."""
    return lambda x: np.stack([np.zeros(len(x)), np.zeros(len(x)), height(x)], axis=1)


def _rotation(angle: float, rate: float, shift: float = 0.0) -> Displacement:
    """Return a rotation about the component's axis by ``angle`` plus ``rate`` times a, and a shift inward."""

    def displacement(x: Floats) -> Floats:
        a, b, n = x.T
        c, s = np.cos(angle + rate * a), np.sin(angle + rate * a)
        return np.stack([np.zeros(len(x)), b * c - n * s - b, b * s + n * c - n - shift], axis=1)

    return displacement


def damaged(place: defect_specimens.Place, boxes: list[Box], defect: Defect, front: int = 0) -> list[Patch]:
    """Return the faces of a component with its defect; ``front`` is the row of the body with the missing piece."""
    faces = []
    for number, body in enumerate(boxes):
        local = place.local(body.centre[None])[0]
        if place.halves and local[0] < 0.0:  # the half that is as designed
            faces += [dataclasses.replace(patch, name=f"{number} {patch.name}") for patch in body.patches()]
            continue
        holes = defect.missing if number == front else np.empty((0, 4))
        a, b, n = (_knots(local[k], body.size[k], k, defect, holes) for k in range(3))
        for patch in body.patches((a, b, n)):
            face = dataclasses.replace(patch, name=f"{number} {patch.name}", present=_present(patch, place, holes))
            if not defect.front_only or (number == front and patch.name == "+n"):
                face = face.displaced(lambda x: defect.displacement(place.local(x)) @ defect_specimens.AXES)
            faces.append(face)
        faces += [_cut(place, body, hole, i, n) for n, hole in enumerate(holes) for i in range(4)]
    return faces


def _knots(middle: float, size: float, axis: int, defect: Defect, holes: Floats) -> Floats:
    """Return the knots 0..1 of a box along an axis: coarse, finer about the defect, and at the edges of holes."""
    low = middle - 0.5 * size
    at = [low + size * np.linspace(0.0, 1.0, 2 if axis == 2 else max(2, int(size / 100.0)))]
    if axis < 2:
        half, step = defect.fine
        at.append(defect.place[axis] + np.arange(-half, half + step, step))
        at.append(holes[:, 2 * axis : 2 * axis + 2].ravel())
    knots: Floats = np.unique(np.clip((np.concatenate(at) - low) / size, 0.0, 1.0).round(9))
    return knots


def _present(patch: Patch, place: defect_specimens.Place, holes: Floats) -> Bools:
    """Mark the cells of a patch's net that lie outside of all holes."""
    p, q = np.meshgrid(0.5 * (patch.p[1:] + patch.p[:-1]), 0.5 * (patch.q[1:] + patch.q[:-1]), indexing="ij")
    local = place.local(patch.at(p.ravel(), q.ravel()))
    return outside(local[:, 0], local[:, 1], holes).reshape(p.shape)


def _cut(place: defect_specimens.Place, body: Box, hole: Floats, side: int, number: int) -> Patch:
    """Return one of the four faces through the plate around a hole, cut off at the plate's edges."""
    low, high = (place.local(body.centre[None])[0] + sign * 0.5 * body.size for sign in (-1.0, 1.0))
    a0, a1 = np.clip(hole[:2], low[0], high[0])
    b0, b1 = np.clip(hole[2:], low[1], high[1])
    corners = np.array([[a0, b0], [a1, b0], [a1, b1], [a0, b1]])
    start, end = corners[side], corners[(side + 1) % 4]
    open_edge = (hole[2] != b0, hole[1] != a1, hole[3] != b1, hole[0] != a0)[side]

    def at(p: Floats, q: Floats) -> Floats:
        ab = start + np.outer(q, end - start)
        local = np.column_stack([ab, low[2] + p * (high[2] - low[2])])
        points: Floats = place.origin + local @ defect_specimens.AXES
        return points

    ends = np.array([0.0, 1.0])
    return Patch(f"cut {number} {side}", at, ends, ends, np.array([[not open_edge]]))


# --- whole structures ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MovementParams:
    """A smooth displacement of a whole structure, mm: a sag towards the middle, a lean, and ripples around it."""

    sag_mm: float = 30.0
    lean_mm: float = 12.0
    ripple_mm: float = 8.0
    ripples: int = 3

    def __post_init__(self) -> None:
        expect(self.ripples >= 0, "asbuilt.ripples", self.ripples, "0 or more")


def movement(params: MovementParams, components: tuple[Component, ...]) -> Displacement:
    """Return the displacement of a structure's points in the design's frame, mm."""
    ends = np.vstack(
        [patch.at(*np.array([[0.0, 1.0, 0.5], [0.0, 0.5, 1.0]])) for c in components for patch in c.patches]
    )
    low, high = ends.min(axis=0), ends.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)

    def displacement(points: Floats) -> Floats:
        x, y, z = ((points - middle) / half).T
        inward = 1.0 - np.minimum(np.hypot(x, y), 1.0)
        ripple = params.ripple_mm * np.cos(params.ripples * np.arctan2(y, x)) * inward
        sag = -params.sag_mm * inward * (2.0 - inward) + ripple
        lean = params.lean_mm * 0.5 * (z + 1.0)
        return np.stack([lean, 0.4 * lean * x, sag], axis=1)

    return displacement
