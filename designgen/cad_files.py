"""CAD files in and out: STEP and IFC to meshes with sizes, designs to STEP.

Whatever unit a file is in, all that comes out of it is in mm; the unit is read from the file, kept and said.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from designgen import mesh
from designgen.scan_files import write_mesh
from processor.model import Floats, InputError, Ints, UsageError

if TYPE_CHECKING:
    import cadquery as cq

TESSELLATION_MM = 0.05
STEP_SUFFIXES, IFC_SUFFIXES = (".step", ".stp"), (".ifc",)
UNITS_MM = {
    "millimetre": 1.0, "mm": 1.0, "centimetre": 10.0, "cm": 10.0, "decimetre": 100.0, "metre": 1000.0, "m": 1000.0,
    "kilometre": 1e6, "micrometre": 1e-3, "inch": 25.4, "in": 25.4, "foot": 304.8, "ft": 304.8, "yard": 914.4,
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A solid of a CAD file, or a surface without a volume: vertices (v, 3) and triangles (f, 3), mm."""

    name: str
    solid: bool
    vertices: Floats
    faces: Ints
    volume_mm3: float
    area_mm2: float

    @property
    def size_mm(self) -> Floats:
        """Sizes (3,) of the box around it."""
        found: Floats = np.ptp(self.vertices, axis=0)
        return found


@dataclass(frozen=True)
class CadFile:
    """The unit that a file says, what that is in mm, and its bodies."""

    unit: str
    unit_mm: float
    bodies: tuple[Body, ...]


def unit_mm(name: str) -> float:
    """Return a unit of length in mm. Raises UsageError for an unknown one."""
    if name.lower() not in UNITS_MM:
        raise UsageError(f"unit {name!r}: expected one of {', '.join(UNITS_MM)}")
    return UNITS_MM[name.lower()]


def read(path: Path, units: str = "") -> CadFile:
    """Read a STEP or IFC file; ``units`` are those of its numbers, whatever it says itself.

    Raises InputError for a file that cannot be read, of another kind, or without geometry.
    """
    suffix = path.suffix.lower()
    if suffix not in STEP_SUFFIXES + IFC_SUFFIXES:
        raise InputError(f"{path}: expected a CAD file (.step, .stp, .ifc), found {suffix or 'no suffix'}")
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not head.lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"ISO-10303-21"):
        raise InputError(
            f"{path}: expected a STEP or IFC text file (ISO-10303-21), found another kind; export it again"
        )
    asked = unit_mm(units) if units else None
    found = _read_step(path) if suffix in STEP_SUFFIXES else _read_ifc(path)
    if not found.bodies:
        raise InputError(f"{path}: holds no geometry; export it with solids or surfaces")
    if asked is None:
        return found
    factor = asked / found.unit_mm
    scaled = tuple(
        Body(b.name, b.solid, b.vertices * factor, b.faces, b.volume_mm3 * factor**3, b.area_mm2 * factor**2)
        for b in found.bodies
    )
    return CadFile(units, asked, scaled)


def _read_step(path: Path) -> CadFile:
    import cadquery as cq
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.Message import Message, Message_Gravity
    from OCP.STEPControl import STEPControl_Reader
    from OCP.TColStd import TColStd_SequenceOfAsciiString

    for printer in Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(Message_Gravity.Message_Fail)
    reader = STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_RetDone:
        raise InputError(f"{path}: not a readable STEP file: it is cut off or damaged; copy or export it again")
    lengths, angles, solid_angles = (TColStd_SequenceOfAsciiString() for _ in range(3))
    reader.FileUnits(lengths, angles, solid_angles)
    unit = lengths.Value(1).ToCString().lower() if lengths.Length() else ""
    if unit not in UNITS_MM:
        raise InputError(f"{path}: says no unit of length that is known ({unit or 'none'}); name it with --units")
    reader.TransferRoots()
    if not reader.NbShapes():
        return CadFile(unit, UNITS_MM[unit], ())
    shape = cq.Shape.cast(reader.OneShape())
    solids = shape.Solids()
    inside = {face.hashCode() for solid in solids for face in solid.Faces()}
    shells = [shell for shell in shape.Shells() if not any(face.hashCode() in inside for face in shell.Faces())]
    bodies = [_body(path, reader, one, number, solid=True) for number, one in enumerate(solids)]
    bodies += [_body(path, reader, one, len(solids) + i, solid=False) for i, one in enumerate(shells)]
    return CadFile(unit, UNITS_MM[unit], tuple(bodies))


def _body(path: Path, reader: Any, shape: cq.Shape, number: int, *, solid: bool) -> Body:
    vertices, faces = mesh.triangulate(shape, TESSELLATION_MM)
    volume = float(shape.Volume()) if solid else float("nan")
    return Body(
        _name(reader, shape) or f"{path.stem}-{number + 1}", solid, vertices, faces, volume, float(shape.Area())
    )


def _name(reader: Any, shape: cq.Shape) -> str:
    """Return the name that the file gives a shape, where it does."""
    from OCP.StepRepr import StepRepr_RepresentationItem

    entity = reader.WS().TransferReader().EntityFromShapeResult(shape.wrapped, 1)
    if not isinstance(entity, StepRepr_RepresentationItem) or entity.Name() is None:
        return ""
    name = str(entity.Name().ToCString())
    return re.sub(
        r"\\X2\\([0-9A-F]+)\\X0\\", lambda m: bytes.fromhex(m[1]).decode("utf-16-be", "replace"), name
    ).strip()


