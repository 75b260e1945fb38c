"""CAD solids as triangle meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from processor.model import Floats, Ints

if TYPE_CHECKING:
    import cadquery as cq

ANGLE_RAD = 0.1


def triangulate(solid: cq.Shape, tolerance_mm: float) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and triangles (f, 3) of a solid, facets about the tolerance from it; normals look outward.

    The vertices lie on the solid; on long curved faces the kernel lets a few facets depart by several tolerances.
    Vertices shared by faces are merged, so the mesh of a closed solid is closed.
    """
    mesh_faces(solid.wrapped, tolerance_mm)
    vertices, faces, _ = facets(solid.wrapped)
    return vertices, faces


def mesh_faces(shape: Any, tolerance_mm: float, *, large: bool = False) -> int:
    """Give every face of a kernel's shape a mesh in place of any that it has; the number of triangles.

    ``large`` takes the kernel's other algorithm, whose time does not grow with the square of a face's triangles.
    """
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.BRepTools import BRepTools
    from OCP.IMeshTools import IMeshTools_MeshAlgoType, IMeshTools_Parameters
    from OCP.Message import Message_ProgressRange

    BRepTools.Clean_s(shape)
    if large:
        asked = IMeshTools_Parameters()
        asked.Deflection, asked.Angle = tolerance_mm, ANGLE_RAD
        asked.MeshAlgo = IMeshTools_MeshAlgoType.IMeshTools_MeshAlgoType_Delabella
        BRepMesh_IncrementalMesh(shape, asked, Message_ProgressRange())
    else:
        BRepMesh_IncrementalMesh(shape, tolerance_mm, False, ANGLE_RAD, False)
    return sum(mesh.NbTriangles() for _, mesh, _ in _meshes(shape) if mesh is not None)


def facets(shape: Any) -> tuple[Floats, Ints, float]:
    """Return the vertices (v, 3), triangles (f, 3) and deviation by the kernel's own figure of a meshed shape.

    Raises ValueError where a face has no mesh.
    """
    from OCP.TopAbs import TopAbs_REVERSED

    points, triangles, deviation, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0.0, 0
    for face, mesh, place in _meshes(shape):
        if mesh is None:
            raise ValueError("a face cannot be meshed")
        of_face = np.array([mesh.Node(i).Coord() for i in range(1, mesh.NbNodes() + 1)], np.float64).reshape(-1, 3)
        if not place.IsIdentity():
            T = place.Transformation()
            matrix = np.array([[T.Value(row, column) for column in (1, 2, 3, 4)] for row in (1, 2, 3)])
            of_face = of_face @ matrix[:, :3].T + matrix[:, 3]
        corners = np.array([mesh.Triangle(i).Get() for i in range(1, mesh.NbTriangles() + 1)], np.int64).reshape(-1, 3)
        if face.Orientation() == TopAbs_REVERSED:
            corners = corners[:, [0, 2, 1]]
        points.append(of_face)
        triangles.append(corners - 1 + count)
        count += len(of_face)
        deviation = max(deviation, float(mesh.Deflection()))
    return *_merged(np.vstack(points), np.vstack(triangles)), deviation


def _meshes(shape: Any) -> list[tuple[Any, Any, Any]]:
    """Return every face of a shape with its mesh, None where it has none, and the mesh's place."""
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_FACE
    from OCP.TopExp import TopExp
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopoDS import TopoDS
    from OCP.TopTools import TopTools_IndexedMapOfShape

    known, found = TopTools_IndexedMapOfShape(), []
    TopExp.MapShapes_s(shape, TopAbs_FACE, known)
    for i in range(1, known.Extent() + 1):
        face, place = TopoDS.Face_s(known.FindKey(i)), TopLoc_Location()
        found.append((face, BRep_Tool.Triangulation_s(face, place), place))
    return found


def _merged(points: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    # Faces have vertices of their own along a common edge; 1e-5 mm is far below any edge and far above rounding.
    _, first, inverse = np.unique(np.round(points, 5), axis=0, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[triangles]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points[first], faces[proper].astype(np.int64)
