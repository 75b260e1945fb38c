"""Triangle meshes from PLY, STL and OBJ files, in pieces by the names of objects in the file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError, Ints

SUFFIXES = (".ply", ".stl", ".obj")
Piece = tuple[str, Floats, Ints]  # name, "" for none; vertices (v, 3); triangles (f, 3)
STL_HEADER, STL_RECORD = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def read(path: Path) -> list[Piece]:
    """Return the named pieces of a mesh file, in the file's unit.

    Raises InputError for a file that cannot be read, is damaged, or has no faces.
    """
    readers = {".ply": _ply, ".stl": _stl, ".obj": _obj}
    try:
        pieces = readers[path.suffix.lower()](path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except InputError:
        raise
    except Exception as error:  # of types that the library for PLY defines
        raise InputError(f"{path}: is damaged ({' '.join(str(error).split())[:120]}); export it again") from None
    pieces = [piece for piece in pieces if len(piece[2])]
    if not pieces:
        raise InputError(f"{path}: expected a mesh with faces, found none; export it with faces")
    for _, vertices, triangles in pieces:
        if triangles.min() < 0 or triangles.max() >= len(vertices) or not np.isfinite(vertices[triangles]).all():
            raise InputError(
                f"{path}: expected finite vertices and faces of these, found others; export it again, or repair it"
            )
    return pieces


def _fans(polygons: list[Any]) -> Ints:
    triangles = [(p[0], p[i], p[i + 1]) for p in polygons for i in range(1, len(p) - 1)]
    return np.array(triangles, np.int64).reshape(-1, 3)


def _ply(path: Path) -> list[Piece]:
    from plyfile import PlyData

    data = PlyData.read(str(path), known_list_len={})
    vertex = data["vertex"].data
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    if "face" not in data:
        return []
    fields = [prop.name for prop in data["face"].properties]
    polygons = data["face"].data[next(name for name in ("vertex_indices", "vertex_index") if name in fields)]
    if len(polygons) and len({len(p) for p in polygons}) == 1 and len(polygons[0]) == 3:
        return [("", vertices, np.stack(polygons).astype(np.int64))]
    return [("", vertices, _fans(list(polygons)))]


def _stl(path: Path) -> list[Piece]:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little") if len(content) >= STL_HEADER else -1
    if len(content) == STL_HEADER + count * STL_RECORD.itemsize:
        corners = np.frombuffer(content, STL_RECORD, count, STL_HEADER)["corners"].astype(np.float64)
        return [("", corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))]
    if not content.lstrip().startswith(b"solid"):
        raise InputError(f"{path}: expected an STL file, found another kind or one that is cut off; export it again")
    if not content.rstrip().rsplit(b"\n", 1)[-1].strip().startswith(b"endsolid"):
        raise InputError(f"{path}: is cut off: its last line, endsolid, is missing; copy or export it again")
    pieces = []
    for header, body in re.findall(rb"^\s*solid[ \t]*([^\r\n]*)(.*?)^\s*endsolid", content, re.S | re.M):
        numbers = re.findall(rb"vertex\s+(%b)\s+(%b)\s+(%b)" % (NUMBER, NUMBER, NUMBER), body)
        vertices = np.array(numbers, np.float64).reshape(-1, 3)
        triangles = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
        pieces.append((header.decode("utf-8", "replace").strip(), vertices, triangles))
    return pieces


def _obj(path: Path) -> list[Piece]:
    vertices: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    name = ""
    with path.open("r", encoding="utf-8", errors="replace") as lines:
        for line in lines:
            kind, _, rest = line.strip().partition(" ")
            if kind == "v":
                vertices.append([float(x) for x in rest.split()[:3]])
            elif kind == "f":
                numbers = [int(corner.split("/")[0]) for corner in rest.split()]
                rows = [n - 1 if n > 0 else len(vertices) + n for n in numbers]
                polygons.setdefault(name, []).append(rows)
            elif kind in ("o", "g"):
                name = rest.strip()
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return [(name, points, _fans(faces)) for name, faces in polygons.items()]
