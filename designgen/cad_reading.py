"""STEP and IFC texts to bodies in mm, by the CAD kernel, in a process of its own.

The kernel ends the whole process on some damaged files, and prints as it likes: so :func:`serve` reads one file for
the process that started it, which gets the bodies, an error, or the news that the process died.
"""

from __future__ import annotations

import os
import pickle
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from designgen import mesh
from processor.model import Floats, InputError, Ints, UsageError

if TYPE_CHECKING:
    import cadquery as cq

TESSELLATION_MM = 0.05
TESSELLATION_RAD = 0.1
# A sphere takes pi radius / deviation triangles: with this share of its size, a million and a half at most.
COARSEST_SHARE = 1e-6
LARGEST_MM = 1e9
UNITS_MM = {
    "millimetre": 1.0, "mm": 1.0, "centimetre": 10.0, "cm": 10.0, "decimetre": 100.0, "metre": 1000.0, "m": 1000.0,
    "kilometre": 1e6, "micrometre": 1e-3, "inch": 25.4, "in": 25.4, "foot": 304.8, "ft": 304.8, "yard": 914.4,
}  # fmt: skip
NO_BODIES = ("IfcFeatureElementSubtraction", "IfcSpace", "IfcVirtualElement", "IfcAnnotation", "IfcGrid")
FLAT = ("Axis", "FootPrint", "Annotation", "Box", "CoG", "Reference")  # representations that have no surface
NO_UNIT = "says no unit of length; name it with --units"


@dataclass(frozen=True)
class Body:
    """A solid of a CAD file, or a surface without a volume: vertices (v, 3) in mm and triangles (f, 3).

    ``closed`` says whether the mesh is, every edge between two triangles; ``deviation_mm`` how far it may be from the
    body; ``volume_mm3`` is NaN for a surface.
    """

    name: str
    solid: bool
    closed: bool
    vertices: Floats
    faces: Ints
    volume_mm3: float
    area_mm2: float
    deviation_mm: float

    @property
    def size_mm(self) -> Floats:
        """Sizes (3,) of the box around it."""
        found: Floats = np.ptp(self.vertices, axis=0)
        return found


@dataclass(frozen=True)
class CadFile:
    """The unit that a file declares ("" if none) and its size, the size that was taken, bodies, and what was lost."""

    unit: str
    unit_mm: float
    taken_mm: float
    bodies: tuple[Body, ...]
    problems: tuple[str, ...]


def serve() -> None:
    """Answer one call of :func:`parse`: its arguments from standard input, a CadFile or an error to standard output."""
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    path, suffix, content, asked_mm = pickle.load(sys.stdin.buffer)
    answer: CadFile | Exception
    try:
        answer = parse(path, suffix, content, asked_mm)
    except (InputError, UsageError) as error:
        answer = error
    except Exception as error:  # the kernel's own kinds, which say little
        said = " ".join(str(error).split())[:200]
        answer = InputError(f"{path}: cannot be read ({type(error).__name__}: {said}); copy or export it again")
    pickle.dump(answer, answers)
    answers.flush()


def parse(path: str, suffix: str, content: bytes, asked_mm: float | None) -> CadFile:
    """Read the text of a STEP file (``suffix`` .step, .stp) or an IFC file; its unit is ``asked_mm`` where given.

    Raises InputError for what cannot be read or has no unit, UsageError where IFC's library is missing and where a unit
    is asked for but the file has several.
    """
    kernel = _parse_ifc if suffix == ".ifc" else _parse_step
    return kernel(path, escaped(content), asked_mm)


def escaped(content: bytes) -> bytes:
    """Return a file's text in ASCII, other characters as ISO 10303-21 writes them, from UTF-8 or else GB 18030.

    Names are often written as they are, against the standard, which the kernels take for Latin or drop.
    """
    if content.isascii():
        return content
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("gb18030", errors="replace")
    return escape(text).encode("ascii")


def escape(text: str) -> str:
    r"""Write what is not ASCII as ISO 10303-21 does: ``\X2\6881\X0\``, beyond 16 bits ``\X4\00020000\X0\``."""
    text = re.sub("[\x80-\uffff]+", lambda m: rf"\X2\{m[0].encode('utf-16-be', 'replace').hex().upper()}\X0" "\\", text)
    return re.sub("[\U00010000-\U0010ffff]+", lambda m: rf"\X4\{m[0].encode('utf-32-be').hex().upper()}\X0" "\\", text)


def _unit(path: str, said: str, size_mm: float) -> tuple[str, list[str]]:
    """Name a unit by its size, which is what counts, and say where the file's own name for it is another."""
    if not 0.0 < size_mm < float("inf"):
        raise InputError(f"{path}: says a unit of length of {size_mm:.10g} mm; name it with --units")
    said = said.strip().lower()
    fitting = [name for name, size in UNITS_MM.items() if abs(size / size_mm - 1.0) < 1e-6]
    if said in UNITS_MM and said not in fitting:
        return f"{size_mm:.10g} mm", [f"the file calls {size_mm:.10g} mm {said}; name the unit with --units if wrong"]
    if fitting:
        return (said if said in fitting else fitting[0]), []
    return (said if re.fullmatch(r"[\w. -]{1,40}", said) else f"{size_mm:.10g} mm"), []


