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
import unicodedata
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from designgen.cad.bodies import UNITS_MM, Body, CadFile
from designgen.cad.process import escape, received
from designgen.export.formats import write_mesh
from processor.jobs.process import Cause, isolated, run
from processor.model import InputError, UsageError
from processor.store import store

if TYPE_CHECKING:
    import cadquery as cq

__all__ = ["Body", "CadFile", "import_file", "read", "summary", "unit_mm", "write_design", "write_step"]

STEP_SUFFIXES, IFC_SUFFIXES = (".step", ".stp"), (".ifc",)
MAGIC, END = b"ISO-10303-21", b"END-ISO-10303-21"
LIMIT_S = 600.0  # for reading a file
MEMORY_BYTES = 8 * 10**9  # for reading a file, where the platform can limit it
CHILD = "from designgen.cad import process; process.serve()"
FILE_NAME_BYTES = 200
WRITTEN = "1970-01-01T00:00:00"  # for every file, so that the same design makes the same bytes

# --- in --------------------------------------------------------------------------------------------------------------


def unit_mm(name: str) -> float:
    """Return a unit of length in mm. Raises UsageError for an unknown one."""
    if name.lower() not in UNITS_MM:
        raise UsageError(f"unit {name!r}: expected one of {', '.join(UNITS_MM)}")
    return UNITS_MM[name.lower()]


def read(path: Path, units: str = "", *, limit_s: float = LIMIT_S, memory_bytes: int = MEMORY_BYTES) -> CadFile:
    """Read a STEP or IFC file; ``units`` are those of its numbers, whatever it says itself.

    A process of its own reads it, within ``limit_s`` seconds and ``memory_bytes`` of memory. Raises InputError for a
    file that cannot be read so, is of another kind, cut off, damaged, or without geometry, UsageError for unknown units
    and where IFC's library is missing.
    """
    return _read(path, _content(path), units, limit_s, memory_bytes)


def _content(path: Path) -> bytes:
    """Return a file's bytes, if they are what its name says and end as they should."""
    suffix = path.suffix.lower()
    if suffix not in STEP_SUFFIXES + IFC_SUFFIXES:
        raise InputError(f"{path}: expected a CAD file (.step, .stp, .ifc), found {suffix or 'no suffix'}")
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: expected a CAD file, found a folder or device")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not content[:4096].lstrip(b"\xef\xbb\xbf \r\n\t").startswith(MAGIC):
        raise InputError(
            f"{path}: expected a STEP or IFC text file (ISO-10303-21), found another kind; export it again"
        )
    schema = re.search(rb"FILE_SCHEMA\s*\(\s*\(\s*'([\w ]*)", content[:65536])
    if schema and schema[1].upper().startswith(b"IFC") != (suffix in IFC_SUFFIXES):
        article = "a STEP" if suffix in IFC_SUFFIXES else "an IFC"
        raise InputError(f"{path}: by its schema {schema[1].decode()} it is {article} file; give it the ending of one")
    # Without its end, the kernels take what is there for all there is.
    if content.rfind(END) < 0:
        raise InputError(f"{path}: is cut off: its last line, {END.decode()}, is missing; copy or export it again")
    return content


def _read(path: Path, content: bytes, units: str, limit_s: float, memory_bytes: int) -> CadFile:
    if units:
        unit_mm(units)
    job: dict[str, Any] = {"path": str(path), "suffix": path.suffix.lower(), "units": units.lower()}
    job |= {"limit_s": limit_s, "memory_bytes": memory_bytes}
    # Damaged files can end the process at once, and the kernels print what they like.
    with tempfile.TemporaryFile() as question, tempfile.TemporaryFile() as answer:
        question.write(json.dumps(job).encode("ascii") + b"\n" + content)
        question.seek(0)
        number = question.fileno()
        ended = run(isolated(CHILD, str(number)), stdout=answer, pass_fds=[number], own_group=False, timeout_s=limit_s)
        if ended.cause is Cause.TIME:
            raise InputError(
                f"{path}: the CAD kernel did not read it within {limit_s:g} s; export it in parts, or again"
            )
        if ended.code:
            why = f"signal {ended.code}" if ended.cause is Cause.SIGNAL else f"exit code {ended.code}"
            raise InputError(
                f"{path}: reading it ended the CAD kernel ({why}): it is damaged, or takes more than "
                f"{memory_bytes / 1e9:g} GB of memory; export it again, or in parts"
            )
        answer.seek(0)
        try:
            found = received(answer)
        except (ValueError, KeyError, TypeError, EOFError, MemoryError):
            raise InputError(f"{path}: the CAD kernel made nonsense of it: it is damaged; export it again") from None
    if not found.bodies:
        why = f" ({found.problems[0]})" if found.problems else ""
        raise InputError(f"{path}: holds no geometry{why}; export it with solids or surfaces")
    return found


