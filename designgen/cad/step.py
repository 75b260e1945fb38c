"""STEP texts to bodies; runs in the child process of :mod:`designgen.cad.process`."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from io import BytesIO
from typing import Any

from OCP.IFSelect import IFSelect_RetDone
from OCP.StepBasic import StepBasic_ProductDefinition, StepBasic_SiUnitAndLengthUnit, StepBasic_SiUnitName
from OCP.STEPConstruct import STEPConstruct_UnitContext
from OCP.STEPControl import STEPControl_Reader
from OCP.StepData import StepData_Factors
from OCP.StepRepr import (
    StepRepr_NextAssemblyUsageOccurrence,
    StepRepr_RepresentationItem,
    StepRepr_ShapeRepresentationRelationship,
    StepRepr_ShapeRepresentationRelationshipWithTransformation,
)
from OCP.StepShape import StepShape_FaceSurface, StepShape_ManifoldSolidBrep, StepShape_ShapeDefinitionRepresentation
from OCP.TColStd import TColStd_SequenceOfAsciiString
from OCP.TopAbs import TopAbs_COMPOUND, TopAbs_FACE, TopAbs_SOLID
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS_Iterator
from OCP.TopTools import TopTools_IndexedMapOfShape

from designgen.cad.bodies import NO_UNIT, UNITS_MM, Body, CadFile, unit_name
from designgen.cad.shapes import Meshed, body_of, parts, pieces
from processor.model import InputError, UsageError

# What Open CASCADE, and with it CadQuery and FreeCAD, writes for a product that has no name.
WRITTEN_BY_KERNEL = r"Open CASCADE STEP translator [\d.]+( [\d.]+)?"


def parse(path: str, content: bytes, units: str, default_units: str, *, exact: bool = False) -> CadFile:
    """Read the text of a STEP file; arguments and errors as of :func:`process.parse`.

    ``exact``: bodies have the forms of their faces and meshes that are finer at edges.
    """
    reader = STEPControl_Reader()
    if reader.ReadStream("file.step", BytesIO(content)) != IFSelect_RetDone:
        raise InputError(f"{path}: not a readable STEP file: it is damaged; copy or export it again")
    model = reader.StepModel()
    # Referenced throughout: Python creates a new object for an entity that is no longer referenced.
    entities = [model.Value(i) for i in range(1, model.NbEntities() + 1)]
    unit_given, sizes = _units(reader, entities)
    damaged = _damaged(reader, entities)
    unit_readable = bool(sizes) and not any(re.match("StepBasic_.*(Length|Conversion)", kind) for kind in damaged)
    if not unit_readable and len(sizes) < 2:
        units = units or default_units
    if not unit_readable and not units and any("SHAPE" in type(entity).__name__.upper() for entity in entities):
        raise InputError(f"{path}: {NO_UNIT}")
    unit, problems = unit_name(path, unit_given, sizes[0]) if unit_readable else ("", [])
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
    scale = 1.0 if sizes else taken  # without a unit, the kernel does not scale the numbers
    reader.TransferRoots()
    names = _Names(reader, entities)
    problems += _lost(reader, entities, names)
    bodies = []
    if reader.NbShapes():
        stem = re.sub(r"\.\w+$", "", os.path.basename(path))
        face_names, meshed = _FaceNames(reader, entities) if exact else None, Meshed()
        for number, (shape, solid) in enumerate(pieces(reader.OneShape())):
            name = names.of(shape) or f"{stem}-{number + 1}"
            name_of = face_names.of if face_names else None
            body = body_of(path, name, shape, scale, solid=solid, face_name=name_of, meshed=meshed)
            if isinstance(body, Body):
                bodies.append(body)
            else:
                problems.append(body)
    return CadFile(units or unit, taken, unit, tuple(bodies), tuple(problems))


def _units(reader: Any, entities: list[Any]) -> tuple[str, list[float]]:
    """Return the name of the file's unit of length, and the distinct sizes in mm that the kernel uses."""
    lengths, angles, solid_angles = (TColStd_SequenceOfAsciiString() for _ in range(3))
    reader.FileUnits(lengths, angles, solid_angles)
    sizes: list[float] = []
    for entity in entities:
        if hasattr(entity, "GlobalUnitAssignedContext"):
            context = STEPConstruct_UnitContext()
            # OCP 7.8 has no default for the factors, which is that of Open CASCADE.
            context.ComputeFactors(entity.GlobalUnitAssignedContext(), StepData_Factors())
            size = float(context.LengthFactor())
            if context.LengthDone() and not any(abs(size / earlier - 1.0) < 1e-9 for earlier in sizes if earlier):
                sizes.append(size)
    return (str(lengths.Value(1).ToCString()) if lengths.Length() == 1 else ""), sizes


