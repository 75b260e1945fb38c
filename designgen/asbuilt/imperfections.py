"""What is built otherwise than designed: each imperfection a function of the design's numbers, with its truth.

Nothing here looks at a mesh: a part as built is its design's closed form with its coordinates moved, a frame its
design's table of nodes and members with other numbers.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from designgen.designs.arch_part import ArchPart, Hole, Plates
from designgen.designs.space_frame import Frame
from processor.model import AsBuilt, Floats, UsageError

EXPANSION_PER_K = 12e-6
CORNER_REACH_MM = 1500.0  # from an end, how far the errors of its corners reach
REFERENCE_C = 20.0
MOST_DRAWS = 200  # of a place for a dent or a missing piece
LEAST_PLATE_MM = 2.0
LEAST_SHARE = 0.5  # of a section's size as designed; a tenth of its size is hollow


@dataclass(frozen=True)
class ArchParams:
    """How far arch parts depart from their design: standard deviations, but counts and sizes of damage as given."""

    length_mm: float = 0.0  # each end's, along the part
    skew_mrad: float = 0.0  # each end's, about both axes of its section
    twist_mrad: float = 0.0  # between the ends
    bow_mm: float = 0.0  # sideways and upward, at the middle
    section_mm: float = 0.0  # width and height
    plate_mm: float = 0.0  # thickness of each plate, which is LEAST_PLATE_MM at least
    corner_mm: float = 0.0  # each corner of each end, along all axes: as ends look that were cut and welded in a yard
    waviness_mm: float = 0.0  # amplitude on each wall
    waviness_length_mm: float = 1500.0
    dents: int = 0  # on all parts together
    dent_depth_mm: float = 8.0
    dent_radius_mm: float = 150.0
    missing_pieces: int = 0  # rectangles cut from webs, on all parts together
    missing_size_mm: float = 250.0
    temperature_C: float = REFERENCE_C

    def __post_init__(self) -> None:
        _check(self)


@dataclass(frozen=True)
class FrameParams:
    """How far a frame departs from its design."""

    node_movement_mm: float = 0.0  # standard deviation of each axis
    wrong_sizes: int = 0  # balls of another size than designed
    radius_mm: float = 0.0  # standard deviation of a ball's radius
    eccentricity_mm: float = 0.0  # of each member's ends off the nodes, standard deviation across the axis
    bow_share: float = 0.0  # of tubes, uniform up to this share of their own length (1/1000 is common)
    missing_bolts: int = 0  # ends of members whose sleeve is not there
    temperature_C: float = REFERENCE_C

    def __post_init__(self) -> None:
        _check(self)


def _check(params: ArchParams | FrameParams) -> None:
    for key in params.__dataclass_fields__:
        value = getattr(params, key)
        if key == "temperature_C":
            if not -60.0 <= value <= 200.0:
                raise UsageError(f"asbuilt.{key}: expected -60 to 200, got {value!r}")
        elif value < 0:
            raise UsageError(f"asbuilt.{key}: expected 0 or more, got {value!r}")


def expansion(temperature_C: float) -> float:
    """Factor of all lengths of steel at a temperature against those at the reference."""
    return 1.0 + EXPANSION_PER_K * (temperature_C - REFERENCE_C)


def stated(temperature_C: float) -> float:
    """Return the temperature as a project states it: not at all (NaN) where it is the reference."""
    return temperature_C if temperature_C != REFERENCE_C else float("nan")


@dataclass
class Ledger:
    """Collects what was built otherwise, a row a number."""

    rows: list[tuple[str, str, float, str]] = field(default_factory=list)

    def note(self, what: str, where: str, value: float, unit: str) -> float:
        """Write a number down and return it."""
        self.rows.append((what, where, float(value), unit))
        return float(value)

    def record(self) -> AsBuilt:
        """Return the truth's record."""
        what, where, value, unit = zip(*self.rows, strict=True) if self.rows else ((), (), (), ())
        return AsBuilt(what, where, np.array(value, np.float64), unit)


# --- arch parts ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Dent:
    wall: str
    s: float
    c: float  # u on the bottom and top, v on the webs
    depth: float
    radius: float


@dataclass(frozen=True)
class _Spot:
    """Where a web is damaged: a square of half a side ``half`` about (s, v)."""

    wall: str
    s: float
    v: float
    half: float

    def apart(self, other: _Spot) -> bool:
        """Whether the squares of two spots do not meet."""
        reach = self.half + other.half
        return self.wall != other.wall or abs(self.s - other.s) >= reach or abs(self.v - other.v) >= reach

    def where(self, part: ArchPart) -> str:
        """Say where it is, for the ledger."""
        return f"{part.name} {self.wall} web, {self.s - part.s0:.0f} mm from the start, {self.v:.0f} mm up"


