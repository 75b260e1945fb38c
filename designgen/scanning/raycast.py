"""Rays of a scanner's angular grid against exact surfaces, in float64.

Every bounding sphere is drawn onto the grid, and the rays it covers are intersected with its shape; the nearest hit of
a ray stays. Rays that meet nothing cost nothing, which most rays of a scan of a roof do.

A scanner's frame has its origin at the scanner and z along its axis; column j looks to azimuth ``j step`` counter-
clockwise from x, row i to elevation ``lowest + i step``. Results depend on neither the thread nor the strip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.scanning import ray_boxes, ray_kernels
from designgen.scanning.surfaces import CONE, DISC, SPHERE, Bools, Surfaces
from processor.model import Floats, Ints, Labels, Shorts

WEIGHTS = (-3.0, 4.0)  # of a net triangle's edges, between which a ray may meet the face that the net stands for


@dataclass(frozen=True)
class Grid:
    """A scanner's directions: ``columns`` all around, ``rows`` upward from elevation ``lowest``; rad."""

    step: float
    lowest: float
    rows: int
    columns: int

    def directions(self, row: Labels, column: Labels) -> Floats:
        """Return unit vectors (n, 3) in the scanner's frame."""
        azimuth, elevation = 2.0 * np.pi * column / self.columns, self.lowest + self.step * row
        level = np.cos(elevation)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


@dataclass(frozen=True)
class Seen:
    """The surfaces in a scanner's frame, and the grid's boxes that their pieces cover, sorted by strip.

    A strip has ``width`` columns; ``side`` columns on either side have a say in its edges.
    """

    shapes: tuple[Any, ...]  # kind, numbers, cuts, cut_start
    boxes: Labels  # (b, 5): piece, first and last column, first and last row
    strip_start: Ints  # (strips + 1,)
    piece: tuple[Any, ...]  # shape, centre, radius
    width: int
    side: int

    def of_strip(self, strip: int) -> tuple[Any, ...]:
        """Shapes, pieces, boxes, first column, width and side of a strip, as the kernels take them."""
        boxes = self.boxes[self.strip_start[strip] : self.strip_start[strip + 1]]
        return (*self.shapes, *self.piece, boxes, strip * self.width, self.width, self.side)


def see(
    surfaces: Surfaces, T_scanner_scene: Floats, grid: Grid, width: int, side: int, reach: float, spread: float
) -> Seen:
    """Move surfaces into a scanner's frame and draw their bounding spheres onto its grid.

    ``width`` is the number of columns of a strip, ``side`` of those that are cast beside it on either side; ``reach``
    is the greatest range (mm), ``spread`` the angle (rad) by which a ray may depart from its direction.
    """
    R, t = T_scanner_scene[:3, :3], T_scanner_scene[:3, 3]
    numbers = surfaces.numbers.copy()
    # Where points, directions and lengths stand among a shape's numbers.
    points = {SPHERE: (0,), CONE: (0,), DISC: (0,), 3: (0, 3, 6)}
    vectors: dict[int, tuple[int, ...]] = {SPHERE: (), CONE: (3, 9), DISC: (3,), 3: ()}
    for kind in range(4):
        rows = np.flatnonzero(surfaces.kind == kind)
        for columns, shift in ((points[kind], t), (vectors[kind], np.zeros(3))):
            for c in columns:
                numbers[rows, c : c + 3] = numbers[rows, c : c + 3] @ R.T + shift
    cuts = surfaces.cuts.copy()
    cuts[:, :3] = cuts[:, :3] @ R.T
    centres = surfaces.piece_centre @ R.T + t
    strips = -(-grid.columns // width)
    found = ray_boxes.boxes(
        centres, surfaces.piece_radius, reach, spread + grid.step, grid.step, grid.lowest, grid.rows, grid.columns,
        side,
    )  # fmt: skip
    boxes, start = ray_boxes.by_strip(found, width, strips, side)
    piece = (surfaces.piece_shape, centres, surfaces.piece_radius)
    return Seen((surfaces.kind, numbers, cuts, surfaces.cut_start), boxes, start, piece, width, side)


def cast(
    seen: Seen,
    grid: Grid,
    strip: int,
    jitter: Shorts,
    turned: float,
    limits: tuple[float, float],
    beam: tuple[float, float],
    beside: Labels,
) -> Any:
    """Shape and range of the rays of a strip and beside it: (width + 2 side, rows) each; -1 = no hit.

    Beside the strip only the next ``beside`` (rows,) columns are cast. ``jitter`` (width + 2 side, rows, 2) turns each
    ray to the left and up, rad, by no more than ``turned``; ``limits`` are the ranges seen, mm. What is nearer hides
    what is behind it. A third answer is the range at which a beam of radius
    ``beam[0] + beam[1] range`` may touch a thing so thin that the rays beside it may all miss it, infinite where there
    is none.
    """
    return ray_kernels.cast(  # type: ignore[call-arg]
        *seen.of_strip(strip), grid.columns, grid.lowest, grid.step, jitter, turned, *limits, beam, beside,
    )  # fmt: skip


def cast_around(
    seen: Seen,
    grid: Grid,
    strip: int,
    jitter: Shorts,
    turned: float,
    limits: tuple[float, float],
    number: Labels,
    angle: Floats,
    offsets: Floats,
) -> Any:
    """Shape and range (m, k) of sub-rays about m rays of a strip.

    ``number`` (width + 2 side, rows) is a ray's row in the answer, -1 where none is wanted; ``angle`` (m,) scales the
    directions' ``offsets`` (k, 2).
    """
    return ray_kernels.cast_around(  # type: ignore[call-arg]
        *seen.of_strip(strip), grid.columns, grid.lowest, grid.step, jitter, turned, *limits, number, angle, offsets,
        len(angle),
    )  # fmt: skip


def directions(grid: Grid, row: Labels, column: Labels, jitter: Floats | Shorts) -> Floats:
    """Directions (n, 3) of rays turned by ``jitter`` (n, 2), as the caster has them."""
    azimuth, elevation = 2.0 * np.pi * column / grid.columns, grid.lowest + grid.step * row
    level, rise, ca, sa = np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth)
    da, de = jitter[:, 0].astype(np.float64), jitter[:, 1].astype(np.float64)
    flat = level - de * rise
    return np.stack([flat * ca - da * sa, flat * sa + da * ca, rise + de * level], axis=1)