def _read_ifc(path: Path) -> CadFile:
    try:
        import ifcopenshell
        import ifcopenshell.geom
        import ifcopenshell.util.unit
    except ImportError:
        raise UsageError("IFC files need the extra 'ifc': pip install 'steel-scan-check[ifc]'") from None
    try:
        model = ifcopenshell.open(str(path))
        if not isinstance(model, ifcopenshell.file) or not model.by_type("IfcProject"):
            raise ValueError("it has no project")
        scale = 1000.0 * float(ifcopenshell.util.unit.calculate_unit_scale(model))
    except Exception as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise InputError(f"{path}: not a readable IFC file: {said}; copy or export it again") from None
    names = [name for name, size in UNITS_MM.items() if abs(size / scale - 1.0) < 1e-6 and len(name) > 2]
    settings = ifcopenshell.geom.settings()
    settings.set("use-world-coords", True)
    settings.set("weld-vertices", True)
    bodies = []
    for product in model.by_type("IfcProduct"):
        if product.Representation is None:
            continue
        try:
            shape: Any = ifcopenshell.geom.create_shape(settings, product)
        except RuntimeError:  # axes, grids, annotations: there is nothing to see of them
            continue
        vertices = np.array(shape.geometry.verts, np.float64).reshape(-1, 3) * 1000.0  # the library gives metres
        faces = np.array(shape.geometry.faces, np.int64).reshape(-1, 3)
        if len(faces):
            bodies.append(_ifc_body(product.Name or product.is_a(), vertices, faces))
    return CadFile(names[0] if names else f"{scale:g} mm", scale, tuple(bodies))


def _ifc_body(name: str, vertices: Floats, faces: Ints) -> Body:
    import trimesh

    shape = trimesh.Trimesh(vertices, faces, process=False)
    shape.merge_vertices()
    closed = bool(shape.is_watertight)
    volume = abs(float(shape.volume)) if closed else float("nan")
    return Body(name, closed, np.array(shape.vertices), np.array(shape.faces, np.int64), volume, float(shape.area))


def import_file(path: Path, folder: Path, units: str = "") -> dict[str, Any]:
    """Write the meshes of a CAD file and import.json as a new folder; returns what import.json says.

    Raises UsageError when the folder exists and is not empty, InputError as :func:`read`.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not empty; name a new folder")
    found = read(path, units)
    folder.parent.mkdir(parents=True, exist_ok=True)
    making = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        listed, taken = [], set[str]()
        for body in found.bodies:
            stem = re.sub(r"[^\w.-]+", "_", body.name).strip("._")[:100] or "body"
            name = next(n for n in (stem, *(f"{stem}-{i}" for i in range(2, 10**6))) if n.lower() not in taken)
            taken.add(name.lower())
            write_mesh(making / f"{name}.ply", body.vertices, body.faces)
            listed.append(
                {
                    "name": body.name,
                    "mesh": f"{name}.ply",
                    "kind": "solid" if body.solid else "surface",
                    "size_mm": body.size_mm.tolist(),
                    "volume_mm3": body.volume_mm3 if body.solid else None,
                    "area_mm2": body.area_mm2,
                    "triangles": len(body.faces),
                }
            )
        said = {
            "file": path.name,
            "sha256": sha256(path.read_bytes()).hexdigest(),
            "unit": found.unit,
            "unit_mm": found.unit_mm,
            "unit_from": "asked for by --units" if units else "said by the file",
            "bodies": listed,
        }
        text = json.dumps(said, indent=1, ensure_ascii=False) + "\n"
        (making / "import.json").write_text(text, encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        os.chmod(making, 0o755)
        os.replace(making, folder)
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise
    return said


# --- out -------------------------------------------------------------------------------------------------------------


def write_step(path: Path, shapes: Mapping[str, cq.Shape]) -> None:
    """Write shapes with their names as one STEP file (AP214, mm); the same shapes make the same bytes."""
    import cadquery as cq

    assembly = cq.Assembly(name="assembly")
    for name, shape in shapes.items():
        assembly.add(shape, name=name)
    assembly.export(str(path), exportType="STEP")
    text = path.read_text("utf-8", errors="surrogateescape")
    # The kernel writes when and into which file it wrote.
    text = re.sub(
        r"FILE_NAME\([^;]*?\);", f"FILE_NAME('{path.stem}','',(''),(''),'','','');", text, count=1, flags=re.S
    )
    # ... and counts the parts of assemblies on through all files of a run.
    numbers = itertools.count(1)
    text = re.sub(r"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\(')\d+'", lambda m: f"{m[1]}{next(numbers)}'", text)
    path.write_text(text, "utf-8", errors="surrogateescape")


def write_design(recipe: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write the solids of a recipe's design as STEP, an arch part a file; returns the files.

    Raises UsageError for what is no recipe of a design.
    """
    from designgen.designs import arch_bridge, arch_part, space_frame
    from designgen.reading import filled
    from designgen.structure_scene import design as structure_design

    folder.mkdir(exist_ok=True)
    kind = recipe.get("kind")
    if kind == "arch-bridge":
        parts = arch_bridge.build(filled(arch_bridge.Params, recipe, "bridge"))
        written = [folder / f"{part.name}.step" for part in parts]
        for path, part in zip(written, parts, strict=True):
            write_step(path, {part.name: arch_part.solid(part)})
        return written
    if kind == "space-frame":
        path = folder / "frame.step"
        write_step(path, {"frame": space_frame.solid(space_frame.build(filled(space_frame.Params, recipe, "frame")))})
        return [path]
    if kind == "structure":
        from designgen.designs import structure

        path = folder / "structure.step"
        write_step(path, {one.name: structure.solid([one]) for one in structure_design(recipe)})
        return [path]
    raise UsageError("--step: the scene does not say by which recipe it was made, so its solids are not known")
