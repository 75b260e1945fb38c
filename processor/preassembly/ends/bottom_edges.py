"""Departures of a part's bottom edges from the design, at regular chainages, with their covariance.

An edge is where the bottom and a web meet. In every interval of chainage the residuals of both faces against the design
are fitted with a plane in the distances along and from the edge. Its value at the edge is the departure, of the web
sideways and of the bottom up. The departures of an edge are then smoothed along it.

Points of one view share errors. The webs are seen from different views, as are the halves of a part, so these errors
are no motion of the part and stay after the adjustment. Where stations are named, the views are the stations, and each
departure follows their errors as its plane does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from processor.adjustment.model_averaging import smooth
from processor.geometry import mesh_distance, rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.geometry.mesh_distance import on_face
from processor.geometry.nearest_neighbours import within_reach
from processor.large_arrays import blocks
from processor.model import Bools, Columns, Floats, Ints, Labels
from processor.preassembly.assembly_errors import INTERVAL_MM
from processor.preassembly.ends import plate_sides
from processor.preassembly.ends.outer_faces import ALONG, RegisteredPart
from processor.robust_statistics import robust_sd

REACH_MM = 200.0  # across each face
LEAST_POINTS = 30  # ten times the unknowns of a plane: fewer are of what hides the edge
LEAST_KEPT = 0.7  # of the points of an interval: on the plane fitted to them
FLOOR_MM = 0.004  # of the design's mesh and of rounding
PASS_POINTS = 50_000  # beside an edge, in memory at once


@dataclass(frozen=True)
class EdgeDepartures:
    """Departures of both bottom edges of a part from the design, a row per chainage and edge; mm, bridge frame.

    ``covariance`` leaves out the error of the part's registration; ``by_pose`` is the derivative of the departures'
    errors by it. ``by_view`` is their derivative by errors that the points of a view share, along the axes, and
    ``by_tilt`` by what tilts a face across. Views are the stations, where several are named; else the halves of the
    left web and of the right web, for the departures sideways, and of the bottom, for those up.
    """

    side: tuple[str, ...]  # left | right
    chainage: Floats  # (k,) from the part's start
    points: Floats  # (k, 3) on the design's edge
    axes: Floats  # (k, 2, 3) unit vectors sideways (to the left) and up
    departure: Floats  # (k, 2) sideways and up; NaN = unknown
    covariance: Floats  # (2, k, k) sideways, and up
    by_pose: Floats  # (k, 2, 6)
    by_view: Floats  # (2, k, v) sideways, and up
    by_tilt: Floats  # (2, k, v)
    tails: Floats  # (2, 2) probabilities of residuals at least as large: of left and right edge, sideways and up


NONE = EdgeDepartures(  # of a part whose design has no bottom edges
    side=(),
    chainage=np.empty(0),
    points=np.empty((0, 3)),
    axes=np.empty((0, 2, 3)),
    departure=np.empty((0, 2)),
    covariance=np.empty((2, 0, 0)),
    by_pose=np.empty((0, 2, 6)),
    by_view=np.empty((2, 0, 4)),
    by_tilt=np.empty((2, 0, 4)),
    tails=np.full((2, 2), np.nan),
)


@dataclass(frozen=True)
class _FacePoints(Columns):
    """Points (n,) of one face near an edge: interval, distances along and from the edge, residual, station."""

    interval: Labels
    x: Floats
    w: Floats
    residual: Floats
    station: Labels

    def basis(self) -> Floats:
        """Return the terms (n, 3) of a plane."""
        return np.stack([np.ones_like(self.x), self.x / INTERVAL_MM, self.w / REACH_MM], axis=1)


class _Candidates(NamedTuple):
    """Points (n,) beside an edge that may be of a face, and which of them are nearer to another face of the design."""

    face: _FacePoints
    inner: Bools


class _Edge(NamedTuple):
    """A bottom edge; lengths in mm.

    ``sense`` is 1 of the left edge and -1 of the right one, ``margin`` the least distance of points from it. Departures
    are measured at ``chainage`` (k,). ``places`` (f, 3) lie at chainages ``fine`` (f,), every 10 mm, with the ``frame``
    there, see :func:`_frame`, and a ``tree`` of them.
    """

    sense: float
    margin: float
    chainage: Floats
    fine: Floats
    places: Floats
    frame: tuple[Floats, Floats, Floats]
    tree: cKDTree


class _AtEdge(NamedTuple):
    """Departures (k,) at the edge, their variances (k,) by noise, and their derivative (k, s) by errors of stations."""

    value: Floats
    variance: Floats
    by_station: Floats


def measure(part: RegisteredPart, left: Polyline, right: Polyline, sigma_mm: float) -> EdgeDepartures:
    """Measure both edges of a part; ``left`` and ``right`` are the design's, ``sigma_mm`` the noise of the points."""
    edges = (_measure_edge("left", part, left, right, sigma_mm), _measure_edge("right", part, right, left, sigma_mm))
    return EdgeDepartures(
        side=edges[0].side + edges[1].side,
        chainage=np.concatenate([edge.chainage for edge in edges]),
        points=np.concatenate([edge.points for edge in edges]),
        axes=np.concatenate([edge.axes for edge in edges]),
        departure=np.concatenate([edge.departure for edge in edges]),
        covariance=np.array([block_diag(*(edge.covariance[axis] for edge in edges)) for axis in range(2)]),
        by_pose=np.concatenate([edge.by_pose for edge in edges]),
        by_view=np.concatenate([edge.by_view for edge in edges], axis=1),
        by_tilt=np.concatenate([edge.by_tilt for edge in edges], axis=1),
        tails=np.concatenate([edge.tails for edge in edges]),
    )