def meet(
    seen: Seen, surfaces: Surfaces, T_scanner_scene: Floats, shape: Labels, ray: Floats, t: Floats
) -> tuple[Floats, Floats]:
    """Ranges (n,) and cosines of incidence (n,) of rays (n, 3) that were found to meet shapes (n,) at about t (n,).

    Patches are met on their own surfaces instead of their nets. NaN where one is not, as at its very edge seen at a
    grazing angle.
    """
    range_, normal = t.copy(), np.empty((len(t), 3))
    plain = surfaces.patch[shape] < 0
    kind, numbers, _, _ = seen.shapes
    normal[plain] = ray_kernels.normals(kind, numbers, shape[plain], ray[plain] * t[plain, None])
    if not plain.all():
        curved = ~plain
        range_[curved], normal[curved] = _on_patches(surfaces, T_scanner_scene, shape[curved], ray[curved], t[curved])
    return range_, np.minimum(np.abs(np.einsum("ni,ni->n", ray, normal)), 1.0)


def _on_patches(
    surfaces: Surfaces, T_scanner_scene: Floats, shape: Labels, ray: Floats, t: Floats, tolerance_mm: float = 1e-5
) -> tuple[Floats, Floats]:
    """Ranges (n,) at which rays meet the patches' own surfaces, near where they met the nets, and normals (n, 3)."""
    result, normal = t.copy(), np.empty((len(t), 3))
    R, origin = T_scanner_scene[:3, :3], -T_scanner_scene[:3, :3].T @ T_scanner_scene[:3, 3]
    patch = surfaces.patch[shape]
    order = np.argsort(patch, kind="stable")
    edges = np.flatnonzero(np.diff(patch[order])) + 1
    for rows in np.split(order, edges):
        at, triangle = surfaces.patches[patch[rows[0]]].at, shape[rows]
        d = ray[rows] @ R  # the ray in the scene's frame
        corners, pq = surfaces.numbers[triangle, :9].reshape(-1, 3, 3), surfaces.corner_pq[triangle]
        edge, turn = corners[:, 1:] - corners[:, :1], pq[:, 1:] - pq[:, :1]
        # The net's triangle gives the derivatives: dx = edge^T w for d(p, q) = turn^T w.
        inverse, regular = _inverse(edge[:, 0], edge[:, 1], -d)
        range_ = t[rows].copy()
        weights = np.einsum("nij,nj->ni", inverse, origin + range_[:, None] * d - corners[:, 0])[:, :2]
        now, met, off = np.empty((len(rows), 2)), np.empty((len(rows), 3)), np.full(len(rows), np.inf)
        live: Any = slice(None)  # most of the time all of them
        for _ in range(12):
            now[live] = pq[live, 0] + np.einsum("ni,nij->nj", weights[live], turn[live])
            met[live] = at(now[live, 0], now[live, 1])
            left = origin + range_[live, None] * d[live] - met[live]
            off[live] = np.sqrt(np.einsum("ni,ni->n", left, left))
            step = np.einsum("nij,nj->ni", inverse[live], left)
            # A grazing ray may step far away, where the face's function has no meaning.
            weights[live] = np.clip(weights[live] + step[:, :2], *WEIGHTS)
            range_[live] += step[:, 2]
            more = np.flatnonzero(off >= 0.1 * tolerance_mm)
            if not len(more):
                break
            live = more if len(more) < len(rows) else live
        range_[~(off < tolerance_mm) | ~regular] = np.nan
        result[rows], normal[rows] = range_, _across(at, now, met, turn) @ R.T
    return result, normal


def _inverse(a: Floats, b: Floats, c: Floats) -> tuple[Floats, Bools]:
    """Inverses (n, 3, 3) of matrices with columns a, b and the unit vectors c (n, 3), and which of them (n,) have one.

    Those that have none get 0.
    """
    found = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("ni,ni->n", a, found[:, 0])
    regular = np.abs(volume) > 1e-12 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    found[~regular], volume[~regular] = 0.0, 1.0
    found /= volume[:, None, None]
    return found, regular


def _across(at: Callable[[Floats, Floats], Floats], pq: Floats, points: Floats, turn: Floats) -> Floats:
    """Return unit normals (n, 3) of a patch at pq (n, 2), where it has its ``points``, by steps along a net's edges."""
    share = 1e-5  # of the net's edges, which bend by a few degrees at most: 1e-6 rad of the normal
    one, other = (at(*(pq + share * turn[:, k]).T) - points for k in range(2))
    normal = np.cross(one, other)
    found: Floats = normal / np.sqrt(np.einsum("ni,ni->n", normal, normal))[:, None]
    return found
