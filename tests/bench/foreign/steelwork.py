"""Steelwork of straight plates: lattice girders half of which moved, a damaged box girder, plates as designed, a hall.

Everything is made of cuboids. Points are drawn on their sides by the density that a station has there, and are measured
where no cuboid is in the way. Noise has heavier tails than a normal law, every cuboid has a bias of its own by its
brightness, edges have mixed pixels, and scans are not in the design's frame. Lengths in mm.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Move = Callable[[Array], Array]  # points (n, 3) as designed to their displacement (n, 3)

SETTINGS: dict[str, float | str] = {
    "case": "deviation",  # deviation | defects | plate | stitch
    "step_mrad": 1.2, "spacing": 8.0, "noise": 0.6, "noise_ppm": 20.0, "bias": 0.1, "beam": 2.0,
    "range_offset": 0.2, "shift": 0.2, "rotation_urad": 15.0, "outliers": 0.0005,
    "moved": 16.0, "length": 15000.0, "damage": 1.0,
    "thickness": 12.0, "sides": 2.0, "bays": 3.0, "hall_step_mrad": 7.0,
}  # fmt: skip
LEAST_COS = 0.12
SIDES = [(axis, sign) for axis in range(3) for sign in (-1.0, 1.0)]
TRUTH_SPACING = 160.0


@dataclass(frozen=True)
class Cuboid:
    """A plate or bar: centre, half sizes, and the axes as columns."""

    centre: Array
    half: Array
    axes: Array

    def side(self, axis: int, sign: float, ab: Array) -> Array:
        """Points (n, 3) on a side at coordinates (n, 2) from -1 to 1."""
        local = np.empty((len(ab), 3))
        local[:, axis] = sign
        local[:, [k for k in range(3) if k != axis]] = ab
        return np.asarray(self.centre + local * self.half @ self.axes.T)


def box(low: Any, high: Any) -> Cuboid:
    """Cuboid between two corners."""
    a, b = np.array(low, float), np.array(high, float)
    return Cuboid((a + b) / 2, (b - a) / 2, np.eye(3))


def bar(a: Any, b: Any, width: float, depth: float, short: float = 0.0) -> Cuboid:
    """Bar between two points of one XZ plane: ``width`` along Y, ``depth`` across; ``short`` less at each end."""
    start, end = np.array(a, float), np.array(b, float)
    along = (end - start) / np.linalg.norm(end - start)
    across = np.cross(along, [0.0, 1.0, 0.0])
    length = float(np.linalg.norm(end - start)) - 2 * short
    return Cuboid(
        (start + end) / 2, np.array([length, width, depth]) / 2, np.stack([along, [0, 1.0, 0], across], axis=1)
    )


def blocked(cuboids: list[Cuboid], points: Array, station: Array) -> Mask:
    """Whether the way from points (n, 3) to a station goes through a cuboid."""
    hidden = np.zeros(len(points), bool)
    for cuboid in cuboids:
        start, way = (points - cuboid.centre) @ cuboid.axes, (station - points) @ cuboid.axes
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.stack([(-cuboid.half - start) / way, (cuboid.half - start) / way])
        enter, leave = np.nanmax(t.min(axis=0), axis=1), np.nanmin(t.max(axis=0), axis=1)
        hidden |= (leave > np.maximum(enter, 0.0)) & (enter < 1.0)
    return hidden


@dataclass(frozen=True)
class Seen:
    """Points (n, 3) as designed that a station sees, normals, distance to the nearest edge, and rows of cuboids."""

    points: Array
    normals: Array
    edge: Array
    cuboid: npt.NDArray[np.int64]


def seen_from(cuboids: list[Cuboid], station: Array, step: float, rng: np.random.Generator) -> Seen:
    """Draw the points that a station sees."""
    found = []
    for k, cuboid in enumerate(cuboids):
        for axis, sign in SIDES:
            normal = sign * cuboid.axes[:, axis]
            off = (station - cuboid.centre) @ cuboid.axes
            if sign * off[axis] <= cuboid.half[axis]:
                continue
            half = np.delete(cuboid.half, axis)
            nearest = float(np.linalg.norm(np.maximum(np.abs(off) - cuboid.half, 0.0)))
            ab = rng.uniform(-1, 1, (rng.poisson(4 * half[0] * half[1] / (step * max(nearest, 300.0)) ** 2), 2))
            points = cuboid.side(axis, sign, ab)
            ray = station - points
            distance = np.linalg.norm(ray, axis=1)
            cos = ray @ normal / distance
            keep = (cos > LEAST_COS) & (rng.random(len(ab)) < cos * (nearest / distance) ** 2)
            keep[keep] = ~blocked(cuboids, points[keep] + 0.05 * normal, station)
            edge = ((1 - np.abs(ab[keep])) * half).min(axis=1, initial=np.inf)
            found.append((points[keep], np.tile(normal, (int(keep.sum()), 1)), edge, np.full(int(keep.sum()), k)))
    return Seen(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def number(settings: dict[str, Any], key: str) -> float:
    """Return a setting as a number."""
    return float(settings[key])


def measured(seen: Seen, built: Array, station: Array, settings: dict[str, Any], rng: np.random.Generator) -> Array:
    """Points as the scanner gives them, of the points as built (n, 3), before the errors of its pose."""
    ray = built - station
    distance = np.linalg.norm(ray, axis=1)
    direction = ray / distance[:, None]
    cos = np.clip(-np.einsum("ni,ni->n", direction, seen.normals), 0.1, 1.0)
    sd = np.hypot(number(settings, "noise"), 1e-6 * number(settings, "noise_ppm") * distance) * cos**-0.35
    wide = np.where(rng.random(len(built)) < 0.08, 2.2, 0.86)
    bias = number(settings, "bias") * np.random.default_rng(5).normal(size=int(seen.cuboid.max()) + 1)
    off = sd * wide * rng.normal(size=len(built)) + bias[seen.cuboid] + number(settings, "range_offset") * rng.normal()
    mixed = (seen.edge < number(settings, "beam")) & (rng.random(len(built)) < 0.35)
    off[mixed] += rng.exponential(20.0, int(mixed.sum()))
    return np.asarray(station + direction * (distance + off)[:, None])


def turned(points: Array, station: Array, settings: dict[str, Any], rng: np.random.Generator) -> Array:
    """Points with the errors of a station's registration."""
    turn = 1e-6 * number(settings, "rotation_urad") * rng.normal(size=3)
    return np.asarray(points + np.cross(turn, points - station) + number(settings, "shift") * rng.normal(size=3))


