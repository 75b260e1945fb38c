"""CadQuery solids as triangle meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from processor.model import Floats, Ints

if TYPE_CHECKING:
    import cadquery as cq


def triangulate(solid: cq.Shape, tolerance_mm: float) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and triangles (f, 3) of a solid, facets about the tolerance from it; normals look outward.

    The vertices lie on the solid; on long curved faces the kernel lets a few facets depart by several tolerances.
    Vertices shared by faces are merged, so the mesh of a closed solid is closed.
    """
    from OCP.BRepMesh import BRepMesh_IncrementalMesh

    # CadQuery would take the tolerance relative to each edge's length; with this mesh in place it makes none.
    BRepMesh_IncrementalMesh(solid.wrapped, tolerance_mm, False, 0.1, False)
    found, triangles = solid.tessellate(1e6, 0.1)
    points = np.array([p.toTuple() for p in found])
    # Faces have vertices of their own along a common edge; 1e-5 mm is far below any edge and far above rounding.
    _, first, inverse = np.unique(np.round(points, 5), axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[np.array(triangles)]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points[first], faces[proper].astype(np.int64)
