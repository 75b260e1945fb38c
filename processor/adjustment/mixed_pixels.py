"""Mixed pixels: points whose beams may also have hit a nearer surface.

A beam has a width of some millimetres. At the outline of a body it meets the body and what is behind, and a phase
scanner states a mean of the two ranges (mixed pixel, Hebert and Krotkov 1992). Such points lie in the air or, where the
body behind is near, a little before its surface. A point is marked because of a neighbour in direction that lies:

- on another face, and more than HIGHER_MM before the face of the point. Its slope is not tested: on a face at grazing
  incidence, an edge far before it lies within the slope of a dent;
- on no face, and before the face of the point by more than HIGHER_MM and SLOPE times the distance along the face;
- on the same face, and before the point itself by more than these two together: on top of a bulge all neighbours lie
  before the face, but the slope is less.

The points of a scanner need not fit in memory: :func:`mark_passes` takes them block by block, sorts them into bands of
elevation, and marks those of a band beside the next rows of directions of the bands about it.
"""
# Numba infers the types of the kernels' arguments: they stay without annotations.

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from processor import large_arrays, tiles
from processor.geometry.thread_ranges import over_ranges
from processor.inner_kernels import inner
from processor.large_arrays import Array, allocate, blocks, in_parts, release
from processor.model import Bools, Floats, Ints, Labels
from processor.tiles import Shared

WINDOW_STEPS = 1.6  # of the scanner, within which a point is a neighbour: those of a square grid and its diagonals
# Half of a beam, by which the window is wider. Beams are 3.5 to 6 mm wide at exit and diverge by 0.3 to 0.5 mrad.
HALF_EXIT_MM, HALF_DIVERGENCE = 2.4, 2e-4
NEAREST_SHARE = 0.05  # of the points, which are so near that their window is not taken in full
STEP_NEIGHBOUR, STEP_SAMPLE = 4, 2_000  # of a point of a square grid, the first four lie one step away
HIGHER_MM = 3.0  # before the face, from which a neighbour is something else
SLOPE = 0.25  # height by the distance along the face, up to which a neighbour may be of the same steel: dents have less
LEAST_RANGE = 5_000  # points per task of a thread
AT_ONCE = 500_000  # points of a scanner that are marked together; more are marked band by band
BAND_POINTS = 500_000  # of a band, but that it has a row of directions at least

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


class Block(NamedTuple):
    """Some points (n, 3), mm, their scanners (n,) as numbers, faces (n,), -1 = none, and facets (n,).

    The facet is -1 for what is not to be marked. ``height`` (n,) is how far the points lie above their faces, mm.
    """

    points: Floats
    scanner: Ints | Labels
    face: Ints | Labels
    facet: Ints | Labels
    height: Floats


def mark(
    points: Floats, scanner: Floats, normals: Floats, height: Floats, face: Ints, every: tuple[Floats, Ints]
) -> Bools:
    """Mark the points (n, 3), mm, seen from a scanner (3,), whose beams may also have hit a nearer surface.

    ``normals`` (n, 3) are of the points' faces, ``height`` (n,) is how far the points lie above these, mm,
    and ``face`` (n,) numbers the faces. ``every`` are all points (m, 3) of the scanner, of which these are some, and
    their faces (m,), -1 = none.
    """
    directions = _directions(every[0], scanner)
    step = _step(len(directions), lambda: [directions])
    if not (len(points) and step > 0.0):
        return np.zeros(len(points), np.bool_)
    ranges = np.linalg.norm(points - scanner, axis=1)
    columns = _columns(_window(step, float(np.quantile(ranges, NEAREST_SHARE))))
    return _marks((points, normals, height, face), scanner, every, _bins(directions, columns), columns, step)


def mark_passes(passes: Iterable[Block], scanners: Floats, normals: Floats) -> Bools:
    """Mark points as :func:`mark` does, of ``passes`` over blocks of all points of scanners (s, 3); NaN = unknown.

    ``normals`` (f, 3) are those of the facets. Returns the marks of the points that are to be marked, in their order.
    """
    count, judged = np.zeros(len(scanners), np.int64), 0
    for block in passes:
        count += np.bincount(block.scanner, minlength=len(scanners))
        judged += int(np.count_nonzero(block.facet >= 0))
    marked, ends = allocate(judged, dtype=np.bool_), np.cumsum(count)
    marked[:] = False
    if not judged:
        return marked
    _, *columns = in_parts(_numbered(passes), lambda block: block[0], ends)
    for scanner, part in zip(scanners, map(slice, ends - count, ends), strict=True):
        if np.isfinite(scanner).all() and part.start < part.stop:
            for rows, marks in _of_scanner(_Columns(*(column[part] for column in columns)), scanner, normals):
                marked[rows] = marks
    return marked


