"""E57 (ASTM E2807): several scans per file, each with a name and the pose of its scanner, in metres.

Points stay in the frame of their scan. Points with an invalid state are left out; the others keep the row and column of
the scanner's grid, if the scan has both.
"""

from __future__ import annotations

import datetime
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import processor.readers.pieces as pieces
from processor.large_arrays import allocate
from processor.model import Codes, Floats, InputError, Labels
from processor.readers.colours import scaled
from processor.readers.file_checks import errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name, without_empty

SUFFIXES = (".e57",)
UNIT = "m"
HEADER = struct.Struct("<8sIIQQQQ")  # signature, version, length, start and length of the XML, page
PAGE, PAYLOAD = 1024, 1020  # bytes of a page and of its content, before the checksum (ASTM E2807)
XML_LIMIT = 64 << 20  # bytes: a scan has some thousand of them; a damaged length would fill the memory
PIECE = 1 << 18  # points read at once: work, not result
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
LONGEST_NAME = 100  # characters: longer names of scans are replaced by a number, as names become file names
GRID = ("rowIndex", "columnIndex")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
# Atomic time of E57 counts in seconds from there (ASTM E2807); 300 years later a clock was not set.
GPS_BEGIN, LATEST_S = datetime.datetime(1980, 1, 6, tzinfo=datetime.timezone.utc), 1e10
MOST_LINES = 2**31 - 1  # rows or columns of a grid: they are stored as int32
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def needs_sandbox(path: Path) -> bool:
    """Whether the file is read in a separate process: always."""
    return True


def read(path: Path) -> list[RawScan]:
    """Read every scan of an E57 file."""
    import pye57

    _check_structure(path)
    with errors_name_the_file(path, "E57"), path.open("rb") as opened:
        # By its descriptor: the library accepts names in UTF-8 only.
        by_descriptor = Path(f"/proc/self/fd/{opened.fileno()}")
        file = pye57.E57(str(by_descriptor if by_descriptor.exists() else path))
        try:
            count = file.scan_count
            if not count:
                raise InputError("expected scans, found none", path=path)
            scan_names = names(scan_name(path), [_stored_name(file.get_header(i)) for i in range(count)])
            scans = [_read_scan(path, file, i, scan_names) for i in range(count)]
            empty = [name for name, scan in zip(scan_names, scans, strict=True) if scan is None]
            return without_empty(path, [scan for scan in scans if scan is not None], empty)
        finally:
            file.close()