def _deviation(path: str, size_mm: float) -> float:
    """Return how far the mesh of a body of a size may be from it."""
    if not size_mm < LARGEST_MM:
        raise InputError(f"{path}: holds a body of {size_mm:.3g} mm; is its unit right? name it with --units")
    return max(TESSELLATION_MM, COARSEST_SHARE * size_mm)


def _closed(vertices: Floats, faces: Ints) -> bool:
    import trimesh

    return bool(trimesh.Trimesh(vertices, faces, process=False).is_watertight)


# --- STEP ------------------------------------------------------------------------------------------------------------


def _parse_step(path: str, content: bytes, asked_mm: float | None) -> CadFile:
    import cadquery as cq
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader()
    if reader.ReadStream("file.step", BytesIO(content)) != IFSelect_RetDone:
        raise InputError(f"{path}: not a readable STEP file: it is cut off or damaged; copy or export it again")
    model = reader.StepModel()
    # Kept together: an entity is the same object only as long as somebody holds it.
    entities = [model.Value(i) for i in range(1, model.NbEntities() + 1)]
    said, sizes = _step_units(reader, entities)
    if not sizes and asked_mm is None and any("SHAPE" in type(one).__name__.upper() for one in entities):
        raise InputError(f"{path}: {NO_UNIT}")
    unit, problems = _unit(path, said, sizes[0]) if sizes else ("", [])
    if len(sizes) > 1:
        unit = " and ".join(f"{size:.10g} mm" for size in sizes)
        if asked_mm is not None:
            raise UsageError(f"--units: {path} has numbers in several units ({unit}); leave --units out")
    declared = sizes[0] if sizes else 1.0  # the kernel's own guess
    taken = declared if asked_mm is None else asked_mm
    reader.SetSystemLengthUnit(declared / taken)
    problems += _broken(reader, entities)
    reader.TransferRoots()
    bodies = []
    if reader.NbShapes():
        names = _Names(reader, entities)
        stem = re.sub(r"\.\w+$", "", os.path.basename(path))
        for number, (shape, solid) in enumerate(_pieces(reader.OneShape())):
            name = names.of(shape) or f"{stem}-{number + 1}"
            body = _step_body(path, name, cq.Shape.cast(shape), solid=solid)
            if isinstance(body, Body):
                bodies.append(body)
            else:
                problems.append(body)
    return CadFile(unit, declared if sizes else float("nan"), taken, tuple(bodies), tuple(problems))


def _step_units(reader: Any, entities: list[Any]) -> tuple[str, list[float]]:
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


def _broken(reader: Any, entities: list[Any]) -> list[str]:
    """Say which geometry refers to what is not there: the kernel leaves it out, with the whole solid around it."""
    checks = reader.WS().ModelCheckList(False)
    checks.Start()
    found = []
    while checks.More():
        number = checks.Number()
        kind = type(entities[number - 1]).__name__ if 0 < number <= len(entities) else ""
        if checks.Value().NbFails() and kind.startswith(("StepShape_", "StepGeom_")):
            found.append(kind.split("_", 1)[1])
        checks.Next()
    return [f"{len(found)} damaged entities, first {found[0]}: bodies may be missing"] if found else []


def _pieces(shape: Any) -> Iterator[tuple[Any, bool]]:
    """Give every solid (True), then every shell and the loose faces outside of solids (False)."""
    from OCP.BRep import BRep_Builder
    from OCP.TopAbs import TopAbs_FACE, TopAbs_SHELL, TopAbs_SOLID
    from OCP.TopExp import TopExp_Explorer
    from OCP.TopoDS import TopoDS_Compound

    for explorer, solid in (
        (TopExp_Explorer(shape, TopAbs_SOLID), True),
        (TopExp_Explorer(shape, TopAbs_SHELL, TopAbs_SOLID), False),
    ):
        while explorer.More():
            yield explorer.Current(), solid
            explorer.Next()
    builder, loose, count = BRep_Builder(), TopoDS_Compound(), 0
    builder.MakeCompound(loose)
    faces = TopExp_Explorer(shape, TopAbs_FACE, TopAbs_SHELL)
    while faces.More():
        builder.Add(loose, faces.Current())
        count += 1
        faces.Next()
    if count:
        yield loose, False


