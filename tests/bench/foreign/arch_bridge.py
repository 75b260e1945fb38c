"""An arch bridge in five parts, each scanned in the shop from several stations and exported as one merged cloud.

Nothing of the stations is in the files. Points are drawn on the surfaces as built, by the density that a station has
there. Errors of a point: range noise that grows with range and incidence, a bias by incidence, a slow drift with
azimuth; of a station: range offset, shift and rotation. Plates are wavy, cuts and sections are off, edges have mixed
pixels, and blocks, floor and stray points lie about. Lengths in mm.
"""

from __future__ import annotations

import argparse
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SETTINGS: dict[str, float] = {
    "span": 16000.0, "rise": 3400.0, "width": 700.0, "height": 820.0, "haunch": 0.35, "plate": 18.0,
    "spacing": 11.0,
    "stations": 6.0, "raised": 4800.0, "range_offset": 0.3, "shift": 0.3, "rotation_urad": 20.0,
    "noise": 0.5, "noise_ppm": 25.0, "drift": 0.1, "incidence_bias": 0.1, "beam": 2.5,
    "waviness": 0.3, "wavelength": 450.0, "fabrication": 1.0, "outliers": 0.0005, "clutter": 1.0,
}  # fmt: skip
PARTS = ("SP-W", "SEG-1", "SEG-2", "SEG-3", "SP-E")
FILES = ("spWEST (2).las", "segment no1 final.las", "SEG2__merged.las", "2026-03-11 seg3.las", "sp_east-neu.las")
CUTS = (0.0, 0.21, 0.41, 0.585, 0.80, 1.0)  # of the arc length
CORNERS = np.array([[1, 0], [-1, 0], [-1, 1], [1, 1], [0, 0], [-1, 0.5], [0, 1], [1, 0.5]])  # P1..P8: u by half, v by H
BASE, OVERHANG, PAD = 40.0, 90.0, (190.0, 130.0, 35.0)
END_ZONE, INSIDE, FAR = 400.0, 700.0, 2500.0
MESH_STEP, LEAST_COS = 25.0, 0.15


# --- the arch as designed ---------------------------------------------------------------------------------------------


