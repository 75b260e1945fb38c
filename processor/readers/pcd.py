"""PCD: ASCII, binary or binary_compressed. Points of an organised cloud without a return are NaN and are left out.

VIEWPOINT is not used: programs differ on whether the points are to be moved by it.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import InputError
from processor.readers.raw import INTENSITY_NAMES, STATION_NAMES, RawScan, check_room, first_named, make, parsing

SUFFIXES = (".pcd",)
UNIT = ""
HEADER_LIMIT = 65_536
LZF_LIMIT = 100  # a match of LZF turns 3 bytes into at most 264


def read(path: Path) -> list[RawScan]:
    """Read a PCD file as one scan."""
    from pypcd4.pypcd4 import MetaData, PointCloud

    with path.open("rb") as file:
        head = file.read(HEADER_LIMIT)
    data = head.find(b"\nDATA ")
    stop = head.find(b"\n", data + 1)
    if data < 0 or stop < 0:
        raise InputError(f"{path}: not a readable PCD file: it has no DATA line; copy or export it again")
    lines = [line.strip() for line in head[:stop].decode("latin-1").splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    with parsing(path, "PCD"):
        meta = MetaData.parse_header(lines)
        row = meta.build_dtype().itemsize
        lengths = {len(meta.fields), len(meta.size), len(meta.type), len(meta.count)}
    if len(lengths) != 1:
        raise InputError(f"{path}: FIELDS, SIZE, TYPE and COUNT differ in length; export the file again")
    if meta.width * meta.height != meta.points:
        raise InputError(f"{path}: WIDTH {meta.width} x HEIGHT {meta.height} is not POINTS {meta.points}")
    room = path.stat().st_size - stop - 1
    encoding = meta.data.value
    least = {"ascii": 2 * sum(meta.count), "binary": row}.get(encoding, row / LZF_LIMIT)
    check_room(path, "PCD", meta.points, least, room + (encoding == "ascii"))
    with parsing(path, "PCD"):
        # Runs of blanks are one separator, which the library does not know; and its header ends at ten lines.
        content = path.read_bytes()
        body = b"\n".join(b" ".join(line.split()) for line in content[stop + 1 :].splitlines())
        text = "\n".join(lines).encode() + b"\n"
        stream: Any = io.BytesIO(text + (body if encoding == "ascii" else content[stop + 1 :]))
        rows = np.atleast_1d(PointCloud.from_fileobj(stream).pc_data)
    if len(rows) != meta.points:
        raise InputError(f"{path}: POINTS declares {meta.points}, but {len(rows)} were found; copy or export it again")
    missing = [name for name in "xyz" if name not in meta.fields]
    if missing:
        raise InputError(f"{path}: expected FIELDS with x, y, z, found {' '.join(meta.fields)}")
    xyz = np.stack([np.asarray(rows[name], np.float64) for name in "xyz"], axis=1)
    valid = ~np.isnan(xyz).any(axis=1)
    intensity = first_named(meta.fields, INTENSITY_NAMES)
    station = first_named(meta.fields, STATION_NAMES)
    return [
        make(
            path,
            path.stem,
            xyz[valid],
            unit=UNIT,
            intensity=rows[intensity][valid] if intensity else (),
            station=rows[station][valid] if station else (),
        )
    ]
