"""Meshes and CAD files in a folder that may be its design, and the bodies in them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from processor.distinct_rows import components
from processor.meshes.mesh_files import SUFFIXES as MESH_SUFFIXES
from processor.meshes.mesh_files import read_whole
from processor.model import DesignBodies, Floats, InputError, Ints, Reason, reason
from processor.scan_folder import cad
from processor.scan_folder.file_values import existing_file_in
from processor.scan_folder.files import CAD_SUFFIXES, SCANS, belongs
from processor.scan_folder.units import MM_PER_UNIT

MADE = "design-parts"  # folder of the meshes that `processor init` writes
DEPTH = 2  # of folders below the scan folder
MOST_PIECES = 60  # of one mesh that may be parts


@dataclass(frozen=True)
class Surface:
    """Vertices (v, 3), triangles (f, 3) and bodies of a file; in mm, or in its own ``unit`` = "" where it has none."""

    path: Path
    vertices: Floats
    faces: Ints
    bodies: DesignBodies | None
    unit: str


def candidates(folder: Path) -> list[list[Path]]:
    """Return the files of surfaces in a folder and the folders below, but not among the scans; a list a folder."""
    groups = []
    for place in _places(folder, DEPTH):
        files = [path for path in sorted(place.iterdir()) if path.is_file() and _is_surface(path)]
        if files:
            groups.append(files)
    return groups


def _places(folder: Path, depth: int) -> Iterator[Path]:
    yield folder
    if depth:
        for place in sorted(folder.iterdir()):
            if belongs(place) and place.name[0] != "." and place.name not in (SCANS, MADE):
                yield from _places(place, depth - 1)


def _is_surface(path: Path) -> bool:
    """Whether a file is a CAD file, or a mesh with faces: a PLY file may be a scan."""
    suffix = path.suffix.lower()
    if path.name.startswith(".") or suffix not in (*CAD_SUFFIXES, *MESH_SUFFIXES):
        return False
    if suffix != ".ply":
        return True
    with path.open("rb") as file:
        head = file.read(1 << 14).split(b"end_header")[0]
    return any(line.startswith(b"element face") and not line.endswith(b" 0") for line in head.splitlines())


def one_a_stem(files: Sequence[Path]) -> tuple[list[Path], list[Reason]]:
    """Return one file for each name, a CAD file before a mesh, and a doubt for each that is there several times."""
    by_stem = defaultdict(list)
    for path in files:
        by_stem[path.stem.casefold()].append(path)
    order = [*CAD_SUFFIXES, *MESH_SUFFIXES]
    chosen, doubts = [], []
    for paths in by_stem.values():
        paths.sort(key=lambda path: order.index(path.suffix.lower()))
        chosen.append(paths[0])
        if len(paths) > 1:
            names = tuple(path.name for path in paths)
            doubts.append(reason("init.files-of-one-name", name=paths[0].stem, files=names, file=names[0]))
    return sorted(chosen), doubts


def read(folder: Path, path: Path, unit: str) -> Surface:
    """Read a file of surfaces. Raises InputError.

    Curved faces of a CAD file that states no unit become facets as fine as they need be if it is in ``unit``.
    """
    existing_file_in(folder, str(path.relative_to(folder)), str(folder))
    if path.suffix.lower() in CAD_SUFFIXES:
        vertices, faces, bodies_of, stated = cad.read(path, unit)
        in_unit = vertices if stated else vertices / MM_PER_UNIT[unit]
        return Surface(path, in_unit, faces, bodies_of, "mm" if stated else "")
    vertices, faces = read_whole(path)
    if len(faces) < 4:
        raise InputError(f"expected a mesh of a body, found {len(faces)} faces", path=path)
    return Surface(path, vertices, faces, None, "")


def bodies(surface: Surface) -> list[tuple[str, Floats, Ints]]:
    """Return name, vertices and triangles of each body of a file: of each piece of a mesh that shares no vertex."""
    if surface.bodies is not None:
        labels, names = surface.bodies.of_facet, list(surface.bodies.names)
    else:
        labels = _pieces(surface)
        count = int(labels.max()) + 1
        if not 1 < count <= MOST_PIECES:
            return [(surface.path.stem, surface.vertices, surface.faces)]
        names = [f"part {k + 1}" for k in range(count)]
    return [(name, surface.vertices, surface.faces[labels == k]) for k, name in enumerate(names)]


def _pieces(surface: Surface) -> Ints:
    """Return the number (f,) of the connected piece of each facet, as the file shares vertices."""
    faces = surface.faces
    label = components(len(surface.vertices), faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1))[faces[:, 0]]
    numbers: Ints = np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return numbers
