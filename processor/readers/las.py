"""LAS and LAZ. Metres, unless the coordinate system of the file is in another unit.

Points flagged as withheld, which means deleted (LAS 1.4 R15, table 9), are left out and counted.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

import processor.readers.coordinate_system as coordinate_system
import processor.readers.pieces as pieces
from processor.large_arrays import allocate
from processor.model import InputError, reason
from processor.readers.colours import of_columns
from processor.readers.file_checks import check_declared_points, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name

SUFFIXES = (".las", ".laz")
# Bytes of the header and of records (LAS 1.4 R15, tables 3, 7 and 8).
LEAST_HEADER, HEADER_1_4 = 227, 375
VERSION_MINOR_AT, COUNTS_AT, POINT_FORMAT_AT, EXTENDED_AT = 25, 96, 104, 235  # offsets
VLR_HEADER, EVLR_HEADER = 54, 60  # lengths of the headers of records
PIECE = 1_000_000  # points read at once: work, not result
# Field of the flags, its bits for synthetic and withheld points: of point formats 0 to 5, and of later ones (table 16).
FLAGS, LAST_OLD_FORMAT = (("raw_classification", 0x20, 0x80), ("classification_flags", 0x01, 0x04)), 5
COLOURS = ("red", "green", "blue")
PACKED = 0xC0  # bits of the point format
LAZ_LIMIT = 2_000  # compression ratio that no real file exceeds


def needs_sandbox(path: Path) -> bool:
    """Whether the file is read in a separate process: if it is compressed, as native code decompresses it."""
    with path.open("rb") as file:
        head = file.read(POINT_FORMAT_AT + 1)
    return len(head) > POINT_FORMAT_AT and bool(head[POINT_FORMAT_AT] & PACKED)


def read(path: Path) -> list[RawScan]:
    """Read a LAS or LAZ file as one scan."""
    import laspy

    _check_header(path)
    read, count, synthetic, named = 0, 0, 0, False
    with errors_name_the_file(path, "LAS"), laspy.open(str(path)) as file:
        header = file.header
        fits_degrees = bool((np.abs([header.mins, header.maxs])[:, :2] <= [180.0, 90.0]).all())
        unit, fault = coordinate_system.unit([*header.vlrs, *(header.evlrs or [])], fits_degrees)
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
        flags_name, synthetic_bit, withheld_bit = FLAGS[header.point_format.id > LAST_OLD_FORMAT]
        colours = COLOURS if set(COLOURS) <= set(header.point_format.dimension_names) else ()
        colour = [allocate(declared, dtype=np.uint16) for _ in colours]
        for piece in file.chunk_iterator(PIECE):
            read += len(piece)
            flags = piece.array[flags_name]
            if np.bitwise_or.reduce(flags, initial=0) & (synthetic_bit | withheld_bit):  # rare
                synthetic += int(np.count_nonzero(flags & synthetic_bit))
                piece = piece[flags & withheld_bit == 0]
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
            pieces.read(len(piece), read, declared)
            named = named or bool(station[rows].any())
    if read != declared:
        raise InputError(f"expected {declared} points as declared, found {read}; copy it again", path=path)
    if read and not count:
        raise InputError(f"all of its {read} points are flagged as withheld, which means deleted", path=path)
    name = scan_name(path)
    remarks = [
        reason("read.withheld-points", count=read - count, scans=(name,)),
        reason("read.synthetic-points", count=synthetic, scans=(name,)),
    ]
    return [
        build_scan(
            path, name, points[:count], unit=unit, unit_fault=fault, scanned=day, intensity=intensity[:count],
            station=station[:count] if named else (),  # 0 in all points: unknown
            colour=of_columns([column[:count] for column in colour]),
            remarks=tuple(one for one in remarks if one.values["count"]),
        )
    ]  # fmt: skip


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
