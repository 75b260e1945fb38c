"""Where the bottom edges of a part really run: departures from the design's, station by station, with their spread.

An edge is where the bottom and a web meet. Near a station both faces' residuals against the design are fitted with a
plane in the distance along and from the edge; at the edge itself they say how far it lies sideways and up. The stations
of an edge are then smoothed along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from processor.adjustment.model_averaging import smooth
from processor.geometry import mesh_distance, rigid
from processor.geometry.mesh_distance import MeshSurface, on_face
from processor.geometry.polyline import Polyline
from processor.model import Floats, Ints
from processor.preassembly.ends import plate_sides
from processor.preassembly.ends.faces import ALONG
from processor.preassembly.ends.plate_sides import Bools

STATION_MM = 200.0
REACH_MM = 200.0  # across each face
LEAST_POINTS = 30
FLOOR_MM = 0.004


@dataclass(frozen=True)
class EdgeStations:
    """Stations of both edges of a part, a row each: design point (k, 3), unit vectors sideways and up (k, 2, 3)."""

    side: tuple[str, ...]  # left | right
    arc: Floats  # (k,) from the part's start
    points: Floats
    axes: Floats
    departure: Floats  # (k, 2) sideways (to the left) and up; NaN where nothing is known
    covariance: Floats  # (2, k, k) of departures sideways, and of those up, but for what by_pose brings
    by_pose: Floats  # (k, 2, 6) how their errors follow that of the part's registration


def measure(
    points: Floats,
    surface: MeshSurface,
    outer: MeshSurface,
    left: Polyline,
    right: Polyline,
    sigma_mm: float,
    pose: Floats,
) -> EdgeStations:
    """Measure both edges on points (n, 3), bridge frame, registered to the design with a covariance ``pose`` (6, 6).

    ``outer`` are the outer faces of ``surface``.
    """
    sides: list[str] = []
    arcs, places, axes, departures, own_noise, by_pose = [], [], [], [], [], []
    for side, line, other, sense in (("left", left, right, 1.0), ("right", right, left, -1.0)):
        count = max(1, int(line.length / STATION_MM))
        arc = STATION_MM * (np.arange(count, dtype=np.float64) + 0.5)
        fine = np.arange(0.0, line.length, 10.0, dtype=np.float64)
        frame = _frame(line, other, fine, sense)
        near, index = cKDTree(line.at(fine)).query(points, distance_upper_bound=1.2 * REACH_MM, workers=-1)
        rows = np.flatnonzero(np.isfinite(near))
        own, at = points[rows], index[rows]
        offset = own - line.at(fine[at])
        along, level, up = (np.einsum("ni,ni->n", offset, frame[k][at]) for k in range(3))
        nearest = surface.distances(own, REACH_MM)[0]
        face, residual, beyond = outer.distances(own, REACH_MM)
        seen = (nearest >= 0) & on_face(face, beyond) & (np.abs(residual) < plate_sides.REACH_MM)
        # Not by the sense of the normals: meshes come with either.
        normal, on = outer.normals[face], surface.normals[nearest]
        facing, nearly = ([np.einsum("ni,ni->n", n, frame[k][at]) for k in (1, 2)] for n in (normal, on))
        lies = [(np.abs(facing[k]) > ALONG) & (np.abs(nearly[k]) > ALONG) for k in range(2)]
        margin = 3.0 * sigma_mm + 2.0
        station = np.floor((fine[at] + along) / STATION_MM).astype(np.int64)
        x = fine[at] + along - arc[np.clip(station, 0, count - 1)]
        inside = seen & (station >= 0) & (station < count)
        web = inside & lies[0] & (np.abs(level) < plate_sides.REACH_MM) & (up > margin) & (up < REACH_MM)
        bottom = inside & lies[1] & (np.abs(up) < plate_sides.REACH_MM) & (-sense * level > margin)
        bottom &= -sense * level < REACH_MM
        for own, out in ((web, sense * np.sign(facing[0])), (bottom, -np.sign(facing[1]))):
            own[own] = _outer(station[own], (out * residual)[own])
        found = [
            _at_edge(station[web], x[web], up[web], np.sign(facing[0][web]) * residual[web], count),
            _at_edge(
                station[bottom], x[bottom], -sense * level[bottom], np.sign(facing[1][bottom]) * residual[bottom], count
            ),
        ]
        sides += [side] * count
        arcs.append(arc)
        places.append(line.at(arc))
        frame = _frame(line, other, arc, sense)
        axes.append(np.stack([frame[1], frame[2]], axis=1))
        moves = [np.einsum("ki,kij->kj", frame[k], rigid.motion(line.at(arc))) for k in (1, 2)]
        both = [smooth(arc, *one, moved @ pose @ moved.T) for one, moved in zip(found, moves, strict=True)]
        left_over = [one.left_of(moved) for one, moved in zip(both, moves, strict=True)]
        departures.append(np.stack([one.mean for one in both], axis=1))
        own_noise.append([one.covariance - F @ pose @ F.T for one, F in zip(both, left_over, strict=True)])
        by_pose.append(np.stack(left_over, axis=1))
    return EdgeStations(
        tuple(sides),
        np.concatenate(arcs),
        np.concatenate(places),
        np.concatenate(axes),
        np.concatenate(departures),
        np.array([block_diag(*sides_of_axis) for sides_of_axis in zip(*own_noise, strict=True)]),
        np.concatenate(by_pose),
    )


def unseen(left: Polyline, right: Polyline) -> EdgeStations:
    """Return the stations of a part of which nothing is known."""
    nothing = np.empty((0, 3))
    mesh = mesh_distance.of_mesh(np.eye(3), np.array([[0, 1, 2]]))
    return measure(nothing, mesh, mesh, left, right, 0.0, np.zeros((6, 6)))


def _frame(line: Polyline, other: Polyline, arc: Floats, sense: float) -> tuple[Floats, Floats, Floats]:
    """Return unit vectors (k, 3) along the edge, to the left, and up, at arc lengths (k,)."""
    along = line.at(arc + 5.0) - line.at(arc - 5.0)
    along = along / np.linalg.norm(along, axis=1)[:, None]
    left = sense * (line.at(arc) - other.at(arc * other.length / line.length))
    left = left - np.einsum("ni,ni->n", left, along)[:, None] * along
    left = left / np.linalg.norm(left, axis=1)[:, None]
    return along, left, np.cross(along, left)


def _outer(station: Ints, out: Floats) -> Bools:
    """Mark points (n,) that are not of a plate's inner side, station by station."""
    kept = np.ones(len(out), bool)
    for one in np.unique(station[out < -plate_sides.LAYER_MM]):
        at = np.flatnonzero(station == one)
        kept[at] = plate_sides.outer(out[at])
    return kept


