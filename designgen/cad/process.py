"""STEP and IFC files read by the CAD kernel in a child process.

A damaged file can end the process of the kernel. The child reads one file and sends the bodies, an error, or nothing.
The parent does not trust a child that read a damaged file: the answer is JSON and plain arrays, which are checked.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import resource
import signal
import sys
from contextlib import suppress
from typing import IO, Any

import numpy as np

from designgen.cad.bodies import Body, CadFile
from designgen.cad.face_surfaces import Form, Forms, surface_of
from processor.jobs.child import end_with_parent
from processor.model import InputError, UsageError
from processor.plain_text import decoded


def serve() -> None:
    """Read the file in the file descriptor of the command line; the answer goes to standard output.

    The descriptor holds a line of JSON with ``path``, ``suffix``, ``units``, ``default_units``, ``exact``,
    ``limit_s``, ``memory_bytes``, and the file's content.
    """
    end_with_parent()
    with os.fdopen(int(sys.argv[1]), "rb") as question:
        job, content = json.loads(question.readline()), question.read()
    answers = os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    _limit(job["limit_s"], job["memory_bytes"])
    answer(job, content, answers)


def answer(job: dict[str, Any], content: bytes, answers: IO[bytes]) -> None:
    """Read the content of a file and write the bodies, or the error, to ``answers``; ``job`` as for :func:`serve`."""
    path, cad = job["path"], None
    try:
        cad = parse(path, job["suffix"], content, job["units"], job["default_units"], exact=job["exact"])
        header = _header(cad)
    except (InputError, UsageError) as error:
        header = {"error": type(error).__name__, "message": str(error)}
    except ImportError as error:
        message = f"{path}: cannot be read: the CAD kernel cannot be loaded ({error}); install the extra 'designgen'"
        header = {"error": "InputError", "message": message}
    except MemoryError:
        message = f"{path}: reading it takes more than {job['memory_bytes'] / 1e9:g} GB of memory; export it in parts"
        header = {"error": "InputError", "message": message}
    except Exception as error:  # of types that the kernel defines
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        message = f"{path}: the CAD kernel cannot read it ({why}); it may be damaged: copy or export it again"
        header = {"error": "InputError", "message": message}
    answers.write(json.dumps(header).encode("ascii") + b"\n")
    for body in cad.bodies if cad is not None and "bodies" in header else ():
        arrays: list[Any] = [body.vertices, body.faces]
        if body.forms is not None:
            numbers = np.concatenate([np.empty(0), *(form.numbers for form in body.forms.forms)])
            arrays += [body.forms.of_triangle, body.forms.corner_uv, numbers]
        for array in arrays:
            np.lib.format.write_array(answers, np.ascontiguousarray(array), allow_pickle=False)
    answers.flush()


def _limit(limit_s: float, memory_bytes: int) -> None:
    """Limit the time, even if the parent has ended, and the memory, where the system lets it."""
    signal.alarm(math.ceil(limit_s) + 5)
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE):
        with suppress(ValueError, OSError):
            resource.setrlimit(kind, (memory_bytes, memory_bytes))


def _header(cad: CadFile) -> dict[str, Any]:
    scalars = ("name", "solid", "closed", "volume_mm3", "area_mm2", "deviation_mm")
    header = {key: getattr(cad, key) for key in ("unit", "unit_mm", "unit_stated", "problems")}
    bodies: list[dict[str, Any]] = [{key: getattr(body, key) for key in scalars} for body in cad.bodies]
    for entry, body in zip(bodies, cad.bodies, strict=True):
        if body.forms is not None:
            entry["forms"] = [[form.name, form.kind, len(form.numbers)] for form in body.forms.forms]
    return {**header, "bodies": bodies}


def received(answer: IO[bytes]) -> CadFile:
    """Return the content of an :func:`answer`.

    Raises the InputError or UsageError in the answer; ValueError, KeyError, TypeError or EOFError for an invalid one.
    """
    header = json.loads(answer.readline())
    if "error" in header:
        raise (UsageError if header["error"] == "UsageError" else InputError)(str(header["message"]))
    bodies = []
    for entry in header["bodies"]:
        vertices = np.lib.format.read_array(answer, allow_pickle=False)
        faces = np.lib.format.read_array(answer, allow_pickle=False)
        fits = (
            vertices.dtype == np.float64 and faces.dtype == np.int64 and vertices.shape[1:] == faces.shape[1:] == (3,)
        )
        if not fits or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("no mesh")
        forms = _received_forms(answer, entry["forms"], len(faces)) if "forms" in entry else None
        body = Body(
            name=str(entry["name"]),
            solid=bool(entry["solid"]),
            closed=bool(entry["closed"]),
            vertices=vertices,
            faces=faces,
            volume_mm3=float(entry["volume_mm3"]) if entry["solid"] else float("nan"),
            area_mm2=float(entry["area_mm2"]),
            deviation_mm=float(entry["deviation_mm"]),
            forms=forms,
        )
        sizes = [body.area_mm2, body.deviation_mm, *([body.volume_mm3] if body.solid else [])]
        if not np.isfinite(vertices).all() or not np.isfinite(sizes).all():
            raise ValueError("no number")
        bodies.append(body)
    problems = tuple(str(problem) for problem in header["problems"])
    return CadFile(str(header["unit"]), float(header["unit_mm"]), str(header["unit_stated"]), tuple(bodies), problems)


def _received_forms(answer: IO[bytes], entries: list[Any], triangles: int) -> Forms:
    """Return the forms of a body in an answer; ValueError for invalid ones."""
    of_triangle, corner_uv, numbers = (np.lib.format.read_array(answer, allow_pickle=False) for _ in range(3))
    lengths = [int(length) for _, _, length in entries]
    fits = of_triangle.dtype == np.int64 and corner_uv.dtype == numbers.dtype == np.float64
    fits &= of_triangle.shape == (triangles,) and corner_uv.shape == (triangles, 3, 2) and numbers.ndim == 1
    fits &= min(lengths, default=0) >= 0 and sum(lengths) == len(numbers)
    if not fits or of_triangle.min() < 0 or of_triangle.max() >= len(entries):
        raise ValueError("no forms")
    if not np.isfinite(corner_uv).all() or not np.isfinite(numbers).all():
        raise ValueError("no number")
    parts = np.split(numbers, np.cumsum(lengths)[:-1])
    forms = tuple(Form(str(name), str(kind), part) for (name, kind, _), part in zip(entries, parts, strict=True))
    for form in forms:
        surface_of(form)
    return Forms(forms, of_triangle, corner_uv)


def parse(
    path: str, suffix: str, content: bytes, units: str, default_units: str = "", *, exact: bool = False
) -> CadFile:
    """Read the text of a STEP file (``suffix`` .step, .stp) or an IFC file; its numbers are in ``units`` if given.

    ``default_units`` is the unit of a file that states none. ``exact``: bodies have the forms of their faces.
    Raises InputError for a text that cannot be read or is without any unit, UsageError where the library for IFC is
    missing and where ``units`` are given but the file has several units.
    """
    # The kernels are loaded in the child process only: that takes seconds, and may fail.
    text = escaped(content)
    if suffix == ".ifc":
        from designgen.cad import ifc

        cad = ifc.parse(path, text, units, default_units, exact=exact)
    else:
        from designgen.cad import step

        cad = step.parse(path, text, units, default_units, exact=exact)
    # Numbers of entities that the file refers to but does not contain
    plain = re.sub(rb"'[^']*'|/\*.*?\*/", b"", text, flags=re.S)
    defined = {int(number) for number in re.findall(rb"#(\d{1,18})\s*=", plain)}
    lost = sorted({int(number) for number in re.findall(rb"#(\d{1,18})(?!\d)", plain)} - defined)
    if not lost:
        return cad
    problem = f"{len(lost)} line(s) that others refer to are missing, first #{lost[0]}: bodies may be missing or wrong"
    return dataclasses.replace(cad, problems=(problem, *cad.problems))


def escaped(content: bytes) -> bytes:
    """Return a file's text in ASCII with all other characters escaped by ISO 10303-21.

    Many programs write names unescaped, against the standard; the kernels take them for Latin letters or drop them.
    """
    if content.isascii():
        return content
    return escape(decoded(content)).encode("ascii")


def escape(text: str) -> str:
    r"""Escape characters beyond ASCII as in ISO 10303-21: ``\X2\6881\X0\``, beyond 16 bits ``\X4\00020000\X0\``."""
    text = re.sub("[\x80-\uffff]+", lambda m: rf"\X2\{m[0].encode('utf-16-be', 'replace').hex().upper()}\X0" "\\", text)
    return re.sub("[\U00010000-\U0010ffff]+", lambda m: rf"\X4\{m[0].encode('utf-32-be').hex().upper()}\X0" "\\", text)