class _Columns(NamedTuple):
    """Points (n, 3) of a scanner, which may lie in a file, with the rows (n,) of their marks; -1 = not to be marked."""

    points: Floats
    face: Labels
    facet: Labels
    height: Floats
    row: Ints


def _numbered(passes: Iterable[Block]) -> Iterator[tuple[Array, ...]]:
    """Pass over the scanners of blocks, and their columns with the rows of the marks."""
    done = 0
    for points, scanner, face, facet, height in passes:
        judged = facet >= 0
        row = np.where(judged, done + np.cumsum(judged) - 1, -1)
        done += int(np.count_nonzero(judged))
        yield scanner.astype(np.int32), points, face.astype(np.int32), facet.astype(np.int32), height, row


def _of_scanner(every: _Columns, scanner: Floats, normals: Floats) -> Iterator[tuple[Ints, Bools]]:
    """Yield the rows of marks, and the marks of all points of a scanner (3,)."""
    count = len(every.points)
    if count <= AT_ONCE:
        points, face = every.points.copy(), every.face.astype(np.int64)
        rows = np.flatnonzero(every.facet >= 0)
        on = normals[every.facet[rows]], every.height[rows], face[rows]
        yield every.row[rows], mark(points[rows], scanner, *on, every=(points, face))
        return
    step = _step(count, lambda: (_directions(every.points[rows], scanner) for rows in blocks(count)))
    bands = _Bands.of(every, scanner, step) if step > 0.0 else None
    if bands is not None:
        fixed = Shared((scanner, normals, bands.columns, step))
        yield from tiles.mapped(_marks_of, bands.tiles(), fixed)


class _Band(NamedTuple):
    """All columns of a band's ``own`` points, and after them those of the rows of directions beside it."""

    columns: _Columns
    own: int


class _Bands(NamedTuple):
    """The points of a scanner (3,) sorted by bands of rows of directions: ``rows`` (b,) and points (b,) before ends."""

    every: _Columns
    columns: Ints
    scanner: Floats
    rows: Ints
    ends: Ints

    @classmethod
    def of(cls, every: _Columns, scanner: Floats, step: float) -> _Bands | None:
        """Sort the points of a scanner; None where none is to be marked."""
        count = len(every.points)
        ranges, done = allocate(sum(int(np.count_nonzero(every.row[rows] >= 0)) for rows in blocks(count))), 0
        for rows in blocks(count):
            judged = every.points[rows][every.row[rows] >= 0]
            ranges[done : done + len(judged)] = np.linalg.norm(judged - scanner, axis=1)
            done += len(judged)
        if not done:
            return None
        columns = _columns(_window(step, large_arrays.quantile(ranges, NEAREST_SHARE)))
        filled = np.zeros(len(columns) - 1, np.int64)
        for part in blocks(count):
            filled += np.bincount(_rows(_directions(every.points[part], scanner), columns), minlength=len(filled))
        band_of_row = tiles.grouped(filled, BAND_POINTS)
        ends = np.cumsum(np.bincount(band_of_row, filled)).astype(np.int64)

        def band_of(block: tuple[Array, ...]) -> Ints:
            found: Ints = band_of_row[_rows(_directions(block[0], scanner), columns)]
            return found

        found = in_parts((tuple(column[part] for column in every) for part in blocks(count)), band_of, ends)
        return cls(_Columns(*found), columns, scanner, np.cumsum(np.bincount(band_of_row)), ends=ends)

    def tiles(self) -> Iterator[_Band]:
        """Pass over the bands, each with the points of the rows of directions beside it."""
        parts = [slice(start, end) for start, end in zip([0, *self.ends[:-1]], self.ends, strict=True)]
        for band, part in enumerate(parts):
            beside = [np.arange(part.start, part.stop)]
            if band:
                beside.append(self._of_row(parts[band - 1], self.rows[band - 1] - 1))
            if band + 1 < len(parts):
                beside.append(self._of_row(parts[band + 1], self.rows[band]))
            rows = np.concatenate(beside)
            yield _Band(_Columns(*(column[rows] for column in self.every)), own=part.stop - part.start)
            release()

    def _of_row(self, part: slice, row: int) -> Ints:
        """Return the points of a band that are of a row of directions."""
        directions = _directions(self.every.points[part], self.scanner)
        found: Ints = part.start + np.flatnonzero(_rows(directions, self.columns) == row)
        return found