def thinned(points: Array, spacing: float) -> npt.NDArray[np.int64]:
    """Return the row of one point of each voxel."""
    cell = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    size = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_index=True)
    return np.sort(first)


def by_stations(points: Array, normals: Array, of: npt.NDArray[np.int64], stations: Array,
                settings: dict[str, Any]) -> Array:  # fmt: skip
    """Covariance (6, 6) of the motion, turn about the origin and shift, that errors of stations look like.

    A station, number ``of`` (n,), has a shift, a turn and an offset of ranges; the motion is the one of least squares
    along the normals (n, 3) of steel at rest. Nothing tells it from a movement of the whole.
    """
    J = np.hstack([np.cross(points, normals), normals])
    inverse, total = np.linalg.inv(J.T @ J), np.zeros((6, 6))
    for k, station in enumerate(stations):
        on = of == k
        ray, normal = points[on] - station, normals[on]
        along = np.einsum("ni,ni->n", ray, normal) / np.linalg.norm(ray, axis=1)
        turn = 1e-6 * number(settings, "rotation_urad") * np.cross(ray, normal)
        errors = [number(settings, "shift") * normal, turn, number(settings, "range_offset") * along[:, None]]
        gain = inverse @ (J[on].T @ np.hstack(errors))
        total += gain @ gain.T
    return total


