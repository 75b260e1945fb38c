"""STEP and IFC files read by the CAD kernel in a child process.

The kernel can end the process on a damaged file. The child reads one file; the parent receives the bodies, an error,
or the end of the process. The answer of a child that read a damaged file is not trusted: it is JSON and plain arrays.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
from typing import IO, Any

import numpy as np

from designgen.cad.bodies import Body, CadFile
from processor.jobs.child import end_with_parent
from processor.model import InputError, UsageError


def serve() -> None:
    """Read the file in the file descriptor of the command line; the answer goes to standard output.

    The descriptor holds a line of JSON with ``path``, ``suffix``, ``units``, ``limit_s`` and ``memory_bytes``, and the
    file's content.
    """
    end_with_parent()
    with os.fdopen(int(sys.argv[1]), "rb") as question:
        job, content = json.loads(question.readline()), question.read()
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    _limit(job["limit_s"], job["memory_bytes"])
    path, found = job["path"], None
    try:
        found = parse(path, job["suffix"], content, job["units"])
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


def parse(path: str, suffix: str, content: bytes, units: str) -> CadFile:
    """Read the text of a STEP file (``suffix`` .step, .stp) or an IFC file; its numbers are in ``units`` where given.

    Raises InputError for what cannot be read or has no unit, UsageError where IFC's library is missing and where a unit
    is asked for but the file has several.
    """
    from designgen.cad import ifc
    from designgen.cad import step as cad_step

    text = escaped(content)
    found = ifc.parse(path, text, units) if suffix == ".ifc" else cad_step.parse(path, text, units)
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
