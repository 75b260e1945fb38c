"""The points of a scene in the frame of its design, found by their places; those of a large scene lie in files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from processor import large_arrays
from processor.distinct_rows import distinct
from processor.geometry import point_grid
from processor.geometry.nearest_neighbours import within_reach
from processor.geometry.point_grid import Cells
from processor.large_arrays import allocate, blocks
from processor.model import Bools, Floats, Ints, Labels, Scene
from processor.views import views

CELL_MM = 25.0  # of the grid
BOX_MM = 150.0  # about places that are searched together


class SeenPoints(NamedTuple):
    """Points (n, 3), mm, in the design's frame less an origin, the unit ray (n, 3) to each, and its view (n,).

    Rays are NaN where they are unknown.
    """

    points: Floats
    ray: Floats
    view: Ints


@dataclass(frozen=True)
class DesignCloud:
    """All points of a scene in the design's frame less an origin, mm, sorted into cells, and from where each was seen.

    ``view`` (n,) is of the points in the order of the cells. ``scanners`` (v, 3) are the positions of the views, all
    NaN if that of one with points is unknown.
    """

    cells: Cells
    view: Labels
    scanners: Floats

    def near(
        self,
        places: Floats,
        radius: float,
        keep: Callable[[SeenPoints], Bools] = lambda seen: np.ones(len(seen.view), bool),
    ) -> SeenPoints:
        """Return the points nearer than ``radius``, mm, to any of the places (m, 3), in the order of the cells.

        Only those that ``keep`` marks; it is called for some of the points at a time.
        """
        found = [np.empty(0, np.int64)]
        box = np.floor(places / BOX_MM).astype(np.int64)
        for corner in distinct(box).rows:
            together = places[(box == corner).all(axis=1)]
            low, high = together.min(axis=0) - radius, together.max(axis=0) + radius
            for some in point_grid.rows_within(self.cells, low, high):
                rows = some[within_reach(self.cells.points[some], together, radius)[0]]
                found.append(rows[keep(self._seen(rows))])
        return self._seen(np.unique(np.concatenate(found)))

    def _seen(self, rows: Ints) -> SeenPoints:
        points, view = self.cells.points[rows], self.view[rows].astype(np.int64)
        large_arrays.release_after(points.nbytes + view.nbytes)
        ray = points - self.scanners[view]
        return SeenPoints(points, ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9), view)


def of_points(points: Floats, view: Ints | Labels, scanners: Floats) -> DesignCloud:
    """Sort points (n, 3), mm, and their views (n,) into cells; ``scanners`` (v, 3) are the positions of the views."""
    grid = point_grid.of_points(points, CELL_MM)
    sorted_view = allocate(len(view), dtype=np.int32)
    for rows in blocks(len(view)):
        sorted_view[rows] = view[grid.order[rows]]
    return DesignCloud(grid.cells, sorted_view, scanners)


def of_scene(scene: Scene, T: Floats, origin: Floats) -> DesignCloud:
    """Return all points of a scene in the design's frame less ``origin`` (3,), mm, by a pose (4, 4) of the project."""
    seen = views(scene, T, origin)
    points, view = seen.placed()
    scanners = seen.scanners(view)
    return of_points(points, view, np.full(seen.positions.shape, np.nan) if scanners is None else scanners)
