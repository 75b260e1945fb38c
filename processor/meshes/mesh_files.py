"""Triangle meshes of PLY, STL and OBJ files, in pieces by the names of objects in the file; polygons are cut."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from processor.meshes.polygons import CrossingError, triangulated
from processor.model import Floats, InputError, Ints
from processor.plain_text import decoded
from processor.readers import ply
from processor.readers.file_checks import errors_name_the_file

SUFFIXES = (".ply", ".stl", ".obj")
# Of binary STL: 80 bytes of text and a count, then 50 bytes a triangle.
STL_HEADER, STL_RECORD = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
INDICES = ("vertex_indices", "vertex_index")  # names of the list of a face's corners in PLY


class Piece(NamedTuple):
    """Triangles (f, 3) of one name, "" for none, with the vertices (v, 3) of the file, in its unit."""

    name: str
    vertices: Floats
    triangles: Ints


def read(path: Path) -> list[Piece]:
    """Return the named pieces of a mesh file; those of an OBJ file have the same vertices.

    Raises InputError for a file that cannot be read, is damaged, or has no faces.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"expected a mesh ({', '.join(SUFFIXES)}), found {suffix or 'no suffix'}", path=path)
    if path.is_dir():
        raise InputError("expected a mesh file, found a folder", path=path)
    with errors_name_the_file(path, f"{suffix[1:].upper()} mesh"):
        try:
            pieces = {".ply": _ply, ".stl": _stl, ".obj": _obj}[suffix](path)
        except CrossingError as error:
            raise InputError(
                f"face {error.row + 1} of the file is a polygon whose sides cross, so that no triangles make it up; "
                "correct it, or export the mesh as triangles",
                path=path,
            ) from None
    pieces = [piece for piece in pieces if len(piece.triangles)]
    if not pieces:
        raise InputError("expected a mesh with faces, found none; export it with faces", path=path)
    for _, vertices, triangles in pieces:
        if triangles.min() < 0 or triangles.max() >= len(vertices) or not np.isfinite(vertices[triangles]).all():
            raise _others(path)
    return pieces


def read_whole(path: Path) -> tuple[Floats, Ints]:
    """Return all vertices (v, 3) and triangles (f, 3) of a mesh file; errors as of :func:`read`."""
    pieces = read(path)
    if len({id(piece.vertices) for piece in pieces}) == 1:
        return pieces[0].vertices, np.concatenate([piece.triangles for piece in pieces])
    counts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)]).tolist()
    triangles = [piece.triangles + first for piece, first in zip(pieces, counts, strict=False)]
    return np.concatenate([piece.vertices for piece in pieces]), np.concatenate(triangles)


def _others(path: Path) -> InputError:
    return InputError(
        "expected finite vertices and faces of these, found vertices that are not finite or faces of vertices that do "
        "not exist; export it again, or repair it",
        path=path,
    )


def _ply(path: Path) -> list[Piece]:
    from plyfile import PlyData, PlyParseError

    header = ply.read_header(path)
    face = next((element for element in header.elements if element.name == "face"), None)
    indices = next((name for name in INDICES if face is not None and name in face.list_counts), None)
    if face is None or not face.count:
        return []
    if indices is None:
        raise InputError(f"expected faces with {INDICES[0]}, found others; export it again", path=path)
    data = None
    for corners in (3, 4):  # faces of as many corners are read at once, in a fraction of the time
        with suppress(PlyParseError):
            data = PlyData.read(str(path), known_list_len={"face": {indices: corners}})
            break
    if data is None:
        data = PlyData.read(str(path), known_list_len={})
    vertex = data["vertex"].data
    vertices = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    rows = data["face"].data[indices]
    if rows.dtype == object:
        ring = np.concatenate([np.asarray(row, np.int64) for row in rows])
        counts = np.array([len(row) for row in rows])
    else:
        ring, counts = rows.astype(np.int64).ravel(), np.full(len(rows), rows.shape[1])
    return [Piece("", vertices, _cut(path, vertices, ring, counts))]


def _cut(path: Path, vertices: Floats, corners: Ints, counts: Ints) -> Ints:
    """Return the triangles of polygons; InputError where these have corners that do not exist."""
    used = corners if (counts > 2).all() else corners[np.repeat(counts > 2, counts)]
    if len(used) and (used.min() < 0 or used.max() >= len(vertices) or not np.isfinite(vertices[used]).all()):
        raise _others(path)
    return triangulated(vertices, corners, counts)


