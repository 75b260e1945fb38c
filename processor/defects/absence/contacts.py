"""Bodies that are gone, by the places that they should hide: points where they would touch another body.

A body of which no point was measured may be gone, or no station may have seen it. If points lie on the face that it
should stand on, well within its outline and nearly as dense as elsewhere, no body stands there. How many points lie
there by error is taken from the contacts of the other bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processor.defects.alignment import chart_of_cells
from processor.defects.deviation_field import Field
from processor.defects.observations import Observed, cells_of
from processor.defects.regions import EMPTY_SHARE, Region, chernoff
from processor.defects.surface_charts import PER_SIDE, PLANE, DesignSurface
from processor.geometry import enclosure, mesh_distance
from processor.geometry.mesh_distance import Bools
from processor.model import Floats, Ints

WITHIN_MM = 4.0  # from the outline of a contact: beams at its border hit the face beside it
DEPTH_MM = 1.0  # into the body, at which a place is tested
ON_MM = 4.0  # distance from the face, up to which a point is on it
GONE_SHARE = 0.02  # of the points that faces seen elsewhere have, up to which none of a body was measured
FEWEST_CELLS = 2.0  # by area, of a body that can be judged
NEAR_MM = 2.0  # margin of the box about a body
GRID_SHARE = 0.01  # voxel by the design's size


@dataclass(frozen=True)
class _Contact:
    """A body: area of its contacts (mm2, well within), points on them, and whether points lie on its faces."""

    body: int
    area: float
    points: int
    is_empty: bool


def of_bodies(
    observed: Observed, field: Field, surface: DesignSurface, hidden: Bools, alarms_per_mm2: float
) -> list[Region]:
    """Return the faces of bodies that are gone. ``hidden`` (cells, samples) are places that other bodies hide."""
    body = enclosure.closed_bodies(surface.faces)
    contacts = list(_contacts(observed, field, surface, hidden, body))
    present = [contact for contact in contacts if not contact.is_empty]
    if not present:
        return []
    rates = [contact.points / contact.area for contact in present]
    # By error, on 1 mm2; of one body, those of the body that is gone are among them.
    rate = max(float(np.median(rates)), 1.0 / sum(contact.area for contact in present))
    least = EMPTY_SHARE * _density(field, surface)
    regions = []
    for contact in contacts:
        if not contact.is_empty or contact.points < least * contact.area:
            continue
        strength = chernoff(rate * contact.area, float(contact.points), more=True)
        if strength > -np.log(alarms_per_mm2 * contact.area):
            regions += _faces(surface, hidden, body, contact.body, strength)
    return regions


def _contacts(
    observed: Observed, field: Field, surface: DesignSurface, hidden: Bools, body: Ints
) -> Iterator[_Contact]:
    """Yield the contacts of each closed body that has any."""
    charts = surface.charts
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    grid = mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, GRID_SHARE * size)
    places, inward, sample_mm2 = *_hidden_places(surface, hidden), (charts.cell_mm / PER_SIDE) ** 2
    found = _points_on_hidden(observed, surface, hidden)
    low, high = enclosure.boxes(surface.vertices, surface.faces, body)
    typical = _density(field, surface) * charts.cell_mm**2
    for one in range(len(low)):
        only = np.where(body == one, 0, -1)

        def number(points: Floats, normals: Floats, only: Ints = only, one: int = one) -> int:
            near = ((points > low[one] - NEAR_MM) & (points < high[one] + NEAR_MM)).all(axis=1)
            return int(_well_inside(points[near], normals[near], grid, only).sum())

        samples = number(places, inward)
        cells = _cells_of_body(surface, body, one)
        judged = cells[field.inner[cells] > 0.0]
        if samples and typical and len(judged) >= FEWEST_CELLS:
            counted = (field.count + field.stray)[judged].sum()
            empty = bool(counted <= GONE_SHARE * typical * surface.share[judged].sum())
            yield _Contact(one, samples * sample_mm2, number(*found), empty)


def _density(field: Field, surface: DesignSurface) -> float:
    """Return the median number of points on 1 mm2 of the faces that were seen; 0 if none were."""
    seen = field.seen > 0.0
    return float(np.median(field.count[seen])) / surface.charts.cell_mm**2 if seen.any() else 0.0


def _well_inside(points: Floats, normals: Floats, grid: mesh_distance.FacetGrid, only: Ints) -> Bools:
    """Mark the places (n, 3) of which all within WITHIN_MM along the face lie inside the one body of ``only`` (f,).

    A contact is on two faces, of this body and of the one that it touches: both ways of the normal are tried.
    """
    inside = np.zeros(len(points), np.bool_)
    if not len(points):
        return inside
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    along = np.cross(normals, helper)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.cross(normals, along)
    for way in (1.0, -1.0):
        all_within = np.ones(len(points), np.bool_)
        for a, b in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            place = points + WITHIN_MM * (a * along + b * across) + (way * DEPTH_MM - enclosure.OUTSIDE_MM) * normals
            all_within &= enclosure.enclosed(place, normals, grid, only)
        inside |= all_within
    return inside


def _hidden_places(surface: DesignSurface, hidden: Bools) -> tuple[Floats, Floats]:
    """Return the middles (n, 3) of hidden samples of plane faces, and the faces' normals (n, 3)."""
    charts = surface.charts
    plane = charts.kind[chart_of_cells(surface)] == PLANE
    cell, sample = np.nonzero(hidden & plane[:, None])
    axes = charts.axes[chart_of_cells(surface)[cell]]
    offset = charts.cell_mm * ((np.stack(np.divmod(sample, PER_SIDE), axis=1) + 0.5) / PER_SIDE - 0.5)
    return surface.centres[cell] + np.einsum("nk,nkj->nj", offset, axes[:, :2]), axes[:, 2]


