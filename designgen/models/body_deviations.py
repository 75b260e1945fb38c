"""Deviations of one body from its design: moved, turned, bent, dented or left out.

A section ``[asbuilt."NAME"]`` of a recipe is about the body NAME. A deviation is a displacement of the design's points:
first bend and dent, then the movement of the whole body. Coordinates are those of the model, mm.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from designgen.checks import expect_all
from designgen.designs.parametric_face import Displacement
from designgen.models.model import ModelBody
from designgen.models.subdivision import Spacing
from designgen.models.surface_samples import sample_surface, triangle_areas, triangle_normals
from designgen.randomness import generator
from designgen.recipe_params import filled
from designgen.scanning.facets import Facets
from processor.model import Floats, UsageError

FACET_MM = 0.005  # largest departure of a displaced triangle from its curved surface, where a face is triangles alone
DENT_EDGE_SHARE = 0.25  # of a dent's radius: longest edge of the triangles within it
FREE_MM = 500.0  # least distance to other triangles before a place where a dent is drawn
FACING = 0.7  # least cosine between a normal and a direction that it counts as facing
ANYWHERE = float("inf")


@dataclass(frozen=True, kw_only=True)
class Params:
    """Deviations of one body. The axes are those of the model.

    ``turn_deg`` is a rotation vector about the middle of the body's box. ``bend_mm`` is the largest displacement along
    ``bend_along``, at the middle of the body's length; "0, 0, 0": along its least thickness. ``dent_at_mm``: the dent
    is at the nearest place of the surface; without it, one is drawn.
    """

    move_mm: tuple[float, ...] = (0.0, 0.0, 0.0)
    turn_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    bend_mm: float = 0.0
    bend_along: tuple[float, ...] = (0.0, 0.0, 0.0)
    dent_mm: float = 0.0  # depth, positive inward
    dent_radius_mm: float = 100.0
    dent_at_mm: tuple[float, ...] = (ANYWHERE, ANYWHERE, ANYWHERE)
    missing: bool = False

    def __post_init__(self) -> None:
        threes = ("move_mm", "turn_deg", "bend_along", "dent_at_mm")
        expect_all(
            "asbuilt",
            *((len(getattr(self, key)) == 3, key, list(getattr(self, key)), "three numbers") for key in threes),
            (self.dent_radius_mm > 0.0, "dent_radius_mm", self.dent_radius_mm, "a length above 0"),
            (abs(self.dent_mm) <= self.dent_radius_mm, "dent_mm", self.dent_mm, "at most dent_radius_mm"),
        )


@dataclass(frozen=True)
class Defect:
    """One defect as the truth states it: centre (3,), mm, area, mm^2, depth, mm, positive inward, and volume, mm^3."""

    kind: str
    body: str
    centre: Floats
    area: float
    depth: float
    _: dataclasses.KW_ONLY
    volume: float


def params_of(recipe: Mapping[str, Any], names: Sequence[str]) -> dict[str, Params]:
    """Return the deviations of a recipe's bodies by name; UsageError for an unknown body or key."""
    section = recipe.get("asbuilt", {})
    if not isinstance(section, Mapping):
        raise UsageError(f"asbuilt: expected a section, got {section!r}")
    for name, table in section.items():
        if not isinstance(table, Mapping):
            raise UsageError(f'asbuilt.{name}: expected a section of a body, [asbuilt."NAME"], got {table!r}')
        if name not in names:
            near = difflib.get_close_matches(name, names, 3) or list(names[:3])
            raise UsageError(
                f"asbuilt.{name}: the model has no body of this name; there are {len(names)}, as {', '.join(near)}"
            )
    return {name: filled(Params, {f"asbuilt.{name}": table}, f"asbuilt.{name}") for name, table in section.items()}


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """The deviation of one body: its displacement, whether that is rigid, and the triangle edges that it needs."""

    displacement: Displacement
    rigid: bool
    spacings: tuple[Spacing, ...]
    defects: tuple[Defect, ...]
    notes: tuple[tuple[str, float, str], ...]
    dent: tuple[Floats, float] | None  # centre (3,) and radius, mm