def with_errors_of_views(edges: EdgeDepartures, level: float, across: float = 0.0) -> EdgeDepartures:
    """Add errors that the points of a view share, of variances ``level`` and ``across`` in mm^2, to the covariance.

    ``across`` is of the tilt across a face, at its sides.
    """
    added = [level * by @ by.T + across * tilt @ tilt.T for by, tilt in zip(edges.by_view, edges.by_tilt, strict=True)]
    return replace(edges, covariance=edges.covariance + np.array(added))


def unknown(left: Polyline, right: Polyline) -> EdgeDepartures:
    """Return the departures, all NaN, of a part without points."""
    mesh = mesh_distance.of_mesh(np.eye(3), np.array([[0, 1, 2]]))
    part = RegisteredPart(
        points=np.empty((0, 3)),
        station=np.empty(0, np.int64),
        between_stations=0.0,
        pose=np.zeros((6, 6)),
        surface=mesh,
        outer=mesh,
    )
    return measure(part, left, right, 0.0)


def _measure_edge(side: str, part: RegisteredPart, line: Polyline, other: Polyline, sigma_mm: float) -> EdgeDepartures:
    sense = 1.0 if side == "left" else -1.0
    count = max(1, int(line.length / INTERVAL_MM))
    chainage = INTERVAL_MM * (np.arange(count, dtype=np.float64) + 0.5)
    stations = int(part.station.max(initial=0)) + 1
    at_edge = [_at_edge(face, count, stations) for face in _faces(part, line, other, sense, sigma_mm, chainage)]
    points = line.at(chainage)
    _, *axes = _frame(line, other, chainage, sense)
    motions = [np.einsum("ki,kij->kj", axis, rigid.motion(points)) for axis in axes]
    smoothed = [
        smooth(chainage, at.value, at.variance, motion @ part.pose @ motion.T)
        for at, motion in zip(at_edge, motions, strict=True)
    ]
    by_station = np.stack([at.by_station for at in at_edge])
    views = by_station, np.zeros_like(by_station)
    if (part.station == part.station[:1]).all():  # of one station, or of views that are not named
        # Derivatives (2, k, 4) of raw departures by the levels and tilts of views that are not named
        first = chainage < 0.5 * line.length
        half = np.stack([first, ~first], axis=1).astype(np.float64)
        none = np.zeros_like(half)
        web = np.hstack([half, none] if sense > 0.0 else [none, half])
        bottom = np.hstack([half, none])
        views = np.stack([web, bottom]), np.stack([web, sense * bottom])
    by_view, by_tilt = (np.stack([e.gain for e in smoothed]) @ of_views for of_views in views)
    by_pose = [estimate.not_followed(motion) for estimate, motion in zip(smoothed, motions, strict=True)]
    return EdgeDepartures(
        side=(side,) * count,
        chainage=chainage,
        points=points,
        axes=np.stack(axes, axis=1),
        departure=np.stack([estimate.mean for estimate in smoothed], axis=1),
        covariance=np.array([e.covariance - F @ part.pose @ F.T for e, F in zip(smoothed, by_pose, strict=True)]),
        by_pose=np.stack(by_pose, axis=1),
        by_view=by_view,
        by_tilt=by_tilt,
        tails=np.array([[estimate.tail for estimate in smoothed]]),
    )


