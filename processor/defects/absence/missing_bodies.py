"""Bodies that are gone, by the places that they should hide: points where they would touch another body.

A body of which no point was measured may be gone, or no station may have seen it. If points lie on the face that it
should stand on, well within its outline and nearly as dense as elsewhere, no body stands there. How many points lie
there by error is taken from the contacts of the other bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from processor.defects.deviation_field import Field
from processor.defects.observations import Observed, cells_of
from processor.defects.regions import EMPTY_SHARE, Region, chernoff
from processor.defects.surface_charts import PLANE, DesignSurface
from processor.geometry import mesh_bodies, mesh_distance, rigid
from processor.large_arrays import blocks
from processor.model import Bools, Floats, Ints

STEP_MM = 2.0  # between places by which contacts are measured
WITHIN_MM = 4.0  # from the outline of a contact: beams at its border hit the face beside it
DEPTH_MM = 1.0  # into the body, at which a place is tested
ON_MM = 4.0  # distance from the face, up to which a point is on it
GONE_SHARE = 0.02  # of the points that faces seen elsewhere have, up to which none of a body was measured
FEWEST_CELLS = 2.0  # by area, of a body that can be judged
NEAR_MM = 2.0  # margin of the box about a body


@dataclass(frozen=True)
class _Contact:
    """A body: area of its contacts (mm2, well within), points on them, and whether points lie on its faces."""

    body: int
    area: float
    points: int
    is_empty: bool


def of_bodies(observed: Observed, field: Field, alarms_per_mm2: float) -> list[Region]:
    """Return the faces of bodies that are gone."""
    body = mesh_bodies.closed_bodies(field.surface.faces)
    contacts = list(_contacts(observed, field, body))
    present = [contact for contact in contacts if not contact.is_empty]
    if not present:
        return []
    rates = [contact.points / contact.area for contact in present]
    # By error, on 1 mm2; points on the contact of a body that is gone also count for the one that it stood on.
    rate = max(float(np.median(rates)), 1.0 / sum(contact.area for contact in present))
    least = EMPTY_SHARE * _density(field)
    regions: list[Region] = []
    for contact in contacts:
        if not contact.is_empty or contact.points < least * contact.area:
            continue
        strength = chernoff(rate * contact.area, float(contact.points), more=True)
        if strength > -np.log(alarms_per_mm2 * contact.area):
            regions += _faces(field.surface, body, contact.body, strength)
    return regions


def _contacts(observed: Observed, field: Field, body: Ints) -> Iterator[_Contact]:
    """Yield the contacts of each closed body that has any."""
    surface, charts = field.surface, field.surface.charts
    touched = np.flatnonzero(surface.hidden.any(axis=1) & (charts.kind == PLANE)[surface.chart])
    places, inward, place_mm2 = _places_of(surface, touched)
    found = _points_on(observed, surface, touched)
    low, high = mesh_bodies.boxes(surface.vertices[surface.faces], body).swapaxes(0, 1)
    typical = _density(field) * charts.cell_mm**2
    for one in range(len(low)):
        only = np.where(body == one, 0, -1)

        def number(points: Floats, normals: Floats, only: Ints = only, one: int = one) -> int:
            near = ((points > low[one] - NEAR_MM) & (points < high[one] + NEAR_MM)).all(axis=1)
            return int(_well_inside(points[near], normals[near], surface.sight_grid, only).sum())

        samples = number(places, inward)
        cells = _cells_of_body(surface, body, one)
        judged = cells[field.inner[cells] > 0.0]
        if samples and typical and len(judged) >= FEWEST_CELLS:
            counted = (field.count + field.stray)[judged].sum()
            empty = bool(counted <= GONE_SHARE * typical * surface.share[judged].sum())
            yield _Contact(one, samples * place_mm2, number(*found), empty)


def _density(field: Field) -> float:
    """Return the median number of points on 1 mm2 of the faces that were seen; 0 if none were."""
    seen = field.seen > 0.0
    return float(np.median(field.count[seen])) / field.surface.charts.cell_mm**2 if seen.any() else 0.0


def _well_inside(points: Floats, normals: Floats, grid: mesh_distance.FacetGrid, only: Ints) -> Bools:
    """Mark the places (n, 3) of which all within WITHIN_MM along the face lie inside the one body of ``only`` (f,).

    A contact is on two faces, of this body and of the one that it touches: both ways of the normal are tried.
    """
    inside = np.zeros(len(points), np.bool_)
    if not len(points):
        return inside
    along, across = rigid.axes_across(normals).transpose(1, 0, 2)
    for way in (1.0, -1.0):
        all_within = np.ones(len(points), np.bool_)
        for a, b in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            place = points + WITHIN_MM * (a * along + b * across) + (way * DEPTH_MM - mesh_bodies.OUTSIDE_MM) * normals
            all_within &= mesh_bodies.enclosed(place, normals, grid, only)
        inside |= all_within
    return inside


def _places_of(surface: DesignSurface, cells: Ints) -> tuple[Floats, Floats, float]:
    """Return places (n, 3) spread over ``cells``, the faces' normals (n, 3), and the area of each place, mm2."""
    charts = surface.charts
    side = int(np.ceil(charts.cell_mm / STEP_MM))
    offset = charts.cell_mm * ((np.indices((side, side)).reshape(2, -1).T + 0.5) / side - 0.5)
    axes = charts.axes[surface.chart[cells]]
    places = surface.centres[cells][:, None] + np.einsum("ok,nkj->noj", offset, axes[:, :2])
    return places.reshape(-1, 3), np.repeat(axes[:, 2], side * side, axis=0), (charts.cell_mm / side) ** 2


def _points_on(observed: Observed, surface: DesignSurface, cells: Ints) -> tuple[Floats, Floats]:
    """Return the feet (n, 3) of points on ``cells`` of plane faces, and the faces' normals (n, 3)."""
    charts = surface.charts
    wanted = np.zeros(len(surface.share), np.bool_)
    wanted[cells] = True
    parts = [(observed.chart[:0], observed.uv[:0])]
    for rows in blocks(len(observed.chart)):
        on = wanted[cells_of(observed, surface, rows)] & (np.abs(observed.deviation[rows]) < ON_MM)
        parts.append((observed.chart[rows][on], observed.uv[rows][on]))
    chart, uv = (np.concatenate(column) for column in zip(*parts, strict=True))
    axes = charts.axes[chart]
    return charts.origin[chart] + np.einsum("nk,nkj->nj", uv, axes[:, :2]), axes[:, 2]


def _cells_of_body(surface: DesignSurface, body: Ints, one: int) -> Ints:
    """Return the cells of the faces that are of one body alone."""
    charts = np.unique(surface.chart_of[body == one])
    charts = np.setdiff1d(charts, surface.chart_of[body != one])
    return np.flatnonzero(np.isin(surface.chart, charts))


def _faces(surface: DesignSurface, body: Ints, one: int, strength: float) -> Iterator[Region]:
    """Yield the cells of each face of a body that could be seen, as missing."""
    cells = _cells_of_body(surface, body, one)
    cells = cells[(surface.covered & ~surface.hidden)[cells].mean(axis=1) > 0.5 * surface.share[cells]]
    cells = cells[surface.share[cells] > 0.0]
    chart = surface.chart[cells]
    chance = float(np.exp(-strength)) / surface.charts.cell_mm**2
    for number in np.unique(chart):
        yield Region(int(number), cells[chart == number], 0, float(np.sqrt(2.0 * strength)), chance)