class Arch:
    """The soffit's curve in XZ by arc length, and the box section on it. A place is (s, u, v), u left, v up."""

    def __init__(self, settings: dict[str, float]) -> None:
        self.span, self.rise = settings["span"], settings["rise"]
        self.width, self.crown, self.haunch = settings["width"], settings["height"], settings["haunch"]
        x = np.linspace(-0.1 * self.span, 1.1 * self.span, 24001)
        slope = self._slope(x)
        grown = np.concatenate(
            [[0.0], np.cumsum(0.5 * np.diff(x) * (np.hypot(1, slope[1:]) + np.hypot(1, slope[:-1])))]
        )
        self.x, self.s = x, grown - np.interp(0.0, x, grown)
        self.length = float(np.interp(self.span, x, self.s))

    def _height(self, x: Array) -> Array:
        k = 2.0 * x / self.span - 1.0
        return np.asarray(self.rise * (1.0 - 0.9 * k**2 - 0.1 * k**4))

    def _slope(self, x: Array) -> Array:
        k = 2.0 * x / self.span - 1.0
        return np.asarray(self.rise * (-1.8 * k - 0.4 * k**3) * 2.0 / self.span)

    def section_height(self, s: Array) -> Array:
        """Height of the box, which grows towards the springings."""
        return np.asarray(self.crown * (1.0 + self.haunch * (2.0 * s / self.length - 1.0) ** 2))

    def frame(self, s: Array) -> tuple[Array, Array, Array]:
        """Point on the soffit, tangent and upward normal (n, 3) at arc length s (n,)."""
        x = np.interp(s, self.s, self.x)
        tangent = np.stack([np.ones_like(x), np.zeros_like(x), self._slope(x)], axis=-1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        normal = np.stack([-tangent[..., 2], np.zeros_like(x), tangent[..., 0]], axis=-1)
        return np.stack([x, np.zeros_like(x), self._height(x)], axis=-1), tangent, normal

    def place(self, suv: Array) -> Array:
        """Points (n, 3) in the bridge's frame of places (n, 3)."""
        point, _, normal = self.frame(suv[..., 0])
        point = point + suv[..., 2:3] * normal
        point[..., 1] += suv[..., 1]
        return np.asarray(point)

    def find(self, points: Array) -> Array:
        """Places (n, 3) of points near the arch."""
        s = np.interp(points[:, 0], self.x, self.s)
        for _ in range(3):
            foot, tangent, normal = self.frame(s)
            s = s + np.einsum("ni,ni->n", points - foot, tangent)
        foot, _, normal = self.frame(s)
        return np.stack([s, points[:, 1], np.einsum("ni,ni->n", points - foot, normal)], axis=1)


# --- a part as built --------------------------------------------------------------------------------------------------


class Part:
    """One part of the arch: from ``start`` to ``end`` along the arc, with what fabrication made of it."""

    def __init__(self, arch: Arch, index: int, settings: dict[str, float], rng: np.random.Generator) -> None:
        self.arch, self.index, self.plate = arch, index, settings["plate"]
        self.start, self.end = CUTS[index] * arch.length, CUTS[index + 1] * arch.length
        size = settings["fabrication"]
        self.cut = size * rng.normal(size=(2, 3)) * [1.5, 1e-3, 1e-3]  # along, per u, per v
        self.bow = size * rng.normal(size=2) * [2.0, 2.0]
        self.twist, self.lozenge = size * rng.normal(size=2) * 1e-3
        self.section = size * rng.normal(size=(2, 2)) * 0.7  # width and height, at start and end
        waves = 6
        self.amplitude = settings["waviness"] * np.sqrt(2.0 / waves)
        self.wave = 2 * np.pi / settings["wavelength"] * rng.uniform(0.5, 1.4, (4, waves))
        self.phase = rng.uniform(0, 2 * np.pi, (4, waves))
        self.across = rng.choice([1.0, 1.0, 2.0], (4, waves))

    def built(self, suv: Array, plate: int = -1) -> Array:
        """Points (n, 3) as built, bridge frame, of places (n, 3); ``plate`` 0..3: bottom, top, left, right."""
        s, u, v = suv[..., 0].copy(), suv[..., 1].copy(), suv[..., 2].copy()
        height, q = self.arch.section_height(s), (s - self.start) / (self.end - self.start)
        middle = v - height / 2
        if plate >= 0:
            t = u / self.arch.width + 0.5 if plate < 2 else v / height
            rise = np.zeros_like(s)
            for k, phase, across in zip(self.wave[plate], self.phase[plate], self.across[plate], strict=True):
                rise += self.amplitude * np.cos(k * s + phase) * np.sin(np.pi * across * np.clip(t, 0, 1))
            u, v = (u, v + rise) if plate < 2 else (u + rise, v)
        wider = (1 - q) * self.section[0, 0] + q * self.section[1, 0]
        higher = (1 - q) * self.section[0, 1] + q * self.section[1, 1]
        turn = self.twist * (q - 0.5)
        u = (
            u * (1 + wider / self.arch.width)
            + self.lozenge * middle
            - turn * middle
            + self.bow[0] * np.sin(np.pi * q) ** 2
        )
        v = v + higher * middle / height + turn * suv[..., 1] + self.bow[1] * np.sin(np.pi * q)
        for k, (at, sign) in enumerate(((self.start, 1.0), (self.end, -1.0))):
            near = np.clip(1.0 - sign * (s - at) / END_ZONE, 0.0, None) * (sign * (s - at) < END_ZONE)
            s = s + near * (self.cut[k, 0] + self.cut[k, 1] * suv[..., 1] + self.cut[k, 2] * middle)
        return self.arch.place(np.stack([s, u, v], axis=-1))

    def key_points(self) -> Array:
        """P1..P8 (2, 8, 3) as built, bridge frame: NaN at the base of a foot."""
        ends = np.full((2, 8, 3), np.nan)
        for k, s in enumerate((self.start, self.end)):
            if 0 < self.index + k < 5:
                height = float(self.arch.section_height(np.array(s)))
                for i, (side, up) in enumerate(CORNERS):
                    plate = (0, 3, 1, 2)[i - 4] if i > 3 else -1
                    ends[k, i] = self.built(np.array([[s, side * self.arch.width / 2, up * height]]), plate)[0]
        return ends

    def edges(self, count: int = 80) -> Array:
        """Points (2, e, 3) along the bottom edges, left and right, as built."""
        s = np.linspace(self.start, self.end, count)
        half = np.full(count, self.arch.width / 2)
        return np.stack([self.built(np.stack([s, sign * half, 0 * s], axis=1)) for sign in (1.0, -1.0)])

    # --- its surfaces

    def faces(self) -> list[Face]:
        """All surfaces: outer plates, the ends' rims and the inner faces near the open ends, base plate, pad."""
        t = self.plate
        found = []
        for inner in (0.0, t):
            for plate in range(4):
                spans = [(self.start, self.end)]
                if inner:
                    spans = [(self.start, self.start + INSIDE)] if self.index > 0 else []
                    spans += [(self.end - INSIDE, self.end)] if self.index < 4 else []
                found += [Face(self, plate, span, inner=inner) for span in spans]
        ends = [
            (s, out) for s, out, there in ((self.start, -1, self.index > 0), (self.end, 1, self.index < 4)) if there
        ]
        found += [Face(self, plate, (s, s), rim=out) for s, out in ends for plate in range(4)]
        boxes = [box for box in (self.pad(), self.base()) if box is not None]
        found += [Face(self, 4 + side, (0.0, 0.0), box=box) for box in boxes for side in range(6)]
        return found

    def pad(self) -> Array:
        """Low and high corner (2, 3) of the pad on the top plate, off the middle, which tells the ends apart."""
        s = self.start + 0.3 * (self.end - self.start)
        top = float(self.arch.section_height(np.array(s)))
        return np.array([[s, 0.08 * self.arch.width, top], [s + PAD[0], 0.08 * self.arch.width + PAD[1], top + PAD[2]]])

    def base(self) -> Array | None:
        """Low and high corner of the base plate of a foot."""
        if 0 < self.index < 4:
            return None
        at = self.start - BASE if self.index == 0 else self.end
        top = float(self.arch.section_height(np.array(self.start if self.index == 0 else self.end)))
        half = self.arch.width / 2 + OVERHANG
        return np.array([[at, -half, -OVERHANG], [at + BASE, half, top + OVERHANG]])


@dataclass(frozen=True)
class Face:
    """One surface of a part over the unit square: a plate's face or rim (0..3), or the side of a box (4..9)."""

    part: Part
    plate: int
    span: tuple[float, float]
    inner: float = 0.0
    rim: int = 0
    box: Array | None = None

    def designed(self, a: Array, b: Array) -> Array:
        """Places (n, 3) as designed at coordinates a, b (n,) within 0 and 1."""
        arch, t = self.part.arch, self.part.plate
        if self.box is not None:
            low, high = self.box
            axis, top = (self.plate - 4) // 2, (self.plate - 4) % 2
            place = np.empty((len(a), 3))
            place[:, axis] = (low, high)[top][axis]
            for other, c in zip([k for k in range(3) if k != axis], (a, b), strict=True):
                place[:, other] = low[other] + c * (high[other] - low[other])
            return place
        s = self.span[0] + a * (self.span[1] - self.span[0])
        height, half = arch.section_height(s), arch.width / 2
        depth = a * t if self.rim else np.full_like(a, self.inner)
        if self.plate < 2:
            clear = 0.0 if not self.inner else t
            u = (b - 0.5) * 2 * (half - clear)
            return np.stack([s, u, depth if self.plate == 0 else height - depth], axis=1)
        clear = t if self.rim or self.inner else 0.0
        v = clear + b * (height - 2 * clear)
        sign = 1.0 if self.plate == 2 else -1.0
        return np.stack([s, sign * (half - depth), v], axis=1)

    def points(self, a: Array, b: Array) -> Array:
        """Points (n, 3) as built, bridge frame."""
        return self.part.built(self.designed(a, b), self.plate if self.plate < 4 else -1)

    def normals(self, a: Array, b: Array) -> Array:
        """Outward unit normals (n, 3) as designed, bridge frame."""
        _, tangent, up = self.part.arch.frame(self.designed(a, b)[:, 0])
        side = np.zeros_like(up)
        side[:, 1] = 1.0
        if self.box is not None:
            return np.asarray((tangent, side, up)[(self.plate - 4) // 2] * (1.0 if self.plate % 2 else -1.0))
        if self.rim:
            return tangent * self.rim
        return np.asarray((-up, up, side, -side)[self.plate] * (-1.0 if self.inner else 1.0))

    def sides(self) -> tuple[float, float]:
        """Lengths of the face along a and b."""
        a, b = np.array([0.0, 1.0, 0.5, 0.5]), np.array([0.5, 0.5, 0.0, 1.0])
        place = self.designed(a, b)
        return float(np.linalg.norm(place[1] - place[0])), float(np.linalg.norm(place[3] - place[2]))


# --- scanning ---------------------------------------------------------------------------------------------------------


def rotation(axis: int, angle: float) -> Array:
    """Rotation (3, 3) about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def shop(part: Part, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rotation and translation of bridge to shop: the chord level on blocks, heading and place at random."""
    ends = part.arch.place(np.array([[part.start, 0, 0], [part.end, 0, 0]]))
    chord = ends[1] - ends[0]
    R = rotation(2, rng.uniform(-np.pi, np.pi)) @ rotation(1, np.arctan2(chord[2], chord[0]))
    t = rng.uniform(-4000, 4000, 3) + np.array([812000.0, 455000.0, 0.0])
    lowest = min(float((face.points(*_grid(12)) @ R.T)[:, 2].min()) for face in part.faces())
    t[2] = rng.uniform(1100, 1400) - lowest
    return R, t


def _grid(n: int) -> tuple[Array, Array]:
    a, b = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    return a.ravel(), b.ravel()


def stations(part: Part, R: Array, t: Array, count: int, raised: float,
             rng: np.random.Generator) -> Array:  # fmt: skip
    """Places (k, 3) of the scanner in the shop, around the part, in turn low and raised; one beyond each open end."""
    middle = part.arch.place(np.array([[(part.start + part.end) / 2, 0, part.arch.crown / 2]]))[0] @ R.T + t
    along = R @ np.array([1.0, 0, 0])
    heading, half = np.arctan2(along[1], along[0]), (part.end - part.start) / 2
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(-0.25, 0.25, count) + 0.35
    away = rng.uniform(4200, 6500, count)
    place = np.stack([np.cos(turns) * (half + 0.8 * away), np.sin(turns) * away], axis=1)
    c, s = np.cos(heading), np.sin(heading)
    xy = place @ np.array([[c, s], [-s, c]]) + middle[:2]
    z = np.where(np.arange(count) % 2, raised * rng.uniform(0.9, 1.1, count), rng.uniform(350, 700, count))
    return np.column_stack([xy, z])


def visible(part: Part, face: Face, points: Array, station: Array) -> Mask:
    """Whether points (n, 3) are in sight of a station, both in the bridge's frame; the face is turned to it."""
    ray = station - points
    distance: Array = np.linalg.norm(ray, axis=1)
    arch, t = part.arch, part.plate
    if face.inner:
        seen = np.zeros(len(points), bool)
        end = part.end if face.span[1] == part.end else part.start
        point, tangent, _ = (x[0] for x in arch.frame(np.array([end])))
        slope = ray @ tangent
        reach = ((point - points) @ tangent) / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        ahead = (reach > 0) & (reach < 1)
        through = arch.find(points + np.clip(reach, 0, 1)[:, None] * ray)
        height = arch.section_height(through[:, 0])
        seen[ahead] = True
        return seen & (np.abs(through[:, 1]) < arch.width / 2 - t) & (through[:, 2] > t) & (through[:, 2] < height - t)
    seen = np.ones(len(points), bool)
    boxes = [box for box in (part.pad(), part.base()) if box is not None]
    for reach_mm in np.geomspace(30.0, FAR, 8):
        at = arch.find(points + np.minimum(reach_mm / distance, 1.0)[:, None] * ray)
        s, u, v = at.T
        within: Mask = (s > part.start + 8) & (s < part.end - 8)
        within &= (np.abs(u) < arch.width / 2 - 8) & (v > 8) & (v < arch.section_height(s) - 8)
        for box in boxes:
            within |= ((at > box[0] + 8) & (at < box[1] - 8)).all(axis=1)
        seen &= ~within
    return seen


def seen_from(part: Part, station: Array, spacing: float, rng: np.random.Generator) -> tuple[Array, ...]:
    """Points (n, 3) on the part that a station measures, their normals, and distances to the nearest edge (n,)."""
    found: list[tuple[Array, ...]] = []
    for face in part.faces():
        along, across = face.sides()
        count = rng.poisson(1.8 * along * across / spacing**2)
        a, b = rng.random((2, count))
        points, normals = face.points(a, b), face.normals(a, b)
        ray = station - points
        distance = np.linalg.norm(ray, axis=1)
        cos = np.einsum("ni,ni->n", ray, normals) / distance
        chance = np.clip(cos * (6500.0 / distance) ** 2, 0.0, 1.0)
        keep = (cos > LEAST_COS) & (rng.random(count) < chance)
        edge = np.minimum(np.minimum(a, 1 - a) * along, np.minimum(b, 1 - b) * across)
        keep[keep] = visible(part, face, points[keep], station)
        found.append((points[keep], normals[keep], edge[keep]))
    return tuple(np.concatenate(columns) for columns in zip(*found, strict=True))


def measured(points: Array, normals: Array, edge: Array, station: Array, settings: dict[str, float],
             rng: np.random.Generator) -> Array:  # fmt: skip
    """Points as the scanner gives them, before the errors of its pose; all in the shop's frame."""
    ray = points - station
    distance = np.linalg.norm(ray, axis=1)
    direction = ray / distance[:, None]
    cos = np.clip(-np.einsum("ni,ni->n", direction, normals), 0.05, 1.0)
    sd = np.hypot(settings["noise"], 1e-6 * settings["noise_ppm"] * distance) * np.sqrt(1 + 0.3 * (1 / cos**2 - 1))
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    off = rng.normal(size=len(points)) * sd + rng.normal() * settings["range_offset"]
    off += settings["incidence_bias"] * (1 / cos - 1)
    off += settings["drift"] * rng.normal() * np.cos(azimuth + rng.uniform(0, 2 * np.pi))
    mixed = (edge < settings["beam"]) & (rng.random(len(points)) < 0.4)
    off[mixed] += rng.exponential(25.0, int(mixed.sum()))
    return np.asarray(station + direction * (distance + off)[:, None])


def posed(points: Array, station: Array, settings: dict[str, float], rng: np.random.Generator) -> Array:
    """Points with the errors of a station's registration: rotation about it, and shift."""
    turn = 1e-6 * settings["rotation_urad"] * rng.normal(size=3)
    shift = settings["shift"] * rng.normal(size=3)
    return np.asarray(points + np.cross(turn, points - station) + shift)


def clutter(part: Part, R: Array, t: Array, count: int, rng: np.random.Generator) -> Array:
    """Points on the floor, on two blocks beneath the part, and astray."""
    places = [np.empty((0, 3))]
    for q in (0.22, 0.78):
        under = part.arch.place(np.array([[part.start + q * (part.end - part.start), 0, 0]]))[0] @ R.T + t
        n = count // 60
        side = np.column_stack([rng.uniform(-450, 450, n), rng.choice([-150.0, 150.0], n), rng.random(n)])
        side[:, 2] *= under[2] - 30.0
        places.append(side + np.array([under[0], under[1], 0.0]))
    middle = part.arch.place(np.array([[(part.start + part.end) / 2, 0, 0]]))[0] @ R.T + t
    floor = np.column_stack([rng.uniform(-3500, 3500, (count // 12, 2)) + middle[:2], rng.normal(0, 1.5, count // 12)])
    return np.concatenate([*places, floor])


def thinned(points: Array, spacing: float) -> Array:
    """One point of each voxel, the first: what export in one cloud does."""
    cell = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    size = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_index=True)
    return np.asarray(points[np.sort(first)])


def scan(part: Part, settings: dict[str, float], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the merged cloud (n, 3) in the shop's frame, and the true pose (4, 4), bridge from shop."""
    R, t = shop(part, rng)
    merged = []
    for station in stations(part, R, t, int(settings["stations"]), settings["raised"], rng):
        points, normals, edge = seen_from(part, (station - t) @ R, settings["spacing"], rng)
        raw = measured(points @ R.T + t, normals @ R.T, edge, station, settings, rng)
        merged.append(posed(raw, station, settings, rng))
    steel = thinned(np.concatenate(merged)[rng.permutation(sum(map(len, merged)))], settings["spacing"])
    low, high = steel.min(axis=0) - 500, steel.max(axis=0) + 500
    stray = rng.uniform(low, high, (int(settings["outliers"] * len(steel)), 3))
    cloud = np.concatenate([steel, clutter(part, R, t, int(settings["clutter"] * len(steel)), rng), stray])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.T, -R.T @ t
    return cloud[rng.permutation(len(cloud))], T


# --- files ------------------------------------------------------------------------------------------------------------


def write_las(path: Path, points_mm: Array) -> None:
    """Write LAS 1.2, point format 0, in metres with steps of 0.05 mm."""
    step, offset = 5e-5, np.floor(points_mm.mean(axis=0) / 1000.0)
    counts = np.rint((points_mm / 1000.0 - offset) / step).astype("<i4")
    rows = np.zeros(len(counts), np.dtype([("xyz", "<i4", 3), ("rest", "V8")]))
    rows["xyz"] = counts
    low, high = counts.min(axis=0) * step + offset, counts.max(axis=0) * step + offset
    bounds = [value for k in range(3) for value in (high[k], low[k])]
    header = struct.pack(
        "<4sHH16sBB32s32sHHHIIBHI5I12d", b"LASF", 0, 0, b"", 1, 2, b"EXPORT", b"merged stations", 70, 2026, 227, 227, 0,
        0, 20, len(rows), len(rows), 0, 0, 0, 0, step, step, step, *offset, *bounds,
    )  # fmt: skip
    path.write_bytes(header + rows.tobytes())


def write_obj(path: Path, part: Part) -> None:
    """Write the part as designed as OBJ in mm: faces as grids of quads with vertices of their own, outward."""
    exact = Part(part.arch, part.index, {**SETTINGS, "plate": part.plate, "fabrication": 0.0, "waviness": 0.0},
                 np.random.default_rng(0))  # fmt: skip
    lines, base = [], 1
    solid = [
        Face(exact, plate, (exact.start, exact.end), inner=inner) for inner in (0.0, exact.plate) for plate in range(4)
    ]
    for face in [*solid, *(f for f in exact.faces() if f.rim or f.box is not None)]:
        n = max(1, int(np.ceil(face.sides()[0] / MESH_STEP))) if face.span[0] < face.span[1] else 1
        a, b = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, n + 1), [0.0, 1.0], indexing="ij"))
        points = face.points(a, b)
        normal = face.normals(np.array([0.5]), np.array([0.5]))[0]
        mid = n // 2 * 2 if n > 1 else 0
        turn = np.cross(points[mid + 2] - points[mid], points[mid + 1] - points[mid]) @ normal > 0
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
        for k in range(n):
            quad = [base + 2 * k, base + 2 * k + 2, base + 2 * k + 3, base + 2 * k + 1]
            lines.append("f " + " ".join(map(str, quad if turn else quad[::-1])))
        base += len(points)
    path.write_text("\n".join(lines) + "\n")


def listed(values: Array) -> Any:
    """Nested lists for JSON, with null for NaN."""
    return [listed(v) for v in values] if values.ndim else (None if np.isnan(values) else float(values))


def make(folder: Path, seed: int, settings: dict[str, float]) -> None:
    """Write the scan folder and its truth."""
    arch = Arch(settings)
    parts = [Part(arch, i, settings, np.random.default_rng([seed, 1, i])) for i in range(5)]
    exact = [
        Part(arch, i, {**settings, "fabrication": 0.0, "waviness": 0.0}, np.random.default_rng(0)) for i in range(5)
    ]
    for name in ("CAD", "export"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    poses = []
    for i, part in enumerate(parts):
        cloud, T = scan(part, settings, np.random.default_rng([seed, 2, i]))
        write_las(folder / "export" / FILES[i], cloud)
        write_obj(folder / "CAD" / f"{PARTS[i]}.obj", part)
        poses.append(T)
    components = {
        name: {"mesh": f"CAD/{name}.obj"}
        | dict(zip(("bottom_edge_left", "bottom_edge_right"), listed(part.edges()), strict=True))
        for name, part in zip(PARTS, exact, strict=True)
    }
    joints = [
        {"name": f"M{i + 1}", "left": PARTS[i], "right": PARTS[i + 1],
         "points": {f"P{k + 1}": listed(p) for k, p in enumerate(exact[i].key_points()[1])}}
        for i in range(4)
    ]  # fmt: skip
    design = {"units": "mm", "kind": "arch-bridge", "order": PARTS, "components": components, "joints": joints}
    (folder / "design.json").write_text(json.dumps(design))
    scans = [
        f'[[scan]]\nfile = "export/{file}"\ncomponent = "{name}"\n' for file, name in zip(FILES, PARTS, strict=True)
    ]
    (folder / "project.toml").write_text('kind = "arch-bridge"\ndesign = "design.json"\n\n' + "\n".join(scans))
    keys = np.stack([part.key_points() for part in parts])
    in_scan = np.stack([(k - T[:3, 3]) @ T[:3, :3] for k, T in zip(keys, poses, strict=True)])
    truth = {
        "format": "processor-truth", "spacing_mm": settings["spacing"], "sigma_mm": settings["noise"],
        "arch": {
            "names": PARTS, "T_bridge_scan": listed(np.stack(poses)), "key_points_scan": listed(in_scan),
            "key_points_bridge": listed(keys), "edges_bridge": listed(np.stack([part.edges(300) for part in parts])),
        },
    }  # fmt: skip
    (folder / "truth.json").write_text(json.dumps(truth))


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
    make(given.folder, given.seed, SETTINGS | {key: float(value) for key, value in changed.items()})


if __name__ == "__main__":
    main()
