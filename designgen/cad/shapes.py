"""Shapes of the CAD kernel (Open CASCADE) as bodies: triangle meshes, and the forms of their faces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from OCP.Bnd import Bnd_Box
from OCP.BRep import BRep_Builder
from OCP.BRepBndLib import BRepBndLib
from OCP.BRepBuilderAPI import BRepBuilderAPI_Transform
from OCP.BRepGProp import BRepGProp
from OCP.gp import gp_Pnt, gp_Trsf
from OCP.GProp import GProp_GProps
from OCP.TopAbs import TopAbs_FACE, TopAbs_SHELL, TopAbs_SOLID
from OCP.TopExp import TopExp_Explorer
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS_Compound
from OCP.TopTools import TopTools_IndexedMapOfShape

from designgen.cad import brep_faces, tessellation
from designgen.cad.bodies import Body, finest_mm, is_closed

MOST_TRIANGLES = 700_000  # of a body: about ten seconds
LARGE_MM = 1000.0  # larger bodies are meshed by the algorithm for many triangles


def pieces(shape: Any) -> Iterator[tuple[Any, bool]]:
    """Yield every solid (True), then every shell and the loose faces outside of solids (False)."""
    for solid in parts(shape, TopAbs_SOLID):
        yield solid, True
    for shell in parts(shape, TopAbs_SHELL, TopAbs_SOLID):
        yield shell, False
    if faces := list(parts(shape, TopAbs_FACE, TopAbs_SHELL)):
        builder, loose = BRep_Builder(), TopoDS_Compound()
        builder.MakeCompound(loose)
        for face in faces:
            builder.Add(loose, face)
        yield loose, False


def parts(shape: Any, *kinds: Any) -> Iterator[Any]:
    """Yield the parts of a shape of the first kind, outside of those of the second."""
    explorer = TopExp_Explorer(shape, *kinds)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


class Meshed:
    """Shapes that have their final mesh: parts placed several times in a file share it, and are meshed once."""

    def __init__(self) -> None:
        self._shapes, self._faces = TopTools_IndexedMapOfShape(), TopTools_IndexedMapOfShape()
        self._deviations: dict[int, float] = {}  # mm, by the number of the shape
        self._owner: dict[int, int] = {}  # shape, by the number of the face

    def deviation(self, shape: Any) -> float | None:
        """Return the deviation (mm) of the mesh of a shape wherever it is placed; None without a mesh."""
        return self._deviations.get(int(self._shapes.FindIndex(_unplaced(shape))))

    def add(self, shape: Any, deviation: float) -> None:
        """Keep that a shape was meshed just now; others that share faces with it have lost the meshes of these."""
        number = int(self._shapes.Add(_unplaced(shape)))
        self._deviations[number] = deviation
        for face in parts(shape, TopAbs_FACE):
            at = int(self._faces.Add(_unplaced(face)))
            before = self._owner.get(at, number)
            self._owner[at] = number
            if before != number:
                self._deviations.pop(before, None)


def _unplaced(shape: Any) -> Any:
    return shape.Located(TopLoc_Location())


def _scaled(shape: Any, scale: float) -> Any:
    scaling = gp_Trsf()
    scaling.SetScale(gp_Pnt(0.0, 0.0, 0.0), scale)
    return BRepBuilderAPI_Transform(shape, scaling, True).Shape()


def _mesh(path: str, name: str, shape: Any, scale: float, size: float, exact: bool) -> float:
    """Mesh a shape of a ``size`` in mm as finely as is wanted; return the deviation of the mesh, mm."""

    def mesh(mm: float) -> int:
        if exact:
            return tessellation.mesh_faces(shape, mm, brep_faces.is_meshed_finer, large=size > LARGE_MM)
        return tessellation.mesh_faces(shape, mm / scale, large=size > LARGE_MM)

    return finest_mm(path, name, size, MOST_TRIANGLES, mesh)


def _unmeshed(name: str, empty: Sequence[tuple[int, Any]], scale: float, face_name: Callable[[Any], str] | None) -> str:
    """Return the problem of a body with faces that no algorithm could mesh, as ``empty``: the first, and its place."""
    row, face = empty[0]
    box = Bnd_Box()
    BRepBndLib.Add_s(face, box, False)
    place = ""
    if not box.IsVoid():
        low, high = box.CornerMin(), box.CornerMax()
        middle = (0.5 * scale * (a + b) for a, b in zip(low.Coord(), high.Coord(), strict=True))
        place = " at " + " ".join(f"{x:.1f}" for x in middle) + " mm"
    label = (face_name(face) if face_name else "") or f"face {row}"
    more = f" and {len(empty) - 1} more faces" if len(empty) > 1 else ""
    return f"{name!r}: {label}{place}{more} cannot be meshed, so that the body is left out"


def body_of(
    path: str,
    name: str,
    shape: Any,
    scale: float,
    *,
    solid: bool,
    face_name: Callable[[Any], str] | None = None,
    meshed: Meshed | None = None,
) -> Body | str:
    """Return a shape, whose unit is ``scale`` mm, as a body, or the problem with it.

    With ``face_name``, which names a face or returns "", the body has the forms of its faces, and edges are
    meshed finer. A shape that is in ``meshed`` keeps its mesh.
    """
    box = Bnd_Box()
    BRepBndLib.Add_s(shape, box, False)
    if box.IsVoid():
        return f"{name!r} is empty and left out"
    if not np.isfinite(box.SquareExtent()):
        return f"{name!r} has a face without bounds and is left out"
    size, exact = scale * float(np.sqrt(box.SquareExtent())), face_name is not None
    if exact and scale != 1.0:  # the numbers of forms are in mm
        shape, scale = _scaled(shape, scale), 1.0

    deviation = None if meshed is None else meshed.deviation(shape)
    if deviation is None:
        deviation = _mesh(path, name, shape, scale, size, exact)
        if meshed is not None:
            meshed.add(shape, deviation)
    volumes, areas = GProp_GProps(), GProp_GProps()
    BRepGProp.VolumeProperties_s(shape, volumes)
    BRepGProp.SurfaceProperties_s(shape, areas)
    forms = None
    if empty := tessellation.empty_faces(shape):
        return _unmeshed(name, empty, scale, face_name)
    if face_name is None:
        vertices, faces, measured = tessellation.facets(shape)
    else:
        vertices, faces, measured, forms = brep_faces.facets_and_forms(shape, face_name)
    vertices = scale * vertices
    numbers = np.array([volumes.Mass(), areas.Mass(), measured]) * [scale**3, scale**2, scale]
    if not len(faces) or not np.isfinite(vertices).all() or not np.isfinite(numbers).all():
        return f"{name!r} has no extent and is left out"
    return Body(
        name=name,
        solid=solid,
        closed=is_closed(faces),
        vertices=vertices,
        faces=faces,
        volume_mm3=float(numbers[0]) if solid else float("nan"),
        area_mm2=float(numbers[1]),
        deviation_mm=max(deviation, float(numbers[2])),
        forms=forms,
    )
