"""LAS and LAZ. Metres, unless the coordinate system of the file is in feet."""

from __future__ import annotations

import dataclasses
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

import processor.readers.pieces as pieces
from processor.large_arrays import allocate
from processor.model import InputError
from processor.readers.colours import coloured
from processor.readers.file_checks import check_declared_points, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name

SUFFIXES = (".las", ".laz")
UNIT = "m"
# Bytes of the header and of records (LAS 1.4 R15, tables 3, 7 and 8).
LEAST_HEADER, HEADER_1_4 = 227, 375
VERSION_MINOR_AT, COUNTS_AT, POINT_FORMAT_AT, EXTENDED_AT = 25, 96, 104, 235
VLR_HEADER, EVLR_HEADER = 54, 60
PIECE = 1_000_000
COLOURS = ("red", "green", "blue")
PACKED = 0xC0  # bits of the point format
LAZ_LIMIT = 2_000  # compression ratio that no real file exceeds
LINEAR_UNIT_KEYS = (3076, 4052)  # ProjLinearUnitsGeoKey, GeogLinearUnitsGeoKey of GeoTIFF
VERTICAL_UNIT_KEY, MODEL_KEY, GEOGRAPHIC = 4099, 1024, 2
EPSG_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}


def needs_sandbox(path: Path) -> bool:
    """Whether the file is read in a separate process: if it is compressed, as native code decompresses it."""
    with path.open("rb") as file:
        head = file.read(POINT_FORMAT_AT + 1)
    return len(head) > POINT_FORMAT_AT and bool(head[POINT_FORMAT_AT] & PACKED)


def read(path: Path) -> list[RawScan]:
    """Read a LAS or LAZ file as one scan."""
    import laspy

    _check_header(path)
    count, named = 0, False
    with errors_name_the_file(path, "LAS"), laspy.open(str(path)) as file:
        header = file.header
        fits_degrees = bool((np.abs([header.mins, header.maxs])[:, :2] <= [180.0, 90.0]).all())
        unit = _unit(path, [*header.vlrs, *(header.evlrs or [])], fits_degrees)
        declared = int(header.point_count)
        day = "" if header.creation_date is None else header.creation_date.isoformat()
        if not np.isfinite([header.scales, header.offsets]).all() or not np.all(header.scales):
            raise InputError(
                f"expected finite scales and offsets, and scales other than 0, found {header.scales} and "
                f"{header.offsets}; export it again",
                path=path,
            )
        points, intensity = allocate(declared, 3), allocate(declared)
        station = allocate(declared, dtype=np.uint16)
        colours = COLOURS if set(COLOURS) <= set(header.point_format.dimension_names) else ()
        colour = [allocate(declared, dtype=np.uint16) for _ in colours]
        for piece in file.chunk_iterator(PIECE):
            rows = slice(count, count + len(piece))
            for i, axis in enumerate("XYZ"):
                coordinate = points[rows, i]
                np.multiply(piece[axis], header.scales[i], out=coordinate)
                coordinate += header.offsets[i]
            intensity[rows] = piece["intensity"]
            station[rows] = piece["point_source_id"]
            for name, column in zip(colours, colour, strict=True):
                column[rows] = piece[name]
            count += len(piece)
            pieces.read(len(piece), count, declared)
            named = named or bool(station[rows].any())
    if count != declared:
        raise InputError(f"expected {declared} points as declared, found {count}; copy it again", path=path)
    # 0 in all points: the stations are unknown.
    scan = build_scan(path, scan_name(path), points, unit=unit, intensity=intensity, station=station if named else ())
    return [dataclasses.replace(coloured(scan, colour), scanned=day)]


def _check_header(path: Path) -> None:
    """Check the counts of the header (LAS 1.4 R15, table 3) against the size of the file: laspy allocates by them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER_1_4)
    if not head.startswith(b"LASF") or len(head) < LEAST_HEADER:
        raise InputError("not a readable LAS file: it has no LAS header; copy or export it again", path=path)
    start, vlrs, form, length, count = struct.unpack_from("<IIBHI", head, COUNTS_AT)
    extended_start, extended = 0, 0
    if head[VERSION_MINOR_AT] >= 4 and len(head) >= HEADER_1_4:
        extended_start, extended, count = struct.unpack_from("<QIQ", head, EXTENDED_AT)
    if (
        not length
        or start > size
        or vlrs * VLR_HEADER > start
        or extended * EVLR_HEADER > size
        or extended_start > size
    ):
        raise InputError(f"the header's counts do not fit the file of {size} bytes; copy or export it again", path=path)
    packed = bool(form & PACKED)
    check_declared_points(path, "LAS", count, length / (LAZ_LIMIT if packed else 1), size - start)
    # From version 1.3 on, other data may follow the points.
    if not packed and head[VERSION_MINOR_AT] < 3 and size - start - count * length >= length:
        raise InputError(
            f"the header declares {count} points, but there is room for {(size - start) // length}; "
            "the file was not finished or its header is damaged: export it again",
            path=path,
        )


def _unit(path: Path, vlrs: Any, fits_degrees: bool) -> str:
    """Return the unit of the coordinate system. Raises InputError for degrees, and for heights in another unit.

    A system in degrees is ignored, as a mistake of the writer, if the coordinates exceed those of degrees (not
    ``fits_degrees``).
    """
    unit, heights = "", ""
    for vlr in vlrs:
        keys = {key.id: key.value_offset for key in getattr(vlr, "geo_keys", ())}
        if fits_degrees and keys.get(MODEL_KEY) == GEOGRAPHIC:
            raise _in_degrees(path)
        unit = unit or next((EPSG_UNITS[keys[key]] for key in LINEAR_UNIT_KEYS if keys.get(key) in EPSG_UNITS), "")
        heights = heights or EPSG_UNITS.get(keys.get(VERTICAL_UNIT_KEY, 0), "")
        # In WKT the unit of a projected system's axes is the last UNIT of the horizontal part.
        wkt = re.split("VERT_?CS|VERTCRS", str(getattr(vlr, "string", "")))
        if fits_degrees and re.match(r"\s*(GEOGCS|GEOGCRS|GEODCRS|COMPD_?(CS|CRS)\[[^\[]*,\s*GEOG)", wkt[0]):
            raise _in_degrees(path)
        if "PROJC" in wkt[0]:
            unit = unit or _last_unit(wkt[0])
            heights = heights or (_last_unit(wkt[1]) if len(wkt) > 1 else "")
    unit = unit or UNIT
    if heights and heights != unit:
        raise InputError(
            f"expected one unit, found x and y in {unit}, z in {heights}, by its coordinate system; "
            "export it in one unit",
            path=path,
        )
    return unit


def _in_degrees(path: Path) -> InputError:
    return InputError(
        "expected projected coordinates, found longitude and latitude; export it in a projected system, in metres",
        path=path,
    )


def _last_unit(wkt: str) -> str:
    """Return the last unit of length of a coordinate system in WKT, "" if it is unknown."""
    units = re.findall(r'(?<!ANGLE)UNIT\["([^"]*)",\s*([0-9.eE+-]+)', wkt)
    lengths = [
        (name, float(size)) for name, size in units if not 0.017 < float(size) < 0.018
    ]  # a degree is 0.01745 rad
    if not lengths:
        return ""
    name, size = lengths[-1]
    if 0.3 < size < 0.31:  # a foot is 0.3048 m
        return "us-ft" if "US" in name.upper() else "ft"
    return "m" if size == 1.0 else ""
