"""Models from files and objects: STEP, IFC, meshes, Python files, CadQuery objects, arrays."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from designgen.cad import files
from designgen.cad.bodies import Body
from designgen.models import cadquery_objects, mesh_bodies, mesh_files
from designgen.models.model import Model, ModelBody, of_cad, repeated, shared_count, turned, unique, volume
from processor.model import Floats, InputError, Ints, UsageError

PYTHON = ".py"
SUFFIXES = (*files.STEP_SUFFIXES, *files.IFC_SUFFIXES, *mesh_files.SUFFIXES, PYTHON)
MOST_NOTES = 12
LOG = logging.getLogger("designgen")  # without a handler, its warnings are lines on standard error


def load(model: Any, units: str = "", name: str = "model") -> Model:
    """Return a model in mm: of a path, a CadQuery object, or vertices (v, 3) and faces (f, 3).

    ``units``: of the file's numbers; "": those that the file names, mm for meshes. Python files are run. Raises
    InputError for a model that cannot be read or has no surface, UsageError for unknown units.
    """
    if isinstance(model, str | PathLike):
        path = Path(model)
        found = _of_file(path, units)
        return _named(path.stem, path.name, found)
    if units:
        raise UsageError("units: expected none for an object, whose lengths are in mm")
    if isinstance(model, tuple | list) and len(model) == 2:
        vertices, faces = _arrays(model)
        bodies, notes = mesh_bodies.bodies_of(name, [("", vertices, faces)], name)
        return Model(name, tuple(bodies), tuple(notes))
    cad, notes = cadquery_objects.bodies_of(name, model, name)
    return _named(name, name, (cad, notes))


def _arrays(model: Any) -> tuple[Floats, Ints]:
    try:
        vertices, faces = np.asarray(model[0], np.float64), np.asarray(model[1])
        shaped = vertices.shape[1:] == faces.shape[1:] == (3,) and faces.dtype.kind in "iu" and len(faces) > 0
        if shaped and np.isfinite(vertices).all() and faces.min() >= 0 and faces.max() < len(vertices):
            return vertices, faces.astype(np.int64)
    except (ValueError, TypeError, IndexError):
        pass
    raise InputError("model: expected finite vertices (v, 3) and faces (f, 3) of rows of these, found others")


def say(model: Model) -> None:
    """Log the notes of a model as warnings, a line each."""
    for note in model.notes[:MOST_NOTES]:
        LOG.warning("%s: %s", model.name, note)
    if len(model.notes) > MOST_NOTES:
        LOG.warning("%s: and %d further notes", model.name, len(model.notes) - MOST_NOTES)


def _of_file(path: Path, units: str) -> tuple[Sequence[Body | ModelBody], list[str]]:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a model ({', '.join(SUFFIXES)}), found {suffix or 'no suffix'}")
    if suffix == PYTHON:
        if units:
            raise UsageError("--units: a Python file's lengths are in mm; leave --units out")
        return cadquery_objects.bodies_of(str(path), cadquery_objects.run(path), path.stem)
    if suffix in mesh_files.SUFFIXES:
        unit_mm = files.unit_mm(units or "mm")
        pieces = [(name, unit_mm * vertices, faces) for name, vertices, faces in mesh_files.read(path)]
        bodies, notes = mesh_bodies.bodies_of(str(path), pieces, path.stem)
        if not units:
            notes.insert(0, "a mesh names no unit: its numbers are taken as mm; state another by --units")
        return bodies, notes
    cad = files.read(path, units, exact=True)
    notes = list(cad.problems)
    if cad.unit_mm != 1.0:
        why = "given by --units" if units else "stated in the file"
        notes.insert(0, f"its numbers are in {cad.unit} ({cad.unit_mm:.10g} mm, {why}); the scene is in mm")
    return cad.bodies, notes


def _named(model: str, file: str, found: tuple[Sequence[Body | ModelBody], list[str]]) -> Model:
    """Return the model of bodies under unique names, with the notes on names and open shells."""
    bodies, notes = found
    if bodies and isinstance(bodies[0], ModelBody):
        return Model(model, tuple(bodies), tuple(notes))  # type: ignore[arg-type]
    names = [body.name for body in bodies]
    notes += repeated(names)
    stem = Path(file).stem
    numbered = sum(name.startswith(f"{stem}-") and name[len(stem) + 1 :].isdigit() for name in names)
    if numbered:
        notes.append(f"{numbered} bodies have no names in the file: they are numbered, as {stem}-1")
    result, open_, inverted = [], [], []
    for body, name in zip(bodies, unique(names), strict=True):
        assert isinstance(body, Body)
        inward = body.closed and volume(body.vertices, body.faces) < 0.0
        inverted += [name] if inward else []
        open_ += [] if body.closed else [name]
        result.append(of_cad(turned(body) if inward else body, name))
    if open_:
        notes.append(f"{_listed(open_)} not closed: scanned as it is, from both sides; check it in the CAD program")
    if inverted:
        notes.append(f"{_listed(inverted)} inside out: the normals were turned outward")
    return Model(model, tuple(result), tuple(notes), shared_count(names), numbered)


def _listed(names: Sequence[str]) -> str:
    return f"{names[0]!r} is" if len(names) == 1 else f"{len(names)} bodies, {names[0]!r} first, are"
