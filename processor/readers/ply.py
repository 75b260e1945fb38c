"""PLY: ASCII or binary, of either byte order, float or double. The vertices are the points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from processor.model import InputError
from processor.readers.raw import INTENSITY_NAMES, STATION_NAMES, RawScan, check_room, first_named, make, parsing

SUFFIXES = (".ply",)
UNIT = ""
HEADER_LIMIT = 65_536
SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


def read(path: Path) -> list[RawScan]:
    """Read the vertices of a PLY file as one scan, with their intensity where there is one."""
    from plyfile import PlyData

    check_header(path)
    with parsing(path, "PLY"):
        vertex = PlyData.read(str(path))["vertex"].data
    fields = vertex.dtype.names or ()
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise InputError(f"{path}: expected vertices with x, y, z, found {', '.join(fields) or 'none'}")
    intensity = first_named(fields, INTENSITY_NAMES)
    xyz = np.stack([np.asarray(vertex[name], np.float64) for name in "xyz"], axis=1)
    station = first_named(fields, STATION_NAMES)
    return [
        make(
            path,
            path.stem,
            xyz,
            unit=UNIT,
            intensity=vertex[intensity] if intensity else (),
            station=vertex[station] if station else (),
        )
    ]


def check_header(path: Path) -> None:
    """Hold the numbers that a header declares against the file's size, before anything makes room for them.

    Raises InputError where the file has too few or too many bytes, and for a file without a header.
    """
    with path.open("rb") as file:
        head = file.read(HEADER_LIMIT)
    end = head.find(b"end_header")
    stop = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or stop < 0:
        raise InputError(f"{path}: not a readable PLY file: it has no PLY header; copy or export it again")
    room = path.stat().st_size - stop - 1
    ascii_rows, least, exact, count = False, 0, True, 0
    for line in head[:end].decode("latin-1").splitlines():
        words = line.split() or [""]
        with parsing(path, "PLY"):
            if words[0] == "format":
                ascii_rows = words[1] == "ascii"
            elif words[0] == "element":
                count = int(words[2])
                check_room(path, "PLY", count, 1, room)
            elif words[0] == "property":
                listed = words[1] == "list"
                exact = exact and not listed
                least += count * (2 if ascii_rows else SIZES[words[2 if listed else 1]])
    # The last number of an ASCII file needs no separator after it.
    if least > room + ascii_rows:
        raise InputError(
            f"{path}: the header declares {least} bytes of data or more, but {room} follow; "
            "the file is cut off or damaged: copy or export it again"
        )
    if exact and not ascii_rows and least < room:
        raise InputError(
            f"{path}: the header declares {least} bytes of data, but {room} follow; "
            "the header does not fit the file: export it again"
        )
