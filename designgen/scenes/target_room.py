"""Scenes of rooms with targets: checkerboards on walls and columns, spheres on posts, and things that look alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.checks import expect
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scanning import survey
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from processor.model import Control, Floats, Scene, TargetKind, TargetSearch, TargetTruth, Truth, UsageError

WALL, FLOOR, STEEL, WHITE, BLACK = 1.1, 0.7, 0.5, 1.8, 0.1  # multiples of the scan's reflectance
# Board's thickness; column's side; least distance and rim of targets: chosen, no two images overlap.
OFF_WALL_MM, COLUMN_MM, APART_MM, BORDER_MM = 4.0, 300.0, 700.0, 15.0
MOST_DRAWS = 500  # work: far more than a room that has space for its targets takes
DECOYS = ("edge", "square", "corner", "stripes", "cross", "chess", "disc", "diagonal")


@dataclass(frozen=True)
class Params:
    """A room, its targets, and the number of decoys; lengths in mm."""

    length_mm: float = 16_000.0
    width_mm: float = 9_000.0
    height_mm: float = 5_000.0
    columns: int = 4
    checkerboards: int = 8
    checkerboard_mm: float = 150.0  # side of the square of four fields
    spheres: int = 4
    sphere_radius_mm: float = 72.5
    decoys: int = 16
    surveyed_mm: float = 0.3  # standard deviation of the targets' known coordinates along each axis

    def __post_init__(self) -> None:
        for key in ("length_mm", "width_mm", "height_mm", "checkerboard_mm", "sphere_radius_mm", "surveyed_mm"):
            expect(getattr(self, key) > 0.0, f"room.{key}", getattr(self, key), "above 0")
        for key in ("columns", "checkerboards", "spheres", "decoys"):
            expect(getattr(self, key) >= 0, f"room.{key}", getattr(self, key), "0 or more")


@dataclass(frozen=True)
class _Face:
    """A plane face of the room: corner, two unit directions with their lengths; their cross product looks inside."""

    corner: Floats
    along: Floats
    up: Floats
    length: float
    height: float

    @property
    def inward(self) -> Floats:
        return np.cross(self.along, self.up)


def make(name: str, recipe: Mapping[str, Any], scanning: Scanning, seed: int) -> tuple[Scene, Truth]:
    """Make the scene of a room. The known coordinates of all targets are its control points, seen in no scan yet."""
    if not isinstance(scanning, ByRays):
        raise UsageError('room: targets are seen by their intensity; set scan.mode = "rays"')
    room, params = filled(Params, recipe, "room"), scanning.params
    builder = Builder()
    faces = _room(builder, room)
    taken: list[Floats] = []
    rng = generator(seed, "targets")
    ids, kinds, places = [], [], []
    for i in range(room.checkerboards):
        place, frame = _on_face(faces, room.checkerboard_mm, taken, rng)
        # Two by two fields with a white border
        half = 0.5 * room.checkerboard_mm
        colours = np.full((4, 4), WHITE)
        colours[1, 1] = colours[2, 2] = BLACK
        edges = np.array([-half - BORDER_MM, -half, 0.0, half, half + BORDER_MM])
        _fields(builder, f"checkerboard {i + 1}", place, frame, edges, colours)
        ids.append(f"K{i + 1}")
        kinds.append(TargetKind.CHECKERBOARD)
        places.append(place)
    for i in range(room.spheres):
        place = _sphere(builder, f"sphere {i + 1}", room, taken, rng)
        ids.append(f"B{i + 1}")
        kinds.append(TargetKind.SPHERE)
        places.append(place)
    of_decoys = generator(seed, "decoys")
    for i in range(room.decoys):
        place, frame = _on_face(faces, 2.0 * room.checkerboard_mm, taken, of_decoys)
        _decoy(builder, DECOYS[i % len(DECOYS)], f"decoy {i + 1}", place, frame, room.checkerboard_mm)
    surveyed = survey.survey(builder.to_surfaces(), (), _stations(room, params, seed), scanning.device, params, seed)
    scans, labels, stations, truth = survey.in_project(surveyed, params, registered=params.registered)
    positions = np.array(places).reshape(-1, 3) + np.array(params.origin_mm)
    known = positions + room.surveyed_mm * generator(seed, "survey of targets").standard_normal(positions.shape)
    scene = Scene(
        name, "structure", scans, stations=stations,
        control=Control(tuple(ids), positions=known, sd=np.full(len(ids), room.surveyed_mm)) if ids else None,
        target_search=TargetSearch(
            room.checkerboard_mm if room.checkerboards else np.nan, room.sphere_radius_mm if room.spheres else np.nan
        ),
    )  # fmt: skip
    return scene, Truth(labels, stations=truth, targets=TargetTruth(tuple(ids), tuple(map(str, kinds)), positions))


def _room(builder: Builder, room: Params) -> list[_Face]:
    """Add walls, floor, ceiling and columns; return the faces that targets hang on."""
    x, y, z = np.eye(3)
    size = np.array([room.length_mm, room.width_mm, room.height_mm])
    zero = np.zeros(3)
    faces = [
        _Face(size * [1, 0, 0], -x, z, size[0], size[2]),  # y = 0, looks along +y
        _Face(size * [0, 1, 0], x, z, size[0], size[2]),
        _Face(zero, y, z, size[1], size[2]),  # x = 0
        _Face(size * [1, 1, 0], -y, z, size[1], size[2]),
    ]
    for number, face in enumerate(faces):
        builder.polygon(-1, f"wall {number + 1}", _corners(face), WALL)
    plan = size * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    builder.polygon(-1, "floor", plan, FLOOR)
    builder.polygon(-1, "ceiling", plan + size * z, WALL)
    for i in range(room.columns):
        at = np.array([(i + 1) / (room.columns + 1) * size[0], (0.3 if i % 2 else 0.7) * size[1], 0.0])
        for along, across in ((x, y), (y, -x), (-x, -y), (-y, x)):
            corner = at + 0.5 * COLUMN_MM * (across - along) + COLUMN_MM * along
            face = _Face(corner, -along, z, COLUMN_MM, size[2])
            builder.polygon(-1, f"column {i + 1}", _corners(face), STEEL)
            faces.append(face)
    return faces


def _corners(face: _Face) -> Floats:
    a, b = face.length * face.along, face.height * face.up
    return np.array([face.corner, face.corner + a, face.corner + a + b, face.corner + b])


def _on_face(
    faces: list[_Face], size: float, taken: list[Floats], rng: np.random.Generator
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Draw a place (3,) on a face for something of a size, apart from all others, and its two directions."""
    weights = np.array([face.length * face.height * (face.length > 1.6 * size) for face in faces])
    for _ in range(MOST_DRAWS):
        face = faces[int(rng.choice(len(faces), p=weights / weights.sum()))]
        reach = 0.75 * size + BORDER_MM
        along = rng.uniform(min(reach, 0.5 * face.length), max(face.length - reach, 0.5 * face.length))
        up = rng.uniform(400.0 + reach, min(face.height - reach, 3_200.0))
        place = face.corner + along * face.along + up * face.up + OFF_WALL_MM * face.inward
        if all(np.linalg.norm(place - other) > APART_MM for other in taken):
            break
    taken.append(place)
    turn = rng.uniform(-0.3, 0.3)
    first = np.cos(turn) * face.along + np.sin(turn) * face.up
    return place, (first, np.cross(face.inward, first))