@dataclass(frozen=True)
class _Wave:
    amplitude: float
    phase: float
    length: float


@dataclass(frozen=True)
class ArchErrors:
    """One part's errors; ``q`` runs from 0 at its start to 1 at its end, ``vc`` is the height above the middle."""

    ends: Floats  # (2, 3): length, skew about the vertical and about the horizontal axis of the section
    twist: float
    bow: tuple[float, float]
    section: tuple[float, float]
    waves: dict[str, _Wave]
    dents: tuple[_Dent, ...] = ()
    corners: Floats = field(default_factory=lambda: np.zeros((2, 4, 3)))  # of P1 to P4 at each end, along, left, up


def fabricate(part: ArchPart, errors: ArchErrors, plates: Plates, holes: tuple[Hole, ...] = ()) -> ArchPart:
    """Return the part with its errors: lengths and skews of its ends, twist, bow, section, waves and dents."""
    s0, span = part.s0, part.s1 - part.s0

    def built(s: Floats, u: Floats, v: Floats, wall: str) -> tuple[Floats, Floats, Floats]:
        q, b, h = (s - s0) / span, part.b(s), part.h(s)
        # Waves and dents move a wall along its normal; they vanish at its edges, where walls meet.
        if wall:
            flat = wall in ("bottom", "top")
            c, across = (u, u / b) if flat else (v, 2.0 * v / h - 1.0)
            near_end = np.clip(np.minimum(q, 1.0 - q) * span / 500.0, 0.0, 1.0)
            wave = errors.waves[wall]
            window = np.maximum(1.0 - across**2, 0.0) * near_end**2
            move = wave.amplitude * np.sin(2.0 * np.pi * s / wave.length + wave.phase) * window
            for dent in errors.dents:
                if dent.wall == wall:
                    away = ((s - dent.s) ** 2 + (c - dent.c) ** 2) / dent.radius**2
                    move = move - dent.depth * np.where(away < 1.0, (1.0 - np.minimum(away, 1.0)) ** 2, 0.0)
            outward = {"bottom": -1.0, "top": 1.0, "left": 1.0, "right": -1.0}[wall] * move
            u, v = (u, v + outward) if flat else (u + outward, v)
        width, height = errors.section
        vc = v - 0.5 * h
        u, vc = u * (1.0 + 0.5 * width / b), vc * (1.0 + height / h)
        first, last = errors.ends
        s = s + (1.0 - q) * (first[0] + first[1] * u + first[2] * vc) + q * (last[0] + last[1] * u + last[2] * vc)
        moved = _off_corners(errors.corners, u / b, 2.0 * vc / h, q * span, (1.0 - q) * span)
        s, u, vc = s + moved[0], u + moved[1], vc + moved[2]
        turn = errors.twist * (q - 0.5)
        u, vc = u * np.cos(turn) - vc * np.sin(turn), u * np.sin(turn) + vc * np.cos(turn)
        bend = np.sin(np.pi * q)
        return s, u + errors.bow[0] * bend, vc + 0.5 * h + errors.bow[1] * bend

    return dataclasses.replace(part, plates=plates, built=built, holes=holes)


def _off_corners(corners: Floats, a: Floats, c: Floats, from_start: Floats, from_end: Floats) -> Floats:
    """Movements (3, n) by those of the ends' corners: bilinear over the section, fading out along the part.

    ``a`` and ``c`` (n,) run from -1 to 1 across the section, to the left and upward.
    """
    left, up = 0.5 * (1.0 + a), 0.5 * (1.0 + c)
    shares = np.stack([left * (1.0 - up), (1.0 - left) * (1.0 - up), (1.0 - left) * up, left * up])
    moved = np.zeros((3, len(a)))
    for end, away in enumerate((from_start, from_end)):
        x = np.clip(away / CORNER_REACH_MM, 0.0, 1.0)
        moved += (1.0 - x) ** 2 * (1.0 + 2.0 * x) * (corners[end].T @ shares)
    return moved


