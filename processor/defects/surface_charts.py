"""The design's surface on grids: components, their faces, and cells on the faces.

A plane or cylindrical face is mapped to a plane by one chart; any other face is cut into pieces that are nearly flat. A
component is a body that the design names. In a mesh without names it is a set of bodies that touch, or a single body
where more than ``mesh_bodies.MOST_BODIES`` touch.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from processor.geometry import circle, mesh_bodies, mesh_distance
from processor.geometry.mesh_distance import FacetGrid, MeshSurface
from processor.model import Bools, DesignBodies, Floats, Ints, Labels

FLAT_COS = np.cos(np.radians(1.0))
PIECE_COS = np.cos(np.radians(15.0))  # cells of one chart shrink by 3 % at most
ROUND_SHARE = 0.02  # of the radius, the largest distance of a vertex from its cylinder
MOST_SIDES = 60  # edges tried for the direction of a face
PLANE, CYLINDER = 0, 1
GRID_SHARE = 0.01  # voxel by the design's size
PER_SIDE = 4  # samples of a cell along each axis, for the share that its face covers


@dataclass(frozen=True)
class Charts:
    """Maps of faces to planes: u, v of a point are along rows 0 and 1 of ``axes`` from ``origin``.

    On a cylinder u runs along its axis, v around it, and ``origin`` lies on the axis; ``way`` is -1 where the steel is
    outside of it (bores, undersides of curved plates). The cells of a chart, a grid of ``shape``, are rows ``first``
    onward of all cells, u slowest.
    """

    kind: Ints  # (c,)
    component: Ints
    origin: Floats  # (c, 3)
    axes: Floats  # (c, 3, 3) rows u, v, outward normal (of a cylinder: away from its axis, where v = 0)
    radius: Floats
    way: Floats  # (c,) of the outward normal of a cylinder: 1 away from its axis, -1 towards it; of a plane 1
    low: Floats  # (c, 2) of u, v at the corner of the first cell
    shape: Ints  # (c, 2)
    first: Ints
    cell_mm: float

    def cells(self, chart: int) -> slice:
        """Return the rows of a chart's cells."""
        start = int(self.first[chart])
        return slice(start, start + int(self.shape[chart].prod()))

    def image(self, values: Floats, chart: int) -> Floats:
        """Return values (cells,) of all cells as the image (nu, nv) of one chart."""
        image: Floats = values[self.cells(chart)].reshape(tuple(self.shape[chart]))
        return image