def _faces(
    part: RegisteredPart, line: Polyline, other: Polyline, sense: float, sigma_mm: float, chainage: Floats
) -> tuple[_FacePoints, _FacePoints]:
    """Points of the web and of the bottom along an edge, those of the plates' inner sides left out."""
    fine = np.arange(0.0, line.length, 10.0, dtype=np.float64)
    places = line.at(fine)
    edge = _Edge(
        sense=sense, margin=3.0 * sigma_mm + 2.0, chainage=chainage, fine=fine, places=places,
        frame=_frame(line, other, fine, sense), tree=cKDTree(places),
    )  # fmt: skip
    rows = np.flatnonzero(within_reach(part.points, places, 1.2 * REACH_MM)[0])
    parts = [_near(part, rows[some], edge) for some in blocks(len(rows), PASS_POINTS)] or [_near(part, rows, edge)]
    webs, bottoms = zip(*parts, strict=True)
    return _outer_side(webs, sense), _outer_side(bottoms, -1.0)


def _outer_side(found: Sequence[_Candidates], sense: float) -> _FacePoints:
    """Join the points of a face, those of the plate's inner side left out; residuals by ``sense`` are outward."""
    face = _FacePoints.concat([one.face for one in found])
    return face.take(_outer(face.interval, sense * face.residual, np.concatenate([one.inner for one in found])))


def _near(part: RegisteredPart, rows: Ints, edge: _Edge) -> tuple[_Candidates, _Candidates]:
    """Return those of the points in ``rows`` that lie on the web and on the bottom beside an edge."""
    points, station, fine, frame = part.points[rows], part.station[rows], edge.fine, edge.frame
    at = edge.tree.query(points, workers=-1)[1]
    offset = points - edge.places[at]
    along, level, up = (np.einsum("ni,ni->n", offset, frame[k][at]) for k in range(3))
    nearest, distance, _ = part.surface.distances(points, REACH_MM)
    face, residual, beyond = part.outer.distances(points, REACH_MM)
    measured = (nearest >= 0) & on_face(face, beyond) & (np.abs(residual) < plate_sides.REACH_MM)
    # The sense of the normals is not used: meshes come with either.
    normals = part.outer.normals[face], part.surface.normals[nearest]
    facing, nearest_facing = ([np.einsum("ni,ni->n", n, frame[k][at]) for k in (1, 2)] for n in normals)
    looks = [(np.abs(facing[k]) > ALONG) & (np.abs(nearest_facing[k]) > ALONG) for k in range(2)]
    interval = np.floor((fine[at] + along) / INTERVAL_MM).astype(np.int64)
    x = fine[at] + along - edge.chainage[np.clip(interval, 0, len(edge.chainage) - 1)]
    inside = measured & (interval >= 0) & (interval < len(edge.chainage))
    inward = -edge.sense * level
    web = inside & looks[0] & (np.abs(level) < plate_sides.REACH_MM) & (up > edge.margin) & (up < REACH_MM)
    bottom = inside & looks[1] & (np.abs(up) < plate_sides.REACH_MM) & (inward > edge.margin) & (inward < REACH_MM)
    inner = np.abs(distance) < np.abs(residual) - plate_sides.LAYER_MM  # nearer to another face of the design
    numbers, stations = interval.astype(np.int32), station.astype(np.int32)
    of_web = _FacePoints(numbers, x, up, np.sign(facing[0]) * residual, stations)
    of_bottom = _FacePoints(numbers, x, inward, np.sign(facing[1]) * residual, stations)
    return _Candidates(of_web.take(web), inner[web]), _Candidates(of_bottom.take(bottom), inner[bottom])