def _damaged(reader: Any, entities: list[Any]) -> list[str]:
    """Return the types of the entities that the kernel cannot interpret.

    It leaves out such geometry, with the whole solid around it, and mistakes a damaged unit for another.
    """
    metre = StepBasic_SiUnitName.StepBasic_sunMetre
    lengths = [entity for entity in entities if isinstance(entity, StepBasic_SiUnitAndLengthUnit)]
    damaged = ["StepBasic_SiUnitAndLengthUnit" for unit in lengths if unit.Name() != metre]
    checks = reader.WS().ModelCheckList(False)
    checks.Start()
    while checks.More():
        number = checks.Number()
        if checks.Value().NbFails() and 0 < number <= len(entities):
            damaged.append(type(entities[number - 1]).__name__)
        checks.Next()
    return damaged


def _lost(reader: Any, entities: list[Any], names: _Names) -> list[str]:
    """Return as problems the solids, and the number of faces, that the kernel did not convert."""
    made, faces = set[Any](), TopTools_IndexedMapOfShape()
    if reader.NbShapes():
        shape = reader.OneShape()
        made = {names.item(solid) for solid in parts(shape, TopAbs_SOLID)}
        for face in parts(shape, TopAbs_FACE):
            faces.Add(face.Located(TopLoc_Location()))
    solids = [entity for entity in entities if isinstance(entity, StepShape_ManifoldSolidBrep)]
    problems = [f"solid {_text(s)!r} is damaged, so that it did not become one" for s in solids if s not in made]
    expected = sum(isinstance(entity, StepShape_FaceSurface) for entity in entities)
    if faces.Extent() < expected:
        problems.append(f"{expected - faces.Extent()} of {expected} faces are damaged and are left out")
    return problems


