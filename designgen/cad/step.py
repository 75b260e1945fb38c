"""STEP texts to bodies; runs in the process of :mod:`designgen.cad.bodies`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np

from designgen import mesh
from designgen.cad.bodies import NO_UNIT, UNITS_MM, Body, CadFile, finest_mm, is_closed, unit_name
from processor.model import InputError, UsageError

MOST_TRIANGLES = 700_000  # of a body: about ten seconds
LARGE_MM = 1000.0  # bodies from here on are meshed by the algorithm for many triangles


def parse(path: str, content: bytes, units: str) -> CadFile:
    """Read the text of a STEP file; its numbers are in ``units`` where given. Raises as cad_reading.parse."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader()
    if reader.ReadStream("file.step", BytesIO(content)) != IFSelect_RetDone:
        raise InputError(f"{path}: not a readable STEP file: it is damaged; copy or export it again")
    model = reader.StepModel()
    # Kept together: an entity is the same object only as long as somebody holds it.
    entities = [model.Value(i) for i in range(1, model.NbEntities() + 1)]
    said, sizes = _units(reader, entities)
    damaged = _damaged(reader, entities)
    known = bool(sizes) and not any(re.match("StepBasic_.*(Length|Conversion)", kind) for kind in damaged)
    if not known and not units and any("SHAPE" in type(one).__name__.upper() for one in entities):
        raise InputError(f"{path}: {NO_UNIT}")
    unit, problems = unit_name(path, said, sizes[0]) if known else ("", [])
    geometry = [kind.split("_", 1)[1] for kind in damaged if kind.startswith(("StepShape_", "StepGeom_"))]
    if geometry:
        problems.append(f"{len(geometry)} damaged entities, first {geometry[0]}: bodies may be missing")
    if len(sizes) > 1:
        unit = " and ".join(f"{size:.10g} mm" for size in sizes)
        if units:
            raise UsageError(f"--units: {path} has numbers in several units ({unit}); leave --units out")
    declared = sizes[0] if sizes else 1.0
    taken = UNITS_MM[units] if units else declared
    if sizes:
        reader.SetSystemLengthUnit(declared / taken)
    scale = 1.0 if sizes else taken  # without a unit, the kernel takes the numbers as they are
    reader.TransferRoots()
    names = _Names(reader, entities)
    problems += _lost(reader, entities, names)
    bodies = []
    if reader.NbShapes():
        stem = re.sub(r"\.\w+$", "", os.path.basename(path))
        for number, (shape, solid) in enumerate(_pieces(reader.OneShape())):
            body = _body(path, names.of(shape) or f"{stem}-{number + 1}", shape, scale, solid=solid)
            if isinstance(body, Body):
                bodies.append(body)
            else:
                problems.append(body)
    return CadFile(units or unit, taken, unit, tuple(bodies), tuple(problems))


def _units(reader: Any, entities: list[Any]) -> tuple[str, list[float]]:
    """Return what the file calls its unit of length, and the different sizes in mm by which the kernel will go."""
    from OCP.STEPConstruct import STEPConstruct_UnitContext
    from OCP.TColStd import TColStd_SequenceOfAsciiString

    lengths, angles, solid_angles = (TColStd_SequenceOfAsciiString() for _ in range(3))
    reader.FileUnits(lengths, angles, solid_angles)
    sizes: list[float] = []
    for entity in entities:
        if hasattr(entity, "GlobalUnitAssignedContext"):
            context = STEPConstruct_UnitContext()
            context.ComputeFactors(entity.GlobalUnitAssignedContext())
            size = float(context.LengthFactor())
            if context.LengthDone() and not any(abs(size / known - 1.0) < 1e-9 for known in sizes if known):
                sizes.append(size)
    return (str(lengths.Value(1).ToCString()) if lengths.Length() == 1 else ""), sizes