def _step_body(path: str, name: str, shape: cq.Shape, *, solid: bool) -> Body | str:
    """Return a shape as a body, or what is wrong with it."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    box = Bnd_Box()
    BRepBndLib.Add_s(shape.wrapped, box, False)
    if box.IsVoid():
        return f"{name!r} is empty"
    deviation = _deviation(path, float(np.sqrt(box.SquareExtent())))
    try:
        vertices, faces = mesh.triangulate(shape, deviation)
    except (AttributeError, IndexError, ValueError):  # a face, or every one, without a mesh
        return f"{name!r} has faces that cannot be meshed"
    volume = float(shape.Volume()) if solid else float("nan")
    return Body(name, solid, _closed(vertices, faces), vertices, faces, volume, float(shape.Area()), deviation)


class _Names:
    """Names of shapes: a solid's own, else that of its place in an assembly, else that of its product."""

    def __init__(self, reader: Any, entities: list[Any]) -> None:
        from OCP.StepRepr import (
            StepRepr_ShapeRepresentationRelationship,
            StepRepr_ShapeRepresentationRelationshipWithTransformation,
        )
        from OCP.StepShape import StepShape_ShapeDefinitionRepresentation

        self._transfers = reader.WS().TransferReader()
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
            for i in range(1, representation.NbItems() + 1 if items is not None else 1):
                self._products.setdefault(items.Value(i), name)

    def of(self, shape: Any) -> str:
        """Return the name of a shape as it lies in the file, or nothing."""
        from OCP.StepRepr import StepRepr_NextAssemblyUsageOccurrence, StepRepr_RepresentationItem
        from OCP.TopLoc import TopLoc_Location

        place = self._transfers.EntityFromShapeResult(shape, 1)
        item = self._transfers.EntityFromShapeResult(shape.Located(TopLoc_Location()), 1)
        own = _text(item) if isinstance(item, StepRepr_RepresentationItem) else ""
        placed = _text(place) if isinstance(place, StepRepr_NextAssemblyUsageOccurrence) else ""
        return own or placed or (self._products.get(item, "") if item is not None else "")


def _product(representation: Any) -> str:
    definition = representation.Definition().PropertyDefinition()
    definition = definition.Definition().ProductDefinition() if definition is not None else None
    formation = definition.Formation() if definition is not None else None
    product = formation.OfProduct() if formation is not None else None
    return _text(product) if product is not None else ""


def _text(entity: Any) -> str:
    name = entity.Name()
    found = str(name.ToCString()).strip() if name is not None else ""
    return "" if found.upper() == "NONE" else found


# --- IFC -------------------------------------------------------------------------------------------------------------


def _parse_ifc(path: str, content: bytes, asked_mm: float | None) -> CadFile:
    try:
        import ifcopenshell
        import ifcopenshell.geom
        import ifcopenshell.util.unit
    except ImportError:
        raise UsageError("IFC files need the extra 'ifc': pip install 'steel-scan-check[ifc]'") from None
    damaged = f"{path}: not a readable IFC file: it is cut off or damaged; copy or export it again"
    try:
        model = ifcopenshell.file.from_string(content.decode("ascii"))
        projects = model.by_type("IfcProject")
    except (RuntimeError, ValueError, TypeError, AttributeError, ifcopenshell.Error):
        raise InputError(damaged) from None
    if not projects:
        raise InputError(damaged)
    declared = ifcopenshell.util.unit.get_project_unit(model, "LENGTHUNIT")
    size = 1000.0 * float(ifcopenshell.util.unit.calculate_unit_scale(model)) if declared is not None else 1000.0
    if declared is None and asked_mm is None:
        raise InputError(f"{path}: {NO_UNIT}")
    said = ifcopenshell.util.unit.get_full_unit_name(declared) if declared is not None else ""
    unit, problems = _unit(path, said, size) if declared is not None else ("", [])
    taken = size if asked_mm is None else asked_mm
    to_mm = 1000.0 * taken / size  # the library gives metres
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    settings.set("weld-vertices", True)
    settings.set("mesher-linear-deflection", TESSELLATION_MM / to_mm)
    settings.set("mesher-angular-deflection", TESSELLATION_RAD)
    bodies = []
    for product in model.by_type("IfcProduct"):
        if product.Representation is None or any(product.is_a(kind) for kind in NO_BODIES):
            continue
        try:
            shape: Any = ifcopenshell.geom.create_shape(settings, product).geometry
            vertices = np.array(shape.verts, np.float64).reshape(-1, 3) * to_mm
            faces = np.array(shape.faces, np.int64).reshape(-1, 3)
        except RuntimeError:
            faces = np.empty((0, 3), np.int64)
        name = (product.Name or "").strip() or product.is_a()
        if len(faces):
            _deviation(path, float(np.linalg.norm(np.ptp(vertices, axis=0))))
            bodies.append(_ifc_body(name, vertices, faces))
        elif any(one.RepresentationIdentifier not in FLAT for one in product.Representation.Representations):
            problems.append(f"{name!r} ({product.is_a()}) cannot be meshed")
    return CadFile(unit, size if declared is not None else float("nan"), taken, tuple(bodies), tuple(problems))


def _ifc_body(name: str, vertices: Floats, faces: Ints) -> Body:
    import trimesh

    shape = trimesh.Trimesh(vertices, faces, process=False)
    shape.merge_vertices()
    closed = bool(shape.is_watertight)
    volume = abs(float(shape.volume)) if closed else float("nan")
    points, triangles = np.array(shape.vertices, np.float64), np.array(shape.faces, np.int64)
    return Body(name, closed, closed, points, triangles, volume, float(shape.area), TESSELLATION_MM)