class _Names:
    """Names of shapes: of the solid, else of its occurrence in an assembly, else of its product.

    Those of the assemblies around it come before it, as in "left rib/web", but for the one that is the whole file.
    """

    def __init__(self, reader: Any, entities: list[Any]) -> None:
        self._transfers = reader.WS().TransferReader()
        self._placed, self._paths = TopTools_IndexedMapOfShape(), list[tuple[str, ...]]()
        self._by_place: dict[tuple[Any, ...], str] = {}  # names of occurrences by product and place in their assembly
        self._bare_shapes, self._items = TopTools_IndexedMapOfShape(), list[Any]()
        products: dict[Any, str] = {}  # of representations
        pairs = []
        for entity in entities:
            if isinstance(entity, StepShape_ShapeDefinitionRepresentation):
                # "" where a damaged file lacks a link of the chain to the product
                links = (
                    "Definition",
                    "PropertyDefinition",
                    "Definition",
                    "ProductDefinition",
                    "Formation",
                    "OfProduct",
                )
                products[entity.UsedRepresentation()] = _text_by(entity, links)
            elif isinstance(entity, StepRepr_ShapeRepresentationRelationship) and not isinstance(
                entity, StepRepr_ShapeRepresentationRelationshipWithTransformation
            ):
                pairs.append((entity.Rep1(), entity.Rep2()))
        for pair in pairs:
            for unnamed, named in (pair, pair[::-1]):
                if unnamed not in products and named in products:
                    products[unnamed] = products[named]
        self._products: dict[Any, str] = {}  # of items
        for representation, name in products.items():
            if representation is not None:
                for i in range(1, representation.NbItems() + 1):  # OCP 7.8 does not read the array of them
                    self._products.setdefault(representation.ItemsValue(i), name)
        roots = [reader.Shape(i) for i in range(1, reader.NbShapes() + 1)]
        for store in (False, True):  # an occurrence may come before the one that has its name
            for root in roots:
                if root.ShapeType() == TopAbs_COMPOUND:
                    self._walk(root, (), store=store)

    def _walk(self, shape: Any, path: tuple[str, ...], *, store: bool) -> None:
        """Go through an assembly, below assemblies of the names ``path``; ``store`` the names of its parts."""
        placed, bare = TopoDS_Iterator(shape), TopoDS_Iterator(shape, True, False)
        while placed.More():
            part, occurrence = placed.Value(), self._occurrence(bare.Value())
            below = path if occurrence is None else (*path, occurrence)
            if part.ShapeType() == TopAbs_COMPOUND:
                self._walk(part, below, store=store)
            elif store and not self._placed.Contains(part):
                self._placed.Add(part)
                self._paths.append(below)
            placed.Next()
            bare.Next()

    def _occurrence(self, shape: Any) -> str | None:
        """Return the name of an occurrence by its place in its assembly, of its product without one; None for none.

        Some programs name the parts of a sub-assembly once, where it is placed several times. So an occurrence without
        a name has that of another one of its product in the same place of its assembly.
        """
        entity = self._transfers.EntityFromShapeResult(shape, 1)
        if isinstance(entity, StepBasic_ProductDefinition):  # placed where it was modelled
            return _text_by(entity, ("Formation", "OfProduct"))
        if not isinstance(entity, StepRepr_NextAssemblyUsageOccurrence):
            return None
        T = shape.Location().Transformation()
        place = tuple(round(T.Value(i, k), 6) for i in (1, 2, 3) for k in (1, 2, 3, 4))
        key, name = (self.item(shape), *place), _text(entity)
        if name:
            return self._by_place.setdefault(key, name) and name
        return self._by_place.get(key) or _text_by(entity, ("RelatedProductDefinition", "Formation", "OfProduct"))

    def of(self, shape: Any) -> str:
        """Return the name of a shape in the file, "" for none."""
        item = self.item(shape)
        name = _text(item) if isinstance(item, StepRepr_RepresentationItem) else ""
        row = self._placed.FindIndex(shape)
        path = self._paths[row - 1] if row else ()
        name = name or (path[-1] if path else "") or (self._products.get(item, "") if item is not None else "")
        return "/".join(filter(None, (*path[:-1], name))) if name else ""

    def item(self, shape: Any) -> Any:
        """Return the entity from which a shape was made, regardless of its location; None where it is unknown."""
        bare = shape.Located(TopLoc_Location())
        if not self._bare_shapes.Contains(bare):  # the kernel searches all entities, so each result is stored
            self._bare_shapes.Add(bare)
            self._items.append(self._transfers.EntityFromShapeResult(bare, 1))
        return self._items[self._bare_shapes.FindIndex(bare) - 1]


def _text_by(entity: Any, links: Sequence[str]) -> str:
    """Return the name of what an entity leads to by links, "" where one of them is missing."""
    for link in links:
        entity = getattr(entity, link)() if hasattr(entity, link) else None
    return _text(entity)


def _text(entity: Any) -> str:
    """Return the name of an entity, "" where it has none or one that is not text."""
    try:
        name = str(entity.Name().ToCString()).strip()
    except (AttributeError, UnicodeDecodeError):
        return ""
    return (
        ""
        if name.upper() == "NONE" or re.fullmatch(WRITTEN_BY_KERNEL, name)
        else name.encode("utf-8", "replace").decode()
    )


class _FaceNames:
    """Names of faces; most files have none."""

    def __init__(self, reader: Any, entities: list[Any]) -> None:
        transfers = reader.WS().TransferReader()
        self._shapes, self._names = TopTools_IndexedMapOfShape(), list[str]()
        for entity in entities:
            name = _text(entity) if isinstance(entity, StepShape_FaceSurface) else ""
            shape = transfers.ShapeResult(entity) if name else None
            if shape is not None and not shape.IsNull() and not self._shapes.Contains(shape):
                self._shapes.Add(shape)
                self._names.append(name)

    def of(self, face: Any) -> str:
        """Return the name of a face in the file, "" for none."""
        row = self._shapes.FindIndex(face.Located(TopLoc_Location()))
        return self._names[row - 1] if row else ""
