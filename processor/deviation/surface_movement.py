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

from processor import tiles
from processor.adjustment import mixed_pixels
from processor.deviation import assignment, station_offsets
from processor.deviation.assignment import Aside, OnSurface
from processor.deviation.local_translation import Movement, PartSums, Translations
from processor.deviation.station_offsets import OnFaces, OnPieces, Pieces
from processor.geometry import m3c2, mesh_bodies, mesh_distance
from processor.geometry.mesh_distance import CurvedFacets, FacetGrid, Samples
from processor.large_arrays import put_aside, release
from processor.model import Bools, Columns, Floats, Ints, Labels
from processor.registration import surface_layers
from processor.tiles import Shared

LEAST_COS = 0.5  # between the normals at a core point and below a scanned point
NOISE_SHARE = 0.75  # quantile of the core points' standard deviations that is the noise: noise across edges is larger
ABOUT = 2.0  # diameters about a core point within which all faces are taken to move alike, to find each point's face
LAYER_POINTS = 1_000_000  # work: by which what stands against the structure is recognised
RETURNS = 3.0  # standard deviations from the surface within which a point removed as an outlier is none


@dataclass(frozen=True)
class Cloud(Columns):
    """Points (n, 3) of a scan, which (n,) of them may be outliers, and the view (n,) that each is of."""

    points: Floats
    doubtful: npt.NDArray[np.bool_]
    view: Ints


@dataclass(frozen=True)
class _Fit:
    """Core points of a design, and what movements at them are fitted with; ``scanners`` (v, 3) of views, if known."""

    core: Samples
    curved: CurvedFacets
    grid: FacetGrid
    diameter: float
    depth: float
    scanners: Floats | None

    def scanner(self, cloud: Cloud) -> Floats | None:
        """Return the position (n, 3) that each point of a cloud was seen from, if known."""
        return None if self.scanners is None else self.scanners[cloud.view]

    def sums(self, times: float = 1.0, least_cos: float = LEAST_COS) -> Translations:
        """Begin the sums of a fit to the points within half of some diameters of the core points."""
        return Translations(self.core.points, self.core.normals, times * self.diameter, least_cos)

    def about(self) -> Translations:
        """Begin the sums of a fit to the points of all faces about the core points."""
        return self.sums(ABOUT, -1.0 - 1e-9)

    def part(self, sums: Translations, seen: OnSurface, distance: Floats) -> PartSums:
        """Return sums over points on the surface with their distances (n,)."""
        if len(distance):
            feet = m3c2.grid(seen.feet, sums.diameter)
            sums.add(feet, distance[feet.order], self.curved.surface.normals[seen.facet[feet.order]])
        return sums.part()


@dataclass(frozen=True)
class _Passes:
    """The ``clouds`` of a scan, the same in every pass; the points of each near the surface, and which are doubtful."""

    clouds: Iterable[Cloud]
    fit: Shared[_Fit]
    asides: list[Aside] = field(default_factory=list)
    doubtful: list[Bools] = field(default_factory=list)

    def near(self) -> Iterator[tuple[Cloud, Aside]]:
        """Pass over the points near the surface, cloud by cloud."""
        for cloud, aside, doubtful in zip(self.clouds, self.asides, self.doubtful, strict=True):
            yield replace(cloud.take(aside.rows), doubtful=doubtful), aside
            release()


class _Around(NamedTuple):
    """The ``known`` core points (m,), a tree of them, and the scatter (k,) about all core points."""

    known: Ints
    tree: cKDTree
    scatter: Floats


def movement(
    clouds: Iterable[Cloud],
    scanners: Floats | None,
    core: Samples,
    curved: CurvedFacets,
    diameter_mm: float,
    depth_mm: float,
) -> tuple[Movement, float, Floats]:
    """Fit movements at core points to a scan in the design's frame, whose points come in the same ``clouds`` each time.

    ``scanners`` (v, 3) are the positions of the views there, None where any is unknown.

    Three fits: the first gives the scatter of the points, the second movements from points whose face is decided for
    that scatter. The last compares each point with the face below its place before the movement, so that a tube that
    moved sideways does not appear smaller, and the side of a beam that moved is not taken for its top.

    Outlier removal takes more points from the outside of a surface than from its inside, where other points are near.
    The last fit therefore uses those again that lie on the surface. Points that may be mixed pixels, as known from the
    positions of the scanners, are treated alike. Core points within another body of the design have no movement. Also
    returns the share of points on the surface, and the standard deviation (k,) of what stations have in common at each
    core point.
    """
    surface = curved.surface
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, depth_mm)
    within = mesh_bodies.enclosed(core.points, core.normals, grid, mesh_bodies.closed_bodies(surface.faces))
    core = replace(core, normals=np.where(within[:, None], np.nan, core.normals))
    passes = _Passes(clouds, Shared(_Fit(core, curved, grid, diameter_mm, depth=depth_mm, scanners=scanners)))
    first, on_surface = _first(passes)
    known = np.flatnonzero(np.isfinite(first.along))
    if not len(known):
        return first, on_surface, np.zeros(len(core.points))
    noise = float(np.quantile(first.sd[known], NOISE_SHARE))
    raw = np.maximum(np.hypot(first.along, first.sd), noise)
    nearest, about, moved = _second(passes, _Around(known, cKDTree(core.points[known]), raw))
    sd = np.where(np.isfinite(moved.sd), np.maximum(moved.sd, noise), np.nan)
    scatter = np.where((about.rank > 1) & np.isfinite(sd), sd, raw)
    vector = Shared(np.nan_to_num(about.vector))
    used, last, stations = _last(passes, vector, nearest, Shared(scatter))

    def on_pieces(pieces: Pieces) -> Iterator[OnPieces]:
        return tiles.mapped(_on_pieces_of, _used(passes, nearest, used), passes.fit, vector, Shared(pieces))

    return last, on_surface, station_offsets.shared_sd(core, last, stations, on_pieces, diameter_mm)


