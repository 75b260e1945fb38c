"""STEP and IFC texts to bodies in mm, by the CAD kernel, in a process of its own.

The kernel ends the whole process on some damaged files, and prints as it likes: so :func:`serve` reads one file for
the process that started it, which gets the bodies, an error, or the news that the process died. What comes back from a
process that read a damaged file is not trusted: it is JSON and plain arrays.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np

from processor.model import Floats, InputError, Ints, UsageError

TESSELLATION_MM = 0.05
COARSE_SHARE = 1e-3  # of a body's size: where meshing starts
COARSER = 10.0  # a mesh than the next
LARGEST_MM = 1e9
NO_UNIT = "says no unit of length that is known; name it with --units"
UNITS_MM = {
    "millimetre": 1.0, "mm": 1.0, "centimetre": 10.0, "cm": 10.0, "decimetre": 100.0, "metre": 1000.0, "m": 1000.0,
    "kilometre": 1e6, "micrometre": 1e-3, "inch": 25.4, "in": 25.4, "foot": 304.8, "ft": 304.8, "yard": 914.4,
}  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A solid of a CAD file, or a surface without a volume: vertices (v, 3) in mm and triangles (f, 3).

    ``closed`` says whether the mesh has no open edge; ``deviation_mm`` how far it may be from the body, by the kernel's
    own figure; ``volume_mm3`` is NaN for a surface.
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
    """The unit of a file's numbers and its size, the unit that the file says ("" if none), its bodies, what was lost.

    ``unit`` and ``unit_said`` differ where another unit was asked for.
    """

    unit: str
    unit_mm: float
    unit_said: str
    bodies: tuple[Body, ...]
    problems: tuple[str, ...]


# --- from process to process -----------------------------------------------------------------------------------------


def serve(job: Mapping[str, Any]) -> None:
    """Read the file whose content follows on standard input; the answer goes to standard output.

    ``job`` holds ``path``, ``suffix``, ``units``, ``limit_s`` and ``memory_bytes``.
    """
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    _limit(job["limit_s"], job["memory_bytes"])
    path, found = job["path"], None
    try:
        found = parse(path, job["suffix"], sys.stdin.buffer.read(), job["units"])
        header = _header(found)
    except (InputError, UsageError) as error:
        header = {"error": type(error).__name__, "message": str(error)}
    except ImportError as error:
        said = f"{path}: cannot be read: the CAD kernel cannot be loaded ({error}); install the extra 'designgen'"
        header = {"error": "InputError", "message": said}
    except MemoryError:
        said = f"{path}: reading it takes more than {job['memory_bytes'] / 1e9:g} GB of memory; export it in parts"
        header = {"error": "InputError", "message": said}
    except Exception as error:  # the kernel's own kinds, which say little
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        said = f"{path}: the CAD kernel cannot read it ({why}); it may be damaged: copy or export it again"
        header = {"error": "InputError", "message": said}
    answers.write(json.dumps(header).encode("ascii") + b"\n")
    for body in found.bodies if found is not None and "bodies" in header else ():
        for array in (body.vertices, body.faces):
            np.lib.format.write_array(answers, np.ascontiguousarray(array), allow_pickle=False)
    answers.flush()


def _limit(limit_s: float, memory_bytes: int) -> None:
    """Limit memory where the platform can; end on its own even if the caller is gone."""
    if hasattr(signal, "alarm"):
        signal.alarm(math.ceil(limit_s) + 5)
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
        resource.setrlimit(resource.RLIMIT_FSIZE, (memory_bytes, memory_bytes))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (ImportError, ValueError, OSError):
        pass


def _header(found: CadFile) -> dict[str, Any]:
    bodies = [
        {
            "name": body.name,
            "solid": body.solid,
            "closed": body.closed,
            "volume_mm3": body.volume_mm3 if body.solid else None,
            "area_mm2": body.area_mm2,
            "deviation_mm": body.deviation_mm,
        }
        for body in found.bodies
    ]
    header = {"unit": found.unit, "unit_mm": found.unit_mm, "unit_said": found.unit_said, "bodies": bodies}
    return {**header, "problems": list(found.problems)}


def received(answer: IO[bytes]) -> CadFile:
    """Return what :func:`serve` answered.

    Raises the InputError or UsageError that it answered, ValueError, KeyError, TypeError or EOFError for no answer.
    """
    header = json.loads(answer.readline())
    if "error" in header:
        raise (UsageError if header["error"] == "UsageError" else InputError)(str(header["message"]))
    bodies = []
    for said in header["bodies"]:
        vertices = np.lib.format.read_array(answer, allow_pickle=False)
        faces = np.lib.format.read_array(answer, allow_pickle=False)
        fits = (
            vertices.dtype == np.float64 and faces.dtype == np.int64 and vertices.shape[1:] == faces.shape[1:] == (3,)
        )
        if not fits or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("no mesh")
        volume = float(said["volume_mm3"]) if said["solid"] else float("nan")
        sizes = (volume, float(said["area_mm2"]), float(said["deviation_mm"]))
        if not np.isfinite(vertices).all() or not np.isfinite(sizes[0 if said["solid"] else 1 :]).all():
            raise ValueError("no number")
        bodies.append(Body(str(said["name"]), bool(said["solid"]), bool(said["closed"]), vertices, faces, *sizes))
    problems = tuple(str(one) for one in header["problems"])
    return CadFile(str(header["unit"]), float(header["unit_mm"]), str(header["unit_said"]), tuple(bodies), problems)


# --- the text --------------------------------------------------------------------------------------------------------


def parse(path: str, suffix: str, content: bytes, units: str) -> CadFile:
    """Read the text of a STEP file (``suffix`` .step, .stp) or an IFC file; its numbers are in ``units`` where given.

    Raises InputError for what cannot be read or has no unit, UsageError where IFC's library is missing and where a unit
    is asked for but the file has several.
    """
    from designgen import cad_ifc, cad_step

    text = escaped(content)
    found = cad_ifc.parse(path, text, units) if suffix == ".ifc" else cad_step.parse(path, text, units)
    lost = missing_lines(text)
    if not lost:
        return found
    said = f"{len(lost)} line(s) that others refer to are missing, first #{lost[0]}: bodies may be missing or wrong"
    return CadFile(found.unit, found.unit_mm, found.unit_said, found.bodies, (said, *found.problems))


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
    return escape(text.removeprefix("\ufeff")).encode("ascii")


def escape(text: str) -> str:
    r"""Write what is not ASCII as ISO 10303-21 does: ``\X2\6881\X0\``, beyond 16 bits ``\X4\00020000\X0\``."""
    text = re.sub("[\x80-\uffff]+", lambda m: rf"\X2\{m[0].encode('utf-16-be', 'replace').hex().upper()}\X0" "\\", text)
    return re.sub("[\U00010000-\U0010ffff]+", lambda m: rf"\X4\{m[0].encode('utf-32-be').hex().upper()}\X0" "\\", text)


def missing_lines(text: bytes) -> list[int]:
    """Return the numbers of entities that a file refers to but does not hold, in order."""
    plain = re.sub(rb"'[^']*'|/\*.*?\*/", b"", text, flags=re.S)
    defined = {int(number) for number in re.findall(rb"#(\d{1,18})\s*=", plain)}
    return sorted({int(number) for number in re.findall(rb"#(\d{1,18})(?!\d)", plain)} - defined)


# --- units and meshes ------------------------------------------------------------------------------------------------


def unit_name(path: str, said: str, size_mm: float) -> tuple[str, list[str]]:
    """Name a unit by its size, which is what counts, and say where the file's own name for it is another.

    Raises InputError for a size that is none.
    """
    if not 0.0 < size_mm < float("inf"):
        raise InputError(f"{path}: says a unit of length of {size_mm:.10g} mm; name it with --units")
    said = said.strip().lower()
    fitting = [name for name, size in UNITS_MM.items() if abs(size / size_mm - 1.0) < 1e-6]
    if said in UNITS_MM and said not in fitting:
        return f"{size_mm:.10g} mm", [f"the file calls {size_mm:.10g} mm {said}; name the unit with --units if wrong"]
    if fitting:
        return (said if said in fitting else fitting[0]), []
    return (said if re.fullmatch(r"[\w. -]{1,40}", said) else f"{size_mm:.10g} mm"), []


def finest_mm(path: str, name: str, size_mm: float, most: int, triangles: Callable[[float], int]) -> float:
    """Return the deviation of the last mesh made by ``triangles``: the aimed at, or what keeps near ``most`` triangles.

    ``triangles`` makes the mesh of a deviation in mm and counts it. The number of a doubly curved body goes with one
    over the deviation, that of any other slower, so that a coarse mesh tells before much time and memory are taken.
    Raises InputError for a body that is too large to be one.
    """
    if not size_mm < LARGEST_MM:
        raise InputError(f"{path}: {name!r} is {size_mm:.3g} mm large; is its unit right? name it with --units")
    deviation = max(TESSELLATION_MM, COARSE_SHARE * size_mm)
    while True:
        count = triangles(deviation)
        finer = max(TESSELLATION_MM, deviation / COARSER, deviation * count / most)
        if finer > 0.9 * deviation:
            return deviation
        deviation = finer


def is_closed(faces: Ints) -> bool:
    """Tell whether the triangles along every edge run one way as often as the other, so that they hold a volume."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, which = np.unique(low * (int(high.max(initial=0)) + 1) + high, return_inverse=True)
    balance = np.bincount(which.reshape(-1), weights=np.where(edges[:, 0] == low, 1.0, -1.0))
    return bool(len(faces)) and not balance.any()