def _fields(
    builder: Builder, name: str, place: Floats, frame: tuple[Floats, Floats], edges: Floats, colours: Floats
) -> None:
    """Add a board of fields: ``edges`` (n + 1,) of its square cells, ``colours`` (n, n) their albedos."""
    for i in range(len(edges) - 1):
        for j in range(len(edges) - 1):
            box = np.array([[edges[i], edges[j]], [edges[i + 1], edges[j + 1]]])
            # A rectangle along the two directions of the frame about the place
            (a, b), (c, d) = box
            plan = np.array([[a, b], [c, b], [c, d], [a, d]])
            builder.polygon(-1, f"{name} {i}{j}", place + plan @ np.array(frame), float(colours[i, j]))


def _decoy(builder: Builder, kind: str, name: str, place: Floats, frame: tuple[Floats, Floats], size: float) -> None:
    """Add something that looks like a target in part."""
    half = 0.5 * size
    if kind == "chess":  # four by four fields, of the size of a target's fields
        edges = np.linspace(-size, size, 5)
        colours = np.where(np.indices((4, 4)).sum(axis=0) % 2, BLACK, WHITE)
    elif kind == "corner":  # one dark field, three bright ones
        edges, colours = np.array([-half, 0.0, half]), np.array([[BLACK, WHITE], [WHITE, WHITE]])
    elif kind == "edge":
        edges, colours = np.array([-half, 0.0, half]), np.array([[BLACK, BLACK], [WHITE, WHITE]])
    elif kind == "stripes":
        edges = np.linspace(-half, half, 7)
        colours = np.where(np.indices((6, 6))[0] % 2, BLACK, WHITE)
    elif kind == "cross":  # dark lines, as of a window
        edges = np.array([-half, -0.1 * half, 0.1 * half, half])
        colours = np.array([[WHITE, BLACK, WHITE], [BLACK, BLACK, BLACK], [WHITE, BLACK, WHITE]])
    elif kind == "diagonal":  # two dark fields that do not touch
        edges = np.array([-half, -0.35 * half, 0.35 * half, half])
        colours = np.array([[BLACK, WHITE, WHITE], [WHITE, WHITE, WHITE], [WHITE, WHITE, BLACK]])
    else:  # square, disc: one dark field on white
        edges = np.array([-size, -half, half, size])
        colours = np.array([[WHITE, WHITE, WHITE], [WHITE, BLACK, WHITE], [WHITE, WHITE, WHITE]])
    if kind == "disc":
        inward = np.cross(*frame)
        builder.disc(-1, name, place, inward, half)
        return
    _fields(builder, name, place, frame, edges, colours)