class _Faces(NamedTuple):
    """The faces (n,) of a cloud's points, -1 = none, and how far those near the surface (m,) lie above it, mm."""

    face: Labels
    height: Floats

    def put(self) -> _Faces:
        """Return the same, put aside."""
        return _Faces(put_aside(self.face), put_aside(self.height))


def _first(passes: _Passes) -> tuple[Movement, float]:
    """Assign all points, put those near the surface aside, and fit movements to them; also the share that is near."""
    faces, near, points = list[_Faces](), 0, 0
    for aside, doubtful, of_faces, counts in tiles.mapped(_assigned_of, passes.clouds, passes.fit):
        passes.asides.append(aside.put())
        passes.doubtful.append(put_aside(doubtful))
        faces.append(of_faces.put())
        near, points = near + counts[0], points + counts[1]
        release()
    _mark_mixed(passes, faces)
    _leave_out_beside(passes)
    first = passes.fit.value.sums()
    for part in tiles.mapped(_first_of, passes.near(), passes.fit):
        first.add_part(part)
    return first.movement(), near / points


def _assigned_of(cloud: Cloud, fit: _Fit) -> tuple[Aside, Bools, _Faces, tuple[int, int]]:
    """Return the points of a cloud near the surface, which of them are outliers, their faces, and counts.

    These are the numbers of points near the surface and of all, outliers left out.
    """
    seen = assignment.assigned(cloud.points, fit.scanner(cloud), fit.curved, fit.grid)
    close = np.abs(seen.distance) <= fit.depth
    counts = int((close & ~cloud.doubtful).sum()), int((~cloud.doubtful).sum())
    face = np.where(seen.facet >= 0, fit.curved.surface.part_of[seen.facet], -1).astype(np.int32)
    return Aside.of(np.flatnonzero(close), seen), cloud.doubtful[close], _Faces(face, seen.distance[close]), counts


def _first_of(near: tuple[Cloud, Aside], fit: _Fit) -> PartSums:
    """Return sums over the points of a cloud near the surface, doubtful ones left out."""
    cloud, aside = near
    seen, sure = aside.seen(cloud.points, fit.curved), np.flatnonzero(~cloud.doubtful)
    return fit.part(fit.sums(), seen.take(sure), seen.distance[sure])


def _mark_mixed(passes: _Passes, faces: Sequence[_Faces]) -> None:
    """Add to what is doubtful the mixed pixels among points near the surface, as all points of their scanner show."""
    fit, done = passes.fit.value, 0
    if fit.scanners is None:
        return
    mixed = mixed_pixels.mark_passes(_Blocks(passes, faces), fit.scanners, fit.curved.surface.normals)
    for row, doubtful in enumerate(passes.doubtful):
        passes.doubtful[row] = put_aside(doubtful | mixed[done : done + len(doubtful)])
        done += len(doubtful)
        release()