def merged(cuboids: list[Cuboid], stations: Array, move: Move, cut: Callable[[Array], Mask], settings: dict[str, Any],
           rng: np.random.Generator) -> tuple[Array, Array]:  # fmt: skip
    """Return the cloud of all stations, design frame, and the covariance :func:`by_stations` of steel at rest.

    Points in ``cut`` are not there.
    """
    clouds, seen_at = [], []
    for k, station in enumerate(stations):
        seen = seen_from(cuboids, station, 1e-3 * number(settings, "step_mrad"), rng)
        moved = move(seen.points)
        raw = measured(seen, seen.points + moved, station, settings, rng)
        there = ~cut(seen.points)
        clouds.append(turned(raw, station, settings, rng)[there])
        at_rest = (moved == 0.0).all(axis=1)
        seen_at.append(np.column_stack([seen.points, seen.normals, np.full(len(raw), k), at_rest])[there])
    order = rng.permutation(sum(len(cloud) for cloud in clouds))
    points, seen_points = np.concatenate(clouds)[order], np.concatenate(seen_at)[order]
    rows = thinned(points, number(settings, "spacing"))
    steel, rest = points[rows], seen_points[rows][seen_points[rows, 7] > 0.0]
    stray = rng.uniform(steel.min(axis=0), steel.max(axis=0), (int(number(settings, "outliers") * len(steel)), 3))
    covariance = by_stations(rest[:, :3], rest[:, 3:6], rest[:, 6].astype(np.int64), stations, settings)
    return np.concatenate([steel, stray]), covariance


# --- what is built ----------------------------------------------------------------------------------------------------


def lattice(length: float) -> list[Cuboid]:
    """Two lattice girders with purlins; one gusset and one bracket alone tell the ends apart."""
    cuboids, panels = [], 6
    x = np.linspace(0.0, length, panels + 1)
    for y in (0.0, 2600.0):
        cuboids.append(bar([-60, y, 0], [length + 60, y, 0], 180, 180))
        cuboids.append(bar([-60, y, 1800], [length + 60, y, 1800], 200, 160))
        for k in range(panels + 1):
            cuboids.append(bar([x[k], y, 90], [x[k], y, 1720], 110, 110))
        for k in range(panels):
            low, high = (x[k], x[k + 1]) if k < panels / 2 else (x[k + 1], x[k])
            cuboids.append(bar([low, y, 0], [high, y, 1800], 90, 90, short=330.0))
    cuboids += [box([x[k] - 50, 100, 1880], [x[k] + 50, 2500, 1980]) for k in range(panels + 1)]
    cuboids.append(box([x[1] + 200, 90, -40], [x[1] + 620, 104, 300]))
    cuboids.append(box([x[4] - 400, 2496, 40], [x[4] - 180, 2510, 330]))
    return cuboids


def girder() -> list[Cuboid]:
    """Return a box girder with ribs on its webs and brackets, about symmetric; two small parts are single."""
    cuboids = [box([0, -300, 0], [6400, 300, 760])]
    for k, x in enumerate(np.linspace(800, 5600, 5)):
        for sign in (-1.0, 1.0):
            low, high = sorted((sign * 300.0, sign * 430.0))
            cuboids.append(box([x - 7, low, 60], [x + 7, high, 700]))
        if k in (1, 3):
            cuboids.append(box([x - 110, -120, 760], [x + 110, 120, 880]))
    return [*cuboids, box([2430, -120, 760], [2560, 60, 815]), box([5850, 300, 320], [5990, 390, 440])]


@dataclass(frozen=True)
class Bump:
    """A round dent (depth above 0) or bulge on a side of the girder: middle, radius, depth, and outward normal."""

    centre: Array
    radius: float
    depth: float
    normal: Array

    def __call__(self, points: Array) -> Array:
        """Displacement of points: half a wave of the cosine, on the side alone."""
        off = points - self.centre
        r = np.linalg.norm(off, axis=1) / self.radius
        on = (r < 1.0) & (np.abs(off @ self.normal) < 1.0)
        return np.asarray(
            np.where(on, -self.depth * (1 + np.cos(np.pi * np.minimum(r, 1))) / 2, 0.0)[:, None] * self.normal
        )

    @property
    def volume(self) -> float:
        """Volume of the bump, in closed form."""
        return float(np.pi * self.radius**2 * abs(self.depth) * (0.5 - 2.0 / np.pi**2))


