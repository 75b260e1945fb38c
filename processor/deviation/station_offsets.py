"""Errors that the points of one station have in common: of its registration and of its scanner's range.

Where several stations saw the same piece of a face, the means of their distances from it differ by more than the noise
of their points explains. The surplus is the variance between stations (DerSimonian and Laird 1986). The mean of many
points of few stations is then no better than the number of stations allows.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.adjustment.groups import pieces
from processor.adjustment.opposite_sides import SURE
from processor.deviation.local_translation import Movement
from processor.geometry.mesh_distance import Samples
from processor.model import Floats, Ints
from processor.robust_statistics import student_factor

CELL_DIAMETERS = 3.0  # side of a piece of a face
LEAST_POINTS = 10  # of a station on a piece
SAME_FACE = 0.9  # least cosine between the normals of a point and of its core point


def shared_sd(
    core: Samples, moved: Movement, feet: Floats, facing: Floats, distance: Floats, station: Ints, diameter_mm: float
) -> Floats:
    """Return the standard deviation (k,) of the error that stations cause in the movements at core points, mm.

    The points at ``feet`` (n, 3) on faces with normals ``facing`` (n, 3) have a ``distance`` (n,) and a ``station``
    (n,). It is 0 where no piece was seen from two stations, and where these do not differ by more than chance.
    """
    shared = np.zeros(len(core.points))
    known = np.flatnonzero(np.isfinite(moved.along))
    if not len(known) or len(np.unique(station)) < 2:
        return shared
    at = known[cKDTree(core.points[known]).query(feet, workers=-1)[1]]
    rows = np.flatnonzero(np.einsum("ni,ni->n", facing, core.normals[at]) > SAME_FACE)
    cell = pieces(core.points[known], core.normals[known], CELL_DIAMETERS * diameter_mm)
    of_core = np.full(len(core.points), -1, np.int64)
    of_core[known] = cell
    left = distance[rows] - moved.along[at[rows]]
    key, group, number = np.unique(
        np.stack([of_core[at[rows]], station[rows]], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    group = group.reshape(-1)
    mean = np.bincount(group, left) / number
    noise = np.bincount(group, (left - mean[group]) ** 2) / np.maximum(number - 1, 1)
    total = np.bincount(of_core[at[rows]], minlength=len(cell))
    share = np.bincount(key[:, 0], number**2, len(cell)) / np.maximum(total, 1) ** 2
    variance = _between(key[:, 0], mean, noise / number, number >= LEAST_POINTS)
    widening = float(student_factor(len(np.unique(station)) - 1))
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
    return variance if variance > SURE * float(surplus.std()) / np.sqrt(len(surplus)) else 0.0
