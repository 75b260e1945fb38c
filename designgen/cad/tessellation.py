"""Triangle meshes of shapes of the CAD kernel (Open CASCADE)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
from OCP.BRep import BRep_Builder, BRep_Tool
from OCP.BRepMesh import BRepMesh_IncrementalMesh
from OCP.BRepTools import BRepTools
from OCP.IMeshTools import IMeshTools_MeshAlgoType, IMeshTools_Parameters
from OCP.Message import Message_ProgressRange
from OCP.TopAbs import TopAbs_FACE, TopAbs_REVERSED
from OCP.TopExp import TopExp
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Compound
from OCP.TopTools import TopTools_IndexedMapOfShape

from designgen.cad.bodies import ANGLE_RAD, EDGE_SHARE
from processor.model import Floats, Ints

FINER = 0.1  # of the deviation aimed at: a face that no mesh could be made for may have one with more points


def mesh_faces(
    shape: Any, tolerance_mm: float, finer: Callable[[Any], bool] | None = None, *, large: bool = False
) -> int:
    """Mesh every face of a shape, in place of any earlier mesh; return the number of triangles.

    Faces for which ``finer`` is true are meshed EDGE_SHARE times as coarse. The kernel keeps the edges of faces that
    have been meshed, so the other faces have finer edges, too. ``large`` selects the kernel's other algorithm, whose
    time does not grow with the square of a face's triangles.
    """
    BRepTools.Clean_s(shape)
    if finer is not None:
        _mesh(_compound(face for face, _, _ in meshes(shape) if finer(face)), EDGE_SHARE * tolerance_mm, large)
    _mesh(shape, tolerance_mm, large)
    return sum(mesh.NbTriangles() for _, mesh, _ in meshes(shape) if mesh is not None)


def _mesh(shape: Any, tolerance_mm: float, large: bool) -> None:
    """Mesh a shape; faces that one algorithm leaves empty go to the other one, and again more finely.

    Delabella leaves curved extrusions of a large size empty, Watson now and then a face with a short edge. The kernel
    keeps the points on edges of faces that have a mesh, so that neighbours still meet.
    """
    kinds = IMeshTools_MeshAlgoType
    delabella, watson = kinds.IMeshTools_MeshAlgoType_Delabella, kinds.IMeshTools_MeshAlgoType_Watson
    first, second = (delabella, watson) if large else (watson, delabella)
    for algorithm, share in ((first, 1.0), (second, 1.0), (first, FINER), (second, FINER)):
        parameters = IMeshTools_Parameters()
        parameters.Deflection, parameters.Angle = share * tolerance_mm, ANGLE_RAD
        parameters.MeshAlgo = algorithm
        BRepMesh_IncrementalMesh(shape, parameters, Message_ProgressRange())
        empty = [face for face, mesh, _ in meshes(shape) if _is_empty(mesh)]
        if not empty:
            return
        shape = _compound(empty)


def _compound(faces: Iterable[Any]) -> Any:
    builder, compound = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(compound)
    for face in faces:
        builder.Add(compound, face)
    return compound


def _is_empty(mesh: Any) -> bool:
    return mesh is None or not mesh.NbTriangles()


def empty_faces(shape: Any) -> list[tuple[int, Any]]:
    """Return the faces of a meshed shape that have no triangles, each with its number from 1."""
    return [(row, face) for row, (face, mesh, _) in enumerate(meshes(shape), 1) if _is_empty(mesh)]


def facets(shape: Any) -> tuple[Floats, Ints, float]:
    """Return vertices (v, 3), triangles (f, 3) and the kernel's figure of the deviation of a meshed shape.

    Vertices shared by faces are merged, so that the mesh of a closed solid is closed; normals point outward. Faces
    without a mesh are passed over.
    """
    points, triangles, deviation, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0.0, 0
    for face, mesh, location in meshes(shape):
        if mesh is None:
            continue
        of_face = np.array([mesh.Node(i).Coord() for i in range(1, mesh.NbNodes() + 1)], np.float64).reshape(-1, 3)
        if not location.IsIdentity():
            T = location.Transformation()
            matrix = np.array([[T.Value(row, column) for column in (1, 2, 3, 4)] for row in (1, 2, 3)])
            of_face = of_face @ matrix[:, :3].T + matrix[:, 3]
        corners = np.array([mesh.Triangle(i).Get() for i in range(1, mesh.NbTriangles() + 1)], np.int64).reshape(-1, 3)
        if face.Orientation() == TopAbs_REVERSED:
            corners = corners[:, [0, 2, 1]]
        points.append(of_face)
        triangles.append(corners - 1 + count)
        count += len(of_face)
        deviation = max(deviation, float(mesh.Deflection()))
    vertices, faces, _ = merged(np.vstack(points), np.vstack(triangles))
    return vertices, faces, deviation


def meshes(shape: Any) -> list[tuple[Any, Any, Any]]:
    """Return every face of a shape with its mesh, None where it has none, and the mesh's location."""
    faces, result = TopTools_IndexedMapOfShape(), []
    TopExp.MapShapes_s(shape, TopAbs_FACE, faces)
    for i in range(1, faces.Extent() + 1):
        face, location = TopoDS.Face_s(faces.FindKey(i)), TopLoc_Location()
        result.append((face, BRep_Tool.Triangulation_s(face, location), location))
    return result


def merged(points: Floats, triangles: Ints) -> tuple[Floats, Ints, npt.NDArray[np.bool_]]:
    """Return the distinct points (v, 3), the triangles of these (f, 3), and which of the given triangles are kept.

    Triangles of which two corners are one point are left out.
    """
    # Faces have separate vertices along a common edge; 1e-5 mm is far below any edge and far above rounding.
    rounded = np.round(points, 5)
    order = np.lexsort(rounded.T[::-1])  # as np.unique sorts rows, in a fraction of its time
    begins = np.ones(len(points), bool)
    begins[1:] = (np.diff(rounded[order], axis=0) != 0.0).any(axis=1)
    first, inverse = order[begins], np.empty(len(points), np.int64)
    inverse[order] = np.cumsum(begins) - 1
    faces = inverse[triangles]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points[first], faces[proper].astype(np.int64), proper
