"""E57 files (ASTM E2807) in double precision: several scans, each with its pose, Cartesian or spherical.

The library's own function rounds coordinates to 32 bits, which at map coordinates loses decimetres.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from designgen.export import METRES
from processor.model import Floats, Scan

CHUNK = 1_000_000


def write(path: Path, scans: Sequence[Scan], *, spherical: bool) -> None:
    """Write all scans in metres; points in the scan's frame, with ``T_project_scan`` as pose where there is one."""
    from pye57 import libe57

    image = libe57.ImageFile(str(path), "w")
    try:
        image.extensionsAdd("", libe57.E57_V1_0_URI)
        root, vector = image.root(), libe57.VectorNode(image, True)
        header = {
            "formatName": "ASTM E57 3D Imaging Data File",
            "guid": _guid(*(scan.name.encode() + scan.points.tobytes() for scan in scans)),
            "versionMajor": libe57.E57_FORMAT_MAJOR,
            "versionMinor": libe57.E57_FORMAT_MINOR,
            "e57LibraryVersion": libe57.E57_LIBRARY_ID,
            "coordinateMetadata": "",
            "creationDateTime": _structure(image, {"dateTimeValue": 0.0, "isAtomicClockReferenced": 0}),
            "data3D": vector,
            "images2D": libe57.VectorNode(image, True),
        }
        for name, value in header.items():
            root.set(name, _node(image, value))
        for number, scan in enumerate(scans):
            _write_scan(image, vector, scan, number, spherical=spherical)
    finally:
        image.close()


def names_read(stem: str, scans: Sequence[Scan]) -> list[str]:
    """Return the names a reader gives to several scans of a file: their own, or numbers where they are unsuitable."""
    names = []
    for number, scan in enumerate(scans, 1):
        odd = not scan.name.isprintable() or scan.name != scan.name.strip() or len(scan.name) > 100
        odd = odd or not scan.name or scan.name.startswith(".") or "/" in scan.name or "\\" in scan.name
        names.append(f"{stem}-{number}" if odd else scan.name)
    return names if len(set(names)) == len(names) else [f"{stem}-{number}" for number in range(1, len(scans) + 1)]


def _guid(*content: bytes) -> str:
    """Return an identifier computed from the content, so that the same scans give the same file."""
    digest = hashlib.sha256(b"".join(content)).hexdigest()
    return f"{{{digest[:8]}-{digest[8:12]}-{digest[12:16]}-{digest[16:20]}-{digest[20:32]}}}"


def _node(image: Any, value: Any) -> Any:
    from pye57 import libe57

    if isinstance(value, float):
        return libe57.FloatNode(image, value)
    if isinstance(value, int):
        return libe57.IntegerNode(image, value)
    return libe57.StringNode(image, value) if isinstance(value, str) else value


def _structure(image: Any, values: Mapping[str, Any]) -> Any:
    from pye57 import libe57

    node = libe57.StructureNode(image)
    for name, value in values.items():
        node.set(name, _node(image, value))
    return node


def _write_scan(image: Any, scans: Any, scan: Scan, number: int, *, spherical: bool) -> None:
    from pye57 import libe57

    points = (scan.points + scan.origin) * METRES
    columns: dict[str, Any] = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
    if spherical:
        columns = _spherical(points)
    types: dict[str, Any] = {name: libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE) for name in columns}
    if len(scan.intensity):
        columns["intensity"] = scan.intensity
        low, high = float(scan.intensity.min()), float(scan.intensity.max())
        types["intensity"] = libe57.FloatNode(image, low, libe57.E57_SINGLE, low, high)
    # A merged cloud has no grid of its own: the numbers of its scans repeat.
    if len(scan.grid_row) and not len(scan.point_station):
        for name, cells in (("rowIndex", scan.grid_row), ("columnIndex", scan.grid_column)):
            columns[name] = cells.astype(np.longlong)  # the library takes the type "long" for 32 bits
            least, most = int(cells.min()), int(cells.max())
            types[name] = libe57.IntegerNode(image, least, least, most)
    guid = _guid(f"{number} {scan.name}".encode(), points.tobytes())
    node = _structure(image, {"guid": guid, "name": scan.name, "description": "synthetic scan"})
    if scan.T_project_scan.size:
        w, x, y, z = quaternion(scan.T_project_scan[:3, :3])
        t = scan.T_project_scan[:3, 3] * METRES
        rotation = _structure(image, {"w": w, "x": x, "y": y, "z": z})
        translation = _structure(image, {"x": float(t[0]), "y": float(t[1]), "z": float(t[2])})
        node.set("pose", _structure(image, {"rotation": rotation, "translation": translation}))
    prototype = libe57.StructureNode(image)
    for name, type_ in types.items():
        prototype.set(name, type_)
    vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", vector)
    scans.append(node)
    arrays = {name: np.empty(CHUNK, column.dtype) for name, column in columns.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, CHUNK, True, True))
    writer = vector.writer(buffers)
    for start in range(0, len(points), CHUNK):
        count = min(CHUNK, len(points) - start)
        for name, column in columns.items():
            arrays[name][:count] = column[start : start + count]
        writer.write(count)
    writer.close()


def _spherical(points: Floats) -> dict[str, Any]:
    """Return range, azimuth and elevation of points (n, 3) as defined by ASTM E2807."""
    level = np.hypot(points[:, 0], points[:, 1])
    return {
        "sphericalRange": np.hypot(level, points[:, 2]),
        "sphericalAzimuth": np.arctan2(points[:, 1], points[:, 0]),
        "sphericalElevation": np.arctan2(points[:, 2], level),
    }


def quaternion(R: Floats) -> tuple[float, float, float, float]:
    """Return w >= 0, x, y, z of a rotation (3, 3), by the method of Shepperd (1978), which avoids small divisors."""
    squares = np.array([np.trace(R), R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(squares))
    if k == 0:
        q = np.array([1.0 + squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = np.empty(4)
        q[0], q[1 + i] = R[m, j] - R[j, m], 1.0 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j], q[1 + m] = R[i, j] + R[j, i], R[i, m] + R[m, i]
    q *= (1.0 if q[0] >= 0.0 else -1.0) / np.linalg.norm(q)
    w, x, y, z = q.tolist()
    return w, x, y, z