def _at_edge(station: np.ndarray, x: Floats, w: Floats, residual: Floats, count: int) -> tuple[Floats, Floats]:
    """Residual (count,) at the edge, of planes in x and w fitted station by station, and its variance."""
    basis = np.stack([np.ones_like(x), x / STATION_MM, w / REACH_MM], axis=1)
    used = np.ones(len(x), bool)
    value, variance = np.full(count, np.nan), np.full(count, np.nan)
    for _ in range(3):
        s, B, r = station[used], basis[used], residual[used]
        number = np.bincount(s, minlength=count)
        normal = np.stack([np.bincount(s, B[:, i] * B[:, j], count) for i in range(3) for j in range(3)], axis=1)
        right = np.stack([np.bincount(s, B[:, i] * r, count) for i in range(3)], axis=1)
        whole = np.flatnonzero(number >= LEAST_POINTS)
        N = normal[whole].reshape(-1, 3, 3)
        well = np.linalg.cond(N) < 1e6
        whole, N = whole[well], N[well]
        solution = np.zeros((count, 3))
        inverse = np.linalg.inv(N)
        solution[whole] = np.einsum("nij,nj->ni", inverse, right[whole])
        rest = residual - np.einsum("ni,ni->n", basis, solution[station])
        known = np.isin(station, whole)
        spread = 1.4826 * float(np.median(np.abs(rest[known & used]))) if (known & used).any() else 0.0
        value, variance = np.full(count, np.nan), np.full(count, np.nan)
        value[whole], variance[whole] = solution[whole, 0], spread**2 * inverse[:, 0, 0] + FLOOR_MM**2
        now = known & (np.abs(rest) < 4.5 * max(spread, FLOOR_MM))
        if (now == used).all():
            break
        used = now
    return value, variance