def import_file(path: Path, folder: Path, units: str = "") -> dict[str, Any]:
    """Write the meshes of a CAD file and import.json as a new folder; returns what import.json says.

    Raises UsageError when the folder exists and is not empty, InputError as :func:`read`.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists and is not empty; name a new folder")
    content = _content(path)
    found = _read(path, content, units, LIMIT_S, MEMORY_BYTES)
    said: dict[str, Any] = {
        "file": path.name,
        "sha256": sha256(content).hexdigest(),
        "unit": found.unit,
        "unit_mm": found.unit_mm,
        "unit_from": "asked for by --units" if units else "said by the file",
        "unit_said": found.unit_said or None,
        "bodies": [],
        "problems": list(found.problems),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    making = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        taken = set[str]()
        for body in found.bodies:
            file = f"{_file_stem(body.name, taken)}.ply"
            write_mesh(making / file, body.vertices, body.faces)
            said["bodies"].append(
                {
                    "name": body.name,
                    "mesh": file,
                    "kind": "solid" if body.solid else "surface",
                    "closed": body.closed,
                    "size_mm": body.size_mm.tolist(),
                    "volume_mm3": body.volume_mm3 if body.solid else None,
                    "area_mm2": body.area_mm2,
                    "triangles": len(body.faces),
                    "deviation_mm": body.deviation_mm,
                }
            )
        text = json.dumps(said, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        (making / "import.json").write_text(text, encoding="utf-8")
        for one in (*making.iterdir(), making):
            store.sync(one)
        if folder.exists():
            folder.rmdir()
        os.chmod(making, 0o755)
        os.replace(making, folder)
        store.sync(folder.parent)
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise
    return said


def summary(said: Mapping[str, Any]) -> list[str]:
    """Return lines that say what :func:`import_file` found: the unit, then a line a body."""
    other = f"; the file says {said['unit_said'] or 'none'}" if said["unit_said"] != said["unit"] else ""
    lines = [f"{said['file']}: unit {said['unit']} ({said['unit_mm']:.10g} mm, {said['unit_from']}{other})"]
    for body in said["bodies"]:
        x, y, z = body["size_mm"]
        volume = f"{body['volume_mm3']:.6g} mm3" if body["kind"] == "solid" else "no volume: a surface"
        unclosed = ", not closed" if body["kind"] == "solid" and not body["closed"] else ""
        lines.append(f"  {body['mesh']}: {x:.3f} x {y:.3f} x {z:.3f} mm, {volume}{unclosed}")
    return lines


def _file_stem(name: str, taken: set[str]) -> str:
    """Return a name for a file that is safe, not too long, and not taken on disks that ignore case either."""
    plain = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name)).strip("._")
    plain = plain.encode()[:FILE_NAME_BYTES].decode(errors="ignore") or "body"
    stems = itertools.chain([plain], (f"{plain}-{i}" for i in itertools.count(2)))
    stem = next(stem for stem in stems if stem.casefold() not in taken)
    taken.add(stem.casefold())
    return stem


# --- out -------------------------------------------------------------------------------------------------------------


def write_step(path: Path, shapes: Mapping[str, cq.Shape], origin_mm: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
    """Write shapes with their names as one STEP file (AP214, mm); the same shapes make the same bytes.

    ``origin_mm`` is where the shapes' own origin comes to lie. Raises InputError where the file cannot be written.
    """
    import cadquery as cq

    assembly = cq.Assembly(name="assembly")
    there = cq.Location(cq.Vector(*map(float, origin_mm)))
    # The kernel takes the bytes of a name for letters, so names are put into the text afterwards.
    places = {f"name-{number:06d}-of-shape": name for number, name in enumerate(shapes)}
    for place, shape in zip(places, shapes.values(), strict=True):
        assembly.add(shape, name=place, loc=there)
    with store.replacing(path) as temporary:
        assembly.export(str(temporary), exportType="STEP")
        text = temporary.read_text("ascii")
        # The kernel writes when and into which file it wrote.
        header = f"FILE_NAME('{_quoted(path.stem)}','{WRITTEN}',(''),(''),'','','');\n"
        text = re.sub(r"FILE_NAME\(.*?\);\s*(?=FILE_SCHEMA)", lambda _: header, text, count=1, flags=re.S)
        # ... and counts the parts of assemblies on through all files of a run, and breaks lines by the number's length.
        numbers = itertools.count(1)
        text = re.sub(
            r"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\(')\d+([^;]*;)",
            lambda m: m[1] + str(next(numbers)) + re.sub(r"\s*\n\s*", "", m[2]),
            text,
        )
        text = re.sub(r"'(name-\d{6}-of-shape)'", lambda m: f"'{_quoted(places[m[1]])}'", text)
        temporary.write_text(text, "ascii")


def _quoted(name: str) -> str:
    """Return a name as it stands between the quotes of a STEP file."""
    plain = "".join(c if c.isprintable() else " " for c in name)
    return escape(plain.replace("\\", "\\\\").replace("'", "''"))


def write_design(recipe: Mapping[str, Any], folder: Path) -> list[Path]:
    """Write the solids of a recipe's design as STEP, an arch part a file, where the scene has them; returns the files.

    Raises UsageError for what is no recipe of a design.
    """
    from designgen.designs import arch_bridge, arch_part, space_frame
    from designgen.reading import filled
    from designgen.scenes.structure import design as structure_design

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
        shapes = {"frame": space_frame.solid(space_frame.build(filled(space_frame.Params, recipe, "frame")))}
    elif kind == "structure":
        from designgen.designs import structure

        path = folder / "structure.step"
        shapes = {one.name: structure.solid([one]) for one in structure_design(recipe)}
    else:
        raise UsageError("--step: the scene does not say by which recipe it was made, so its solids are not known")
    write_step(path, shapes, recipe.get("scan", {}).get("origin_mm", (0.0, 0.0, 0.0)))
    return [path]