@dataclass(frozen=True, kw_only=True)
class ShapeChange:
    """One deviation of a body's shape, a bend or a dent: the displacement, and the triangle edges that it needs."""

    field: Displacement
    spacing: Spacing
    defect: Defect
    notes: tuple[tuple[str, float, str], ...]


def deviation_of(body: ModelBody, params: Params, facets: Facets, seed: int) -> Deviation:
    """Return the deviation of a body by its parameters."""
    bend = [_bend(body, params)] if params.bend_mm else []
    dent = [_dent(body, params, facets, seed)] if params.dent_mm else []
    changes, moved = bend + dent, _movement(body, params)

    def displacement(points: Floats) -> Floats:
        shape = np.zeros_like(points)
        for change in changes:
            shape = shape + change.field(points)
        result: Floats = shape if moved is None else shape + moved(points + shape)
        return result

    defects = [change.defect for change in changes]
    notes = [note for change in changes for note in change.notes]
    if moved is not None:
        defects.append(_misalignment(body, moved))
        for key, unit in (("move_mm", "mm"), ("turn_deg", "deg")):
            what = key.partition("_")[0]
            notes += [(f"{what}, {axis}", c, unit) for axis, c in zip("xyz", getattr(params, key), strict=True)]
    return Deviation(
        displacement=displacement,
        rigid=not changes,
        spacings=tuple(change.spacing for change in changes),
        defects=tuple(defects),
        notes=tuple(notes),
        dent=(dent[0].defect.centre, params.dent_radius_mm) if dent else None,
    )


def _has_triangulated_face(body: ModelBody) -> bool:
    """Return whether a face of the body is known by its triangles alone."""
    return any(surface is None for surface in body.surfaces)


def _bend(body: ModelBody, params: Params) -> ShapeChange:
    """Return a bend: half a wave along the body, which is largest at its middle and vanishes at its ends."""
    middle, along, length, across = _axis(body, params)
    most = params.bend_mm

    def field(x: Floats) -> Floats:
        result: Floats = np.outer(most * np.cos(np.pi * ((x - middle) @ along) / length), across)
        return result

    # A chord h departs from a curve by h^2 / 8 times the curvature, bend (pi / length)^2.
    facet = length / np.pi * float(np.sqrt(8.0 * FACET_MM / abs(most)))
    longest = min(facet, length / 16.0) if _has_triangulated_face(body) else length / 16.0
    front = float(triangle_areas(body)[triangle_normals(body) @ across > FACING].sum())
    return ShapeChange(
        field=field,
        spacing=Spacing(middle, float("inf"), longest),
        defect=Defect("bend", body.name, middle, front, abs(most), volume=front * abs(most) * 2.0 / np.pi),
        notes=(("bend", most, "mm"),),
    )


def _dent(body: ModelBody, params: Params, facets: Facets, seed: int) -> ShapeChange:
    """Return a round dent; it fades out in depth, so that an opposite wall stays."""
    centre, inward = _dent_place(body, params, facets, seed)
    radius, depth = params.dent_radius_mm, params.dent_mm

    def field(points: Floats) -> Floats:
        arm = points - centre
        below = arm @ inward
        share = np.minimum((np.einsum("ni,ni->n", arm, arm) - below**2) / radius**2, 1.0)
        fade = np.clip(2.0 * np.abs(below) / radius - 1.0, 0.0, 1.0)
        result: Floats = np.outer(depth * (1.0 - share) ** 2 * (1.0 - fade**2) ** 2, inward)
        return result

    # The curvature in the middle is 4 depth / radius^2.
    facet = float(np.sqrt(2.0 * FACET_MM / abs(depth)))
    longest = radius * (min(facet, DENT_EDGE_SHARE) if _has_triangulated_face(body) else DENT_EDGE_SHARE)
    area = np.pi * radius**2
    kind = "dent" if depth > 0.0 else "bulge"
    places = [(f"dent, {axis}", float(c), "mm") for axis, c in zip("xyz", centre, strict=True)]
    return ShapeChange(
        field=field,
        spacing=Spacing(centre, 1.5 * radius, longest),
        defect=Defect(kind, body.name, centre, area, depth, volume=area * depth / 3.0),
        notes=(("dent, depth", depth, "mm"), ("dent, radius", radius, "mm"), *places),
    )


