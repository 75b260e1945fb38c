"""Imperfections of arch parts and space frames: each a function of the design's numbers, with its truth.

No mesh is involved. A part as built is the closed form of its design with displaced coordinates; a frame as built is
the design's table of nodes and members with other numbers.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from designgen.checks import expect
from designgen.designs.arch_part import ArchPart, Hole, Plates
from designgen.designs.space_frame import Frame
from processor.model import AsBuilt, Floats, UsageError

EXPANSION_PER_K = 12e-6  # of structural steel (EN 1993-1-1, 3.2.6)
MOST_GAP_MM = 500.0  # chosen: no joint is welded across as much: a number was mistyped
CORNER_REACH_MM = 1500.0  # distance from an end over which the errors of its corners fade out
REFERENCE_C = 20.0  # at which a design's lengths hold (ISO 1)
MOST_DRAWS = 200  # attempts to find a place for a dent or a missing piece
LEAST_PLATE_MM = 2.0  # chosen: thinner than any plate of a bridge, so that its two sides stay apart
LEAST_SHARE = 0.5  # least size of a section as a fraction of its design
MOST_FILLED = 0.9  # largest fraction of a section's size that plates may take


@dataclass(frozen=True)
class ArchParams:
    """Deviations of arch parts from their design: standard deviations; counts and sizes of damage are used as given."""

    length_mm: float = 0.0  # of each end, along the part
    skew_mrad: float = 0.0  # of each end, about both axes of its section
    twist_mrad: float = 0.0  # between the ends
    bow_mm: float = 0.0  # sideways and upward, at the middle
    section_mm: float = 0.0  # width and height
    plate_mm: float = 0.0  # thickness of each plate; at least LEAST_PLATE_MM is left
    corner_mm: float = 0.0  # of each corner of each end along all axes, as from cutting and welding
    waviness_mm: float = 0.0  # amplitude on each wall
    waviness_length_mm: float = 1500.0
    dents: int = 0  # total of all parts
    dent_depth_mm: float = 8.0
    dent_radius_mm: float = 150.0
    missing_pieces: int = 0  # rectangles cut from webs, total of all parts
    missing_size_mm: float = 250.0
    temperature_C: float = REFERENCE_C
    gap_table_mm: tuple[float, ...] = ()  # gaps of P1 to P4 along, to the left and up, joint after joint

    def __post_init__(self) -> None:
        _check(self)


@dataclass(frozen=True)
class FrameParams:
    """Deviations of a frame from its design."""

    node_movement_mm: float = 0.0  # standard deviation along each axis
    sag_mm: float = 0.0  # of the middle of the plan against its edges, by a parabola along either side
    wrong_sizes: int = 0  # number of balls of another size than designed
    radius_mm: float = 0.0  # standard deviation of a ball's radius
    eccentricity_mm: float = 0.0  # of each member's ends from the nodes, standard deviation across the axis
    bow_share: float = 0.0  # of tubes, uniform up to this fraction of their length (1/1000 is common)
    missing_bolts: int = 0  # number of members' ends without sleeve
    temperature_C: float = REFERENCE_C

    def __post_init__(self) -> None:
        _check(self)


def _check(params: ArchParams | FrameParams) -> None:
    for key in params.__dataclass_fields__:
        value = getattr(params, key)
        if key == "temperature_C":
            expect(-60.0 <= value <= 200.0, f"asbuilt.{key}", value, "-60 to 200")
        elif key == "gap_table_mm":
            known = all(-MOST_GAP_MM <= gap <= MOST_GAP_MM for gap in value)
            expect(
                known and len(value) % 12 == 0,
                f"asbuilt.{key}",
                value,
                f"12 numbers per joint, each to {MOST_GAP_MM:g}",
            )
        else:
            expect(value >= 0, f"asbuilt.{key}", value, "0 or more")


def expansion(temperature_C: float) -> float:
    """Return the ratio of the lengths of steel at a temperature to those at REFERENCE_C."""
    return 1.0 + EXPANSION_PER_K * (temperature_C - REFERENCE_C)


def stated(temperature_C: float) -> float:
    """Return the temperature to store in a scene: NaN (not given) for the reference temperature."""
    return temperature_C if temperature_C != REFERENCE_C else float("nan")


@dataclass
class Ledger:
    """Collects the imperfections, a row each."""

    rows: list[tuple[str, str, float, str]] = field(default_factory=list)

    def note(self, imperfection: str, where: str, value: float, unit: str) -> None:
        """Add a row."""
        self.rows.append((imperfection, where, float(value), unit))

    def note_corners(self, what: str, where: str, corners: Floats) -> None:
        """Add rows of what the corners P1 to P4 (4, 3) of an end are off along, to the left and up, mm."""
        for k, axis in np.ndindex(4, 3):
            self.note(f"{what} P{k + 1}, {('along', 'left', 'up')[axis]}", where, corners[k, axis], "mm")

    def record(self) -> AsBuilt:
        """Return the rows as the truth's record."""
        imperfection, where, value, unit = zip(*self.rows, strict=True) if self.rows else ((), (), (), ())
        return AsBuilt(imperfection, where, np.array(value, np.float64), unit)


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
    """A damaged square on a web: middle (s, v), side 2 ``half``, mm."""

    wall: str
    s: float
    v: float
    half: float

    def disjoint(self, spot: _Spot) -> bool:
        """Return whether two squares do not overlap."""
        reach = self.half + spot.half
        return self.wall != spot.wall or abs(self.s - spot.s) >= reach or abs(self.v - spot.v) >= reach

    def where(self, part: ArchPart) -> str:
        """Return the place as text for the ledger."""
        return f"{part.name} {self.wall} web, {self.s - part.s0:.0f} mm from the start, {self.v:.0f} mm up"


