"""Models from files and objects: STEP, IFC, meshes, Python files, CadQuery objects, arrays."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from designgen.cad import faults, files
from designgen.cad.bodies import Body, is_closed
from designgen.models import cadquery_objects, mesh_bodies
from designgen.models.model import Model, ModelBody, of_cad, unique_names
from processor.meshes import mesh_files
from processor.meshes.mesh_files import Piece
from processor.model import Floats, InputError, Ints, UsageError

PYTHON = ".py"
SUFFIXES = (*files.STEP_SUFFIXES, *files.IFC_SUFFIXES, *mesh_files.SUFFIXES, PYTHON)
MOST_NOTES = 12  # lines: a screen half full; the rest is counted
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
        bodies, notes = mesh_bodies.bodies_of(name, [Piece("", vertices, faces)], name)
        return Model(name, tuple(bodies), tuple(notes))
    if isinstance(model, tuple | list | np.ndarray):
        raise InputError(f"model: expected vertices (v, 3) and faces (f, 3), found {len(model)} arrays or rows")
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


def log_notes(model: Model) -> None:
    """Log the notes of a model, and what is wrong with its bodies together, as warnings, a line each."""
    bodies = [
        faults.Named(body.name, body.vertices, body.triangles, is_closed(body.triangles)) for body in model.bodies
    ]
    notes = [*model.notes, *faults.of_bodies(bodies)]
    for note in notes[:MOST_NOTES]:
        LOG.warning("%s: %s", model.name, note)
    if len(notes) > MOST_NOTES:
        LOG.warning("%s: and %d further notes", model.name, len(notes) - MOST_NOTES)


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
        pieces = [piece._replace(vertices=unit_mm * piece.vertices) for piece in mesh_files.read(path)]
        bodies, notes = mesh_bodies.bodies_of(str(path), pieces, path.stem)
        if not units:
            ends = np.array([[body.vertices.min(axis=0), body.vertices.max(axis=0)] for body in bodies])
            x, y, z = ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0)
            notes.insert(
                0,
                f"a mesh names no unit: its numbers are taken as mm, {x:.4g} x {y:.4g} x {z:.4g} mm in all; state "
                "another by --units",
            )
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
    names, stem = [body.name for body in bodies], Path(file).stem
    notes += faults.of_names(names, stem)
    result, open_, inverted = [], [], []
    for body, name in zip(bodies, unique_names(names), strict=True):
        assert isinstance(body, Body)
        open_ += [] if body.closed else [name]
        if body.closed and faults.volume(body.vertices, body.faces) < 0.0:  # its triangles are wound the other way
            inverted.append(name)
            forms = body.forms and replace(body.forms, corner_uv=body.forms.corner_uv[:, ::-1])
            body = replace(body, faces=body.faces[:, ::-1], forms=forms)
        result.append(of_cad(body, name))
    notes += faults.of_shells(open_, inverted, "scanned as it is, from both sides")
    unnamed = len(faults.numbered(names, stem))
    return Model(model, tuple(result), tuple(notes), faults.shared_count(names), unnamed)
