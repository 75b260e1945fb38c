"""STEP and IFC files to triangle meshes in mm, with their sizes; the unit is read from the file and reported."""

from __future__ import annotations

import itertools
import json
import re
import tempfile
import unicodedata
import zipfile
import zlib
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from designgen.cad import faults
from designgen.cad.bodies import UNITS_MM, CadFile
from designgen.cad.process import received
from processor.jobs.causes import Cause
from processor.jobs.process import isolated, run
from processor.model import InputError, PlainError, UsageError
from processor.store.whole_output import check_new, whole_folder
from processor.writers.ply import write_mesh

STEP_SUFFIXES, ZIPPED, IFC_SUFFIXES = (".step", ".stp"), ".ifczip", (".ifc", ".ifczip")
MAGIC, END = b"ISO-10303-21", b"END-ISO-10303-21"
LIMIT_S = 600.0  # time for reading a file
MEMORY_BYTES = 8 * 10**9  # memory for reading a file, where the platform can limit it
CHILD = "from designgen.cad import process; process.serve()"
FILE_NAME_BYTES = 200  # file systems allow 255: a number and a suffix follow


def unit_mm(name: str) -> float:
    """Return a unit of length in mm. Raises UsageError for an unknown one."""
    if name.lower() not in UNITS_MM:
        raise UsageError(f"unit {name!r}: expected one of {', '.join(UNITS_MM)}")
    return UNITS_MM[name.lower()]


def read(
    path: Path,
    units: str = "",
    default_units: str = "",
    *,
    content: bytes | None = None,
    exact: bool = False,
    limit_s: float = LIMIT_S,
    memory_bytes: int = MEMORY_BYTES,
) -> CadFile:
    """Read a STEP or IFC file, or its ``content``; ``units``, if given, replace the unit of length in the file.

    ``default_units`` is the unit of a file that states none; "": such a file is refused.

    With ``exact`` bodies have the forms of their faces. A child process reads the file, within ``limit_s`` seconds and
    ``memory_bytes`` of memory. Raises InputError for a file that cannot be read so, is of another kind, cut off,
    damaged, or without geometry; UsageError for unknown units and where the library for IFC is missing.
    """
    content = _content(path, path) if content is None else content
    for unit in filter(None, (units, default_units)):
        unit_mm(unit)
    suffix = ".ifc" if path.suffix.lower() in IFC_SUFFIXES else path.suffix.lower()
    job: dict[str, Any] = {"path": str(path), "suffix": suffix, "units": units.lower(), "exact": exact}
    job |= {"default_units": default_units.lower(), "limit_s": limit_s, "memory_bytes": memory_bytes}
    # A damaged file can end the child process, and the kernels print to its standard streams.
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
            content_read = received(answer)
        except PlainError:  # what the process reports
            raise
        except (ValueError, KeyError, TypeError, EOFError, MemoryError):
            raise InputError(f"{path}: the CAD kernel made nonsense of it: it is damaged; export it again") from None
    if not content_read.bodies:
        why = f" ({content_read.problems[0]})" if content_read.problems else ""
        raise InputError(f"{path}: holds no geometry{why}; export it with solids or surfaces")
    return content_read


def _content(file: Path, path: Path) -> bytes:
    """Return a file's bytes; InputError, which names ``path``, where they are not of its kind, or are cut off."""
    suffix = path.suffix.lower()
    if suffix not in STEP_SUFFIXES + IFC_SUFFIXES:
        raise InputError(f"{path}: expected a CAD file (.step, .stp, .ifc, .ifczip), found {suffix or 'no suffix'}")
    try:
        if file.exists() and not file.is_file():
            raise InputError(f"{path}: expected a CAD file, found a folder or device")
        content = _unzipped(file, path) if suffix == ZIPPED else file.read_bytes()
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
    # The kernels read a file without its end as if it were complete.
    if content.rfind(END) < 0:
        raise InputError(f"{path}: is cut off: its last line, {END.decode()}, is missing; copy or export it again")
    return content