@dataclass(frozen=True)
class ArchErrors:
    """The errors of one part, mm and rad."""

    ends: Floats  # (2, 3): length, skew about the vertical and about the horizontal axis of the section
    twist: float
    bow: Floats  # (2,) sideways, upward
    section: Floats  # (2,) width, height
    waves: dict[str, tuple[float, float]]  # amplitude and phase by wall
    wave_length: float
    dents: tuple[_Dent, ...] = ()
    corners: Floats = field(default_factory=lambda: np.zeros((2, 4, 3)))  # of P1 to P4 at each end: along, left, up


def fabricate(part: ArchPart, errors: ArchErrors, plates: Plates, holes: tuple[Hole, ...] = ()) -> ArchPart:
    """Return the part as built: errors of ends, twist, bow, section and corners, waves and dents."""
    s0, span = part.s0, part.s1 - part.s0

    def built(s: Floats, u: Floats, v: Floats, wall: str) -> tuple[Floats, Floats, Floats]:
        q, b, h = (s - s0) / span, part.b(s), part.h(s)  # q runs from 0 at the start to 1 at the end
        # Waves and dents displace a wall along its normal; they vanish at its edges, where walls join.
        if wall:
            flat = wall in ("bottom", "top")
            c, across = (u, u / b) if flat else (v, 2.0 * v / h - 1.0)
            near_end = np.clip(np.minimum(q, 1.0 - q) * span / 500.0, 0.0, 1.0)
            amplitude, phase = errors.waves[wall]
            window = np.maximum(1.0 - across**2, 0.0) * near_end**2
            move = amplitude * np.sin(2.0 * np.pi * s / errors.wave_length + phase) * window
            for dent in errors.dents:
                if dent.wall == wall:
                    share = ((s - dent.s) ** 2 + (c - dent.c) ** 2) / dent.radius**2
                    move = move - dent.depth * np.where(share < 1.0, (1.0 - np.minimum(share, 1.0)) ** 2, 0.0)
            outward = {"bottom": -1.0, "top": 1.0, "left": 1.0, "right": -1.0}[wall] * move
            u, v = (u, v + outward) if flat else (u + outward, v)
        width, height = errors.section
        vc = v - 0.5 * h  # height above the middle of the section
        u, vc = u * (1.0 + 0.5 * width / b), vc * (1.0 + height / h)
        first, last = errors.ends
        s = s + (1.0 - q) * (first[0] + first[1] * u + first[2] * vc) + q * (last[0] + last[1] * u + last[2] * vc)
        along, left, up = _corner_displacement(errors.corners, u / b, 2.0 * vc / h, q * span, (1.0 - q) * span)
        s, u, vc = s + along, u + left, vc + up
        angle = errors.twist * (q - 0.5)
        u, vc = u * np.cos(angle) - vc * np.sin(angle), u * np.sin(angle) + vc * np.cos(angle)
        bend = np.sin(np.pi * q)
        return s, u + errors.bow[0] * bend, vc + 0.5 * h + errors.bow[1] * bend

    return dataclasses.replace(part, plates=plates, built=built, holes=holes)


