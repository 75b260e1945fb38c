"""E57 (ASTM E2807): several scans a file, each named and with the pose of its scanner, in whose frame points stay.

Points whose invalid state is set are no returns and are left out; the others keep the row and column of the scanner's
grid, where the scan has both. SI metres.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import Floats, InputError
from processor.readers.common import RawScan, make, parsing, room_for, stem

SUFFIXES = (".e57",)
UNIT = "m"
HEADER = struct.Struct("<8sIIQQQQ")  # signature, version, length, start and length of the XML, page
PAGE, PAYLOAD = 1024, 1020
XML_LIMIT = 64 << 20
PIECE = 1 << 18
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
LONGEST_NAME = 100
GRID = ("rowIndex", "columnIndex")
MOST_LINES = 2**31 - 1  # of a grid whose rows and columns fit their type
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def apart(path: Path) -> bool:
    """Whether the file is read in a process of its own."""
    return True


def read(path: Path) -> list[RawScan]:
    """Read every scan of an E57 file."""
    import pye57

    _check_structure(path)
    with parsing(path, "E57"), path.open("rb") as opened:
        # By its descriptor, as the library takes names in UTF-8 alone.
        by_descriptor = Path(f"/proc/self/fd/{opened.fileno()}")
        file = pye57.E57(str(by_descriptor if by_descriptor.exists() else path))
        try:
            count = file.scan_count
            if not count:
                raise InputError(f"{path}: holds no scans")
            called = names(stem(path), [_own_name(file.get_header(i)) for i in range(count)])
            return [_read_scan(path, file, i, called) for i in range(count)]
        finally:
            file.close()


def _check_structure(path: Path) -> None:
    """Refuse a file whose header does not fit its size, and XML that declares types or entities of its own.

    The XML of ASTM E2807 has neither; entities can be made to grow without bound or to name other files.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(b"ASTM-E57"):
            raise InputError(f"{path}: not a readable E57 file: it has no E57 header; copy or export it again")
        _, _, _, length, start, xml_length, page = HEADER.unpack(head)
        pages = -(-(start % PAGE + xml_length) // PAYLOAD) + 1
        if page != PAGE or length != size or start > size or xml_length > min(size, XML_LIMIT):
            raise InputError(f"{path}: its header does not fit a file of {size} bytes; copy or export it again")
        first = start // PAGE
        file.seek(first * PAGE)
        raw = file.read(pages * PAGE)
    # Each page ends in a check sum of four bytes.
    text = b"".join(raw[i : i + PAYLOAD] for i in range(0, len(raw), PAGE))
    text = text[start % PAGE : start % PAGE + xml_length]
    if text[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in text:
        raise InputError(f"{path}: its XML is not in UTF-8, as the format has it; export it again")
    if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(f"{path}: its XML declares a document type or entities, which scans have not; it is not read")
    declared = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", text.removeprefix(b"\xef\xbb\xbf"))
    if declared and declared[1].lower() not in (b"utf-8", b"utf8", b"us-ascii"):
        raise InputError(f"{path}: its XML is in {declared[1][:40]!r}, expected UTF-8; export it again")


def names(stem: str, own: Sequence[str]) -> list[str]:
    """Return how the scans of a file are called, by the file's stem and their own names in it.

    A lone scan is named by the file, as in other formats. Of several each keeps its own name where that is plain text
    and no other's; the rest are numbered.
    """
    if len(own) == 1:
        return [stem]
    found = [
        name if _is_plain(name) and own.count(name) == 1 else f"{stem}-{number}" for number, name in enumerate(own, 1)
    ]
    return found if len(set(found)) == len(found) else [f"{stem}-{number}" for number in range(1, len(own) + 1)]


def _is_plain(name: str) -> bool:
    return bool(name.strip() == name and name.isprintable() and 0 < len(name) <= LONGEST_NAME and name[0] != ".") and (
        not set(name) & set("/\\")
    )


def _own_name(header: Any) -> str:
    try:
        return str(header.node["name"].value()) if header.node.isDefined("name") else ""
    except UnicodeDecodeError:
        return ""


def _read_scan(path: Path, file: Any, index: int, called: Sequence[str]) -> RawScan:
    name, count = called[index], len(called)
    header = file.get_header(index)
    declared = int(header.point_count)
    if declared > 8 * path.stat().st_size:  # less than a bit for a point
        raise InputError(f"{path}: scan {index + 1} declares {declared} points, more than the file can hold")
    fields = set(header.point_fields)
    cartesian = fields.issuperset(CARTESIAN)
    if not cartesian and not fields.issuperset(SPHERICAL):
        raise InputError(f"{path}: scan {name!r} has neither Cartesian nor spherical points ({', '.join(fields)})")
    state = "cartesianInvalidState" if cartesian else "sphericalInvalidState"
    axes = CARTESIAN if cartesian else SPHERICAL
    wanted = [*axes, *({state, "intensity"} & fields)]
    points = room_for(declared, 3)
    intensity = room_for(declared if "intensity" in fields else 0)
    data, buffers = file.make_buffers(wanted, min(declared, PIECE) or 1)
    grid = _grid_buffers(file, header, data, buffers, min(declared, PIECE) or 1)
    cells = [room_for(declared, dtype=np.int32) for _ in grid]
    reader = header.points.reader(buffers)
    read = found = 0
    while declared and (rows := reader.read()):
        read += rows
        if read > declared:
            break
        valid = data[state][:rows] == 0 if state in data else slice(None)
        columns = [data[axis][:rows][valid] for axis in axes]
        kept = len(columns[0])
        xyz = points[found : found + kept]
        if cartesian:
            for i in range(3):
                xyz[:, i] = columns[i]
        else:
            xyz[:] = cartesian_from_spherical(*columns)
        if len(intensity):
            intensity[found : found + kept] = data["intensity"][:rows][valid]
        for field, lines in zip(grid, cells, strict=True):
            numbers = data[field][:rows][valid]
            # Written so that NaN is refused as well.
            if kept and not (numbers.min() >= 0 and numbers.max() < MOST_LINES):
                grid, cells = (), []
                break
            lines[found : found + kept] = numbers
        found += kept
    if read != declared:
        raise InputError(f"{path}: scan {name!r} declares {declared} points but holds {read}; copy it again")
    if declared and not found:
        raise InputError(f"{path}: scan {name!r} holds no returns: all of its {declared} points are marked invalid")
    pose = _pose(path, name, header) if header.has_pose() else np.empty(0)
    # Writers give a lone or merged cloud an identity pose too, so it says nothing of where a scanner stood.
    posed = pose.size > 0 and (count > 1 or bool((pose != np.eye(4)).any()))
    return make(
        path,
        name,
        points[:found],
        unit=UNIT,
        intensity=intensity[:found],
        position=np.zeros(3) if posed else (),
        T_project_scan=pose,
        grid=(cells[0][:found], cells[1][:found]) if cells else None,
        single=_is_single(header, axes[0]),
    )


def _grid_buffers(file: Any, header: Any, data: dict[str, Any], buffers: Any, capacity: int) -> tuple[str, ...]:
    """Have the grid's fields read along, and return their names: none where one is missing or is no number.

    The library's own buffers of 16 bits refuse larger numbers, and the file with them; doubles hold whatever comes.
    """
    from pye57 import libe57

    prototype = libe57.StructureNode(header.points.prototype())
    numbers = (libe57.IntegerNode, libe57.ScaledIntegerNode, libe57.FloatNode)
    if not all(prototype.isDefined(name) and isinstance(prototype[name], numbers) for name in GRID):
        return ()
    for name in GRID:
        data[name] = np.empty(capacity)
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, data[name], capacity, True, True))
    return GRID


def _is_single(header: Any, field: str) -> bool:
    from pye57 import libe57

    node = libe57.StructureNode(header.points.prototype())[field]
    return isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE


def cartesian_from_spherical(distance: Floats, azimuth: Floats, elevation: Floats) -> Floats:
    """Points (n, 3) of ranges and angles (n,) in rad; the elevation is 0 at the horizon, as in ASTM E2807."""
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _pose(path: Path, name: str, header: Any) -> Floats:
    pose = np.eye(4)
    node = header.node["pose"]
    if node.isDefined("rotation"):
        w, x, y, z = (float(node["rotation"][key].value()) for key in "wxyz")
        length = float(np.sqrt(w * w + x * x + y * y + z * z))
        if not 0.99 < length < 1.01:
            raise InputError(f"{path}: the pose of scan {name!r} has a quaternion of length {length:g}, expected 1")
        w, x, y, z = w / length, x / length, y / length, z / length
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    if node.isDefined("translation"):
        pose[:3, 3] = [float(node["translation"][key].value()) for key in "xyz"]
    if not np.isfinite(pose).all():
        raise InputError(f"{path}: the pose of scan {name!r} holds numbers that are not finite")
    return pose