def _stl(path: Path) -> list[Piece]:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little") if len(content) >= STL_HEADER else -1
    if len(content) == STL_HEADER + count * STL_RECORD.itemsize:
        corners = np.frombuffer(content, STL_RECORD, count, STL_HEADER)["corners"].astype(np.float64)
        return [Piece("", corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))]
    if not re.match(rb"\s*solid\b", content, re.I):
        raise InputError("expected an STL file, found another kind or one that is cut off; export it again", path=path)
    pieces, name, begin = list[Piece](), b"", -1
    for line in re.finditer(rb"^[ \t]*(end)?solid\b[ \t]*([^\r\n]*)", content, re.I | re.M):
        if line[1] is None:
            name, begin = line[2], line.end()
        elif begin >= 0:
            pieces.append(_facets(path, name, content[begin : line.start()]))
            begin = -1
    if begin >= 0 or not pieces:
        raise InputError("is cut off: its last line, endsolid, is missing; copy or export it again", path=path)
    return pieces


def _facets(path: Path, name: bytes, body: bytes) -> Piece:
    """Return the facets of one solid of an STL file in ASCII."""
    lines = re.findall(rb"^[ \t]*vertex[ \t]+([^\r\n]+)", body, re.I | re.M)
    vertices = _coordinates(lines)
    if len(vertices) != 3 * len(re.findall(rb"^[ \t]*endloop\b", body, re.I | re.M)):
        raise InputError(
            "expected three vertices in each facet, found others; it is damaged: export it again", path=path
        )
    return Piece(decoded(name).strip(), vertices, np.arange(len(vertices)).reshape(-1, 3))


def _numbers(lines: Sequence[bytes], end: bytes, dtype: type) -> tuple[np.ndarray, Ints]:
    """Return the numbers of lines one after the other, and how many each has; ``end`` is a number that none has.

    Raises ValueError for other words in a line, and for ``end``.
    """
    text = b"".join((b" ", (b" %b " % end).join(lines), b" ", end)) if lines else b""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # of text after the last number that can be read
        try:
            numbers: np.ndarray = np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            raise ValueError("expected numbers alone in the lines of vertices and faces") from None
    last = np.isnan(numbers) if dtype is np.float64 else numbers == 0
    ends = np.flatnonzero(last)
    if len(ends) != len(lines):
        raise ValueError(f"expected no {end.decode()} in the lines of vertices and faces")
    return numbers[~last], np.diff(ends, prepend=-1) - 1


def _coordinates(lines: Sequence[bytes]) -> Floats:
    """Return the first three numbers of each line (n, 3); ValueError where a line has fewer."""
    numbers, counts = _numbers(lines, b"nan", np.float64)
    if (counts < 3).any():
        raise ValueError("expected x, y, z of each vertex")
    first = np.cumsum(counts) - counts
    return np.asarray(numbers[first[:, None] + np.arange(3)], np.float64)


def _obj(path: Path) -> list[Piece]:
    content = path.read_bytes()
    if b"\\" in content:
        content = re.sub(rb"\\[ \t]*\r?\n", b" ", content)  # a backslash continues a line
    vertices, faces = list[bytes](), list[bytes]()
    names, name_from = [b""], [0]  # a name, and the number of faces before its first
    seen, seen_from = [0], [0]  # of vertices, from so many faces on: negative numbers count back from there
    for line in content.splitlines():
        kind = line[:2]
        if kind not in (b"v ", b"f "):
            kind, _, rest = line.strip().replace(b"\t", b" ").partition(b" ")
            if kind in (b"o", b"g"):
                names.append(rest.strip())
                name_from.append(len(faces))
            if kind not in (b"v", b"f"):
                continue
            line = b"  " + rest
        if kind[:1] == b"v":
            vertices.append(line[2:])
            continue
        if seen[-1] != len(vertices):
            seen.append(len(vertices))
            seen_from.append(len(faces))
        faces.append(line[2:])
    if b"/" in content:
        faces = re.sub(rb"/\S*", b"", b"\n".join(faces)).split(b"\n")  # of v/vt/vn the first
    points = _coordinates(vertices)
    corners, counts = _numbers(faces, b"0", np.int64)
    before = np.repeat(seen, np.diff([*seen_from, len(faces)]))
    corners = np.where(corners > 0, corners - 1, np.repeat(before, counts) + corners)
    triangles = _cut(path, points, corners, counts)
    of = np.repeat(np.repeat(np.arange(len(names)), np.diff([*name_from, len(faces)])), np.maximum(counts - 2, 0))
    by_name: dict[bytes, list[int]] = {}
    for number in np.unique(of).tolist():
        by_name.setdefault(names[number], []).append(number)
    if len(by_name) == 1:
        return [Piece(decoded(next(iter(by_name))), points, triangles)]
    return [Piece(decoded(name), points, triangles[np.isin(of, which)]) for name, which in by_name.items()]
