"""Bodies of meshes: connected parts apart, normals outward, and what had to be repaired."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from designgen.cad import faults as notes_on
from designgen.models.model import ModelBody, of_mesh, unique_names
from processor.meshes.faults import mended
from processor.meshes.mesh_files import Piece
from processor.model import Floats, InputError, Ints


class _Part(NamedTuple):
    """Vertices (v, 3), mm, and triangles (f, 3) of a body, and how many edges one triangle alone has."""

    name: str
    vertices: Floats
    triangles: Ints
    open_edges: int


def bodies_of(path: str, pieces: Sequence[Piece], stem: str) -> tuple[list[ModelBody], list[str]]:
    """Return the bodies of named pieces, mm, and notes on what was found and repaired.

    A piece without a name is as many bodies as it has connected parts. Raises InputError where no triangle has an area.
    """
    notes: list[str] = []
    parts = [part for piece in pieces for part in _parts(piece, stem, notes)]
    if not parts:
        raise InputError(f"{path}: expected triangles with an area, found none; export it again")
    unnamed = sum(not part.name for part in parts)
    names = [part.name or (f"{stem}-{i + 1}" if len(parts) > 1 else stem) for i, part in enumerate(parts)]
    if unnamed > 1:
        notes.append(f"{unnamed} connected parts have no names and are numbered as bodies {names[0]} to {names[-1]}")
    notes += notes_on.repeated(names)
    names = unique_names(names)
    for name, part in zip(names, parts, strict=True):
        if part.open_edges:
            notes.append(
                f"{name!r} is not closed ({part.open_edges} open edges): it is scanned as it is, from both sides; "
                "close its holes if it is a solid"
            )
    return [of_mesh(name, part.vertices, part.triangles) for name, part in zip(names, parts, strict=True)], notes


def _parts(piece: Piece, stem: str, notes: list[str]) -> Iterator[_Part]:
    """Yield the bodies of a piece: one where it has a name; add to ``notes`` what was repaired."""
    name, vertices, triangles = piece
    if not len(triangles):
        return
    whole = mended(vertices, triangles)
    if whole.repeated:
        notes.append(f"{name or stem!r}: {whole.repeated} of {len(triangles)} triangles repeat others: left out")
    if whole.turned:
        notes.append(
            f"{name or stem!r}: {whole.turned} of {len(triangles)} triangles were turned so that all normals point "
            "outward"
        )
    a, b, c = (whole.points[whole.corners[:, i]] for i in range(3))
    has_area = (whole.part >= 0) & (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.0)
    part = np.where(has_area, 0 if name else whole.part, -1)
    for rows in _groups(part):
        used, corners = np.unique(whole.corners[rows], return_inverse=True)
        yield _Part(
            name, whole.points[used], corners.reshape(-1, 3).astype(np.int64), int(whole.open_sides[rows].sum())
        )


def _groups(label: Ints) -> Iterator[Ints]:
    """Yield the rows of each label of 0 and more, in the order of the labels."""
    order = np.argsort(label, kind="stable")
    order = order[label[order] >= 0]
    yield from np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(order) else ()
