"""Forms of the faces of the CAD kernel (Open CASCADE), and the parameters of their meshes' vertices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.GeomAbs import GeomAbs_CurveType, GeomAbs_SurfaceType
from OCP.GeomConvert import GeomConvert
from OCP.TopAbs import TopAbs_REVERSED

from designgen.cad import face_surfaces
from designgen.cad.face_surfaces import Form, Forms
from designgen.cad.tessellation import merged, meshes
from processor.model import Floats, Ints

QUADRICS = {
    GeomAbs_SurfaceType.GeomAbs_Cylinder: (face_surfaces.CYLINDER, "Cylinder", ("Radius",)),
    GeomAbs_SurfaceType.GeomAbs_Cone: (face_surfaces.CONE, "Cone", ("RefRadius", "SemiAngle")),
    GeomAbs_SurfaceType.GeomAbs_Sphere: (face_surfaces.SPHERE, "Sphere", ("Radius",)),
    GeomAbs_SurfaceType.GeomAbs_Torus: (face_surfaces.TORUS, "Torus", ("MajorRadius", "MinorRadius")),
}
# Straight in one direction: the number of triangles is that of the points on the edges.
FEW_TRIANGLES = (
    GeomAbs_SurfaceType.GeomAbs_Plane,
    GeomAbs_SurfaceType.GeomAbs_Cylinder,
    GeomAbs_SurfaceType.GeomAbs_Cone,
    GeomAbs_SurfaceType.GeomAbs_SurfaceOfExtrusion,
)
NameOf = Callable[[Any], str]  # face -> its name, "" for none


def facets_and_forms(shape: Any, name_of: NameOf) -> tuple[Floats, Ints, float, Forms]:
    """Return vertices (v, 3), triangles (f, 3), the kernel's deviation, and the forms of a meshed shape's faces, mm.

    Vertices shared by faces are merged. Faces without a mesh are passed over.
    """
    points, triangles, uv, owner, described = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [], [], []
    deviation, count = 0.0, 0
    for row, (face, mesh, location) in enumerate(meshes(shape)):
        if mesh is None:
            continue
        T = location.Transformation()
        nodes = range(1, mesh.NbNodes() + 1)
        of_face = np.array([mesh.Node(i).Transformed(T).Coord() for i in nodes], np.float64).reshape(-1, 3)
        corners = np.array([mesh.Triangle(i).Get() for i in range(1, mesh.NbTriangles() + 1)], np.int64).reshape(-1, 3)
        if face.Orientation() == TopAbs_REVERSED:
            corners = corners[:, [0, 2, 1]]
        form = _form(face, name_of(face) or f"face {row + 1}")
        at = np.array([mesh.UVNode(i).Coord() for i in nodes], np.float64) if mesh.HasUVNodes() else None
        if at is None:
            form = Form(form.name, face_surfaces.FACETS, np.empty(0))
        points.append(of_face)
        triangles.append(corners - 1 + count)
        uv.append(np.zeros((len(corners), 3, 2)) if at is None else at.reshape(-1, 2)[corners - 1])
        owner.append(np.full(len(corners), row))
        described.append(form)
        count += len(of_face)
        deviation = max(deviation, float(mesh.Deflection()))
    vertices, faces, kept = merged(np.vstack(points), np.vstack(triangles))
    corner_uv = np.concatenate([np.empty((0, 3, 2)), *uv])[kept]
    of_triangle = np.concatenate([np.empty(0, np.int64), *owner])[kept].astype(np.int64)
    return vertices, faces, deviation, Forms(tuple(described), of_triangle, corner_uv)


def is_meshed_finer(face: Any) -> bool:
    """Return whether a face is to have a finer mesh: it takes few triangles, or its triangles are its form."""
    kind = BRepAdaptor_Surface(face).GetType()
    return kind in FEW_TRIANGLES or _form(face, "").kind == face_surfaces.FACETS


def _form(face: Any, name: str) -> Form:
    """Return the form of a face; facets for a surface that has no formula here, such as an offset of another."""
    surface = BRepAdaptor_Surface(face)
    kind = surface.GetType()
    if kind == GeomAbs_SurfaceType.GeomAbs_Plane:
        return Form(name, face_surfaces.PLANE, _frame(surface.Plane().Position()))
    if kind in QUADRICS:
        said, getter, sizes = QUADRICS[kind]
        quadric = getattr(surface, getter)()
        return Form(name, said, np.array([*_frame(quadric.Position()), *(getattr(quadric, size)() for size in sizes)]))
    if kind == GeomAbs_SurfaceType.GeomAbs_BSplineSurface:
        return Form(name, face_surfaces.SPLINE, _spline(surface.BSpline()))
    if kind == GeomAbs_SurfaceType.GeomAbs_BezierSurface:
        return Form(name, face_surfaces.SPLINE, _spline(GeomConvert.SurfaceToBSplineSurface_s(surface.Bezier())))
    if kind == GeomAbs_SurfaceType.GeomAbs_SurfaceOfExtrusion:
        curve = _curve(surface.BasisCurve())
        if curve is not None:
            return Form(name, face_surfaces.EXTRUSION, np.array([*surface.Direction().Coord(), *curve]))
    if kind == GeomAbs_SurfaceType.GeomAbs_SurfaceOfRevolution:
        axis, curve = surface.AxeOfRevolution(), _curve(surface.BasisCurve())
        if curve is not None:
            numbers = [*axis.Location().Coord(), *axis.Direction().Coord(), *curve]
            return Form(name, face_surfaces.REVOLUTION, np.array(numbers))
    return Form(name, face_surfaces.FACETS, np.empty(0))


def _frame(position: Any) -> Floats:
    directions = (position.XDirection(), position.YDirection(), position.Direction())
    return np.array([*position.Location().Coord(), *(c for direction in directions for c in direction.Coord())])


def _knots(count: int, knot: Callable[[int], float], multiplicity: Callable[[int], int]) -> list[float]:
    """Return all knots of a spline, one of multiplicity m as m equal ones."""
    return [knot(i) for i in range(1, count + 1) for _ in range(multiplicity(i))]


def _spline(surface: Any) -> Floats:
    """Return the numbers of a spline surface, see :func:`designgen.cad.face_surfaces._spline_surface`."""
    surface = surface.Copy()
    if surface.IsUPeriodic():
        surface.SetUNotPeriodic()
    if surface.IsVPeriodic():
        surface.SetVNotPeriodic()
    knots = [
        _knots(surface.NbUKnots(), surface.UKnot, surface.UMultiplicity),
        _knots(surface.NbVKnots(), surface.VKnot, surface.VMultiplicity),
    ]
    poles = [
        [*(c * surface.Weight(i, j) for c in surface.Pole(i, j).Coord()), surface.Weight(i, j)]
        for i in range(1, surface.NbUPoles() + 1)
        for j in range(1, surface.NbVPoles() + 1)
    ]
    degrees = [surface.UDegree(), surface.VDegree()]
    return np.array(
        [*degrees, *map(len, knots), *knots[0], *knots[1], *(c for pole in poles for c in pole)], np.float64
    )


def _curve(adaptor: Any) -> list[float] | None:
    """Return the numbers of a curve, see :func:`designgen.cad.face_surfaces._curve`; None without a formula."""
    kind = adaptor.GetType()
    if kind == GeomAbs_CurveType.GeomAbs_Line:
        line = adaptor.Line()
        return [face_surfaces.LINE, *line.Location().Coord(), *line.Direction().Coord()]
    if kind in (GeomAbs_CurveType.GeomAbs_Circle, GeomAbs_CurveType.GeomAbs_Ellipse):
        circle = kind == GeomAbs_CurveType.GeomAbs_Circle
        conic = adaptor.Circle() if circle else adaptor.Ellipse()
        radii = (conic.Radius(), conic.Radius()) if circle else (conic.MajorRadius(), conic.MinorRadius())
        directions = (conic.Position().XDirection(), conic.Position().YDirection())
        axes = [radius * c for radius, unit in zip(radii, directions, strict=True) for c in unit.Coord()]
        return [face_surfaces.ELLIPSE, *conic.Location().Coord(), *axes]
    if kind in (GeomAbs_CurveType.GeomAbs_BSplineCurve, GeomAbs_CurveType.GeomAbs_BezierCurve):
        if kind == GeomAbs_CurveType.GeomAbs_BSplineCurve:
            spline = adaptor.BSpline().Copy()
        else:
            spline = GeomConvert.CurveToBSplineCurve_s(adaptor.Bezier())
        if spline.IsPeriodic():
            spline.SetNotPeriodic()
        knots = _knots(spline.NbKnots(), spline.Knot, spline.Multiplicity)
        poles = [
            c
            for i in range(1, spline.NbPoles() + 1)
            for c in (*(spline.Weight(i) * x for x in spline.Pole(i).Coord()), spline.Weight(i))
        ]
        return [face_surfaces.CURVE, float(spline.Degree()), float(len(knots)), *knots, *poles]
    return None