def _damaged(reader: Any, entities: list[Any]) -> list[str]:
    """Return the kinds of the entities that the kernel cannot make sense of.

    It leaves geometry out, with the whole solid around it, and takes a damaged unit for another.
    """
    from OCP.StepBasic import StepBasic_SiUnitAndLengthUnit, StepBasic_SiUnitName

    metre = StepBasic_SiUnitName.StepBasic_sunMetre
    lengths = [one for one in entities if isinstance(one, StepBasic_SiUnitAndLengthUnit)]
    found = ["StepBasic_SiUnitAndLengthUnit" for one in lengths if one.Name() != metre]
    checks = reader.WS().ModelCheckList(False)
    checks.Start()
    while checks.More():
        number = checks.Number()
        if checks.Value().NbFails() and 0 < number <= len(entities):
            found.append(type(entities[number - 1]).__name__)
        checks.Next()
    return found


def _lost(reader: Any, entities: list[Any], names: _Names) -> list[str]:
    """Say which solids and how many faces of the file did not become any."""
    from OCP.StepShape import StepShape_FaceSurface, StepShape_ManifoldSolidBrep
    from OCP.TopAbs import TopAbs_FACE, TopAbs_SOLID
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopLoc import TopLoc_Location
    from OCP.TopTools import TopTools_IndexedMapOfShape

    shape, nowhere = reader.OneShape() if reader.NbShapes() else None, TopLoc_Location()
    made, faces = set[Any](), TopTools_IndexedMapOfShape()
    for kind in (TopAbs_SOLID, TopAbs_FACE) if shape is not None else ():
        explorer = TopExp_Explorer(shape, kind)
        while explorer.More():
            if kind == TopAbs_FACE:
                faces.Add(explorer.Current().Located(nowhere))
            else:
                made.add(names.item(explorer.Current()))
            explorer.Next()
    solids = [one for one in entities if isinstance(one, StepShape_ManifoldSolidBrep)]
    found = [f"solid {_text(one)!r} is damaged, so that it did not become one" for one in solids if one not in made]
    wanted = sum(isinstance(one, StepShape_FaceSurface) for one in entities)
    if faces.Extent() < wanted:
        found.append(f"{wanted - faces.Extent()} of {wanted} faces are damaged and are left out")
    return found


def _pieces(shape: Any) -> Iterator[tuple[Any, bool]]:
    """Give every solid (True), then every shell and the loose faces outside of solids (False)."""
    from OCP.BRep import BRep_Builder
    from OCP.TopAbs import TopAbs_FACE, TopAbs_SHELL, TopAbs_SOLID
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS_Compound

    for kind, avoided in ((TopAbs_SOLID, None), (TopAbs_SHELL, TopAbs_SOLID)):
        explorer = TopExp_Explorer(shape, kind, *([avoided] if avoided is not None else []))
        while explorer.More():
            yield explorer.Current(), avoided is None
            explorer.Next()
    builder, loose, faces = BRep_Builder(), TopoDS_Compound(), TopExp_Explorer(shape, TopAbs_FACE, TopAbs_SHELL)
    builder.MakeCompound(loose)
    if faces.More():
        while faces.More():
            builder.Add(loose, faces.Current())
            faces.Next()
        yield loose, False