def _points_on_hidden(observed: Observed, surface: DesignSurface, hidden: Bools) -> tuple[Floats, Floats]:
    """Return the feet (n, 3) of points on hidden samples of plane faces, and the faces' normals (n, 3)."""
    charts = surface.charts
    near = np.flatnonzero((np.abs(observed.deviation) < ON_MM) & (charts.kind[observed.chart] == PLANE))
    chart, uv = observed.chart[near], observed.uv[near]
    cell = cells_of(observed, surface)[near]
    share = (uv - charts.low[chart]) / charts.cell_mm
    at = np.clip(np.floor((share - np.floor(share)) * PER_SIDE), 0, PER_SIDE - 1).astype(np.int64)
    on = hidden[cell, at[:, 0] * PER_SIDE + at[:, 1]]
    chart, uv = chart[on], uv[on]
    axes = charts.axes[chart]
    return charts.origin[chart] + np.einsum("nk,nkj->nj", uv, axes[:, :2]), axes[:, 2]


def _cells_of_body(surface: DesignSurface, body: Ints, one: int) -> Ints:
    """Return the cells of the faces that are of one body alone."""
    charts = np.unique(surface.chart_of[body == one])
    charts = np.setdiff1d(charts, surface.chart_of[body != one])
    return np.flatnonzero(np.isin(chart_of_cells(surface), charts))


def _faces(surface: DesignSurface, hidden: Bools, body: Ints, one: int, strength: float) -> Iterator[Region]:
    """Yield the cells of each face of a body that could be seen, as missing."""
    cells = _cells_of_body(surface, body, one)
    cells = cells[(surface.covered & ~hidden)[cells].mean(axis=1) > 0.5 * surface.share[cells]]
    cells = cells[surface.share[cells] > 0.0]
    chart = chart_of_cells(surface)[cells]
    chance = float(np.exp(-strength)) / surface.charts.cell_mm**2
    for number in np.unique(chart):
        yield Region(int(number), cells[chart == number], 0, float(np.sqrt(2.0 * strength)), chance)
