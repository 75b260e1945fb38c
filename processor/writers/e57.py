"""E57 files (ASTM E2807) in double precision: several scans, each with its pose, Cartesian or spherical.

The library's own function rounds coordinates to 32 bits, which at map coordinates loses decimetres. Scalar fields are
written under an extension's prefix, as the standard requires; numbers of stations are not, as each scan is of one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats
from processor.writers.cloud import BLOCK, COLOURS, COLUMN, INTENSITY, METRES, ROW, STATION, Cloud

STANDARD = {INTENSITY: "intensity", ROW: "rowIndex", COLUMN: "columnIndex"}
STANDARD |= {name: f"color{name.title()}" for name in COLOURS}
PREFIX, EXTENSION = "ssc", "urn:steel-scan-check:scalar-fields"
DESCRIPTION = "written by steel-scan-check"
LARGEST = 2**31 - 1  # of int32, as readers store rows and columns
COLOUR_ENDS = (("Minimum", 0), ("Maximum", 255))  # of 8 bits
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def write(path: Path, clouds: Sequence[Cloud], *, spherical: bool = False) -> list[int]:
    """Write clouds in metres, a scan each, with ``T_project_scan`` as pose where there is one.

    Returns the number of points of each. Raises OSError where the file cannot be written.
    """
    from pye57 import libe57

    try:
        return _write(path, clouds, spherical=spherical)
    except libe57.E57Exception as error:
        raise OSError(0, f"E57: {str(error).strip().splitlines()[0]}") from error


def _write(path: Path, clouds: Sequence[Cloud], *, spherical: bool) -> list[int]:
    from pye57 import libe57

    image = libe57.ImageFile(str(path), "w")
    whole = False
    try:
        image.extensionsAdd("", libe57.E57_V1_0_URI)
        if any(name not in STANDARD for cloud in clouds for name in _kept(cloud)):
            image.extensionsAdd(PREFIX, EXTENSION)
        root, vector = image.root(), libe57.VectorNode(image, True)
        guids = [_guid(f"{number} {cloud.name}".encode(), cloud.identity) for number, cloud in enumerate(clouds)]
        header = {
            "formatName": "ASTM E57 3D Imaging Data File",
            "guid": _guid(*(guid.encode() for guid in guids)),
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
        counts = [
            _write_scan(image, vector, cloud, guid, spherical=spherical)
            for guid, cloud in zip(guids, clouds, strict=True)
        ]
        image.close()
        whole = True
    finally:
        if not whole:
            image.cancel()
    return counts


def names_read(stem: str, names: Sequence[str]) -> list[str]:
    """Return the names that a reader gives to several scans of a file: theirs, or numbers where they are unsuitable."""
    read = []
    for number, name in enumerate(names, 1):
        odd = not name.isprintable() or name != name.strip() or len(name) > 100
        odd = odd or not name or name.startswith(".") or "/" in name or "\\" in name
        read.append(f"{stem}-{number}" if odd else name)
    return read if len(set(read)) == len(read) else [f"{stem}-{number}" for number in range(1, len(names) + 1)]


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


def _kept(cloud: Cloud) -> list[str]:
    """Return the columns that are written."""
    return [name for name in cloud.fields if name != STATION]


def _type(image: Any, cloud: Cloud, name: str) -> Any:
    """Return the node of the type of a column."""
    from pye57 import libe57

    dtype = np.dtype(cloud.fields[name])
    if dtype.kind == "f":
        single = name == INTENSITY or dtype.itemsize == 4
        return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE if single else libe57.E57_DOUBLE)
    if name in COLOURS:
        return libe57.IntegerNode(image, 0, 0, 255)
    least = 0 if name in STANDARD else int(np.iinfo(dtype).min)
    most = cloud.largest.get(name, LARGEST if name in STANDARD else int(np.iinfo(dtype).max))
    return libe57.IntegerNode(image, max(least, 0), least, most)


def _write_scan(image: Any, scans: Any, cloud: Cloud, guid: str, *, spherical: bool) -> int:
    from pye57 import libe57

    node = _structure(image, {"guid": guid, "name": cloud.name, "description": DESCRIPTION})
    if cloud.T_project_scan.size:
        w, x, y, z = quaternion(cloud.T_project_scan[:3, :3])
        t = cloud.T_project_scan[:3, 3] * METRES
        rotation = _structure(image, {"w": w, "x": x, "y": y, "z": z})
        translation = _structure(image, {"x": float(t[0]), "y": float(t[1]), "z": float(t[2])})
        node.set("pose", _structure(image, {"rotation": rotation, "translation": translation}))
    if COLOURS[0] in cloud.fields:
        colours = {f"color{name.title()}{end}": value for name in COLOURS for end, value in COLOUR_ENDS}
        node.set("colorLimits", _structure(image, colours))
    stored = {name: STANDARD.get(name, f"{PREFIX}:{name}") for name in _kept(cloud)}
    prototype = libe57.StructureNode(image)
    for name in SPHERICAL if spherical else CARTESIAN:
        prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE))
    for name in stored:
        prototype.set(stored[name], _type(image, cloud, name))
    vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    node.set("points", vector)
    scans.append(node)
    count, bright = _write_points(image, vector, cloud, stored, spherical=spherical)
    if INTENSITY in cloud.fields and count:
        limits = {"intensityMinimum": bright[0], "intensityMaximum": bright[1]}
        node.set("intensityLimits", _structure(image, limits))
    return count


def _write_points(
    image: Any, vector: Any, cloud: Cloud, stored: Mapping[str, str], *, spherical: bool
) -> tuple[int, tuple[float, float]]:
    """Write the points; return their number, and the least and greatest intensity."""
    from pye57 import libe57

    axes = SPHERICAL if spherical else CARTESIAN
    arrays: dict[str, Any] = {name: np.empty(BLOCK) for name in axes}
    for name in stored:
        dtype = cloud.fields[name]
        # The library takes the type "long" for 32 bits.
        arrays[stored[name]] = np.empty(BLOCK, dtype if np.dtype(dtype).kind == "f" else np.longlong)
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, BLOCK, True, True))
    writer = vector.writer(buffers)
    count, low, high = 0, np.inf, -np.inf
    try:
        for block in cloud.blocks():
            for first in range(0, len(block.points), BLOCK):
                rows = slice(first, first + BLOCK)
                points = (block.points[rows] + cloud.origin) * METRES
                columns = dict(zip(axes, (_spherical(points) if spherical else points).T, strict=True))
                columns |= {field: block.fields[name][rows] for name, field in stored.items()}
                for name, column in columns.items():
                    arrays[name][: len(points)] = column
                writer.write(len(points))
                count += len(points)
            if INTENSITY in cloud.fields and len(block.points):
                bright = block.fields[INTENSITY]
                low, high = min(low, float(bright.min())), max(high, float(bright.max()))
        writer.close()
    finally:
        del writer  # before the file is closed after an error: the library crashes where a writer outlives its file
    return count, (low, high)


def _spherical(points: Floats) -> Floats:
    """Return range, azimuth and elevation (n, 3) of points (n, 3) as defined by ASTM E2807."""
    level = np.hypot(points[:, 0], points[:, 1])
    azimuth, elevation = np.arctan2(points[:, 1], points[:, 0]), np.arctan2(points[:, 2], level)
    return np.stack([np.hypot(level, points[:, 2]), azimuth, elevation], axis=1)


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