def _corner_displacement(corners: Floats, a: Floats, c: Floats, from_start: Floats, from_end: Floats) -> Floats:
    """Return displacements (3, n) due to the corners' (2, 4, 3): bilinear over the section, fading out along the part.

    ``a`` and ``c`` (n,) run from -1 to 1 across the section, to the left and upward.
    """
    left, up = 0.5 * (1.0 + a), 0.5 * (1.0 + c)
    shares = np.stack([left * (1.0 - up), (1.0 - left) * (1.0 - up), (1.0 - left) * up, left * up])
    result = np.zeros((3, len(a)))
    for end, distance in enumerate((from_start, from_end)):
        x = np.clip(distance / CORNER_REACH_MM, 0.0, 1.0)
        result += (1.0 - x) ** 2 * (1.0 + 2.0 * x) * (corners[end].T @ shares)
    return result


def arch(
    parts: tuple[ArchPart, ...], params: ArchParams, rngs: list[np.random.Generator], ledger: Ledger
) -> list[ArchPart]:
    """Draw the errors of every part from its generator, add them to the ledger, and return the parts as built.

    Raises UsageError for drawn plates or sections that cannot be built, and for damage that does not fit on the webs.
    """
    if params.gap_table_mm:
        expect(len(params.gap_table_mm) == 12 * (len(parts) - 1), "asbuilt.gap_table_mm", len(params.gap_table_mm),
               f"{12 * (len(parts) - 1)} numbers for {len(parts) - 1} joints")  # fmt: skip
    built = []
    for number, (part, rng) in enumerate(zip(parts, rngs, strict=True)):
        errors, plates = _draw_errors(part, params, rng, ledger)
        errors = dataclasses.replace(errors, corners=errors.corners + _of_table(part, number, params, ledger))
        damaged: list[_Spot] = []
        dents = _share(params.dents, number, len(parts))
        errors = dataclasses.replace(
            errors, dents=tuple(_dent(part, params, rng, ledger, damaged) for _ in range(dents))
        )
        pieces = _share(params.missing_pieces, number, len(parts))
        holes = tuple(_hole(part, params, rng, ledger, damaged) for _ in range(pieces))
        built.append(fabricate(part, errors, plates, holes))
    return built


def _of_table(part: ArchPart, number: int, params: ArchParams, ledger: Ledger) -> Floats:
    """Return the errors of corners (2, 4, 3) that open the joint before part ``number`` by the gaps of the table."""
    corners = np.zeros((2, 4, 3))
    if params.gap_table_mm and number:
        corners[0] = np.reshape(params.gap_table_mm, (-1, 4, 3))[number - 1]
        ledger.note_corners("gap", f"{part.name} start", corners[0])
    return corners


