"""A model as it is scanned: named bodies with named faces, each a mesh with the surface that it approximates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from designgen.cad.bodies import Body
from designgen.cad.face_surfaces import PLANE, surface_of
from designgen.designs.parametric_face import Surface, Trimmed
from designgen.models.mesh_topology import connected_components, shared_edges
from processor.model import DesignBodies, Floats, Ints

SMOOTH_COS = np.cos(1e-2)  # of the angle between two faces at a common edge, up to which they are one smooth surface


@dataclass(frozen=True, kw_only=True)
class ModelBody:
    """A body: vertices (v, 3), mm, triangles (f, 3) with outward normals, and the face (f,) that each belongs to.

    ``pq`` (f, 3, 2) are the parameters of the corners on the surfaces of the faces, of which a mesh has none. A face
    that is ``flat`` is its triangles. Faces of one number in ``smooth`` join without an edge.
    """

    name: str
    vertices: Floats
    triangles: Ints
    face: Ints
    pq: Floats
    face_names: tuple[str, ...]
    surfaces: tuple[Surface | None, ...]
    flat: tuple[bool, ...]
    smooth: tuple[int, ...]

    def patches(self) -> list[tuple[Trimmed, int]]:
        """Return every face with the number of its smooth surface."""
        order = np.argsort(self.face, kind="stable")
        groups = np.split(order, np.searchsorted(self.face[order], np.arange(1, len(self.face_names))))
        return [
            (
                Trimmed(
                    self.face_names[k],
                    self.vertices[self.triangles[rows]],
                    self.pq[rows],
                    None if self.flat[k] else self.surfaces[k],
                ),
                self.smooth[k],
            )
            for k, rows in enumerate(groups)
            if len(rows)
        ]


@dataclass(frozen=True)
class Model:
    """Named bodies, and the notes: what was found and done when they were read.

    ``shared`` of the bodies had a name in the file that others have, ``unnamed`` had none.
    """

    name: str
    bodies: tuple[ModelBody, ...]
    notes: tuple[str, ...] = ()
    shared: int = 0
    unnamed: int = 0

    def design_bodies(self) -> DesignBodies:
        """Return the bodies of the facets of :meth:`mesh`."""
        return DesignBodies(
            names=tuple(body.name for body in self.bodies),
            of_facet=np.repeat(np.arange(len(self.bodies)), [len(body.triangles) for body in self.bodies]),
            shared=self.shared,
            unnamed=self.unnamed,
        )

    def mesh(self) -> tuple[Floats, Ints]:
        """Return vertices (v, 3), mm, and triangles (f, 3) of all bodies."""
        counts = np.cumsum([0, *(len(body.vertices) for body in self.bodies)]).tolist()
        faces = [body.triangles + first for body, first in zip(self.bodies, counts, strict=False)]
        return np.concatenate([body.vertices for body in self.bodies]), np.concatenate(faces)


def of_cad(body: Body, name: str) -> ModelBody:
    """Return a CAD body with the forms of its faces under a name."""
    if body.forms is None:
        return of_mesh(name, body.vertices, body.faces)
    forms = body.forms.forms
    surfaces = tuple(surface_of(form) for form in forms)
    flat = tuple(form.kind == PLANE or surface is None for form, surface in zip(forms, surfaces, strict=True))
    return ModelBody(
        name=name,
        vertices=body.vertices,
        triangles=body.faces,
        face=body.forms.of_triangle,
        pq=body.forms.corner_uv,
        face_names=tuple(unique_names([form.name for form in forms])),
        surfaces=surfaces,
        flat=flat,
        smooth=_smooth(body, [None if plane else surface for plane, surface in zip(flat, surfaces, strict=True)]),
    )


def of_mesh(name: str, vertices: Floats, triangles: Ints, most_deg: float = 20.0) -> ModelBody:
    """Return a mesh as a body; triangles whose normals differ by less than ``most_deg`` at their edge are one face."""
    first, second, third = (vertices[triangles[:, i]] for i in range(3))
    normal = _unit(np.cross(second - first, third - first))
    a, b, _ = shared_edges(triangles)
    level = np.einsum("ni,ni->n", normal[a], normal[b]) >= np.cos(np.radians(most_deg))
    face = connected_components(len(triangles), a[level], b[level])
    count = int(face.max(initial=-1)) + 1
    return ModelBody(
        name=name,
        vertices=vertices,
        triangles=triangles,
        face=face,
        pq=np.zeros((len(triangles), 3, 2)),
        face_names=tuple(f"face {i + 1}" for i in range(count)),
        surfaces=(None,) * count,
        flat=(True,) * count,
        smooth=tuple(range(count)),
    )


def unique_names(names: Sequence[str]) -> list[str]:
    """Return names with a number after each that has been used before: "web", "web (2)"."""
    taken = set(names)
    counts: dict[str, int] = {}
    result = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        said = name
        while counts[name] > 1 and said in taken:
            said = f"{name} ({counts[name]})"
            counts[name] += said in taken
        taken.add(said)
        result.append(said)
    return result


def _smooth(body: Body, surfaces: Sequence[Surface | None]) -> tuple[int, ...]:
    """Return a number for each face; faces whose normals agree at a common edge have one number."""
    assert body.forms is not None
    owner = body.forms.of_triangle
    a, b, ends = shared_edges(body.faces)
    between = owner[a] != owner[b]
    a, b, ends = a[between], b[between], ends[between]
    normals = [_at_edges(body, surfaces, rows, ends) for rows in (a, b)]
    level = np.einsum("ni,ni->n", *normals) >= SMOOTH_COS
    # All of an edge has to be smooth: two faces that also meet at a corner are not one surface.
    pairs = np.sort(np.stack([owner[a], owner[b]], axis=1), axis=1)
    distinct, which = np.unique(pairs, axis=0, return_inverse=True)
    sharp = np.bincount(which.reshape(-1), weights=~level, minlength=len(distinct)) > 0
    joined = distinct[~sharp]
    return tuple(connected_components(len(surfaces), joined[:, 0], joined[:, 1]).tolist())


def _at_edges(body: Body, surfaces: Sequence[Surface | None], rows: Ints, ends: Ints) -> Floats:
    """Return unit normals (k, 3) of the faces of triangles ``rows`` at the middles of their edges ``ends`` (k, 2)."""
    assert body.forms is not None
    corners = body.vertices[body.faces[rows]]
    normal = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    on_edge = (body.faces[rows][:, :, None] == ends[:, None, :]).any(axis=2)
    uv = body.forms.corner_uv[rows]
    middle = 0.5 * np.einsum("nk,nkc->nc", on_edge, uv)
    inward = 1e-4 * (uv - middle[:, None])
    owner = body.forms.of_triangle[rows]
    for face in np.unique(owner):
        at = surfaces[face]
        if at is None:
            continue
        k = np.flatnonzero(owner == face)
        point = at(*middle[k].T)
        steps = [at(*(middle[k] + inward[k, i]).T) - point for i in range(3)]
        # Two of the three steps are opposite, along the edge; the largest of the products is across it.
        products = np.stack([np.cross(steps[i], steps[(i + 1) % 3]) for i in range(3)], axis=1)
        largest = np.argmax(np.einsum("nij,nij->ni", products, products), axis=1)
        normal[k] = _unit(products[np.arange(len(k)), largest])
    return normal


def _unit(vectors: Floats) -> Floats:
    result: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
    return result
