"""Triangle meshes of a design from PLY, STL and OBJ files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError, Ints
from processor.readers import ply
from processor.readers.file_checks import errors_name_the_file

MESH_SUFFIXES = (".ply", ".stl", ".obj")
CAD_SUFFIXES = (".step", ".stp", ".ifc")  # converted to meshes first, see :mod:`processor.scan_folder.cad`


def read_mesh(path: Path) -> tuple[Floats, Ints]:
    """Return vertices (v, 3) in the file's unit and triangles (f, 3) of a PLY, STL or OBJ file.

    Raises InputError for a file that is damaged, has no faces, or is of another format.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        known = ", ".join((*MESH_SUFFIXES, *CAD_SUFFIXES))
        raise InputError(f"expected a mesh or CAD file ({known}), found {suffix or 'no suffix'}", path=path)
    vertices, faces = _read_ply_mesh(path) if suffix == ".ply" else _read_other_mesh(path, suffix)
    if not len(vertices) or not len(faces):
        raise InputError(
            f"expected a mesh with faces, found {len(vertices)} vertices and {len(faces)} faces", path=path
        )
    if not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            "expected finite vertices and faces of these, found vertices that are not finite or faces of "
            "vertices that do not exist; export it again",
            path=path,
        )
    return vertices, faces


def _read_ply_mesh(path: Path) -> tuple[Floats, Ints]:
    from plyfile import PlyData

    ply.read_header(path)
    with errors_name_the_file(path, "PLY mesh"):
        data = PlyData.read(str(path), known_list_len={})
        vertex = data["vertex"].data
        vertices = np.stack([np.asarray(vertex[name], np.float64) for name in "xyz"], axis=1)
        fields = [prop.name for prop in data["face"].properties]
        indices = next(name for name in ("vertex_indices", "vertex_index") if name in fields)
        polygons: list[Any] = list(data["face"].data[indices])
        faces = [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]
    return vertices, np.array(faces, np.int64).reshape(-1, 3)


def _read_other_mesh(path: Path, suffix: str) -> tuple[Floats, Ints]:
    import trimesh

    # From an open file and without materials the library cannot open other files.
    with errors_name_the_file(path, suffix[1:].upper()), path.open("rb") as file:
        options: dict[str, Any] = {"skip_materials": True} if suffix == ".obj" else {}
        mesh: Any = trimesh.load(file, file_type=suffix[1:], process=False, force="mesh", **options)
        return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