def arch(
    parts: tuple[ArchPart, ...], params: ArchParams, rngs: list[np.random.Generator], ledger: Ledger
) -> list[ArchPart]:
    """Draw every part's errors from its own generator, write them down, and return the parts as built."""
    found = []
    for number, (part, rng) in enumerate(zip(parts, rngs, strict=True)):
        scale = np.array([params.length_mm, 1e-3 * params.skew_mrad, 1e-3 * params.skew_mrad])
        ends = rng.standard_normal((2, 3)) * scale
        twist = 1e-3 * params.twist_mrad * rng.standard_normal()
        bow, section = params.bow_mm * rng.standard_normal(2), params.section_mm * rng.standard_normal(2)
        thick = params.plate_mm * rng.standard_normal(3)
        phases = rng.uniform(0.0, 2.0 * np.pi, 4)
        waves = params.waviness_mm * rng.standard_normal(4)
        corners = params.corner_mm * rng.standard_normal((2, 4, 3)) if params.corner_mm else np.zeros((2, 4, 3))
        for i, end in enumerate(("start", "end")):
            ledger.note("length error", f"{part.name} {end}", ends[i, 0], "mm")
            ledger.note("skew about the vertical", f"{part.name} {end}", ends[i, 1], "rad")
            ledger.note("skew about the horizontal", f"{part.name} {end}", ends[i, 2], "rad")
            for k, axis in np.ndindex(4, 3) if params.corner_mm else ():
                what = f"corner P{k + 1}, {('along', 'left', 'up')[axis]}"
                ledger.note(what, f"{part.name} {end}", corners[i, k, axis], "mm")
        for what, value in zip(("bow sideways", "bow upward", "width", "height"), (*bow, *section), strict=True):
            ledger.note(what, part.name, value, "mm")
        ledger.note("twist", part.name, twist, "rad")
        plates = Plates(*(np.array([part.plates.bottom, part.plates.top, part.plates.web]) + thick).tolist())
        if params.plate_mm:
            _check_plates(part, plates)
        _check_section(part, section)
        for what, value in zip(("bottom plate", "top plate", "web plate"), thick, strict=True):
            ledger.note(what, part.name, value, "mm")
        walls = ("bottom", "top", "left", "right")
        taken: list[_Spot] = []
        errors = ArchErrors(
            ends,
            twist,
            (float(bow[0]), float(bow[1])),
            (float(section[0]), float(section[1])),
            {
                w: _Wave(float(a), float(p), params.waviness_length_mm)
                for w, a, p in zip(walls, waves, phases, strict=True)
            },
            tuple(_dent(part, params, rng, ledger, taken) for _ in range(_share(params.dents, number, len(parts)))),
            corners,
        )
        holes = tuple(
            _hole(part, params, rng, ledger, taken) for _ in range(_share(params.missing_pieces, number, len(parts)))
        )
        found.append(fabricate(part, errors, plates, holes))
    return found


def _sizes(part: ArchPart) -> tuple[float, float]:
    """Return the least width and height of a part as designed."""
    return 2.0 * float(part.half_widths.min()), float(part.heights.min())


def _check_plates(part: ArchPart, plates: Plates) -> None:
    """Raise UsageError for drawn plates that are too thin or fill the part."""
    width, height = _sizes(part)
    for what, thick in zip(("bottom", "top", "web"), dataclasses.astuple(plates), strict=True):
        if thick < LEAST_PLATE_MM:
            raise UsageError(
                f"asbuilt.plate_mm: expected plates of {LEAST_PLATE_MM:g} mm at least, drew a {what} plate of "
                f"{thick:.1f} mm for {part.name}; ask for smaller errors of plates"
            )
    for what, both, size in (
        ("bottom and top", plates.bottom + plates.top, height),
        ("two web", 2.0 * plates.web, width),
    ):
        if both > 0.9 * size:
            raise UsageError(
                f"asbuilt.plate_mm: expected plates that leave {part.name} hollow, drew {what} plates of {both:.1f} mm "
                f"together where the section measures {size:g} mm; ask for smaller errors of plates"
            )


def _check_section(part: ArchPart, section: Floats) -> None:
    """Raise UsageError for a drawn section much smaller than designed."""
    for what, error, size in zip(("width", "height"), section, _sizes(part), strict=True):
        if size + error < LEAST_SHARE * size:
            raise UsageError(
                f"asbuilt.section_mm: expected at least half of {part.name}'s section, drew an error of its {what} "
                f"of {error:.1f} mm where it measures {size:g} mm; ask for smaller errors of sections"
            )