def bumps(rng: np.random.Generator) -> list[Bump]:
    """Dents and bulges in fields of the girder's webs and top, one a field at most."""
    fields = [(x, side, z) for x in (400.0, 1400, 2600, 3800, 5000) for side, z in ((-1.0, 380.0), (1.0, 380.0))]
    found = []
    for k in rng.permutation(len(fields))[:7]:
        x, side, z = fields[k]
        radius = rng.uniform(70, 210)
        place = np.array([x + rng.uniform(-80, 80), side * 300.0, z + rng.uniform(-110, 110)])
        depth = rng.uniform(3.0, 12.0) * (1.0 if rng.random() < 0.6 else -1.0)
        found.append(Bump(place, radius, depth, np.array([0.0, side, 0.0])))
    return found


# --- the cases --------------------------------------------------------------------------------------------------------


def nothing(points: Array) -> Mask:
    """No point is cut away."""
    return np.zeros(len(points), bool)


def still(points: Array) -> Array:
    """No movement."""
    return np.zeros_like(points)


def half_moved(length: float, most: float) -> Move:
    """Let the second half sink and swing aside by the square of the distance from the middle."""

    def move(points: Array) -> Array:
        t = np.clip((points[:, 0] - length / 2) / (length / 2), 0.0, None)
        return np.outer(t**2, [0.0, 0.35 * most, -most])

    return move


def around(
    low: Array, high: Array, count: int, away: float, heights: tuple[float, ...], rng: np.random.Generator
) -> Array:
    """Stations (k, 3) around a structure, at heights in turn."""
    turn = 2 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count + 0.4
    half = (high - low)[:2] / 2 + away
    xy = (low + high)[:2] / 2 + half * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.column_stack([xy, np.resize(heights, count) + low[2]])


def surface(cuboids: list[Cuboid], move: Move) -> dict[str, Any]:
    """Truth of a structure: points on all sides, normals and displacements."""
    points, normals = [], []
    for cuboid in cuboids:
        for axis, sign in SIDES:
            half = np.delete(cuboid.half, axis)
            n = np.maximum(1, np.ceil(2 * half / TRUTH_SPACING)).astype(int)
            a, b = np.meshgrid(*((2 * (np.arange(k) + 0.5) / k - 1) for k in n))
            place = cuboid.side(axis, sign, np.stack([a.ravel(), b.ravel()], axis=1))
            points.append(place)
            normals.append(np.tile(sign * cuboid.axes[:, axis], (len(place), 1)))
    at = np.concatenate(points)
    return {"points": at.tolist(), "normals": np.concatenate(normals).tolist(), "displacement": move(at).tolist()}


def frame_of(rng: np.random.Generator) -> Array:
    """Pose (4, 4), project from design: a heading and a shift."""
    T = np.eye(4)
    turn = rng.uniform(-np.pi, np.pi)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = rng.uniform(-30000, 30000, 3)
    return T


def write_ply(path: Path, points_mm: Array) -> None:
    """Write binary PLY of doubles, metres."""
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points_mm)}\n{names}end_header\n"
    path.write_bytes(head.encode() + (points_mm / 1000.0).astype("<f8").tobytes())


def write_stl(path: Path, cuboids: list[Cuboid]) -> None:
    """Write the design as ASCII STL, mm."""
    lines = ["solid steelwork"]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    for cuboid in cuboids:
        for axis, sign in SIDES:
            quad = cuboid.side(axis, sign, corners)
            normal = sign * cuboid.axes[:, axis]
            if np.cross(quad[1] - quad[0], quad[2] - quad[0]) @ normal < 0:
                quad = quad[::-1]
            for three in (quad[[0, 1, 2]], quad[[0, 2, 3]]):
                lines += ["facet normal {:.6f} {:.6f} {:.6f}".format(*normal), "outer loop"]
                lines += ["vertex {:.4f} {:.4f} {:.4f}".format(*corner) for corner in three] + ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid steelwork"]) + "\n")