def _draw_errors(
    part: ArchPart, params: ArchParams, rng: np.random.Generator, ledger: Ledger
) -> tuple[ArchErrors, Plates]:
    """Draw one part's errors but its damage, and its plates, and add them to the ledger."""
    scale = np.array([params.length_mm, 1e-3 * params.skew_mrad, 1e-3 * params.skew_mrad])
    ends = rng.standard_normal((2, 3)) * scale
    twist = 1e-3 * params.twist_mrad * rng.standard_normal()
    bow, section = params.bow_mm * rng.standard_normal(2), params.section_mm * rng.standard_normal(2)
    thickness = params.plate_mm * rng.standard_normal(3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    amplitudes = params.waviness_mm * rng.standard_normal(4)
    corners = params.corner_mm * rng.standard_normal((2, 4, 3)) if params.corner_mm else np.zeros((2, 4, 3))
    for i, end in enumerate(("start", "end")):
        ledger.note("length error", f"{part.name} {end}", ends[i, 0], "mm")
        ledger.note("skew about the vertical", f"{part.name} {end}", ends[i, 1], "rad")
        ledger.note("skew about the horizontal", f"{part.name} {end}", ends[i, 2], "rad")
        if params.corner_mm:
            ledger.note_corners("corner", f"{part.name} {end}", corners[i])
    for size, value in zip(("bow sideways", "bow upward", "width", "height"), (*bow, *section), strict=True):
        ledger.note(size, part.name, value, "mm")
    ledger.note("twist", part.name, twist, "rad")
    plates = Plates(*(np.array(dataclasses.astuple(part.plates)) + thickness).tolist())
    if params.plate_mm:
        _check_plates(part, plates)
    _check_section(part, section)
    for plate, value in zip(("bottom plate", "top plate", "web plate"), thickness, strict=True):
        ledger.note(plate, part.name, value, "mm")
    waves = dict(zip(("bottom", "top", "left", "right"), zip(amplitudes, phases, strict=True), strict=True))
    errors = ArchErrors(
        ends=ends, twist=twist, bow=bow, section=section, waves=waves, wave_length=params.waviness_length_mm,
        corners=corners,
    )  # fmt: skip
    return errors, plates


def _sizes(part: ArchPart) -> tuple[float, float]:
    """Return the least width and height of a part as designed."""
    return 2.0 * float(part.half_widths.min()), float(part.heights.min())


def _check_plates(part: ArchPart, plates: Plates) -> None:
    """Raise UsageError for drawn plates that are too thin or fill the part."""
    width, height = _sizes(part)
    for plate, thickness in dataclasses.asdict(plates).items():
        if thickness < LEAST_PLATE_MM:
            raise UsageError(
                f"asbuilt.plate_mm: expected plates of {LEAST_PLATE_MM:g} mm at least, drew a {plate} plate of "
                f"{thickness:.1f} mm for {part.name}; give smaller errors of plates"
            )
    pairs = (("bottom and top", plates.bottom + plates.top, height), ("two web", 2.0 * plates.web, width))
    for pair, both, size in pairs:
        if both > MOST_FILLED * size:
            raise UsageError(
                f"asbuilt.plate_mm: expected plates that leave {part.name} hollow, drew {pair} plates of {both:.1f} mm "
                f"together where the section measures {size:g} mm; give smaller errors of plates"
            )


def _check_section(part: ArchPart, section: Floats) -> None:
    """Raise UsageError for a drawn section much smaller than designed."""
    for side, error, size in zip(("width", "height"), section, _sizes(part), strict=True):
        if size + error < LEAST_SHARE * size:
            raise UsageError(
                f"asbuilt.section_mm: expected at least half of {part.name}'s section, drew an error of its {side} "
                f"of {error:.1f} mm where it measures {size:g} mm; give smaller errors of sections"
            )


def _share(count: int, number: int, of: int) -> int:
    """Return how many of ``count`` things are on part ``number`` of ``of``; the middle part is served first."""
    order = [of // 2, *(i for i in range(of) if i != of // 2)]
    return count // of + (order.index(number) < count % of)


def _on_web(part: ArchPart, size: float, rng: np.random.Generator, damaged: list[_Spot]) -> _Spot:
    """Draw a spot on a web's constant section, ``size`` from every edge and disjoint from ``damaged``; add it there."""
    s0, s1 = part.constant_section()
    h = float(part.h(np.array(s0)))
    low, high = part.plates.bottom + 1.2 * size, h - part.plates.top - 1.2 * size
    if low > high or s1 - s0 < 3.0 * size:
        raise UsageError(f"asbuilt: dents and missing pieces of {size:g} mm do not fit on a web of {part.name}")
    for _ in range(MOST_DRAWS):
        wall = ("left", "right")[int(rng.integers(2))]
        spot = _Spot(wall, rng.uniform(s0 + 1.5 * size, s1 - 1.5 * size), rng.uniform(low, high), size)
        if all(spot.disjoint(earlier) for earlier in damaged):
            damaged.append(spot)
            return spot
    raise UsageError(
        f"asbuilt.dents, missing_pieces: {len(damaged) + 1} of them do not fit on the webs of {part.name} apart from "
        "each other; give fewer or smaller ones"
    )


def _dent(part: ArchPart, params: ArchParams, rng: np.random.Generator, ledger: Ledger, damaged: list[_Spot]) -> _Dent:
    spot = _on_web(part, params.dent_radius_mm, rng, damaged)
    ledger.note("dent, depth", spot.where(part), params.dent_depth_mm, "mm")
    ledger.note("dent, radius", spot.where(part), params.dent_radius_mm, "mm")
    return _Dent(spot.wall, spot.s, spot.v, params.dent_depth_mm, params.dent_radius_mm)


def _hole(part: ArchPart, params: ArchParams, rng: np.random.Generator, ledger: Ledger, damaged: list[_Spot]) -> Hole:
    half = 0.5 * params.missing_size_mm
    spot = _on_web(part, half, rng, damaged)
    ledger.note("missing piece, side", spot.where(part), params.missing_size_mm, "mm")
    return Hole(spot.wall, spot.s - half, spot.s + half, spot.v - half, spot.v + half)


# --- space frames -------------------------------------------------------------------------------------------------


def frame(nominal: Frame, params: FrameParams, rng: np.random.Generator, ledger: Ledger) -> Frame:
    """Draw a frame's errors and return the frame as built, at its temperature.

    Wrong sizes, missing bolts, bows and eccentricities are added to the ledger; centres and radii are in the truth's
    table of nodes.

    Raises UsageError for more wrong balls or missing bolts than there are, and for errors too large to build the frame.
    """
    count, members = len(nominal.centres), len(nominal.members)
    for key, most, of in (("wrong_sizes", count, "balls"), ("missing_bolts", 2 * members, "bolts")):
        if getattr(params, key) > most:
            raise UsageError(f"asbuilt.{key}: expected at most {most}, all {of}, got {getattr(params, key)}")
    grown = expansion(params.temperature_C)
    centres = nominal.centres + params.node_movement_mm * rng.standard_normal((count, 3))
    if params.sag_mm:
        plan = nominal.centres[:, :2]
        low, extent = plan.min(axis=0), np.maximum(np.ptp(plan, axis=0), 1e-9)
        centres[:, 2] -= params.sag_mm * np.prod(1.0 - (2.0 * (plan - low) / extent - 1.0) ** 2, axis=1)
        ledger.note("sag of the middle", "frame", params.sag_mm, "mm")
    centres = centres * grown
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
    second_side = np.cross(unit, side)
    draws = params.eccentricity_mm * rng.standard_normal((members, 2, 2))
    offsets = draws[..., 0, None] * side[:, None] + draws[..., 1, None] * second_side[:, None]
    angle = rng.uniform(0.0, 2.0 * np.pi, members)
    connection = nominal.connection.scaled(grown)
    built = dataclasses.replace(nominal, centres=centres, radii=radii, offsets=offsets, connection=connection)
    try:
        tubes = built.tube_lengths()
    except UsageError as error:
        raise UsageError(f"asbuilt: this frame cannot be built with errors so large: {error}") from error
    bow = params.bow_share * tubes * rng.uniform(0.0, 1.0, members)
    bows = bow[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * second_side)
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
