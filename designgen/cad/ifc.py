"""IFC texts to bodies; runs in the child process of :mod:`designgen.cad.process`."""

from __future__ import annotations

from typing import Any

import numpy as np

from designgen.cad.bodies import ANGLE_RAD, NO_UNIT, UNITS_MM, Body, CadFile, finest_mm, is_closed, unit_name
from processor.meshes.faults import mended
from processor.model import Floats, InputError, Ints, UsageError
from processor.store.making import beside

MOST_TRIANGLES = 100_000  # of a body; the library's time grows with the square of the number
BEYOND = 1.5  # largest deviation in units of the requested one; measured on spheres: 1.37
NO_BODIES = ("IfcFeatureElementSubtraction", "IfcSpace", "IfcVirtualElement", "IfcAnnotation", "IfcGrid")
FLAT = ("Axis", "FootPrint", "Annotation", "Box", "CoG", "Reference")  # representations without a surface


def parse(path: str, content: bytes, units: str, default_units: str, *, exact: bool = False) -> CadFile:
    """Read the text of an IFC file; arguments and errors as of :func:`process.parse`.

    ``exact``: bodies have the forms of their faces, where the library gives their exact geometry.
    """
    try:
        import ifcopenshell
        import ifcopenshell.util.unit
    except ImportError:
        raise UsageError("IFC files need the extra 'ifc': pip install 'steel-scan-check[ifc]'") from None
    damaged = f"{path}: not a readable IFC file: it is damaged or holds no project; copy or export it again"
    try:
        model = ifcopenshell.file.from_string(content.decode("ascii"))
        projects = model.by_type("IfcProject")
    except (RuntimeError, ValueError, TypeError, AttributeError, ifcopenshell.Error):
        raise InputError(damaged) from None
    if not projects:
        raise InputError(damaged)
    problems: list[str] = []
    declared, size, name = ifcopenshell.util.unit.get_project_unit(model, "LENGTHUNIT"), 1000.0, ""
    if declared is not None:
        size = 1000.0 * float(ifcopenshell.util.unit.calculate_unit_scale(model))
        name, problems = unit_name(path, ifcopenshell.util.unit.get_full_unit_name(declared), size)
    elif not (units := units or default_units):
        raise InputError(f"{path}: {NO_UNIT}")
    taken = UNITS_MM[units] if units else size
    bodies: list[Any] = []
    for product in model.by_type("IfcProduct"):
        if product.Representation is None or any(product.is_a(kind) for kind in NO_BODIES):
            continue
        to_mm = 1000.0 * taken / size
        found = (_exact(path, product, to_mm) if exact else []) or [_body(path, product, to_mm)]
        if found[0] is not None:
            bodies += found
        elif any(r.RepresentationIdentifier not in FLAT for r in product.Representation.Representations):
            problems.append(f"{_name(product)!r} ({product.is_a()}) cannot be meshed and is left out")
    return CadFile(units or name, taken, name, tuple(bodies), tuple(problems))


def _name(product: Any) -> str:
    return (product.Name or "").strip() or str(product.is_a())


def _exact(path: str, product: Any, to_mm: float) -> list[Any]:
    """Return a product's bodies with the forms of their faces; empty if the library does not give exact geometry."""
    import ifcopenshell
    import ifcopenshell.geom
    from OCP.BRep import BRep_Builder
    from OCP.BRepTools import BRepTools
    from OCP.TopoDS import TopoDS_Shape

    from designgen.cad.shapes import body_of, pieces

    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    settings.set("iterator-output", ifcopenshell.ifcopenshell_wrapper.SERIALIZED)
    shape = TopoDS_Shape()
    try:
        element = ifcopenshell.geom.create_shape(settings, product)  # kept, as the geometry is a part of its memory
        text = element.geometry.brep_data
        with beside() as folder:  # the kernel reads it from a file alone
            file = folder / "product.brep"
            file.write_text(text, "ascii")
            if not BRepTools.Read_s(shape, str(file), BRep_Builder()):
                return []
    except (RuntimeError, AttributeError):
        return []
    found = list(pieces(shape))
    if not found:
        return []
    named = (_name(product) if len(found) == 1 else f"{_name(product)}-{i + 1}" for i in range(len(found)))
    bodies = [
        body_of(path, name, piece, to_mm, solid=solid, face_name=lambda face: "")
        for name, (piece, solid) in zip(named, found, strict=True)
    ]
    return bodies if all(isinstance(body, Body) for body in bodies) else []


def _body(path: str, product: Any, to_mm: float) -> Body | None:
    """Return a product's body, None if the library makes none; ``to_mm`` is the length of the library's metre in mm."""
    import ifcopenshell.geom

    made: dict[str, Any] = {}

    def triangles(deviation_mm: float) -> int:
        settings = ifcopenshell.geom.settings()
        settings.set("use-world-coords", True)
        settings.set("weld-vertices", True)
        settings.set("mesher-linear-deflection", deviation_mm / to_mm)
        settings.set("mesher-angular-deflection", ANGLE_RAD)
        # The element is kept, as the geometry is a part of its memory.
        made["element"] = ifcopenshell.geom.create_shape(settings, product)
        made["shape"] = made["element"].geometry
        return len(made["shape"].faces) // 3

    try:
        triangles(1e3 * to_mm)  # a coarse mesh, for its size
        first = np.array(made["shape"].verts, np.float64).reshape(-1, 3) * to_mm
        if not len(made["shape"].faces) or not np.isfinite(first).all():
            return None
        deviation = finest_mm(
            path, _name(product), float(np.linalg.norm(np.ptp(first, axis=0))), MOST_TRIANGLES, triangles
        )
    except RuntimeError:
        return None
    vertices = np.array(made["shape"].verts, np.float64).reshape(-1, 3) * to_mm
    faces = np.array(made["shape"].faces, np.int64).reshape(-1, 3)
    return _measured(_name(product), vertices, faces, BEYOND * deviation) if len(faces) else None


def _measured(name: str, vertices: Floats, faces: Ints, deviation_mm: float) -> Body:
    whole = mended(vertices, faces)  # where an opening is cut, corners differ in their last bits
    points, triangles = whole.points, whole.corners[whole.part >= 0]
    a, b, c = (points[triangles[:, i]] - points.mean(axis=0) for i in range(3))
    across = np.cross(b - a, c - a)
    area, volume = 0.5 * float(np.linalg.norm(across, axis=1).sum()), float(np.sum(a * across)) / 6.0
    closed = is_closed(triangles)
    return Body(
        name=name,
        solid=closed,
        closed=closed,
        vertices=points,
        faces=triangles,
        volume_mm3=abs(volume) if closed else float("nan"),
        area_mm2=area,
        deviation_mm=deviation_mm,
    )
