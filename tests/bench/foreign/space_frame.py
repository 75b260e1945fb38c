"""A vault of bolt balls and tubes, ray cast from stations on the floor, with scaffold, pipes and lamps about.

Three-way grids in two layers on a cylinder. Every ray of a station is cut with spheres, cylinders and cones in closed
form; the nearest is measured. Balls have sizes that are in no catalogue, tubes are bowed, nodes are off their places,
and stations are registered with errors. The cloud is one, and says nothing of its stations. Lengths in mm.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SETTINGS: dict[str, float] = {
    "rows": 4.0, "columns": 5.0, "pitch": 2300.0, "depth": 1550.0, "radius": 17000.0, "height": 6200.0,
    "stations": 4.0, "step_mrad": 1.3, "noise": 0.8, "noise_ppm": 40.0, "range_offset": 0.3, "shift": 0.4,
    "rotation_urad": 30.0, "bow": 0.0007, "off": 3.0, "clutter": 1.0, "outliers": 0.0005, "mixed": 0.5,
    "design": 1.0, "missing": 0.0, "extra": 0.0, "wrong_size": 0.0,
}  # fmt: skip
BALLS = (53.0, 59.5, 67.0, 76.5, 88.0)
TUBES = {48.3: (13.0, 40.0), 63.5: (18.0, 48.0), 82.5: (24.0, 60.0)}  # diameter: sleeve radius, cone length
SLEEVE, PIECES, PIECE = 36.0, 4, 900.0
FIELD, LEAST_COS = 1.02, 0.12  # half width of a camera's image; cosine of the most grazing return


@dataclass
class Bodies:
    """Round bodies about straight axes: from ``a`` to ``b``, radii there; a sphere has b = a. ``kind``: 0 clutter."""

    a: list[Array] = field(default_factory=list)
    b: list[Array] = field(default_factory=list)
    radii: list[tuple[float, float]] = field(default_factory=list)

    def add(self, a: Array, b: Array, radius: float, other: float = -1.0) -> None:
        """Add a cylinder, or a cone with another radius at ``b``, in pieces that are not too long."""
        other = radius if other < 0 else other
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / PIECE)))
        for k in range(count):
            self.a.append(a + (b - a) * k / count)
            self.b.append(a + (b - a) * (k + 1) / count)
            radii = [radius + (other - radius) * (k + i) / count for i in (0, 1)]
            self.radii.append((radii[0], radii[1]))

    def sphere(self, centre: Array, radius: float) -> None:
        """Add a sphere."""
        self.a.append(centre)
        self.b.append(centre)
        self.radii.append((radius, radius))


# --- the frame --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """Nodes (k, 3) with radii, and members: pairs of rows (m, 2) with tube diameters."""

    nodes: Array
    radii: Array
    members: Indices
    tubes: Array


def designed(settings: dict[str, float], rng: np.random.Generator) -> Frame:
    """Two three-way layers on a cylinder about Y; a lower node hangs below each upward triangle of the upper layer."""
    rows, columns, p = int(settings["rows"]), int(settings["columns"]), settings["pitch"]
    flat: list[list[float]] = []
    lower: list[tuple[int, int]] = []
    pairs: list[tuple[int, int]] = []
    at: dict[tuple[int, int, int], int] = {}
    for i in range(rows):
        for j in range(columns):
            at[0, i, j] = len(flat)
            flat.append([p * (j + 0.5 * (i % 2)), p * i * np.sqrt(0.75), 0.0])
    for i in range(rows - 1):
        for j in range(columns - 1):
            at[1, i, j] = len(flat)
            flat.append([p * (j + 0.5 + 0.5 * (i % 2)), p * (i + 1 / 3) * np.sqrt(0.75), -settings["depth"]])
            lower.append((i, j))
    place = np.array(flat)
    count = rows * columns
    for layer in (range(count), range(count, len(place))):
        pairs += [(a, b) for a in layer for b in layer if a < b and np.linalg.norm(place[a] - place[b]) < 1.05 * p]
    for i, j in lower:
        node = at[1, i, j]
        level = np.linalg.norm(place[:count, :2] - place[node, :2], axis=1)
        pairs += [(int(k), node) for k in np.flatnonzero(level < 0.62 * p)]
    middle = place.mean(axis=0)
    turn = (place[:, 0] - middle[0]) / settings["radius"]
    out = settings["radius"] + place[:, 2]
    nodes = np.column_stack([out * np.sin(turn), place[:, 1] - middle[1], out * np.cos(turn) - settings["radius"]])
    nodes[:, 2] += settings["height"] + settings["depth"]
    members = np.array(sorted(pairs))
    tubes = np.array(list(TUBES))[rng.integers(0, len(TUBES), len(members))]
    largest = np.zeros(len(nodes))
    for (a, b), tube in zip(members, tubes, strict=True):
        largest[[a, b]] = np.maximum(largest[[a, b]], tube)
    sizes = np.searchsorted(list(TUBES), largest) + rng.integers(0, 3, len(nodes))
    return Frame(nodes, np.array(BALLS)[sizes], members, tubes)


def steel(frame: Frame, settings: dict[str, float], rng: np.random.Generator) -> Bodies:
    """Balls, sleeves, cones and bowed tubes."""
    bodies = Bodies()
    for centre, radius in zip(frame.nodes, frame.radii, strict=True):
        bodies.sphere(centre, radius)
    for (i, j), tube in zip(frame.members, frame.tubes, strict=True):
        sleeve, cone = TUBES[tube]
        a, b = frame.nodes[i], frame.nodes[j]
        length = float(np.linalg.norm(b - a))
        along = (b - a) / length
        side = np.cross(along, rng.normal(size=3))
        side *= settings["bow"] * length * rng.normal() / np.linalg.norm(side)
        starts = []
        for node, sign in ((i, 1.0), (j, -1.0)):
            centre, out = frame.nodes[node], sign * along
            milled = np.sqrt(frame.radii[node] ** 2 - sleeve**2)
            bodies.add(centre + milled * out, centre + (milled + SLEEVE) * out, sleeve)
            bodies.add(centre + (milled + SLEEVE) * out, centre + (milled + SLEEVE + cone) * out, sleeve + 3, tube / 2)
            starts.append(centre + (milled + SLEEVE + cone) * out)
        t = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
        axis = starts[0] + t * (starts[1] - starts[0]) + 4 * t * (1 - t) * side
        for k in range(PIECES):
            bodies.add(axis[k], axis[k + 1], tube / 2)
    return bodies


def raised(point: Array, by: float) -> Array:
    """Return a point moved up."""
    return np.asarray(point + np.array([0.0, 0.0, by]))


def clutter(frame: Frame, bodies: Bodies, rng: np.random.Generator) -> None:
    """Add a scaffold tower to below the frame, a pipe on hangers, and lamps on rods."""
    low, high = frame.nodes.min(axis=0), frame.nodes.max(axis=0)
    x, y = low[:2] + rng.uniform(0.15, 0.55, 2) * (high - low)[:2]
    top = low[2] - 400
    corners = [np.array([x + i, y + j, 0.0]) for i, j in ((0, 0), (1800, 0), (1800, 1100), (0, 1100))]
    for k, corner in enumerate(corners):
        bodies.add(raised(corner, 2500), raised(corner, top), 24.15)
        for z in np.arange(2600.0, top, 1000.0):
            bodies.add(raised(corner, z), raised(corners[(k + 1) % 4], z), 24.15)
    pipe = np.array([low[0], rng.uniform(low[1], high[1]), low[2] - 350])
    end = np.array([high[0], pipe[1], pipe[2]])
    bodies.add(pipe, end, 57.0)
    for t in np.linspace(0.1, 0.9, 4):
        bodies.add(pipe + t * (end - pipe), raised(pipe + t * (end - pipe), 700), 6.0)
    for _ in range(3):
        lamp = np.append(low[:2] + rng.uniform(0.1, 0.9, 2) * (high - low)[:2], low[2] - 700)
        bodies.sphere(lamp, 140.0)
        bodies.add(raised(lamp, 130), raised(lamp, 900), 8.0)


# --- ray casting ------------------------------------------------------------------------------------------------------


def cameras() -> Iterator[Array]:
    """Rotations (3, 3) whose rows are right, down and ahead: upwards and to four sides."""
    for ahead, right in (((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, 1, 0)), ((-1, 0, 0), (0, 1, 0)),
                         ((0, 1, 0), (1, 0, 0)), ((0, -1, 0), (1, 0, 0))):  # fmt: skip
        yield np.array([right, np.cross(ahead, right), ahead], float)


def _hits(ray: Array, a: Array, b: Array, radii: tuple[float, float]) -> tuple[Array, Array]:
    """Range (n,) along unit rays (n, 3) from the origin to a body, infinite without a hit; cosine of incidence."""
    axis = b - a
    length = float(np.linalg.norm(axis))
    along = axis / length if length else np.zeros(3)
    slope = (radii[1] - radii[0]) / length if length else 0.0
    d, o = ray @ along, float(-a @ along)
    flat, start = ray - d[:, None] * along, -a - o * along
    at = radii[0] + slope * o  # radius where the origin is along the axis
    qa = np.einsum("ni,ni->n", flat, flat) - (slope * d) ** 2
    qb = flat @ start - slope * d * at
    qc = float(start @ start) - at**2
    root = qb**2 - qa * qc
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-qb - np.sqrt(root)) / qa
        s = o + t * d
        good = (root > 0) & (t > 0)
        if length:
            good &= (s >= 0) & (s <= length)
        normal = start + t[:, None] * flat
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) - slope * along
        cos = -np.einsum("ni,ni->n", normal, ray) / np.hypot(1.0, slope)
    return np.where(good, t, np.inf), np.where(good, cos, 0.0)


def image(bodies: Bodies, station: Array, camera: Array, step: float) -> tuple[Array, Array, Array]:
    """Ranges (h, w) of one camera, infinite where nothing is hit, cosines of incidence, and unit rays (h, w, 3)."""
    lines = np.arange(-FIELD, FIELD, step)
    u, v = np.meshgrid(lines, lines)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rays = rays @ camera
    depth, cosine = np.full(u.shape, np.inf), np.zeros(u.shape)
    for a, b, radii in zip(bodies.a, bodies.b, bodies.radii, strict=True):
        ends = np.stack([a, b]) - station
        here = ends @ camera.T
        reach = max(radii)
        if here[:, 2].min() < 2 * reach:
            continue
        near = here[:, 2:].min() - reach
        low = np.minimum((here[:, :2] - reach) / near, (here[:, :2] - reach) / (here[:, 2:] + reach)).min(axis=0)
        high = np.maximum((here[:, :2] + reach) / near, (here[:, :2] + reach) / (here[:, 2:] + reach)).max(axis=0)
        i, j = (slice(*np.clip(np.searchsorted(lines, [low[k], high[k]]), 0, len(lines))) for k in (1, 0))
        window = rays[i, j]
        if not window.size:
            continue
        t, cos = _hits(window.reshape(-1, 3), ends[0], ends[1], radii)
        t, cos = t.reshape(window.shape[:2]), cos.reshape(window.shape[:2])
        nearer = t < depth[i, j]
        depth[i, j][nearer], cosine[i, j][nearer] = t[nearer], cos[nearer]
    return depth, cosine, rays


def measured(depth: Array, cosine: Array, settings: dict[str, float], rng: np.random.Generator) -> Array:
    """Measured ranges (h, w): noise by range and incidence, mixed pixels where the neighbour is farther."""
    seen = np.isfinite(depth) & (cosine > LEAST_COS) & (np.abs(np.log(np.maximum(cosine, 1e-9))) < 9)
    ranges = np.where(seen, depth, np.nan)
    sd = np.hypot(settings["noise"], 1e-6 * settings["noise_ppm"] * depth) / np.sqrt(np.maximum(cosine, 0.1))
    beside = np.roll(ranges, 1, axis=1)
    jump = np.abs(beside - ranges)
    mixed = (jump > 30) & (jump < 1500) & (rng.random(depth.shape) < settings["mixed"])
    share = rng.random(depth.shape)
    ranges[mixed] = (share * ranges + (1 - share) * beside)[mixed]
    return np.asarray(ranges + sd * rng.normal(size=depth.shape))


def scan(bodies: Bodies, frame: Frame, settings: dict[str, float], rng: np.random.Generator) -> Array:
    """Return the merged cloud (n, 3), with the errors of the stations' registration."""
    low, high = frame.nodes.min(axis=0), frame.nodes.max(axis=0)
    count = int(settings["stations"])
    clouds = []
    for k in range(count):
        turn = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / count
        middle, half = (low + high)[:2] / 2, (high - low)[:2] / 2
        station = np.append(middle + half * 0.75 * np.array([np.cos(turn), np.sin(turn)]), rng.uniform(1500, 1900))
        offset = settings["range_offset"] * rng.normal()
        pose = 1e-6 * settings["rotation_urad"] * rng.normal(size=3), settings["shift"] * rng.normal(size=3)
        for camera in cameras():
            depth, cosine, rays = image(bodies, station, camera, 1e-3 * settings["step_mrad"])
            ranges = measured(depth, cosine, settings, rng)
            ray = rays[np.isfinite(ranges)] * (ranges[np.isfinite(ranges)] + offset)[:, None]
            clouds.append(station + ray + np.cross(pose[0], ray) + pose[1])
    cloud = np.concatenate(clouds)
    stray = rng.uniform(low - 500, high + 500, (int(settings["outliers"] * len(cloud)), 3))
    cloud = np.concatenate([cloud, stray])
    return np.asarray(cloud[rng.permutation(len(cloud))])