def _share(count: int, number: int, of: int) -> int:
    """How many of ``count`` things fall to a part: the middle parts first."""
    order = [of // 2, *(i for i in range(of) if i != of // 2)]
    return count // of + (order.index(number) < count % of)


def _on_web(part: ArchPart, size: float, rng: np.random.Generator, taken: list[_Spot]) -> _Spot:
    """Draw a place on a web's constant section, ``size`` away from every edge and apart from those taken; take it."""
    s0, s1 = part.constant_section()
    h = float(part.h(np.array(s0)))
    low, high = part.plates.bottom + 1.2 * size, h - part.plates.top - 1.2 * size
    if low > high or s1 - s0 < 3.0 * size:
        raise UsageError(f"asbuilt: dents and missing pieces of {size:g} mm do not fit on a web of {part.name}")
    for _ in range(MOST_DRAWS):
        wall = ("left", "right")[int(rng.integers(2))]
        spot = _Spot(wall, rng.uniform(s0 + 1.5 * size, s1 - 1.5 * size), rng.uniform(low, high), size)
        if all(spot.apart(other) for other in taken):
            taken.append(spot)
            return spot
    raise UsageError(
        f"asbuilt.dents, missing_pieces: {len(taken) + 1} of them do not fit on the webs of {part.name} apart from "
        "each other; ask for fewer or smaller ones"
    )


def _dent(part: ArchPart, params: ArchParams, rng: np.random.Generator, ledger: Ledger, taken: list[_Spot]) -> _Dent:
    spot = _on_web(part, params.dent_radius_mm, rng, taken)
    where = spot.where(part)
    depth = ledger.note("dent, depth", where, params.dent_depth_mm, "mm")
    return _Dent(spot.wall, spot.s, spot.v, depth, ledger.note("dent, radius", where, params.dent_radius_mm, "mm"))


def _hole(part: ArchPart, params: ArchParams, rng: np.random.Generator, ledger: Ledger, taken: list[_Spot]) -> Hole:
    half = 0.5 * params.missing_size_mm
    spot = _on_web(part, half, rng, taken)
    ledger.note("missing piece, side", spot.where(part), params.missing_size_mm, "mm")
    return Hole(spot.wall, spot.s - half, spot.s + half, spot.v - half, spot.v + half)


# --- space frames -------------------------------------------------------------------------------------------------


def frame(nominal: Frame, params: FrameParams, rng: np.random.Generator, ledger: Ledger) -> Frame:
    """Draw a frame's errors, write them down, and return the frame as built, at its temperature.

    Raises UsageError for more wrong balls or missing bolts than there are, and for errors that leave no room to build.
    """
    count, members = len(nominal.centres), len(nominal.members)
    for key, most, of in (("wrong_sizes", count, "balls"), ("missing_bolts", 2 * members, "bolts")):
        if getattr(params, key) > most:
            raise UsageError(f"asbuilt.{key}: expected at most {most}, all {of}, got {getattr(params, key)}")
    grown = expansion(params.temperature_C)
    centres = (nominal.centres + params.node_movement_mm * rng.standard_normal((count, 3))) * grown
    radii = nominal.radii + params.radius_mm * rng.standard_normal(count)
    sizes = np.unique(nominal.radii)
    wrong = rng.permutation(count)[: params.wrong_sizes]
    for node in np.sort(wrong):
        larger = sizes[sizes > nominal.radii[node]]
        radii[node] += (larger[0] if len(larger) else nominal.radii[node] + 10.0) - nominal.radii[node]
        ledger.note("wrong size, radius", f"ball {node}", radii[node] * grown, "mm")
    radii = radii * grown
    along = centres[nominal.members[:, 1]] - centres[nominal.members[:, 0]]
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    side = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit), axis=1)])
    side /= np.linalg.norm(side, axis=1)[:, None]
    other = np.cross(unit, side)

    def across(draws: Floats) -> Floats:
        moved: Floats = draws[..., 0, None] * side[:, None] + draws[..., 1, None] * other[:, None]
        return moved

    offsets = across(params.eccentricity_mm * rng.standard_normal((members, 2, 2)))
    angle = rng.uniform(0.0, 2.0 * np.pi, members)
    joined = nominal.connection.scaled(grown)
    built = dataclasses.replace(nominal, centres=centres, radii=radii, offsets=offsets, connection=joined)
    try:
        tubes = built.tube_lengths()
    except UsageError as error:
        raise UsageError(f"asbuilt: this frame cannot be built with errors so large: {error}") from error
    bow = params.bow_share * tubes * rng.uniform(0.0, 1.0, members)
    bows = bow[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    missing = np.zeros((members, 2), bool)
    for place in np.sort(rng.permutation(2 * members)[: params.missing_bolts]):
        missing[place // 2, place % 2] = True
        node = nominal.members[place // 2, place % 2]
        ledger.note("missing bolt, member", f"ball {node}", float(place // 2), "row")
    if params.bow_share or params.eccentricity_mm:
        for m in range(members):
            ledger.note("bow", f"member {m}", bow[m], "mm")
            for end in range(2):
                size = float(np.linalg.norm(offsets[m, end]))
                ledger.note("eccentricity", f"member {m} end {end}", size, "mm")
    return dataclasses.replace(built, bows=bows, missing=missing)