def _body(path: str, name: str, shape: Any, scale: float, *, solid: bool) -> Body | str:
    """Return a shape, ``scale`` mm its unit, as a body, or what is wrong with it."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    box = Bnd_Box()
    BRepBndLib.Add_s(shape, box, False)
    if box.IsVoid():
        return f"{name!r} is empty and left out"
    if not np.isfinite(box.SquareExtent()):
        return f"{name!r} has a face without bounds and is left out"
    size = scale * float(np.sqrt(box.SquareExtent()))
    deviation = finest_mm(
        path, name, size, MOST_TRIANGLES, lambda mm: mesh.mesh_faces(shape, mm / scale, large=size > LARGE_MM)
    )
    volumes, areas = GProp_GProps(), GProp_GProps()
    BRepGProp.VolumeProperties_s(shape, volumes)
    BRepGProp.SurfaceProperties_s(shape, areas)
    try:
        vertices, faces, measured = mesh.facets(shape)
    except ValueError:
        return f"{name!r} has faces that cannot be meshed and is left out"
    vertices = scale * vertices
    numbers = np.array([volumes.Mass(), areas.Mass(), measured]) * [scale**3, scale**2, scale]
    if not len(faces) or not np.isfinite(vertices).all() or not np.isfinite(numbers).all():
        return f"{name!r} has no extent and is left out"
    volume = float(numbers[0]) if solid else float("nan")
    return Body(
        name, solid, is_closed(faces), vertices, faces, volume, float(numbers[1]), max(deviation, float(numbers[2]))
    )


class _Names:
    """Names of shapes: a solid's own, else that of its place in an assembly, else that of its product."""

    def __init__(self, reader: Any, entities: list[Any]) -> None:
        from OCP.StepRepr import (
            StepRepr_ShapeRepresentationRelationship,
            StepRepr_ShapeRepresentationRelationshipWithTransformation,
        )
        from OCP.StepShape import StepShape_ShapeDefinitionRepresentation
        from OCP.TopTools import TopTools_IndexedMapOfShape

        self._transfers = reader.WS().TransferReader()
        self._known, self._items = TopTools_IndexedMapOfShape(), list[Any]()
        products: dict[Any, str] = {}  # of representations
        pairs = []
        for entity in entities:
            if isinstance(entity, StepShape_ShapeDefinitionRepresentation):
                products[entity.UsedRepresentation()] = _product(entity)
            elif isinstance(entity, StepRepr_ShapeRepresentationRelationship) and not isinstance(
                entity, StepRepr_ShapeRepresentationRelationshipWithTransformation
            ):
                pairs.append((entity.Rep1(), entity.Rep2()))
        for one, other in pairs:
            for of, known in ((one, other), (other, one)):
                if of not in products and known in products:
                    products[of] = products[known]
        self._products: dict[Any, str] = {}  # of items
        for representation, name in products.items():
            items = representation.Items() if representation is not None else None
            if items is not None:
                for i in range(1, items.Length() + 1):
                    self._products.setdefault(items.Value(i), name)

    def of(self, shape: Any) -> str:
        """Return the name of a shape as it lies in the file, or nothing."""
        from OCP.StepRepr import StepRepr_NextAssemblyUsageOccurrence, StepRepr_RepresentationItem

        item = self.item(shape)
        own = _text(item) if isinstance(item, StepRepr_RepresentationItem) else ""
        if own:
            return own
        place = None if shape.Location().IsIdentity() else self._transfers.EntityFromShapeResult(shape, 1)
        placed = _text(place) if isinstance(place, StepRepr_NextAssemblyUsageOccurrence) else ""
        return placed or (self._products.get(item, "") if item is not None else "")

    def item(self, shape: Any) -> Any:
        """Return the entity that a shape was made of, wherever it lies; None where the kernel does not know."""
        from OCP.TopLoc import TopLoc_Location

        bare = shape.Located(TopLoc_Location())
        if not self._known.Contains(bare):  # the kernel looks through everything, so it is asked once
            self._known.Add(bare)
            self._items.append(self._transfers.EntityFromShapeResult(bare, 1))
        return self._items[self._known.FindIndex(bare) - 1]


def _product(representation: Any) -> str:
    """Return the name of the product that a representation shows; damaged files lack any link of the chain."""
    found = representation
    for link in ("Definition", "PropertyDefinition", "Definition", "ProductDefinition", "Formation", "OfProduct"):
        found = getattr(found, link)() if hasattr(found, link) else None
    return _text(found)


def _text(entity: Any) -> str:
    """Return the name of an entity, nothing where it has none or it is no text."""
    try:
        found = str(entity.Name().ToCString()).strip()
    except (AttributeError, UnicodeDecodeError):
        return ""
    return "" if found.upper() == "NONE" else found.encode("utf-8", "replace").decode()
