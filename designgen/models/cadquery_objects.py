"""Bodies of CadQuery objects, and Python files that leave one in ``result``."""

from __future__ import annotations

import runpy
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from designgen.cad.bodies import Body
from processor.model import InputError

RESULT = "result"
EXPECTED = "a CadQuery Workplane, Shape or Assembly with solids or faces"


def run(path: Path) -> Any:
    """Run a Python file and return the object that it leaves in ``result``; modules beside the file can be imported.

    The file is run as any Python program is, with all rights of the user. Raises InputError where it fails or leaves
    nothing.
    """
    if not path.is_file():
        raise InputError(f"{path}: cannot be read: no such file")
    sys.path.insert(0, str(path.resolve().parent))
    try:
        left = runpy.run_path(str(path), run_name="model")
    except (Exception, SystemExit) as error:
        lines = [entry.lineno for entry in traceback.extract_tb(error.__traceback__) if entry.filename == str(path)]
        where = f" in line {lines[-1]}" if lines else ""
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(
            f"{path}: ended with an error{where} ({why}); correct it, it runs as a Python program"
        ) from None
    finally:
        sys.path.remove(str(path.resolve().parent))
    if RESULT not in left:
        raise InputError(f"{path}: expected {EXPECTED} in the variable {RESULT}, which it does not set")
    return left[RESULT]


def bodies_of(path: str, model: Any, stem: str) -> tuple[list[Body], list[str]]:
    """Return the bodies of a CadQuery object, with the forms of their faces, and notes on what is left out.

    Raises InputError for another object, and for one without solids or faces.
    """
    from designgen.cad.shapes import body_of, pieces

    bodies: list[Body] = []
    notes: list[str] = []
    for name, shape in _shapes(path, model):
        found = list(pieces(shape))
        for number, (piece, solid) in enumerate(found):
            said = name if name and len(found) == 1 else f"{name or stem}-{number + 1}"
            body = body_of(path, said, piece, 1.0, solid=solid, face_name=lambda face: "")
            if isinstance(body, Body):
                bodies.append(body)
            else:
                notes.append(body)
    if not bodies:
        raise InputError(f"{path}: expected {EXPECTED}, found none{': ' + notes[0] if notes else ''}")
    return bodies, notes


def solids(path: str, model: Any) -> list[Any]:
    """Return the solids of a CadQuery object in the order of :func:`bodies_of`; none where it has other pieces."""
    import cadquery as cq

    from designgen.cad.shapes import pieces

    found = [piece for _, shape in _shapes(path, model) for piece in pieces(shape)]
    return [cq.Solid(piece) for piece, _ in found] if all(solid for _, solid in found) else []


def _shapes(path: str, model: Any) -> Iterator[tuple[str, Any]]:
    """Yield names, "" for none, and shapes of the kernel."""
    import cadquery as cq

    if isinstance(model, cq.Assembly):
        for shape, name, location, _ in model:
            yield name.partition("/")[2] or name, shape.moved(location).wrapped
    elif isinstance(model, cq.Workplane):
        shapes = [value for value in model.vals() if isinstance(value, cq.Shape)]
        if shapes:
            yield "", (shapes[0] if len(shapes) == 1 else cq.Compound.makeCompound(shapes)).wrapped
    elif isinstance(model, cq.Shape):
        yield "", model.wrapped
    else:
        raise InputError(f"{path}: expected {EXPECTED}, found {type(model).__name__}")
