"""Movement of a scanned surface from its design's, at core points of the design.

M3C2 with the design's surface itself in place of a cloud of it: each scanned point is compared with the facet below it,
so that the curvature of a tube does not count as roughness, and the two sides of a plate are kept separate.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.deviation import assignment, station_offsets
from processor.deviation.assignment import Aside, OnSurface
from processor.deviation.local_translation import Movement, Translations
from processor.deviation.station_offsets import OnFaces
from processor.geometry import enclosure, m3c2, mesh_distance
from processor.geometry.mesh_distance import CurvedFacets, FacetGrid, Samples
from processor.large_arrays import put_aside, release
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


@dataclass(frozen=True)
class _Passes:
    """Core points of a design, what movements at them are fitted with, and the ``clouds`` of a scan, in every pass.

    ``asides`` are the points of each cloud near the surface.
    """

    clouds: Iterable[Cloud]
    core: Samples
    curved: CurvedFacets
    grid: FacetGrid
    diameter: float
    depth: float
    asides: list[Aside] = field(default_factory=list)

    def sums(self, times: float = 1.0, least_cos: float = LEAST_COS) -> Translations:
        """Begin the sums of a fit to the points within half of some diameters of the core points."""
        return Translations(self.core.points, self.core.normals, times * self.diameter, least_cos)

    def add(self, sums: Translations, seen: OnSurface, distance: Floats) -> None:
        """Add points on the surface with their distances (n,) to a fit."""
        if len(distance):
            feet = m3c2.grid(seen.feet, sums.diameter)
            sums.add(feet, distance[feet.order], self.curved.surface.normals[seen.facet[feet.order]])

    def near(self) -> Iterator[tuple[Cloud, OnSurface]]:
        """Pass over the points near the surface, and what is known of them, cloud by cloud."""
        for cloud, aside in zip(self.clouds, self.asides, strict=True):
            points = cloud.of(aside.rows)
            yield points, aside.seen(points.points, self.curved)
            release()


class _Shifts(NamedTuple):
    """Movements (k, 3) at core points, and the core point next to each point near the surface, cloud by cloud."""

    vector: Floats
    nearest: list[Ints]


def movement(
    clouds: Iterable[Cloud], core: Samples, curved: CurvedFacets, diameter_mm: float, depth_mm: float
) -> tuple[Movement, float, Floats]:
    """Fit movements at core points to a scan in the design's frame, whose points come in the same ``clouds`` each time.

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
    fit = _Passes(clouds, core, curved, grid, diameter=diameter_mm, depth=depth_mm)
    first, on_surface = _first(fit)
    known = np.flatnonzero(np.isfinite(first.along))
    if not len(known):
        return first, on_surface, np.zeros(len(core.points))
    noise = float(np.quantile(first.sd[known], NOISE_SHARE))
    raw = np.maximum(np.hypot(first.along, first.sd), noise)
    nearest, about, moved = _second(fit, known, raw)
    sd = np.where(np.isfinite(moved.sd), np.maximum(moved.sd, noise), np.nan)
    scatter = np.where((about.rank > 1) & np.isfinite(sd), sd, raw)
    shifts = _Shifts(np.nan_to_num(about.vector), nearest)
    used, last = _last(fit, shifts, scatter)
    shared = station_offsets.shared_sd(core, last, lambda: _used(fit, shifts, used), diameter_mm)
    return last, on_surface, shared


def _first(fit: _Passes) -> tuple[Movement, float]:
    """Assign all points, put those near the surface aside, and fit movements to them; also the share that is near."""
    first, near, points = fit.sums(), 0, 0
    for cloud in fit.clouds:
        seen = assignment.assigned(cloud.points, cloud.scanner, fit.curved, fit.grid)
        close = np.abs(seen.distance) <= fit.depth
        near, points = near + int((close & ~cloud.doubtful).sum()), points + int((~cloud.doubtful).sum())
        fit.asides.append(Aside.put(np.flatnonzero(close), seen))
        sure = np.flatnonzero(close & ~cloud.doubtful)
        fit.add(first, seen.of(sure), seen.distance[sure])
        release()
    return first.movement(), near / points


def _second(fit: _Passes, known: Ints, raw: Floats) -> tuple[list[Ints], Movement, Movement]:
    """Fit movements to points whose face is decided, for the scatter ``raw`` (k,) about core points.

    Returns the ``known`` core point next to each point near the surface, and the fits for all faces about a core point
    and for its own.
    """
    tree = cKDTree(fit.core.points[known])
    nearest, about, moved = list[Ints](), fit.sums(ABOUT, -1.0 - 1e-9), fit.sums()
    for cloud, seen in fit.near():
        at = known[tree.query(seen.feet, workers=-1)[1]] if len(seen.feet) else known[:0]
        nearest.append(put_aside(at.astype(np.int32)))
        rows = np.flatnonzero(assignment.clear(seen, raw[at]) & ~cloud.doubtful)
        clear = seen.of(rows)
        fit.add(about, clear, clear.distance)
        fit.add(moved, clear, clear.distance)
    return nearest, about.movement(), moved.movement()


def _last(fit: _Passes, shifts: _Shifts, scatter: Floats) -> tuple[list[Aside], Movement]:
    """Fit movements to points by the faces below their places before the movement; returns the points used, too."""
    used, last = list[Aside](), fit.sums()
    for (cloud, _), at in zip(fit.near(), shifts.nearest, strict=True):
        about = scatter[at]
        before = assignment.assigned(cloud.points - shifts.vector[at], cloud.scanner, fit.curved, fit.grid)
        left = np.abs(before.distance)
        clear = assignment.clear(before, about) & (left <= fit.depth) & (~cloud.doubtful | (left <= RETURNS * about))
        rows = np.flatnonzero(clear)
        used.append(Aside.put(rows, before))
        before = before.of(rows)
        fit.add(last, before, _distance(fit, before, shifts.vector[at[rows]]))
    return used, last.movement()


def _distance(fit: _Passes, before: OnSurface, shift: Floats) -> Floats:
    """Return the movement found, and what is left of it, along the facet's normal."""
    distance: Floats = before.distance + np.einsum("ni,ni->n", fit.curved.surface.normals[before.facet], shift)
    return distance


def _used(fit: _Passes, shifts: _Shifts, used: Sequence[Aside]) -> Iterator[OnFaces]:
    """Pass over the points of the last fit."""
    for cloud, near, at, aside in zip(fit.clouds, fit.asides, shifts.nearest, used, strict=True):
        points, shift = cloud.of(near.rows[aside.rows]), shifts.vector[at[aside.rows]]
        before = aside.seen(points.points - shift, fit.curved)
        facing = fit.curved.surface.normals[before.facet]
        yield OnFaces(before.feet, facing, _distance(fit, before, shift), points.station)
        release()