def write_structure(folder: Path, cuboids: list[Cuboid], scan: tuple[Array, Array], truth: dict[str, Any],
                    T: Array) -> None:  # fmt: skip
    """Write design, one :func:`merged` cloud in a frame of its own, and the truth."""
    cloud, covariance = scan
    write_stl(folder / "steel.stl", cuboids)
    write_ply(folder / "Merge_2 (clean).ply", cloud @ T[:3, :3].T + T[:3, 3])
    (folder / "project.toml").write_text(
        'kind = "structure"\ndesign = "steel.stl"\ndesign_units = "mm"\n[[scan]]\nfile = "Merge_2 (clean).ply"\n'
    )
    pose = {"T_design_project": np.linalg.inv(T).tolist(), "covariance": covariance.tolist()}
    (folder / "truth.json").write_text(json.dumps({"format": "processor-truth", "pose": pose} | truth))


def make_deviation(folder: Path, settings: dict[str, Any], rng: np.random.Generator) -> None:
    """Half of the lattice girders moved."""
    length = number(settings, "length")
    cuboids, move = lattice(length), half_moved(length, number(settings, "moved"))
    stations = around(np.array([0, 0, -900.0]), np.array([length, 2600.0, 1900]), 6, 3500.0, (1700.0, 3900.0), rng)
    scan, T = merged(cuboids, stations, move, nothing, settings, rng), frame_of(rng)
    write_structure(folder, cuboids, scan, {"structure": surface(cuboids, move)}, T)


def make_defects(folder: Path, settings: dict[str, Any], rng: np.random.Generator) -> None:
    """Make a girder with dents and bulges, without one rib and the corner of another; or without damage."""
    cuboids = girder()
    found = bumps(rng) if number(settings, "damage") else []
    rows = [
        (
            "dent" if b.depth > 0 else "bulge",
            b.centre,
            np.pi * b.radius**2,
            b.depth,
            b.volume if b.depth > 0 else -b.volume,
        )
        for b in found
    ]
    built = cuboids
    cut: Callable[[Array], Mask] = nothing
    if found:
        missing, notched = rng.choice([k for k, c in enumerate(cuboids) if c.half[0] == 7.0], 2, replace=False)
        built = [c for k, c in enumerate(cuboids) if k != missing]
        lost = 2 * (4 * cuboids[missing].half[1] * cuboids[missing].half[2])
        rows.append(("missing-part", cuboids[missing].centre, lost, np.nan, np.nan))
        plate = cuboids[notched]
        corner = plate.centre + plate.half * [0, np.sign(plate.centre[1]), 1]
        side = rng.uniform(50, 90)
        # A piece that reaches two borders of its plate is a missing part: docs/steps/defects.md, classes.
        rows.append(("missing-part", corner - side / 2 * np.array([0, np.sign(corner[1]), 1]), side**2, np.nan, np.nan))
        cut = _notch(corner, side)
    stations = around(np.array([0, -300.0, -700]), np.array([6400, 300.0, 760]), 6, 2600.0, (500.0, 3300.0), rng)
    move: Move = lambda points: np.asarray(sum((b(points) for b in found), np.zeros_like(points)))  # noqa: E731
    scan, T = merged(built, stations, move, cut, settings, rng), frame_of(rng)
    columns: list[Any] = list(zip(*rows, strict=True)) if rows else [()] * 5
    truth = {
        "ids": list(range(1, len(rows) + 1)), "classes": list(columns[0]), "components": ["steel"] * len(rows),
        "centres": [list(map(float, c)) for c in columns[1]],
        **{key: [None if np.isnan(v) else float(v) for v in column]
           for key, column in zip(("area_mm2", "depth_max_mm", "volume_mm3"), columns[2:], strict=True)},
    }  # fmt: skip
    write_structure(folder, cuboids, scan, {"defects": truth}, T)


def _notch(corner: Array, side: float) -> Callable[[Array], Mask]:
    return lambda points: np.asarray((np.abs(points - corner) < [20.0, side, side]).all(axis=1))