def _sphere(builder: Builder, name: str, room: Params, taken: list[Floats], rng: np.random.Generator) -> Floats:
    """Add a sphere on a post that stands on the floor; return its centre (3,)."""
    for _ in range(MOST_DRAWS):
        at = np.array([rng.uniform(0.08, 0.92) * room.length_mm, rng.uniform(0.1, 0.9) * room.width_mm, 0.0])
        at[2] = rng.uniform(600.0, 1_900.0)
        if all(np.linalg.norm(at - other) > 2.0 * APART_MM for other in taken):
            break
    taken.append(at)
    post = at[2] - 0.99 * room.sphere_radius_mm
    builder.sphere(-1, name, at, room.sphere_radius_mm, [], WHITE)
    builder.cone(-1, f"{name} post", at * [1, 1, 0], np.array([0.0, 0.0, 1.0]), (12.0, 12.0), post)
    return at


def _stations(room: Params, params: Any, seed: int) -> dict[str, Floats]:
    """Return poses of levelled scanners along the room, alternately left and right of its middle."""
    poses = {}
    count = int(np.prod(params.stations))
    for i in range(count):
        rng = generator(seed, f"place S{i + 1}")
        share = (i + 0.5) / count
        at = np.array([share * room.length_mm, (0.42 if i % 2 else 0.58) * room.width_mm, params.height_mm])
        at[:2] += rng.uniform(-300.0, 300.0, 2)
        poses[f"S{i + 1}"] = survey.levelled_pose(at, rng.uniform(0.0, 2.0 * np.pi))
    return poses
