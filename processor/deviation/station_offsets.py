"""Errors that the points of one station have in common: of its registration and of its scanner's range.

Where several stations saw the same piece of a face, the means of their distances from it differ by more than the noise
of their points explains. The surplus is the variance between stations (DerSimonian and Laird 1986). The mean of many
points of few stations is then no better than the number of stations allows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.adjustment.point_groups import pieces
from processor.adjustment.view_error_from_opposite_sides import SIGNIFICANT
from processor.deviation.local_translation import Movement
from processor.geometry.mesh_distance import Samples
from processor.large_arrays import put_aside, release
from processor.model import Floats, Ints
from processor.robust_statistics import student_factor

CELL_DIAMETERS = 3.0  # side of a piece of a face
LEAST_POINTS = 10  # of a station on a piece
SAME_FACE = 0.9  # least cosine between the normals of a point and of its core point


class OnFaces(NamedTuple):
    """Points whose ``feet`` (n, 3) lie on faces with normals ``facing`` (n, 3): ``distance`` (n,), ``station`` (n,)."""

    feet: Floats
    facing: Floats
    distance: Floats
    station: Ints


class Pieces(NamedTuple):
    """Pieces of faces: the ``known`` core points (m,), a tree of them, and of each core point (k,) its piece, or -1.

    ``normals`` (k, 3) are those of the core points, ``along`` (k,) their movements.
    """

    known: Ints
    tree: cKDTree
    of_core: Ints
    normals: Floats
    along: Floats


class OnPieces(NamedTuple):
    """Points (n,) on pieces: the piece, the station, and the distance less the movement of the core point."""

    piece: Ints
    station: Ints
    left: Floats


def on_pieces(points: OnFaces, pieces: Pieces) -> OnPieces:
    """Assign points to the pieces of their core points."""
    at = pieces.known[pieces.tree.query(points.feet, workers=-1)[1]] if len(points.feet) else pieces.known[:0]
    rows = np.flatnonzero(np.einsum("ni,ni->n", points.facing, pieces.normals[at]) > SAME_FACE)
    at = at[rows]
    return OnPieces(
        pieces.of_core[at].astype(np.int32),
        points.station[rows].astype(np.int32),
        points.distance[rows] - pieces.along[at],
    )


def shared_sd(
    core: Samples,
    moved: Movement,
    stations: Collection[int],
    points: Callable[[Pieces], Iterable[OnPieces]],
    diameter_mm: float,
) -> Floats:
    """Return the standard deviation (k,) of the error that stations cause in the movements at core points, mm.

    ``points`` passes over the points that were measured, from ``stations``. It is 0 where no piece was seen from two
    stations, and where these do not differ by more than chance.
    """
    shared = np.zeros(len(core.points))
    known = np.flatnonzero(np.isfinite(moved.along))
    if not len(known) or len(stations) < 2:
        return shared
    cell = pieces(core.points[known], core.normals[known], CELL_DIAMETERS * diameter_mm)
    of_core = np.full(len(core.points), -1, np.int64)
    of_core[known] = cell
    cells, most = int(cell.max()) + 1, max(stations) + 1
    number, total = np.zeros(cells * most, np.int64), np.zeros(cells * most)
    asides = []
    for part in points(Pieces(known, cKDTree(core.points[known]), of_core, core.normals, moved.along)):
        key = part.piece.astype(np.int64) * most + part.station
        number += np.bincount(key, minlength=len(number))
        total += np.bincount(key, part.left, len(number))
        asides.append((put_aside(key.astype(np.int32)), put_aside(part.left)))
    mean, square = total / np.maximum(number, 1), np.zeros(len(number))
    for key, left in asides:
        square += np.bincount(key, (left - mean[key]) ** 2, len(number))
        release()
    seen = np.flatnonzero(number)
    of_cell, count = seen // most, number[seen]
    noise = square[seen] / np.maximum(count - 1, 1)
    share = np.bincount(of_cell, count**2, cells) / np.maximum(np.bincount(of_cell, count, cells), 1) ** 2
    variance = _between(of_cell, mean[seen], noise / count, count >= LEAST_POINTS)
    widening = float(student_factor(len(stations) - 1))
    shared[known] = widening * np.sqrt(variance * share[cell])
    return shared


def _between(cell: Ints, mean: Floats, noise: Floats, enough: npt.NDArray[np.bool_]) -> float:
    """Variance between stations, mm^2, by their means on cells and the noise of these; 0 if it may be chance."""
    cell, mean, noise = cell[enough], mean[enough], noise[enough]
    count = np.bincount(cell)
    several = count >= 2
    if several.sum() < 2:
        return 0.0
    middle = np.bincount(cell, mean) / np.maximum(count, 1)
    scatter = np.bincount(cell, (mean - middle[cell]) ** 2) / np.maximum(count - 1, 1)
    surplus = (scatter - np.bincount(cell, noise) / np.maximum(count, 1))[several]
    variance = float(surplus.mean())
    return variance if variance > SIGNIFICANT * float(surplus.std()) / np.sqrt(len(surplus)) else 0.0