# --- files ------------------------------------------------------------------------------------------------------------


def write_pcd(path: Path, points_mm: Array) -> None:
    """Write binary PCD of doubles, metres."""
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(points_mm)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points_mm)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + (points_mm / 1000.0).astype("<f8").tobytes())


def as_designed(built: Frame, missing: Indices, R: Array, t: Array, nodes: Array) -> dict[str, object]:
    """Return the design of a frame in its own coordinates, without nodes ``missing`` (k,) and their members."""
    left = np.setdiff1d(np.arange(len(nodes)), missing)
    places = (nodes - t) @ R / 1000.0
    return {
        "units": "m", "kind": "space-frame",
        "nodes": [
            {"id": 101 + int(k), "centre": places[k].tolist(), "radius": float(built.radii[k]) / 1000.0} for k in left
        ],
        "members": [
            {"a": 101 + int(a), "b": 101 + int(b), "tube_diameter": float(tube) / 1000.0}
            for (a, b), tube in zip(built.members, built.tubes, strict=True) if a in left and b in left
        ],
    }  # fmt: skip


def without(frame: Frame, rows: Indices) -> Frame:
    """Return a frame without some nodes: they get no members; their balls are taken out by the caller."""
    keep = ~np.isin(frame.members, rows).any(axis=1)
    return Frame(frame.nodes, frame.radii, frame.members[keep], frame.tubes[keep])