def _unzipped(file: Path, path: Path) -> bytes:
    """Return the one IFC file in a zip file; InputError where there is another number, or it cannot be unpacked."""
    try:
        with zipfile.ZipFile(file) as archive:
            inside = [entry for entry in archive.infolist() if entry.filename.lower().endswith(".ifc")]
            if len(inside) != 1:
                raise InputError(f"{path}: expected one .ifc file in it, found {len(inside)}; unpack it and name one")
            if inside[0].file_size > MEMORY_BYTES:
                raise InputError(f"{path}: unpacked it has more than {MEMORY_BYTES / 1e9:g} GB; export it in parts")
            return archive.read(inside[0])
    except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError):
        raise InputError(f"{path}: is no zip file, damaged or encrypted; copy or export it again") from None


def import_file(
    path: Path, folder: Path, units: str = "", default_units: str = "", named: Path | None = None
) -> dict[str, Any]:
    """Write the meshes of a CAD file and import.json as a new folder; return the content of import.json.

    Errors call the file ``named``, if that is given: the original of a copy.

    Raises UsageError where the folder exists and is not empty, InputError as :func:`read`.
    """
    check_new(folder)
    content = _content(path, named or path)
    cad = read(named or path, units, default_units, content=content)
    unit_from = "stated in the file" if cad.unit_stated else "given by --default-units"
    report: dict[str, Any] = {
        "file": path.name,
        "sha256": sha256(content).hexdigest(),
        "unit": cad.unit,
        "unit_mm": cad.unit_mm,
        "unit_from": "given by --units" if units else unit_from,
        "unit_stated": cad.unit_stated or None,
        "bodies": [],
        "problems": list(cad.problems),
        "notes": _notes(cad, path.stem),
    }
    with whole_folder(folder) as making:
        taken = set[str]()
        for body in cad.bodies:
            file = f"{_file_stem(body.name, taken)}.ply"
            inward = body.closed and faults.volume(body.vertices, body.faces) < 0.0
            write_mesh(making / file, body.vertices, body.faces[:, ::-1] if inward else body.faces)
            report["bodies"].append(
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
        text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        (making / "import.json").write_text(text, encoding="utf-8")
    return report


def _notes(cad: CadFile, stem: str) -> list[str]:
    """Return what is wrong with bodies that could be read: their names, open shells, overlaps."""
    bodies = [faults.Named(body.name, body.vertices, body.faces, body.closed) for body in cad.bodies]
    open_ = [body.name for body in cad.bodies if not body.closed]
    inverted = [body.name for body in bodies if body.closed and faults.volume(body.vertices, body.triangles) < 0.0]
    return [
        *faults.of_names([body.name for body in bodies], stem),
        *faults.of_shells(open_, inverted, "written as it is"),
        *faults.of_bodies(bodies),
    ]


def summary(report: Mapping[str, Any]) -> list[str]:
    """Return the result of :func:`import_file` as lines of text: the unit, then a line for each body."""
    in_file = f"; the file states {report['unit_stated'] or 'none'}" if report["unit_stated"] != report["unit"] else ""
    lines = [f"{report['file']}: unit {report['unit']} ({report['unit_mm']:.10g} mm, {report['unit_from']}{in_file})"]
    for body in report["bodies"]:
        x, y, z = body["size_mm"]
        volume = f"{body['volume_mm3']:.6g} mm3" if body["kind"] == "solid" else "no volume: a surface"
        unclosed = ", not closed" if body["kind"] == "solid" and not body["closed"] else ""
        lines.append(f"  {body['mesh']}: {x:.3f} x {y:.3f} x {z:.3f} mm, {volume}{unclosed}")
    return lines


def _file_stem(name: str, taken: set[str]) -> str:
    """Return a file name without special characters, short, and unique even if case is ignored; add it to ``taken``."""
    plain = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name)).strip("._")
    plain = plain.encode()[:FILE_NAME_BYTES].decode(errors="ignore") or "body"
    stems = itertools.chain([plain], (f"{plain}-{i}" for i in itertools.count(2)))
    stem = next(stem for stem in stems if stem.casefold() not in taken)
    taken.add(stem.casefold())
    return stem