@dataclass(frozen=True)
class DesignSurface:
    """A design's facets with their charts, and their cells; ``share`` is the part of a cell that its face covers.

    ``covered`` marks the samples of a cell that are on its face, row by row of PER_SIDE x PER_SIDE.
    """

    vertices: Floats
    faces: Ints
    normals: Floats
    chart_of: Ints  # (f,)
    part_of: Ints  # (f,) the smooth face, of which a chart may be a piece
    component_of: Ints  # (f,)
    charts: Charts
    covered: Bools  # (cells, samples)
    share: Floats  # (cells,)
    centres: Floats  # (cells, 3)
    outward: Floats  # (cells, 3)
    names: tuple[str, ...]  # of the components

    @cached_property
    def size_mm(self) -> float:
        """Diagonal of the box about the design, mm."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @cached_property
    def sight_grid(self) -> FacetGrid:
        """The facets in a grid, by which lines of sight are followed."""
        return mesh_distance.facet_grid(self.vertices, self.faces, self.normals, GRID_SHARE * self.size_mm)

    @cached_property
    def hidden(self) -> Bools:
        """The samples (cells, samples) of cells that another body of the design touches or holds: none can be seen."""
        return _hidden(self)

    @cached_property
    def cell_areas(self) -> Floats:
        """Areas (cells,) of cells that their face covers by more than half, mm2, and 0 of others.

        Their sum over a face is the area of its facets, which samples of cells at the border give to about 1 %.
        """
        facets = 0.5 * mesh_distance.double_areas(self.vertices, self.faces)[1]
        share = np.where(self.share > 0.5, self.share, 0.0)
        of_chart = np.bincount(self.chart, share, len(self.charts.kind))
        areas: Floats = share * (np.bincount(self.chart_of, facets) / np.maximum(of_chart, 1e-9))[self.chart]
        return areas

    @cached_property
    def chart(self) -> Ints:
        """The chart (cells,) of each cell."""
        return np.repeat(np.arange(len(self.charts.kind)), self.charts.shape.prod(axis=1))

    @property
    def component(self) -> Ints:
        """The component (cells,) of each cell."""
        component: Ints = self.charts.component[self.chart]
        return component

    @property
    def area_mm2(self) -> float:
        """Area of all cells, mm2."""
        return float(self.share.sum()) * self.charts.cell_mm**2


def of_mesh(vertices: Floats, faces: Ints, cell_mm: float, bodies: DesignBodies | None = None) -> DesignSurface:
    """Map a mesh to charts with cells of ``cell_mm``; its components are its ``bodies``, where these have names."""
    vertices, faces, component = _joined(vertices, faces, bodies)
    mesh = mesh_distance.of_mesh(vertices, faces, spacing_mm=1e9)
    vertices, faces, normals = mesh.vertices, mesh.faces, mesh.normals
    count = int(component.max(initial=-1)) + 1
    chart_of = _pieces(vertices, faces, normals, mesh.part_of)
    surface = DesignSurface(
        vertices=vertices,
        faces=faces,
        normals=normals,
        chart_of=chart_of,
        part_of=mesh.part_of,
        component_of=component,
        charts=_charts(vertices, faces, normals, chart_of, component),
        covered=np.empty((0, PER_SIDE**2), np.bool_),
        share=np.empty(0),
        centres=np.empty((0, 3)),
        outward=np.empty((0, 3)),
        names=tuple(map(mesh_bodies.component_name, range(count))) if bodies is None else bodies.names,
    )
    return gridded(surface, cell_mm)


def gridded(surface: DesignSurface, cell_mm: float) -> DesignSurface:
    """Return the surface with cells of another size."""
    vertices, faces, chart_of = surface.vertices, surface.faces, surface.chart_of
    charts = _with_cells(surface, cell_mm)
    covered = np.zeros((int(charts.shape.prod(axis=1).sum()), PER_SIDE**2), np.bool_)
    a, b, c = (layout(charts, chart_of, vertices[faces[:, k]]) for k in range(3))
    turn = 2.0 * np.pi * charts.radius[chart_of]
    closed = charts.kind[chart_of] == CYLINDER
    for corner in (b, c):  # of a facet that lies across the seam
        corner[:, 1] += np.where(closed, np.round((a[:, 1] - corner[:, 1]) / turn), 0.0) * np.where(closed, turn, 0.0)
    rasterise(a, b, c, chart_of, charts.low, charts.shape, charts.first, cell_mm, covered)
    centres, outward = _cell_places(charts)
    return dataclasses.replace(
        surface, charts=charts, covered=covered, share=covered.mean(axis=1), centres=centres, outward=outward
    )


def _hidden(surface: DesignSurface) -> Bools:
    """Mark the samples (cells, samples) of cells that another body of the design touches or holds."""
    charts, marked = surface.charts, np.zeros_like(surface.covered)
    along = charts.axes[surface.chart, 0]
    across = np.cross(surface.outward, along)
    body = mesh_bodies.closed_bodies(surface.faces)
    near = np.flatnonzero(_near_bodies(surface, body, 0.5 * charts.cell_mm * (np.abs(along) + np.abs(across))))
    centres, outward, along, across = (x[near] for x in (surface.centres, surface.outward, along, across))
    reach = max(surface.size_mm * GRID_SHARE, charts.cell_mm)
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, reach)
    for sample in range(PER_SIDE**2):
        a, b = (charts.cell_mm * ((k + 0.5) / PER_SIDE - 0.5) for k in divmod(sample, PER_SIDE))
        on = surface.covered[near, sample]
        marked[near[on], sample] = mesh_bodies.enclosed((centres + a * along + b * across)[on], outward[on], grid, body)
    return marked


def _near_bodies(surface: DesignSurface, body: Ints, halves: Floats) -> Bools:
    """Mark cells, with half sides (cells, 3), that reach into the box about a closed body: no other can be hidden."""
    low, high = mesh_bodies.boxes(surface.vertices[surface.faces], body).swapaxes(0, 1)
    middles = surface.centres + mesh_bodies.OUTSIDE_MM * surface.outward
    first, last = middles - halves - mesh_bodies.WELD_MM, middles + halves + mesh_bodies.WELD_MM
    near = np.zeros(len(middles), np.bool_)
    for chart in range(len(surface.charts.kind)):
        rows = surface.charts.cells(chart)
        meet = (low <= last[rows].max(axis=0)) & (high >= first[rows].min(axis=0))
        for k in np.flatnonzero(meet.all(axis=1)):
            near[rows] |= ((low[k] <= last[rows]) & (high[k] >= first[rows])).all(axis=1)
    return near


def layout(charts: Charts, chart: Ints, points: Floats) -> Floats:
    """Return u, v (n, 2) of points (n, 3) on their charts (n,), mm."""
    arm = points - charts.origin[chart]
    local = np.einsum("nij,nj->ni", charts.axes[chart], arm)
    around = charts.radius[chart] * np.arctan2(local[:, 1], local[:, 2])
    return np.stack([local[:, 0], np.where(charts.kind[chart] == CYLINDER, around, local[:, 1])], axis=1)


def with_components(vertices: Floats, faces: Ints, bodies: DesignBodies | None = None) -> tuple[MeshSurface, Ints]:
    """Prepare a mesh for searches; also the component (f,) of each of its facets, numbered as in the defects' names.

    Components are the ``bodies``, in their order, where these have names.
    """
    vertices, faces, component = _joined(vertices, faces, bodies)
    return mesh_distance.of_design(vertices, faces), component


def _joined(vertices: Floats, faces: Ints, bodies: DesignBodies | None) -> tuple[Floats, Ints, Ints]:
    """Return a mesh with one vertex at a place, without facets of no area, and the component (f,) of each facet."""
    vertices, faces = mesh_bodies.welded(vertices, faces, None if bodies is None else bodies.of_facet)
    has_area = mesh_distance.double_areas(vertices, faces)[1] > mesh_distance.LEAST_AREA
    faces = faces[has_area]
    return vertices, faces, mesh_bodies.components(vertices, faces) if bodies is None else bodies.of_facet[has_area]


def _pieces(vertices: Floats, faces: Ints, normals: Floats, part: Ints) -> Ints:
    """Return the chart (f,) of each facet: a smooth face, or pieces of it if it is neither plane nor cylindrical."""
    chart = np.full(len(faces), -1, np.int64)
    count = 0
    order = np.argsort(part, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        n = normals[rows]
        flat = n @ n[0] > FLAT_COS
        if flat.all() or _cylinder(vertices[faces[rows]], n) is not None:
            chart[rows] = count
            count += 1
            continue
        left = rows
        while len(left):
            near = normals[left] @ normals[left[0]] > PIECE_COS
            chart[left[near]] = count
            count += 1
            left = left[~near]
    return chart


def _cylinder(corners: Floats, normals: Floats) -> tuple[Floats, Floats, float] | None:
    """Return a point (3,) and direction (3,) of the axis, and the radius, of facets (f, 3, 3); None if no cylinder."""
    if len(corners) < 6:
        return None
    variances, axes = np.linalg.eigh(normals.T @ normals / len(normals))
    if variances[0] > 1e-4 or variances[1] < 1e-2:
        return None
    axis = axes[:, 0] * np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0])
    points = corners.reshape(-1, 3)
    middle = points.mean(axis=0)
    flat = (points - middle) @ axes[:, 1:]
    fitted = circle.algebraic(flat)
    if fitted is None:
        return None
    centre, radius = fitted
    off = np.abs(np.linalg.norm(flat - centre, axis=1) - radius).max()
    return (middle + axes[:, 1:] @ centre, axis, radius) if off < ROUND_SHARE * radius else None


def _charts(vertices: Floats, faces: Ints, normals: Floats, chart_of: Ints, component: Ints) -> Charts:
    """Return the charts without cells."""
    count = int(chart_of.max(initial=-1)) + 1
    kind, component_of = np.zeros(count, np.int64), np.zeros(count, np.int64)
    origin, axes = np.zeros((count, 3)), np.zeros((count, 3, 3))
    radius, way = np.full(count, np.inf), np.ones(count)
    order = np.argsort(chart_of, kind="stable")
    for chart, rows in enumerate(np.split(order, np.flatnonzero(np.diff(chart_of[order])) + 1)):
        corners = vertices[faces[rows]]
        component_of[chart] = component[rows[0]]
        size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        normal = size @ normals[rows]
        flat = (normals[rows] @ normals[rows[0]] > FLAT_COS).all()
        cylinder = None if flat else _cylinder(corners, normals[rows])
        if cylinder is not None:
            kind[chart] = CYLINDER
            origin[chart], along, radius[chart] = cylinder
            side = normals[rows[0]] - (normals[rows[0]] @ along) * along
            out = side / np.linalg.norm(side)
            away = np.einsum("ni,ni->n", corners.mean(axis=1) - origin[chart], normals[rows])
            way[chart] = 1.0 if size @ away > 0.0 else -1.0
        else:
            origin[chart] = corners.reshape(-1, 3).mean(axis=0)
            out = normal / np.linalg.norm(normal)
            along = _longest(corners, out)
        axes[chart] = [along, np.cross(out, along), out]
    return Charts(
        kind=kind,
        component=component_of,
        origin=origin,
        axes=axes,
        radius=np.where(kind == PLANE, 1.0, radius),
        way=way,
        low=np.zeros((count, 2)),
        shape=np.ones((count, 2), np.int64),
        first=np.zeros(count, np.int64),
        cell_mm=1.0,
    )


def _with_cells(surface: DesignSurface, cell_mm: float) -> Charts:
    """Return the charts with grids of cells about the middles of their faces."""
    charts, chart_of = surface.charts, surface.chart_of
    count = len(charts.kind)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for k in range(3):
        uv = layout(charts, chart_of, surface.vertices[surface.faces[:, k]])
        np.minimum.at(low, chart_of, uv)
        np.maximum.at(high, chart_of, uv)
    closed = charts.kind == CYLINDER
    half_turn = np.pi * charts.radius
    low[closed, 1], high[closed, 1] = -half_turn[closed], half_turn[closed]
    shape = np.maximum(np.ceil((high - low) / cell_mm - 1e-6), 1).astype(np.int64)
    low = 0.5 * (low + high) - 0.5 * shape * cell_mm
    low[closed, 1] = -half_turn[closed]
    first = np.concatenate([[0], np.cumsum(shape.prod(axis=1))[:-1]]).astype(np.int64)
    return dataclasses.replace(charts, low=low, shape=shape, first=first, cell_mm=cell_mm)


def _longest(corners: Floats, out: Floats) -> Floats:
    """Return the direction (3,) of the longer side of the smallest rectangle about facets, normal to ``out`` (3,)."""
    sides = (corners - np.roll(corners, 1, axis=1)).reshape(-1, 3)
    sides = sides - np.outer(sides @ out, out)
    lengths = np.linalg.norm(sides, axis=1)
    order = np.argsort(-lengths, kind="stable")[:MOST_SIDES]
    points = corners.reshape(-1, 3)
    least_area, longest = np.inf, sides[order[0]] / lengths[order[0]]
    for row in order:
        along = sides[row] / max(lengths[row], 1e-12)
        wide, high = np.ptp(points @ np.stack([along, np.cross(out, along)], axis=1), axis=0)
        if wide * high < least_area * (1.0 - 1e-6):
            least_area = wide * high
            longest = along if wide >= high * (1.0 - 1e-6) else np.cross(out, along)
    size = np.abs(longest)
    main = int(np.argmax(size > 0.7)) if (size > 0.7).any() else int(np.argmax(size))
    positive: Floats = longest * np.sign(longest[main])
    return positive


def placed(charts: Charts, chart: Ints | Labels, uv: Floats) -> tuple[Floats, Floats]:
    """Return the places (n, 3) at u, v (n, 2) on charts (n,), and their outward normals (n, 3)."""
    axes, u, v = charts.axes[chart], uv[:, :1], uv[:, 1:]
    closed, radius = (charts.kind[chart] == CYLINDER)[:, None], charts.radius[chart][:, None]
    turn = np.where(closed, v, 0.0) / np.where(closed, radius, 1.0)
    away = np.sin(turn) * axes[:, 1] + np.cos(turn) * axes[:, 2]  # of a plane its normal
    places: Floats = charts.origin[chart] + u * axes[:, 0] + np.where(closed, radius * away, v * axes[:, 1])
    return places, np.where(closed, charts.way[chart][:, None] * away, away)


def _cell_places(charts: Charts) -> tuple[Floats, Floats]:
    """Return the middles (cells, 3) of all cells and their outward normals."""
    parts = [(np.empty((0, 3)), np.empty((0, 3)))]
    for chart in range(len(charts.kind)):
        grid = np.indices(tuple(charts.shape[chart])).reshape(2, -1).T + 0.5
        parts.append(placed(charts, np.full(len(grid), chart), charts.low[chart] + grid * charts.cell_mm))
    centres, outward = (np.concatenate(column) for column in zip(*parts, strict=True))
    return centres, outward


@njit(cache=True, nogil=True)
def rasterise(
    a: Floats,
    b: Floats,
    c: Floats,
    chart_of: Ints,
    low: Floats,
    shape: Ints,
    first: Ints,
    cell_mm: float,
    covered: Bools,
) -> None:
    """Mark in ``covered`` (cells, samples) the samples of cells that triangles with corners a, b, c (f, 2) cover."""
    step = cell_mm / PER_SIDE
    for f in range(len(a)):
        k = chart_of[f]
        nu, nv = shape[k, 0] * PER_SIDE, shape[k, 1] * PER_SIDE
        au, av = (a[f, 0] - low[k, 0]) / step, (a[f, 1] - low[k, 1]) / step
        bu, bv = (b[f, 0] - low[k, 0]) / step, (b[f, 1] - low[k, 1]) / step
        cu, cv = (c[f, 0] - low[k, 0]) / step, (c[f, 1] - low[k, 1]) / step
        turn = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if turn == 0.0:
            continue
        i0, i1 = max(0, int(min(au, bu, cu))), min(nu - 1, int(max(au, bu, cu)))
        j0, j1 = int(min(av, bv, cv)) - 1, int(max(av, bv, cv))
        for i in range(i0, i1 + 1):
            u = i + 0.5
            for j in range(j0, j1 + 1):
                v = j + 0.5
                p = ((bu - u) * (cv - v) - (bv - v) * (cu - u)) / turn
                q = ((cu - u) * (av - v) - (cv - v) * (au - u)) / turn
                if p >= -1e-9 and q >= -1e-9 and p + q <= 1.0 + 1e-9:
                    row, column = i // PER_SIDE, (j % nv) // PER_SIDE
                    sample = (i % PER_SIDE) * PER_SIDE + (j % nv) % PER_SIDE
                    covered[first[k] + row * shape[k, 1] + column, sample] = True