def make(folder: Path, seed: int, settings: dict[str, float]) -> None:
    """Write the scan folder and its truth."""
    rng = np.random.default_rng([seed, 77])
    design = designed(settings, rng)
    count = len(design.nodes)
    order = rng.permutation(count)
    extra, missing = np.split(order[: int(settings["extra"] + settings["missing"])], [int(settings["extra"])])
    radii = design.radii.copy()
    for k in order[len(extra) + len(missing) :][: int(settings["wrong_size"])]:
        radii[k] = BALLS[max(0, BALLS.index(radii[k]) - 1)] if radii[k] > BALLS[2] else BALLS[BALLS.index(radii[k]) + 1]
    off = settings["off"] * rng.normal(size=(count, 3)) / np.sqrt(3.0)
    built = without(Frame(design.nodes + off, radii, design.members, design.tubes), missing)
    there = np.setdiff1d(np.arange(count), missing)
    bodies = steel(built, settings, rng)
    for k in sorted(missing.tolist(), reverse=True):
        for column in (bodies.a, bodies.b, bodies.radii):
            del column[k]
    if settings["clutter"]:
        clutter(built, bodies, rng)
    cloud = scan(bodies, built, settings, rng)
    turn, shift = rng.uniform(-0.6, 0.6), rng.uniform(-2e4, 2e4, 3)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    folder.mkdir(parents=True, exist_ok=True)
    write_pcd(folder / "hall_ALL stations-merged.pcd", cloud)
    # A node that the design lacks is "extra" as built; one that was not built is "missing".
    if settings["design"]:
        table = as_designed(design, extra, R, shift, design.nodes)
        (folder / "design.json").write_text(json.dumps(table))
        (folder / "project.toml").write_text('kind = "space-frame"\ndesign = "design.json"\n')
    else:
        (folder / "project.toml").write_text('kind = "space-frame"\n')
    lowest = built.nodes[there] - np.outer(radii[there], [0, 0, 1.0])
    truth = {
        "format": "processor-truth", "sigma_mm": settings["noise"],
        "frame": {"ids": (101 + there).tolist(), "centres": built.nodes[there].tolist(), "radii": radii[there].tolist(),
                  "lowest": lowest.tolist()},
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
