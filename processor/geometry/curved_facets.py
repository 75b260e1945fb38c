"""What a mesh leaves out of a curved surface: facets lie inside of a tube by up to their tolerance.

The height of the smooth surface over a facet is the parabola that the normals at its corners ask for: half of Phong
tessellation (Boubekeur and Alexa 2008), which on a cylinder is exact to second order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry.mesh_surface import MeshSurface
from processor.model import Floats, Ints

MOST_MM = 1.0  # facets that would bulge by more are meant flat: no mesh is as coarse


@dataclass(frozen=True)
class CurvedFacets:
    """Slopes (f, 3, 3) by corner: of the plane at each corner, over the facet's own, along the three axes."""

    surface: MeshSurface
    slopes: Floats

    def heights(self, feet: Floats, facet: Ints) -> Floats:
        """Height (n,) of the smooth surface over facets (n,) at feet (n, 3) on them; 0 where there is no facet."""
        found = np.zeros(len(feet))
        on = np.flatnonzero(facet >= 0)
        at = facet[on]
        share = np.clip(self.surface.barycentric(feet[on], at), 0.0, 1.0)
        for k in range(3):
            off = feet[on] - self.surface.vertices[self.surface.faces[at, k]]
            found[on] += 0.5 * share[:, k] * np.einsum("ni,ni->n", off, self.slopes[at, k])
        return found


def of_surface(surface: MeshSurface) -> CurvedFacets:
    """Find the slopes of a mesh's facets; 0 for those that are flat, or meant so."""
    corners = surface.vertices[surface.faces]
    # The normal at a corner: of the facets of the same smooth face about it, by the angle that each has there.
    ahead, behind = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    length = np.linalg.norm(ahead, axis=2) * np.linalg.norm(behind, axis=2)
    cosine = np.einsum("fki,fki->fk", ahead, behind) / np.maximum(length, 1e-300)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)).ravel()
    key = surface.faces * (int(surface.part_of.max()) + 1) + surface.part_of[:, None]
    number = np.unique(key.ravel(), return_inverse=True)[1].reshape(-1)
    each = np.repeat(surface.normals, 3, axis=0) * angle[:, None]
    total = np.stack([np.bincount(number, each[:, i]) for i in range(3)], axis=1)
    total = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    normal = total[number].reshape(-1, 3, 3)
    up = np.einsum("fki,fi->fk", normal, surface.normals)
    # A plane with normal m, over a facet with normal n, rises by -(m . d) / (m . n) at d along the facet.
    slopes = -normal / np.maximum(up, 0.5)[:, :, None]
    slopes -= np.einsum("fki,fi->fk", slopes, surface.normals)[:, :, None] * surface.normals[:, None]
    rise = np.abs(np.einsum("fki,fki->fk", slopes, ahead)), np.abs(np.einsum("fki,fki->fk", slopes, behind))
    bulge = np.maximum(*rise).max(axis=1) / 4.0
    slopes[bulge > MOST_MM] = 0.0
    return CurvedFacets(surface, slopes)
