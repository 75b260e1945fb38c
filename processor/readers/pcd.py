"""PCD: ASCII, binary or binary_compressed. Points of an organised cloud without a return are NaN and are left out.

VIEWPOINT is not used: programs differ on whether the points are to be transformed by it. Parsed here and not by
pypcd4, which for 5 million points takes 1.2 (binary), 2 (compressed) and 3.5 times (ASCII) as long, needs more memory,
and refuses files of version 0.6, without COUNT, or with tabs or repeated blanks.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from processor import large_arrays
from processor.model import Floats, InputError
from processor.readers.ascii_rows import Rows
from processor.readers.columns import columns_of_records, fill_columns, wanted
from processor.readers.file_checks import check_declared_points, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name

SUFFIXES = (".pcd",)
HEADER_LIMIT = 65_536  # bytes: headers have some hundreds; a file without an end of it is none
PIECE = 1 << 15  # points
LZF_LIMIT = 100  # a match of LZF turns 3 bytes into at most 264


@dataclass(frozen=True)
class Header:
    """The declarations of a file's header."""

    names: list[str]
    types: list[str]  # of numpy, with a shape where COUNT is not 1
    counts: list[int]
    points: int
    data: str  # ascii, binary or binary_compressed
    start: int  # first byte of the data

    def dtype(self) -> Any:
        """Return the type of a record; fields are named by their number, as names may repeat."""
        return np.dtype([(str(i), t, (n,)) for i, (t, n) in enumerate(zip(self.types, self.counts, strict=True))])


def read(path: Path) -> list[RawScan]:
    """Read a PCD file as one scan."""
    header = read_header(path)
    count, read = header.points, wanted(path, header.names, colours=False)
    if read is None:
        raise InputError(f"expected FIELDS with x, y, z, found {' '.join(header.names)}", path=path)
    fields, columns = read.columns, read.room(count)
    with errors_name_the_file(path, "PCD"), path.open("rb") as file:
        file.seek(header.start)
        if header.data == "ascii":
            first = np.cumsum([0, *header.counts])
            fill_columns(columns, Rows(file).pieces([int(first[field]) for field in fields], count, sum(header.counts)))
        elif header.data == "binary":
            pieces = columns_of_records(file, header.dtype(), [str(field) for field in fields], count)
            fill_columns(columns, ([column[:, 0] for column in piece] for piece in pieces))
        else:
            fill_columns(columns, _unpacked(file, header, fields))
    returns = _without_nan(columns)
    return [
        build_scan(
            path,
            scan_name(path),
            columns[0][:returns],
            single=header.data != "ascii" and header.types[fields[0]] == "<f4",
            **read.fields(column[:returns] for column in columns[1:]),
        )
    ]


def read_header(path: Path) -> Header:
    """Read the header. Raises InputError if the size of the file contradicts it."""
    with path.open("rb") as file:
        head = file.read(HEADER_LIMIT)
    data = head.find(b"\nDATA ")
    stop = head.find(b"\n", data + 1)
    if data < 0 or stop < 0:
        raise InputError("not a readable PCD file: it has no DATA line; copy or export it again", path=path)
    lines = {}
    for line in head[:stop].decode("latin-1").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if not lines.get(key)]
    if missing:
        raise InputError(f"not a readable PCD file: its header has no {missing[0]} line; export it again", path=path)
    names = lines["FIELDS"]
    with errors_name_the_file(path, "PCD"):
        sizes, kinds = lines["SIZE"], lines["TYPE"]
        counts = [int(word) for word in lines.get("COUNT", ["1"] * len(names))]
        if not len(names) == len(sizes) == len(kinds) == len(counts):
            raise InputError("FIELDS, SIZE, TYPE and COUNT differ in length; export the file again", path=path)
        codes = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
        if any(size not in codes.get(kind, ()) for size, kind in zip(sizes, kinds, strict=True)):
            raise ValueError(f"expected TYPE F, I or U of a SIZE of these, found {kinds} of {sizes}"[:200])
        types = [f"<{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
        width, height = int(lines["WIDTH"][0]), int(lines["HEIGHT"][0])
        points = int(lines["POINTS"][0]) if "POINTS" in lines else width * height
        form = lines["DATA"][0].lower()
        if form not in ("ascii", "binary", "binary_compressed") or min(counts) < 1 or max(counts) > HEADER_LIMIT:
            raise ValueError(f"unknown DATA {form[:40]}, or COUNT outside 1 to {HEADER_LIMIT}")
    if width * height != points:
        raise InputError(f"WIDTH {width} x HEIGHT {height} is not POINTS {points}; export the file again", path=path)
    room = path.stat().st_size - stop - 1
    row = sum(int(size) * n for size, n in zip(sizes, counts, strict=True))
    least = {"ascii": 2 * sum(counts), "binary": row}.get(form, row / LZF_LIMIT)
    check_declared_points(path, "PCD", points, least, room + (form == "ascii"))
    return Header(names, types, counts, points=points, data=form, start=stop + 1)


def _unpacked(file: BinaryIO, header: Header, fields: Sequence[int]) -> Iterator[list[Any]]:
    """Yield columns of compressed data, which are stored field after field."""
    import lzf

    packed_size, size = struct.unpack("<II", file.read(8))
    sizes = [int(t[2]) * n * header.points for t, n in zip(header.types, header.counts, strict=True)]
    room = os.fstat(file.fileno()).st_size - header.start - 8
    if size != sum(sizes) or packed_size > room:
        raise ValueError(f"expected {sum(sizes)} bytes in {room} or fewer, found {size} in {packed_size} declared")
    packed = file.read(packed_size)
    unpacked = lzf.decompress(packed, size) if size else b""
    if unpacked is None or len(unpacked) != size:
        raise ValueError("the compressed data are damaged")
    del packed
    starts = np.cumsum([0, *sizes])
    whole = [np.frombuffer(unpacked, header.types[i], header.points * header.counts[i], int(starts[i])) for i in fields]
    for start in range(0, header.points, PIECE):
        stop = min(start + PIECE, header.points)
        yield [column.reshape(-1, header.counts[i])[start:stop, 0] for i, column in zip(fields, whole, strict=True)]


def _without_nan(columns: Sequence[Floats]) -> int:
    """Move the rows without NaN coordinates to the front, in their order, and return their number."""
    returns, count = 0, len(columns[0])
    if count and not np.isnan(large_arrays.extremes(columns[0])[0]):
        return count
    for start in range(0, count, PIECE):
        rows = slice(start, min(start + PIECE, count))
        valid = np.atleast_1d(~np.isnan(columns[0][rows]).any(axis=1))
        added = int(np.count_nonzero(valid))
        if returns != start or added != len(valid):
            for column in columns:
                column[returns : returns + added] = column[rows][valid]
        returns += added
        large_arrays.release()
    return returns