def _check_structure(path: Path) -> None:
    """Raise InputError if the header contradicts the size of the file, or the XML declares types or entities.

    The XML of ASTM E2807 has neither; entities can expand without bound or refer to other files.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(b"ASTM-E57"):
            raise InputError("not a readable E57 file: it has no E57 header; copy or export it again", path=path)
        _, _, _, length, start, xml_length, page = HEADER.unpack(head)
        pages = -(-(start % PAGE + xml_length) // PAYLOAD) + 1
        if page != PAGE or length != size or start > size or xml_length > min(size, XML_LIMIT):
            raise InputError(f"its header does not fit its size of {size} bytes; copy or export it again", path=path)
        first = start // PAGE
        file.seek(first * PAGE)
        raw = file.read(pages * PAGE)
    # Each page ends in a checksum of four bytes.
    text = b"".join(raw[i : i + PAYLOAD] for i in range(0, len(raw), PAGE))
    text = text[start % PAGE : start % PAGE + xml_length]
    if text[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in text:
        raise InputError("expected XML in UTF-8, found another encoding; export it again", path=path)
    if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(
            "its XML declares a document type or entities, which is not allowed; export it again", path=path
        )
    declared = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", text.removeprefix(b"\xef\xbb\xbf"))
    if declared and declared[1].lower() not in (b"utf-8", b"utf8", b"us-ascii"):
        encoding = declared[1][:40].decode("latin-1")
        raise InputError(f"expected XML in UTF-8, found {encoding!r}; export it again", path=path)


def names(stem: str, stored: Sequence[str]) -> list[str]:
    """Return the names of the scans of a file, from the stem of the file and the names stored in it.

    A single scan has the name of the file, as in other formats. Of several scans each keeps its stored name if that is
    plain text and unique; the others are numbered.
    """
    if len(stored) == 1:
        return [stem]
    numbered = [f"{stem}-{number}" for number in range(1, len(stored) + 1)]
    mixed = [
        name if _is_plain(name) and stored.count(name) == 1 else number
        for name, number in zip(stored, numbered, strict=True)
    ]
    return mixed if len(set(mixed)) == len(mixed) else numbered


def _is_plain(name: str) -> bool:
    return bool(name.strip() == name and name.isprintable() and 0 < len(name) <= LONGEST_NAME and name[0] != ".") and (
        not set(name) & set("/\\")
    )


def _stored_name(header: Any) -> str:
    try:
        return str(header.node["name"].value()) if header.node.isDefined("name") else ""
    except UnicodeDecodeError:
        return ""


def _read_scan(path: Path, file: Any, index: int, scan_names: Sequence[str]) -> RawScan | None:
    """Return a scan of a file, None where it has no points, or none that is valid."""
    from pye57 import libe57

    name = scan_names[index]
    header = file.get_header(index)
    declared = int(header.point_count)
    if not declared:  # the library refuses to read it
        return None
    if declared > 8 * path.stat().st_size:  # less than a bit a point
        raise InputError(
            f"scan {index + 1} declares {declared} points, more than the file can hold; copy or export it again",
            path=path,
        )
    fields = set(header.point_fields)
    cartesian = fields.issuperset(CARTESIAN)
    if not cartesian and not fields.issuperset(SPHERICAL):
        raise InputError(
            f"expected Cartesian or spherical points in scan {name!r}, found {', '.join(sorted(fields))}", path=path
        )
    axes = CARTESIAN if cartesian else SPHERICAL
    points, intensity, cells, colour = _read_points(path, name, file, header, axes)
    if not len(points):
        return None
    pose = _pose(path, name, header) if header.has_pose() else np.empty(0)
    # Writers give single and merged clouds an identity pose too, so it is no evidence of a scanner's position.
    posed = pose.size > 0 and (len(scan_names) > 1 or bool((pose != np.eye(4)).any()))
    node = libe57.StructureNode(header.points.prototype())[axes[0]]
    return build_scan(
        path,
        name,
        points,
        unit=UNIT,
        intensity=intensity,
        colour=colour,
        position=np.zeros(3 if posed else 0),
        T_project_scan=pose,
        scanned=_day(file, header),
        single=isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE,
        **dict(zip(("grid_row", "grid_column"), cells, strict=False)),
    )


def _day(file: Any, header: Any) -> str:
    """Return the day (UTC) that a scan was begun, else that of the file, as far as the file states one.

    Times are seconds since the begin of GPS time; the leap seconds since then do not count for a day.
    """
    root = file.image_file.root()
    for node, name in ((header.node, "acquisitionStart"), (root, "creationDateTime")):
        if not node.isDefined(name) or not node[name].isDefined("dateTimeValue"):
            continue
        seconds = float(node[name]["dateTimeValue"].value())
        if 0.0 < seconds < LATEST_S:
            return (GPS_BEGIN + datetime.timedelta(seconds=seconds)).date().isoformat()
    return ""


def _read_points(
    path: Path, name: str, file: Any, header: Any, axes: Sequence[str]
) -> tuple[Floats, Floats, list[Labels], Codes]:
    """Return points (n, 3), intensities, if the scan has a grid rows and columns (n,), and colours of valid points."""
    declared, fields = int(header.point_count), set(header.point_fields)
    state = "cartesianInvalidState" if axes is CARTESIAN else "sphericalInvalidState"
    points = allocate(declared, 3)
    intensity = allocate(declared if "intensity" in fields else 0)
    data, buffers = file.make_buffers([*axes, *({state, "intensity"} & fields)], min(declared, PIECE) or 1)
    grid = _number_buffers(file, header, data, buffers, GRID)
    colours = _number_buffers(file, header, data, buffers, COLOURS)
    low, high = _colour_limits(header) if colours else (0.0, 255.0)
    colour = allocate(declared if colours else 0, 3, dtype=np.uint8)
    cells = [allocate(declared, dtype=np.int32) for _ in grid]
    reader = header.points.reader(buffers)
    read = count = 0
    while rows := reader.read():
        read += rows
        if read > declared:
            break
        valid = data[state][:rows] == 0 if state in data else slice(None)
        columns = [data[axis][:rows][valid] for axis in axes]
        part = slice(count, count + len(columns[0]))
        if axes is CARTESIAN:
            for i in range(3):
                points[part, i] = columns[i]
        else:
            points[part] = cartesian_from_spherical(*columns)
        if len(intensity):
            intensity[part] = data["intensity"][:rows][valid]
        if colours:
            colour[part] = scaled([data[name][:rows][valid] for name in colours], low, high)
        for field, lines in zip(grid, cells, strict=True):
            numbers = data[field][:rows][valid]
            # The comparisons are false for NaN.
            if len(numbers) and not (numbers.min() >= 0 and numbers.max() < MOST_LINES):
                grid, cells = (), []
                break
            lines[part] = numbers
        count = part.stop
        pieces.read(rows, read, declared)
    if read != declared:
        raise InputError(
            f"expected {declared} points in scan {name!r} as declared, found {read}; copy it again", path=path
        )
    return points[:count], intensity[:count], [lines[:count] for lines in cells], colour[:count]


def _number_buffers(
    file: Any, header: Any, data: dict[str, Any], buffers: Any, names: tuple[str, ...]
) -> tuple[str, ...]:
    """Add buffers for fields and return their ``names``: none if a field is missing or not a number.

    The library's default buffers of 16 bits fail on larger numbers; float64 holds all of them.
    """
    from pye57 import libe57

    capacity = min(int(header.point_count), PIECE) or 1
    prototype = libe57.StructureNode(header.points.prototype())
    numbers = (libe57.IntegerNode, libe57.ScaledIntegerNode, libe57.FloatNode)
    if not all(prototype.isDefined(name) and isinstance(prototype[name], numbers) for name in names):
        return ()
    for name in names:
        data[name] = np.empty(capacity)
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, data[name], capacity, True, True))
    return names


def _colour_limits(header: Any) -> tuple[float, float]:
    """Return the numbers of black and of full colour: as stated, else by the type of the numbers, else 0 to 255."""
    from pye57 import libe57

    node, limits = header.node, {}
    if node.isDefined("colorLimits"):
        for end in ("Minimum", "Maximum"):
            if node["colorLimits"].isDefined(f"colorRed{end}"):
                limits[end] = float(node["colorLimits"][f"colorRed{end}"].value())
    red = libe57.StructureNode(header.points.prototype())[COLOURS[0]]
    if len(limits) < 2 and isinstance(red, libe57.IntegerNode):
        limits = {"Minimum": float(red.minimum()), "Maximum": float(red.maximum())}
    low, high = limits.get("Minimum", 0.0), limits.get("Maximum", 255.0)
    return (low, high) if np.isfinite([low, high]).all() and low < high else (0.0, 255.0)


def cartesian_from_spherical(distance: Floats, azimuth: Floats, elevation: Floats) -> Floats:
    """Return points (n, 3) of ranges and angles (n,) in rad; the elevation is 0 at the horizon, as in ASTM E2807."""
    level = distance * np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def _pose(path: Path, name: str, header: Any) -> Floats:
    pose = np.eye(4)
    node = header.node["pose"]
    if node.isDefined("rotation"):
        w, x, y, z = (float(node["rotation"][key].value()) for key in "wxyz")
        length = float(np.sqrt(w * w + x * x + y * y + z * z))
        if not 0.99 < length < 1.01:
            raise InputError(
                f"the pose of scan {name!r} has a quaternion of length {length:g}, expected 1; export it again",
                path=path,
            )
        from scipy.spatial.transform import Rotation  # loaded in a quarter of a second, which other formats spare

        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    if node.isDefined("translation"):
        pose[:3, 3] = [float(node["translation"][key].value()) for key in "xyz"]
    if not np.isfinite(pose).all():
        raise InputError(f"the pose of scan {name!r} has numbers that are not finite; export it again", path=path)
    return pose
