"""Binary PLY files with coordinates as doubles, mm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, Ints


def records(columns: Mapping[str, Any]) -> np.ndarray:
    """Return columns (n,) by name as records (n,) in little-endian order."""
    result = np.empty(len(columns["x"]), [(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    for name, column in columns.items():
        result[name] = column
    return result


def write_columns(path: Path, columns: Mapping[str, Any], faces: Ints | None = None) -> None:
    """Write vertices from columns (n,) by name, with their types, and triangles (f, 3)."""
    from plyfile import PlyData, PlyElement

    elements = [PlyElement.describe(records(columns), "vertex")]
    if faces is not None:
        face = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
        face["vertex_indices"] = faces
        elements.append(PlyElement.describe(face, "face"))
    PlyData(elements, byte_order="<").write(str(path))


def write_mesh(path: Path, vertices: Floats, faces: Ints) -> None:
    """Write a mesh of vertices (v, 3), mm, and triangles (f, 3)."""
    write_columns(path, {axis: vertices[:, i] for i, axis in enumerate("xyz")}, faces)
