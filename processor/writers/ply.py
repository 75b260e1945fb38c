"""Binary PLY: clouds with coordinates as doubles, mm, and triangle meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, Ints
from processor.writers.cloud import GRID, Cloud

REALS = {"f8": "double", "f4": "float"}
TYPES = REALS | {"i4": "int", "u4": "uint", "i2": "short", "u2": "ushort", "i1": "char", "u1": "uchar"}
DIGITS = 12  # of a count that is known at the end alone


def records(columns: Mapping[str, Any]) -> np.ndarray:
    """Return columns (n,) by name as records (n,) in little-endian order."""
    result = np.empty(len(columns["x"]), [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        result[name] = column
    return result


def write(path: Path, cloud: Cloud) -> int:
    """Write a cloud in mm with its columns, but for the scanner's grid; return the number of points."""
    kept = [name for name in cloud.fields if name not in GRID]
    count = 0
    with path.open("wb") as file:
        file.write(_header(cloud, kept, cloud.count or 0))
        for block in cloud.blocks():
            columns = dict(zip("xyz", (block.points + cloud.origin).T, strict=True))
            columns |= {name: np.asarray(block.fields[name], cloud.fields[name]) for name in kept}
            file.write(records(columns).data)
            count += len(block.points)
        file.seek(0)
        file.write(_header(cloud, kept, count))
    return count


def _header(cloud: Cloud, kept: list[str], count: int) -> bytes:
    width = DIGITS if cloud.count is None else 1
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in cloud.comments)]
    lines += [f"element vertex {count:{width}d}", *(f"property double {axis}" for axis in "xyz")]
    lines += [f"property {TYPES[np.dtype(cloud.fields[name]).str[1:]]} {name}" for name in kept]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def write_mesh(path: Path, vertices: Floats, faces: Ints) -> None:
    """Write a mesh of vertices (v, 3), mm, and triangles (f, 3)."""
    from plyfile import PlyData, PlyElement

    face = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
    face["vertex_indices"] = faces
    points = records({axis: vertices[:, i] for i, axis in enumerate("xyz")})
    PlyData([PlyElement.describe(points, "vertex"), PlyElement.describe(face, "face")], byte_order="<").write(str(path))