def make_plate(folder: Path, settings: dict[str, Any], rng: np.random.Generator) -> None:
    """Make a plate and a box on it exactly as designed, seen from one side or both."""
    t = number(settings, "thickness")
    cuboids = [box([0, 0, 0], [760, 640, t]), box([90, 120, t], [330, 290, t + 8 * t])]
    stations = np.array([[-900.0, -700, 1900], [1500, 1400, 2100], [-700, 1500, 1700], [300, -1500, 1500]])
    if number(settings, "sides") > 1:
        stations = np.vstack([stations, stations * [1, 1, -1]])
    scan, T = merged(cuboids, stations, still, nothing, settings, rng), frame_of(rng)
    write_structure(folder, cuboids, scan, {"structure": surface(cuboids, still)}, T)


def hall(bays: int, rng: np.random.Generator) -> list[Cuboid]:
    """Portal frames on a floor with crates, a gable wall, and braces in the first bay."""
    cuboids = [box([-3000, -7000, -200], [bays * 5000 + 3000, 7000, 0]), box([-2400, -6500, 0], [-2250, 5200, 4200])]
    for k in range(bays + 1):
        x = k * 5000.0
        for y in (-5000.0, 5000.0):
            cuboids.append(box([x - 110, y - 130, 0], [x + 110, y + 130, 5200]))
        cuboids.append(box([x - 80, -5000, 5200], [x + 80, 5000, 5560]))
    cuboids += [box([0, y - 60, 4700], [bays * 5000, y + 60, 4880]) for y in (-4950.0, 4950.0)]
    cuboids.append(bar([150, 4950, 300], [4850, 4950, 4600], 80, 120))
    for _ in range(9):
        low = np.append(rng.uniform([-1500, -4300], [bays * 5000, 4000]), 0.0)
        cuboids.append(box(low, low + rng.uniform([300, 300, 350], [1300, 1100, 1700])))
    return cuboids


def make_stitch(folder: Path, settings: dict[str, Any], rng: np.random.Generator) -> None:
    """Make a hall scanned from several stations, each in a frame and a file of its own."""
    bays = int(number(settings, "bays"))
    cuboids = hall(bays, rng)
    ids, poses, names = [], [], ("north door", "Scan-B", "03", "platz_4", "e5", "06", "g")
    for k in range(min(bays + 1, 7)):
        station = np.array([2500 + 5000.0 * (k - 0.5), rng.uniform(-2500, 2500), rng.uniform(1500, 2400)])
        while blocked(cuboids, station[None], station + np.array([1.0, 0, 0]))[0]:
            station[1] += 400.0
        T = frame_of(rng)
        tilt = 1e-3 * rng.normal(size=2)
        T[:3, :3] = T[:3, :3] @ np.array([[1, 0, tilt[1]], [0, 1, -tilt[0]], [-tilt[1], tilt[0], 1]])
        U, _, V = np.linalg.svd(T[:3, :3])
        T[:3, :3], T[:3, 3] = U @ V, station
        seen = seen_from(cuboids, station, 1e-3 * number(settings, "hall_step_mrad"), rng)
        cloud = measured(seen, seen.points, station, settings, rng)
        write_ply(folder / f"{names[k]}.ply", (cloud - station) @ T[:3, :3])
        ids.append(names[k])
        poses.append(T.tolist())
    (folder / "project.toml").write_text('kind = "structure"\n')
    nothing_else = {"zero_offset_mm": [0.0] * len(ids), "scale_ppm": [0.0] * len(ids), "tilt": [[0.0, 0.0]] * len(ids)}
    truth = {"format": "processor-truth", "stations": {"ids": ids, "T_project_station": poses} | nothing_else}
    (folder / "truth.json").write_text(json.dumps(truth))


CASES = {"deviation": make_deviation, "defects": make_defects, "plate": make_plate, "stitch": make_stitch}


def main() -> None:
    """Read the command line and write the scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    changed = dict(word.split("=", 1) for word in given.set)
    if unknown := sorted(set(changed) - set(SETTINGS)):
        parser.error(f"unknown setting {unknown[0]!r}; there are {', '.join(SETTINGS)}")
    settings = SETTINGS | {key: value.strip('"') for key, value in changed.items()}
    given.folder.mkdir(parents=True, exist_ok=True)
    CASES[str(settings["case"])](
        given.folder, settings, np.random.default_rng([given.seed, len(str(settings["case"]))])
    )


if __name__ == "__main__":
    main()
