"""PLY: ASCII or binary, of either byte order, float or double. The vertices are the points; the rest is ignored.

Points are parsed here and not by plyfile, which for 5 million points takes 1.0 (binary) and 50 times (ASCII) as long,
1.8 times the memory, and refuses comments that are not ASCII; meshes and normals are read with plyfile.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
from numba import njit

from processor.model import InputError
from processor.readers.ascii_rows import Rows
from processor.readers.columns import columns_of_records, fill_columns, wanted
from processor.readers.file_checks import check_declared_points, errors_name_the_file
from processor.readers.raw_scan import RawScan, build_scan, scan_name

SUFFIXES = (".ply",)
HEADER_LIMIT = 65_536  # bytes: headers have some hundreds; a file without an end of it is none
SKIPPED_BYTES = 4 << 20  # that are read at once of elements before the vertices
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    types: dict[str, str] = field(default_factory=dict)
    list_counts: dict[str, str] = field(default_factory=dict)  # type of the number of values, by list property


@dataclass(frozen=True)
class Header:
    """The declarations of a file's header."""

    order: str  # of bytes; "" = ASCII
    elements: list[_Element]
    start: int  # first byte of the data


def read(path: Path) -> list[RawScan]:
    """Read the vertices of a PLY file as one scan, with their intensity if it has one."""
    header = read_header(path)
    vertex = next((element for element in header.elements if element.name == "vertex"), _Element("vertex", 0))
    before = header.elements[: header.elements.index(vertex)] if vertex in header.elements else []
    names = list(vertex.types)
    read = wanted(path, names)
    if read is None:
        raise InputError(f"expected vertices with x, y, z, found {', '.join(names) or 'none'}", path=path)
    if vertex.list_counts:
        raise InputError("expected vertices without lists, found lists within them; export points only", path=path)
    columns, used = read.room(vertex.count), [names[i] for i in read.columns]
    with errors_name_the_file(path, "PLY"), path.open("rb") as file:
        file.seek(header.start)
        if header.order:
            dtype = np.dtype([(name, header.order + code) for name, code in vertex.types.items()])
            for element in before:
                _skip(file, element, header.order)
            fill_columns(columns, columns_of_records(file, dtype, used, vertex.count))
        else:
            rows = Rows(file)
            for _ in range(sum(element.count for element in before)):
                rows.skip_line()
            fill_columns(columns, rows.pieces(read.columns, vertex.count, len(names)))
    single = bool(header.order) and vertex.types[used[0]] == "f4"
    return [build_scan(path, scan_name(path), columns[0], single=single, **read.fields(columns[1:]))]


def _skip(file: BinaryIO, element: _Element, order: str) -> None:
    """Move behind the records of an element of a binary file. Raises ValueError where the file ends before."""
    start, size = file.tell(), os.fstat(file.fileno()).st_size
    if not element.list_counts:
        file.seek(element.count * sum(int(code[1]) for code in element.types.values()), os.SEEK_CUR)
        return
    fields = [(element.list_counts.get(name, ""), code) for name, code in element.types.items()]
    if any(count[0] == "f" for count, _ in fields if count):
        raise ValueError("expected lists whose number of values is whole")
    # Of each field: bytes of the number of values (0: no list), whether it has a sign, and bytes of a value.
    layout = np.array([(int(c[1]) if c else 0, c[:1] == "i", int(code[1])) for c, code in fields], np.int64)
    left, room = element.count, SKIPPED_BYTES
    while left:
        file.seek(start)
        text = np.frombuffer(file.read(room), np.uint8)
        records, end = behind_records(text, left, layout, order == ">")
        if start + end > size or (not records and len(text) < room):
            raise ValueError(f"the file ends within the element {element.name}")
        left, start, room = left - records, start + end, room if records else 2 * room
    file.seek(start)


@njit(cache=True, nogil=True)
def behind_records(
    text: npt.NDArray[np.uint8], most: int, layout: npt.NDArray[np.int64], big_endian: bool
) -> tuple[int, int]:
    """Count records of lists whose numbers of values lie in ``text``, at most ``most``, and the bytes up to their end.

    ``layout`` has a row a field: bytes of the number of values, 0 for a single value, whether it has a sign, and bytes
    of a value. The last record may end behind ``text``.
    """
    records, end = 0, 0
    while records < most:
        at = end
        for i in range(len(layout)):
            width, signed, item = layout[i]
            values = 1
            if width > 0:
                if at + width > len(text):
                    return records, end
                values = 0
                for k in range(width):
                    values = values * 256 + np.int64(text[at + k if big_endian else at + width - 1 - k])
                if signed and values >= 1 << (8 * width - 1):
                    values = 0  # a list of less than no values
                at += width
            at += values * item
        records, end = records + 1, at
    return records, end


def read_header(path: Path) -> Header:
    """Read a header, and check the numbers that it declares against the size of the file, before memory is allocated.

    Raises InputError for a file with too few or too many bytes, and for one without a header.
    """
    with path.open("rb") as file:
        head = file.read(HEADER_LIMIT)
    end = head.find(b"end_header")
    stop = head.find(b"\n", end)
    if not head.startswith(b"ply") or end < 0 or stop < 0:
        raise InputError("not a readable PLY file: it has no PLY header; copy or export it again", path=path)
    room = path.stat().st_size - stop - 1
    order, elements = "", list[_Element]()
    with errors_name_the_file(path, "PLY"):
        for line in head[:end].decode("latin-1").splitlines():
            words = line.split() or [""]
            if words[0] == "format":
                order = ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
                check_declared_points(path, "PLY", elements[-1].count, 1, room)
            elif words[0] == "property" and words[1] == "list":
                elements[-1].list_counts[words[4]] = TYPES[words[2]]
                elements[-1].types[words[4]] = TYPES[words[3]]
            elif words[0] == "property":
                if words[2] in elements[-1].types:
                    raise ValueError(f"two properties {words[2]}")
                elements[-1].types[words[2]] = TYPES[words[1]]
    exact = not any(element.list_counts for element in elements)
    least = 0
    for element in elements:
        codes = [element.list_counts.get(name, code) for name, code in element.types.items()]
        least += element.count * (2 * len(codes) if not order else sum(int(code[1]) for code in codes))
    # The last number of an ASCII file needs no separator after it.
    if least > room + (not order):
        raise InputError(
            f"the header declares {least} bytes of data or more, but {room} follow; "
            "the file is cut off or damaged: copy or export it again",
            path=path,
        )
    if exact and order and least < room:
        raise InputError(
            f"the header declares {least} bytes of data, but {room} follow; "
            "header and data do not match: export it again",
            path=path,
        )
    return Header(order, elements, stop + 1)
