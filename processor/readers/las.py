"""LAS and LAZ. Metres, unless the file's own coordinate system names feet."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import InputError
from processor.readers.raw import RawScan, check_room, make, parsing

SUFFIXES = (".las", ".laz")
UNIT = "m"
LAZ_LIMIT = 2_000  # no real file is packed more tightly than this
LINEAR_UNIT_KEYS = (3076, 4052)  # ProjLinearUnitsGeoKey, GeogLinearUnitsGeoKey of GeoTIFF
EPSG_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}


def read(path: Path) -> list[RawScan]:
    """Read a LAS or LAZ file as one scan."""
    import laspy

    _check_header(path)
    with parsing(path, "LAS"):
        las = laspy.read(str(path))
        xyz = np.asarray(las.xyz, np.float64)
        intensity = np.asarray(las.intensity, np.float64)
        station = np.asarray(las.point_source_id, np.int64)
        unit = _unit(las.header.vlrs)
        declared = int(las.header.point_count)
    if len(xyz) != declared:
        raise InputError(f"{path}: the header declares {declared} points, but {len(xyz)} were read; copy it again")
    # 0 in all of the file: it does not say.
    return [make(path, path.stem, xyz, unit=unit, intensity=intensity, station=station if station.any() else ())]


def _check_header(path: Path) -> None:
    """Hold the counts of the header (LAS 1.4 R15, table 3) against the file's size: laspy makes room for them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if not head.startswith(b"LASF") or len(head) < 227:
        raise InputError(f"{path}: not a readable LAS file: it has no LAS header; copy or export it again")
    start, vlrs, form, length, count = struct.unpack_from("<IIBHI", head, 96)
    extended_start, extended = 0, 0
    if head[25] >= 4 and len(head) >= 375:
        extended_start, extended, count = struct.unpack_from("<QIQ", head, 235)
    if not length or start > size or vlrs * 54 > start or extended * 60 > size or extended_start > size:
        raise InputError(f"{path}: the header's counts do not fit the file of {size} bytes; copy or export it again")
    packed = bool(form & 0xC0)
    check_room(path, "LAS", count, length / (LAZ_LIMIT if packed else 1), size - start)


def _unit(vlrs: Any) -> str:
    for vlr in vlrs:
        for key in getattr(vlr, "geo_keys", ()):
            if key.id in LINEAR_UNIT_KEYS and key.value_offset in EPSG_UNITS:
                return EPSG_UNITS[key.value_offset]
        # In WKT the unit of a projected system's axes is the last UNIT of the horizontal part.
        wkt = str(getattr(vlr, "string", "")).split("VERT_CS")[0]
        units = re.findall(r'UNIT\["([^"]*)",\s*([0-9.eE+-]+)', wkt) if "PROJCS" in wkt else []
        if units and 0.3 < float(units[-1][1]) < 0.31:
            return "us-ft" if "US" in units[-1][0].upper() else "ft"
    return UNIT