def _leave_out_beside(passes: _Passes) -> None:
    """Leave out the points near the surface that are of something which stands against the structure."""
    fit = passes.fit.value
    surface, core = fit.curved.surface, fit.core
    step = max(1, sum(len(aside.rows) for aside in passes.asides) // LAYER_POINTS)

    def seen(rows: slice, sure: bool) -> Iterator[OnSurface]:
        for cloud, aside in passes.near():
            at = aside.seen(cloud.points, fit.curved)
            yield at.take(np.flatnonzero(~cloud.doubtful)[rows]) if sure else at

    few = OnSurface.concat(list(seen(slice(None, None, step), sure=True)))
    body = mesh_bodies.closed_bodies(surface.faces)[core.facet]
    normals = surface.normals[few.facet]
    layers = surface_layers.of_points(core, body, few.feet, few.distance, normals, fit.diameter)
    for row, at in enumerate(seen(slice(None), sure=False)):
        kept, aside = layers.of_structure(at.feet, at.distance, behind=False), passes.asides[row]
        passes.asides[row] = aside.take(kept).put()
        passes.doubtful[row] = put_aside(passes.doubtful[row][kept])


@dataclass(frozen=True)
class _Blocks:
    """Passes over all points of the clouds with their ``faces``."""

    passes: _Passes
    faces: Sequence[_Faces]

    def __iter__(self) -> Iterator[mixed_pixels.Block]:
        """Pass over all points."""
        columns = self.passes.clouds, self.passes.asides, self.faces
        for cloud, aside, (face, above) in zip(*columns, strict=True):
            facet, height = np.full(len(face), -1, np.int32), np.zeros(len(face))
            facet[aside.rows], height[aside.rows] = aside.facet, above
            yield mixed_pixels.Block(cloud.points, cloud.view, face, facet, height)
            release()


def _second(passes: _Passes, around: _Around) -> tuple[list[Ints], Movement, Movement]:
    """Fit movements to points whose face is decided, for the scatter about core points.

    Returns the known core point next to each point near the surface, and the fits for all faces about a core point
    and for its own.
    """
    nearest, about, moved = list[Ints](), passes.fit.value.about(), passes.fit.value.sums()
    for at, *parts in tiles.mapped(_second_of, passes.near(), passes.fit, Shared(around)):
        nearest.append(put_aside(at))
        for sums, part in zip((about, moved), parts, strict=True):
            sums.add_part(part)
    return nearest, about.movement(), moved.movement()


def _second_of(near: tuple[Cloud, Aside], fit: _Fit, around: _Around) -> tuple[Ints, PartSums, PartSums]:
    """Return what :func:`_second` needs of the points of a cloud."""
    cloud, aside = near
    seen = aside.seen(cloud.points, fit.curved)
    at = around.known[around.tree.query(seen.feet, workers=-1)[1]] if len(seen.feet) else around.known[:0]
    rows = np.flatnonzero(assignment.clear(seen, around.scatter[at]) & ~cloud.doubtful)
    clear = seen.take(rows)
    about, moved = (fit.part(sums, clear, clear.distance) for sums in (fit.about(), fit.sums()))
    return at.astype(np.int32), about, moved


def _last(
    passes: _Passes, vector: Shared[Floats], nearest: Sequence[Ints], scatter: Shared[Floats]
) -> tuple[list[Aside], Movement, set[int]]:
    """Fit movements to points by the faces below their places before the movement.

    Returns the points used and their stations, too.
    """
    used, last, stations = list[Aside](), passes.fit.value.sums(), set[int]()
    near = ((cloud, at) for (cloud, _), at in zip(passes.near(), nearest, strict=True))
    for aside, part, seen_from in tiles.mapped(_last_of, near, passes.fit, vector, scatter):
        used.append(aside.put())
        last.add_part(part)
        stations |= seen_from
    return used, last.movement(), stations


def _last_of(near: tuple[Cloud, Ints], fit: _Fit, vector: Floats, scatter: Floats) -> tuple[Aside, PartSums, set[int]]:
    """Return what :func:`_last` needs of the points of a cloud."""
    cloud, at = near
    about = scatter[at]
    before = assignment.assigned(cloud.points - vector[at], fit.scanner(cloud), fit.curved, fit.grid)
    left = np.abs(before.distance)
    clear = assignment.clear(before, about) & (left <= fit.depth) & (~cloud.doubtful | (left <= RETURNS * about))
    rows = np.flatnonzero(clear)
    aside, before = Aside.of(rows, before), before.take(rows)
    part = fit.part(fit.sums(), before, _distance(fit.curved, before, vector[at[rows]]))
    return aside, part, set(np.unique(cloud.view[rows]).tolist())


def _distance(curved: CurvedFacets, before: OnSurface, shift: Floats) -> Floats:
    """Return the movement found, and what is left of it, along the facet's normal."""
    distance: Floats = before.distance + np.einsum("ni,ni->n", curved.surface.normals[before.facet], shift)
    return distance


class _Used(NamedTuple):
    """Points (n, 3) of the last fit, their stations, the core points next to them, and what was put aside."""

    points: Floats
    station: Ints
    nearest: Ints
    aside: Aside


def _used(passes: _Passes, nearest: Sequence[Ints], used: Sequence[Aside]) -> Iterator[_Used]:
    """Pass over the points of the last fit."""
    for cloud, near, at, aside in zip(passes.clouds, passes.asides, nearest, used, strict=True):
        rows = near.rows[aside.rows]
        yield _Used(cloud.points[rows], cloud.view[rows], at[aside.rows], aside)
        release()


def _on_pieces_of(used: _Used, fit: _Fit, vector: Floats, pieces: Pieces) -> OnPieces:
    """Return what :func:`station_offsets.shared_sd` needs of points of the last fit."""
    shift = vector[used.nearest]
    before = used.aside.seen(used.points - shift, fit.curved)
    facing, distance = fit.curved.surface.normals[before.facet], _distance(fit.curved, before, shift)
    return station_offsets.on_pieces(OnFaces(before.feet, facing, distance, used.station), pieces)