def _misalignment(body: ModelBody, moved: Displacement) -> Defect:
    """Return a moved body as a defect: half of its surface, by the components along the normals."""
    middles, areas = body.vertices[body.triangles].mean(axis=1), triangle_areas(body)
    out = np.abs(np.einsum("ni,ni->n", moved(middles), triangle_normals(body)))
    box = 0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0))
    return Defect(
        "misalignment", body.name, box, 0.5 * float(areas.sum()), float(out.max()), volume=0.5 * float(areas @ out)
    )


def _movement(body: ModelBody, params: Params) -> Displacement | None:
    """Return the displacement of a body that is moved and turned about the middle of its box; None for neither."""
    move, turn = np.array(params.move_mm), np.radians(params.turn_deg)
    angle = float(np.linalg.norm(turn))
    if angle == 0.0 and not move.any():
        return None
    x, y, z = turn / angle if angle else np.zeros(3)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    change = np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    middle = 0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0))

    def moved(points: Floats) -> Floats:
        result: Floats = (points - middle) @ change.T + move
        return result

    return moved


def _dent_place(body: ModelBody, params: Params, facets: Facets, seed: int) -> tuple[Floats, Floats]:
    """Return the middle (3,) of a dent on the surface, and the unit normal (3,) into the body."""
    points, normals = sample_surface(body.vertices[body.triangles], 2000)
    at = np.array(params.dent_at_mm)
    if np.isfinite(at).all():
        nearest = int(np.argmin(np.linalg.norm(points - at, axis=1)))
        # The plane of the nearest of many points, as these are not dense.
        return at - normals[nearest] * float((at - points[nearest]) @ normals[nearest]), -normals[nearest]
    # Of places with room before them, some of those farthest from other faces; one of them by chance.
    areas = np.array([triangle_areas(body)[body.face == k].sum() for k in range(len(body.face_names))])
    on_face = np.abs(areas - areas.max()) < 0.01 * areas.max()
    rows = np.flatnonzero(on_face[body.face])
    points, normals = sample_surface(body.vertices[body.triangles[rows]], 500)
    free = facets.free(points, points + FREE_MM * normals)
    points, normals = (points[free], normals[free]) if free.any() else (points, normals)
    others = body.vertices[body.triangles[np.setdiff1d(np.arange(len(body.face)), rows)]]
    if len(others):
        edges = sample_surface(others, 4000)[0]
        apart = np.min([np.linalg.norm(points - edge, axis=1) for edge in edges], axis=0)
        best = np.flatnonzero(apart >= 0.8 * apart.max())
    else:
        best = np.arange(len(points))
    pick = int(best[generator(seed, f"dent {body.name}").integers(len(best))])
    return points[pick], -normals[pick]


def _axis(body: ModelBody, params: Params) -> tuple[Floats, Floats, float, Floats]:
    """Return middle, direction and length of a body's longest extent, and the direction across in which it bends."""
    wanted = np.array(params.bend_along)
    points, _ = sample_surface(body.vertices[body.triangles], 2000)
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    reach = body.vertices @ axes.T
    low, high = reach.min(axis=0), reach.max(axis=0)
    across = wanted - axes[0] * (wanted @ axes[0]) if wanted.any() else axes[2]
    size = float(np.linalg.norm(across))
    if size < 1e-9:
        raise UsageError(f"asbuilt.{body.name}.bend_along: expected a direction across the body's length")
    return 0.5 * (low + high) @ axes, axes[0], float(high[0] - low[0]), across / size


def missing_part(body: ModelBody) -> Defect:
    """Return a body that is left out as a defect: half of its surface, and its mean thickness as the depth."""
    points, _ = sample_surface(body.vertices[body.triangles], 500)
    corners = body.vertices[body.triangles]
    volume = abs(float(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum())) / 6.0
    area = 0.5 * float(triangle_areas(body).sum())
    return Defect("missing-part", body.name, points.mean(axis=0), area, volume / area, volume=volume)
