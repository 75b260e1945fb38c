"""Mixed pixels: points whose beams may also have hit a nearer surface.

A beam has a width of some millimetres. At the outline of a body it meets the body and what is behind, and a phase
scanner states a mean of the two ranges (mixed pixel, Hebert and Krotkov 1992). Such points lie in the air or, where the
body behind is near, a little before its surface. A point is marked because of a neighbour in direction that lies:

- on another face, and more than HIGHER_MM before the face of the point. Its slope is not tested: on a face at grazing
  incidence, an edge far before it lies within the slope of a dent;
- on no face, and before the face of the point by more than HIGHER_MM and SLOPE times the distance along the face;
- on the same face, and before the point itself by more than these two together: on top of a bulge all neighbours lie
  before the face, but the slope is less.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor.geometry.thread_ranges import over_ranges
from processor.model import Bools, Floats, Ints

WINDOW_STEPS = 1.6  # of the scanner, within which a point is a neighbour: those of a square grid and its diagonals
# Half of a beam, by which the window is wider. Beams are 3.5 to 6 mm wide at exit and diverge by 0.3 to 0.5 mrad.
HALF_EXIT_MM, HALF_DIVERGENCE = 2.4, 2e-4
NEAREST_SHARE = 0.05  # of the points, which are so near that their window is not taken in full
STEP_NEIGHBOUR, STEP_SAMPLE = 4, 2_000  # of a point of a square grid, the first four lie one step away
HIGHER_MM = 3.0  # before the face, from which a neighbour is something else
SLOPE = 0.25  # height by the distance along the face, up to which a neighbour may be of the same steel: dents have less
LEAST_RANGE = 5_000  # points per task of a thread


T = TypeVar("T", float, Floats)


class _Others(NamedTuple):
    """All points (m, 3) of a scanner and their faces (m,), sorted by the bins (m,) of their directions.

    ``columns`` are the first bins of rows of one elevation, ``step`` is in rad.
    """

    points: Floats
    face: Ints
    key: Ints
    columns: Ints
    step: float


def mark(
    points: Floats, scanner: Floats, normals: Floats, height: Floats, face: Ints, every: tuple[Floats, Ints]
) -> Bools:
    """Mark the points (n, 3), mm, seen from a scanner (3,), whose beams may also have hit a nearer surface.

    ``normals`` (n, 3) are of the points' faces, ``height`` (n,) is how far the points lie above these, mm,
    and ``face`` (n,) numbers the faces. ``every`` are all points (m, 3) of the scanner, of which these are some, and
    their faces (m,), -1 = none.
    """
    everything, faces = every
    marked = np.zeros(len(points), np.bool_)
    directions = _directions(everything, scanner)
    step = _step(directions)
    if not (len(points) and step > 0.0):
        return marked
    nearest = float(np.quantile(np.linalg.norm(points - scanner, axis=1), NEAREST_SHARE))
    key, columns = _keys(directions, WINDOW_STEPS * step + half_beam_width(nearest) / nearest)
    order = np.argsort(key, kind="stable")
    others = _Others(np.ascontiguousarray(everything[order]), faces[order], key[order], columns, step)
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)

    def kernel(first: int, last: int) -> None:
        _mark(points, normals, height, face, scanner, others, marked, first, last)

    over_ranges(kernel, len(points), least=LEAST_RANGE)
    return marked


def half_beam_width(away: T) -> T:
    """Return half the width of a beam, mm, at distances from its scanner, mm."""
    return HALF_EXIT_MM + HALF_DIVERGENCE * away


def _directions(points: Floats, scanner: Floats) -> Floats:
    """Return unit vectors (n, 3) from a scanner (3,) to points (n, 3)."""
    arm = points - scanner
    directions: Floats = arm / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)[:, None]
    return directions


def _step(directions: Floats) -> float:
    """Return the angle in rad between neighbouring rays, of which only those that returned are known."""
    if len(directions) <= STEP_NEIGHBOUR:
        return 0.0
    sample = directions[:: max(1, len(directions) // STEP_SAMPLE)]
    distance = cKDTree(directions, balanced_tree=False).query(sample, k=STEP_NEIGHBOUR + 1)[0]
    return float(np.median(distance[:, -1]))


def _keys(directions: Floats, window: float) -> tuple[Ints, Ints]:
    """Return the bin (n,) of directions, and the first bins (rows + 1,) of rows of one elevation.

    A bin is as high as the window and at least as wide, so that all neighbours are in the bins about one.
    """
    rows = int(np.ceil(np.pi / window))
    elevation = np.pi * np.abs(np.arange(rows + 1) / rows - 0.5)
    widest = np.cos(np.maximum(elevation[:-1], elevation[1:]))
    columns = np.concatenate([[0], np.cumsum(np.maximum(1, np.floor(2.0 * np.pi * widest / window)))]).astype(np.int64)
    polar, turn = np.arccos(np.clip(directions[:, 2], -1.0, 1.0)), np.arctan2(directions[:, 1], directions[:, 0])
    row = np.minimum((polar / np.pi * rows).astype(np.int64), rows - 1)
    wide = columns[row + 1] - columns[row]
    return columns[row] + np.minimum(((turn / (2.0 * np.pi) + 0.5) * wide).astype(np.int64), wide - 1), columns


@njit(cache=True, nogil=True)
def _mark(points, normals, height, face, scanner, others, marked, first, last):  # type: ignore[no-untyped-def]
    """Mark points first to last - 1 of which a neighbour within the window stands before the face."""
    columns = others.columns
    rows = len(columns) - 1
    for i in range(first, last):
        x, y, z = points[i, 0] - scanner[0], points[i, 1] - scanner[1], points[i, 2] - scanner[2]
        far = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / far, y / far, z / far
        window = WINDOW_STEPS * others.step + HALF_EXIT_MM / far + HALF_DIVERGENCE
        ray, of_face = (x, y, z, window), (height[i], face[i])
        row = min(int(np.arccos(z) / np.pi * rows), rows - 1)
        turn = np.arctan2(y, x) / (2.0 * np.pi) + 0.5
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            start, end = columns[r], columns[r + 1] - 1
            at = start + min(int(turn * (end + 1 - start)), end - start)
            # The bins about one follow each other, but that a row's last and first ones are side by side.
            low, high = max(at - 1, start), min(at + 1, end)
            found = _any_before(points[i], normals[i], of_face, scanner, ray, others, low, high)
            if not found and at == start:
                found = _any_before(points[i], normals[i], of_face, scanner, ray, others, end, end)
            if not found and at == end:
                found = _any_before(points[i], normals[i], of_face, scanner, ray, others, start, start)
            if found:
                marked[i] = True
                break


@njit(cache=True, nogil=True)
def _any_before(point, normal, of_face, scanner, ray, others, low, high):  # type: ignore[no-untyped-def]
    """Return whether any of the points in bins low to high is a neighbour that stands before a point's face.

    ``of_face`` is how far the point lies above its face, and the face's number; ``ray`` its direction, and the window.
    """
    (height, face), (x, y, z, window) = of_face, ray
    for k in range(np.searchsorted(others.key, low), len(others.key)):
        if others.key[k] > high:
            break
        other, of_other = others.points[k], others.face[k]
        dx, dy, dz = other[0] - point[0], other[1] - point[1], other[2] - point[2]
        rise = dx * normal[0] + dy * normal[1] + dz * normal[2]
        above = rise + (0.0 if of_other == face else height)
        if above < HIGHER_MM:  # most neighbours: without any root
            continue
        a, b, c = other[0] - scanner[0], other[1] - scanner[1], other[2] - scanner[2]
        cosine = (a * x + b * y + c * z) / np.sqrt(a * a + b * b + c * c)
        if 1.0 - cosine > 0.5 * window * window:
            continue
        across = np.sqrt(max(dx * dx + dy * dy + dz * dz - rise * rise, 0.0))
        slope = SLOPE if of_other == face or of_other < 0 else 0.0
        if above > HIGHER_MM + slope * across:
            return True
    return False