def _frame(line: Polyline, other: Polyline, chainage: Floats, sense: float) -> tuple[Floats, Floats, Floats]:
    """Return unit vectors (k, 3) along the edge, to the left, and up, at chainages (k,)."""
    along = line.at(chainage + 5.0) - line.at(chainage - 5.0)
    along = along / np.linalg.norm(along, axis=1)[:, None]
    left = sense * (line.at(chainage) - other.at(chainage * other.length / line.length))
    left = left - np.einsum("ni,ni->n", left, along)[:, None] * along
    left = left / np.linalg.norm(left, axis=1)[:, None]
    return along, left, np.cross(along, left)


def _outer(interval: Labels, out: Floats, inner: Bools) -> Bools:
    """Mark points (n,) that are not of a plate's inner side, interval by interval.

    A single layer where the design has the ``inner`` (n,) side may be either side, and is left out.
    """
    outer = np.ones(len(out), bool)
    for number in np.unique(interval[out < -plate_sides.LAYER_MM]):
        rows = np.flatnonzero(interval == number)
        layer = plate_sides.outer_layer(out[rows])
        outer[rows] = layer & ~inner[rows] if layer.all() else layer
    return outer


def _at_edge(face: _FacePoints, count: int, stations: int) -> _AtEdge:
    """Values at the edge of planes in x and w, fitted to the residuals of each of ``count`` intervals.

    An interval of which many points lie off its plane shows something else (a trestle beneath the part), and is NaN.
    """
    used = np.ones(len(face.x), bool)
    value, variance = np.full(count, np.nan), np.full(count, np.nan)
    by_station = np.zeros((count, stations))
    for _ in range(3):
        number, N, right, of_station = _sums(face, used, count, stations)
        fitted = np.flatnonzero(number >= LEAST_POINTS)
        N = N[fitted]
        well_posed = np.linalg.cond(N) < 1e6
        fitted, N = fitted[well_posed], N[well_posed]
        solution = np.zeros((count, 3))
        inverse = np.linalg.inv(N)
        solution[fitted] = np.einsum("nij,nj->ni", inverse, right[fitted])
        rest = np.empty(len(face.x))
        for rows in blocks(len(rest)):
            some = face.take(rows)
            rest[rows] = some.residual - np.einsum("ni,ni->n", some.basis(), solution[some.interval])
        known = np.isin(face.interval, fitted)
        sd = robust_sd(rest[known & used])
        value, variance = np.full(count, np.nan), np.full(count, np.nan)
        value[fitted], variance[fitted] = solution[fitted, 0], sd**2 * inverse[:, 0, 0] + FLOOR_MM**2
        by_station[:], by_station[fitted] = 0.0, np.einsum("ni,nsi->ns", inverse[:, 0], of_station[fitted])
        now = known & (np.abs(rest) < 4.5 * max(sd, FLOOR_MM))
        if (now == used).all():
            break
        used = now
    of_face = np.bincount(face.interval[now], minlength=count) >= LEAST_KEPT * np.bincount(
        face.interval, minlength=count
    )
    value[~of_face] = np.nan
    return _AtEdge(value, variance, by_station)


def _sums(face: _FacePoints, used: Bools, count: int, stations: int) -> tuple[Ints, Floats, Floats, Floats]:
    """Sum the used points of ``count`` intervals: their number, and the normal equations of their planes.

    These are the matrix (count, 3, 3), the right side (count, 3), mm, and the terms (count, s, 3) of each station's
    points, all in the units of the basis.
    """
    number, N, right = np.zeros(count, np.int64), np.zeros((count, 9)), np.zeros((count, 3))
    of_station = np.zeros((count * stations, 3))
    for rows in blocks(len(used)):
        some = face.take(rows).take(used[rows])
        B, group = some.basis(), some.interval.astype(np.int64) * stations + some.station
        number += np.bincount(some.interval, minlength=count)
        for k in range(3):
            right[:, k] += np.bincount(some.interval, B[:, k] * some.residual, count)
            of_station[:, k] += np.bincount(group, B[:, k], count * stations)
            for m in range(3):
                N[:, 3 * k + m] += np.bincount(some.interval, B[:, k] * B[:, m], count)
    return number, N.reshape(count, 3, 3), right, of_station.reshape(count, stations, 3)