def _marks_of(band: _Band, fixed: tuple[Floats, Floats, Ints, float]) -> tuple[Ints, Bools]:
    """Return the rows of marks, and the marks of a band's own points."""
    scanner, normals, columns, step = fixed
    points, face = band.columns.points, band.columns.face.astype(np.int64)
    rows = np.flatnonzero(band.columns.facet[: band.own] >= 0)
    judged = points[rows], normals[band.columns.facet[rows]], band.columns.height[rows], face[rows]
    key = _bins(_directions(points, scanner), columns)
    return band.columns.row[rows], _marks(judged, scanner, (points, face), key, columns, step)


def _marks(
    judged: tuple[Floats, Floats, Floats, Ints],
    scanner: Floats,
    every: tuple[Floats, Ints],
    key: Ints,
    columns: Ints,
    step: float,
) -> Bools:
    """Mark points, with their normals, heights and faces, among all points and faces that have the bins ``key``."""
    points, normals, height, face = judged
    marked = np.zeros(len(points), np.bool_)
    order = np.argsort(key, kind="stable")
    others = _Others(np.ascontiguousarray(every[0][order]), every[1][order], key[order], columns, step)
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


def _step(count: int, passes: Callable[[], Iterable[Floats]]) -> float:
    """Return the angle in rad between neighbouring rays of which only those that returned are known.

    ``passes`` passes over the directions (n, 3) of all rays, ``count`` in number.
    """
    if count <= STEP_NEIGHBOUR:
        return 0.0
    every, done, chosen = max(1, count // STEP_SAMPLE), 0, list[Floats]()
    for directions in passes():
        chosen.append(directions[-done % every :: every].copy())
        done += len(directions)
    sample = np.concatenate(chosen)
    nearest = np.full((len(sample), STEP_NEIGHBOUR + 1), np.inf)
    for distance in tiles.mapped(_neighbours, passes(), Shared(sample)):
        nearest = np.sort(np.hstack([nearest, distance]), axis=1)[:, : STEP_NEIGHBOUR + 1]
    return float(np.median(nearest[:, -1]))


def _neighbours(directions: Floats, sample: Floats) -> Floats:
    """Return the distances (s, k) of a sample of directions to the nearest of some."""
    tree = cKDTree(directions, balanced_tree=False)
    distance: Floats = tree.query(sample, k=STEP_NEIGHBOUR + 1)[0]
    return distance


def _window(step: float, nearest: float) -> float:
    """Return the window, rad, of a point at a range, mm."""
    return WINDOW_STEPS * step + half_beam_width(nearest) / nearest


def _columns(window: float) -> Ints:
    """Return the first bins (rows + 1,) of rows of directions of one elevation.

    A bin is as high as the window and at least as wide, so that all neighbours are in the bins about one.
    """
    rows = int(np.ceil(np.pi / window))
    elevation = np.pi * np.abs(np.arange(rows + 1) / rows - 0.5)
    widest = np.cos(np.maximum(elevation[:-1], elevation[1:]))
    wide = np.maximum(1, np.floor(2.0 * np.pi * widest / window))
    return np.concatenate([[0], np.cumsum(wide)]).astype(np.int64)


def _rows(directions: Floats, columns: Ints) -> Ints:
    """Return the row (n,) of directions: of one elevation."""
    rows, polar = len(columns) - 1, np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
    return np.minimum((polar / np.pi * rows).astype(np.int64), rows - 1)


def _bins(directions: Floats, columns: Ints) -> Ints:
    """Return the bin (n,) of directions."""
    row, turn = _rows(directions, columns), np.arctan2(directions[:, 1], directions[:, 0])
    wide = columns[row + 1] - columns[row]
    bins: Ints = columns[row] + np.minimum(((turn / (2.0 * np.pi) + 0.5) * wide).astype(np.int64), wide - 1)
    return bins


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


@inner
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
