"""Movement of a scanned surface from its design's, at core points of the design.

M3C2 with the design's surface itself in place of a cloud of it: each scanned point is compared with the facet below it,
so that the curvature of a tube does not count as roughness, and the two sides of a plate are kept separate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.deviation import assignment, local_translation, station_offsets
from processor.deviation.assignment import OnSurface
from processor.deviation.local_translation import Movement
from processor.geometry import enclosure, m3c2, mesh_distance
from processor.geometry.mesh_distance import CurvedFacets, MeshSurface, Samples
from processor.model import Floats, Ints

LEAST_COS = 0.5  # between the normals at a core point and below a scanned point
NOISE_SHARE = 0.75  # quantile of the core points' standard deviations that is the noise: noise across edges is larger
ABOUT = 2.0  # diameters about a core point within which all faces are taken to move alike, to find each point's face
RETURNS = 3.0  # standard deviations from the surface within which a point removed as an outlier is none


@dataclass(frozen=True)
class Cloud:
    """Points (n, 3) of a scan, the positions (n, 3) they were seen from, if known, and which (n,) may be outliers.

    ``station`` (n,) is the number of the scan or station that a point is from.
    """

    points: Floats
    scanner: Floats | None
    doubtful: npt.NDArray[np.bool_]
    station: Ints

    def of(self, rows: Ints) -> Cloud:
        """Return the points of some rows alone."""
        scanner = None if self.scanner is None else self.scanner[rows]
        return Cloud(self.points[rows], scanner, self.doubtful[rows], self.station[rows])


def movement(
    cloud: Cloud, core: Samples, curved: CurvedFacets, diameter_mm: float, depth_mm: float
) -> tuple[Movement, float, Floats]:
    """Fit movements at core points to a scan in the design's frame.

    Three fits: the first gives the scatter of the points, the second movements from points whose face is decided for
    that scatter. The last compares each point with the face below its place before the movement, so that a tube that
    moved sideways does not appear smaller, and the side of a beam that moved is not taken for its top.

    Outlier removal takes more points from the outside of a surface than from its inside, where other points are near.
    The last fit therefore uses those again that lie on the surface. Core points within another body of the design have
    no movement. Also returns the share of points on the surface, and the standard deviation (k,) of what stations have
    in common at each core point.
    """
    surface = curved.surface
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, depth_mm)
    within = enclosure.enclosed(core.points, core.normals, grid, enclosure.closed_bodies(surface.faces))
    core = replace(core, normals=np.where(within[:, None], np.nan, core.normals))
    seen = assignment.assigned(cloud.points, cloud.scanner, curved, grid)
    near = np.abs(seen.distance) <= depth_mm
    on_surface = float(near[~cloud.doubtful].mean())
    rows = np.flatnonzero(near)
    cloud, seen = cloud.of(rows), seen.of(rows)
    sure = np.flatnonzero(~cloud.doubtful)
    first = _fitted(core, surface, seen.of(sure), seen.distance[sure], diameter_mm)
    known = np.flatnonzero(np.isfinite(first.along))
    if not len(known):
        return first, on_surface, np.zeros(len(core.points))
    nearest = known[cKDTree(core.points[known]).query(seen.feet, workers=-1)[1]]
    noise = float(np.quantile(first.sd[known], NOISE_SHARE))
    raw = np.maximum(np.hypot(first.along, first.sd), noise)[nearest]
    rows = np.flatnonzero(assignment.clear(seen, raw) & ~cloud.doubtful)
    clear = seen.of(rows)
    about = _fitted(core, surface, clear, clear.distance, ABOUT * diameter_mm, least_cos=-1.0 - 1e-9)
    moved = _fitted(core, surface, clear, clear.distance, diameter_mm)
    shift = np.nan_to_num(about.vector)[nearest]
    before = assignment.assigned(cloud.points - shift, cloud.scanner, curved, grid)
    sd = np.where(np.isfinite(moved.sd), np.maximum(moved.sd, noise), np.nan)[nearest]
    scatter = np.where((about.rank[nearest] > 1) & np.isfinite(sd), sd, raw)
    left = np.abs(before.distance)
    used = assignment.clear(before, scatter) & (left <= depth_mm) & (~cloud.doubtful | (left <= RETURNS * scatter))
    rows = np.flatnonzero(used)
    # The movement found, and what is left of it, along the facet's normal.
    distance = before.distance[rows] + np.einsum("ni,ni->n", surface.normals[before.facet[rows]], shift[rows])
    last = _fitted(core, surface, before.of(rows), distance, diameter_mm)
    facing = surface.normals[before.facet[rows]]
    shared = station_offsets.shared_sd(
        core, last, before.feet[rows], facing, distance, cloud.station[rows], diameter_mm
    )  # fmt: skip
    return last, on_surface, shared


def _fitted(
    core: Samples, surface: MeshSurface, seen: OnSurface, distance: Floats, diameter_mm: float,
    least_cos: float = LEAST_COS,
) -> Movement:  # fmt: skip
    grid = m3c2.grid(seen.feet, diameter_mm)
    return local_translation.movement(
        grid, distance[grid.order], surface.normals[seen.facet[grid.order]], core.points, core.normals,
        diameter_mm=diameter_mm, least_cos=least_cos,
    )  # fmt: skip
