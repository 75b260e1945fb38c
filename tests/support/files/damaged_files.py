"""Small good files of every format, and ways to damage them; always the same ones."""

import functools
import io
import random
import re
import struct
import tempfile
from pathlib import Path

import numpy as np

from processor.model import PointLabels, Scan, Scene, Truth
from processor.store import store
from processor.writers import e57
from processor.writers.cloud import of_scan

POINTS = np.random.default_rng(6).normal(0.0, 3.0, (60, 3)).round(4)
COUNT = len(POINTS)
POSE = "10 20 30\n0 1 0\n-1 0 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"
NUMBERS = ("0", "-1", "1", "99999999999", "2147483648", "4294967295", "1e400", "nan", "", "-", "0.5", "9" * 400, "\0")


def _rows(separator=" ", more="", decimal="."):
    lines = (separator.join(f"{x:.4f}" for x in row) + more for row in POINTS)
    return "\n".join(lines).replace(".", decimal) + "\n"


def _ply(form, order):
    kind, code = ("float", "f4") if form == "ascii" else ("double", "f8")
    head = f"ply\nformat {form} 1.0\ncomment scan\nelement vertex {COUNT}\n"
    head += "".join(f"property {kind} {axis}\n" for axis in "xyz") + "property uchar intensity\n"
    if form == "ascii":
        return (head + "end_header\n" + _rows(more=" 7")).encode()
    rows = np.empty(COUNT, [(axis, order + code) for axis in "xyz"] + [("i", "u1")])
    rows["x"], rows["y"], rows["z"], rows["i"] = *POINTS.T, 7
    face = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    return (head + face).encode() + rows.tobytes() + struct.pack(order + "BiiiBiii", 3, 0, 1, 2, 3, 1, 2, 3)


def _pcd(data):
    import lzf

    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {COUNT // 4}\nHEIGHT 4\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA {data}\n"
    ).encode()
    rows = np.column_stack([POINTS, np.ones(COUNT)]).astype("<f4")
    rows[5, :3] = np.nan
    if data == "ascii":
        return head + _rows(more=" 7").encode()
    if data == "binary":
        return head + rows.tobytes()
    columns = rows.T.tobytes()
    packed = lzf.compress(columns, 2 * len(columns))
    return head + struct.pack("<II", len(packed), len(columns)) + packed


def _ptx():
    grid = "10\n6\n" + POSE + "0 0 0 0.5\n" + "\n".join(f"{x:.4f} {y:.4f} {z:.4f} 0.25" for x, y, z in POINTS[1:])
    return (grid + "\n") * 2


def _las(version, form, suffix):
    import laspy

    header = laspy.LasHeader(point_format=form, version=version)
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.tile(POINTS, (4, 1)).T
    las.intensity = np.arange(4 * COUNT) % 9
    kept = io.BytesIO()
    las.write(kept, do_compress=suffix == "laz")
    return kept.getvalue()


def _e57(folder, spherical):
    pose = np.eye(4)
    pose[:3, 3] = 1_000.0
    grid = {"grid_row": np.arange(COUNT) % 6, "grid_column": np.arange(COUNT) // 6}
    scans = [
        Scan("S1", 1_000.0 * POINTS, intensity=np.arange(COUNT) % 9.0, T_project_scan=pose, **grid),
        Scan("S2", 1_000.0 * POINTS),
    ]
    e57.write(folder / "a.e57", [*map(of_scan, scans)], spherical=spherical)
    return (folder / "a.e57").read_bytes()


def _integers(folder):
    """An E57 file of scaled integers, with invalid points."""
    from pye57 import libe57

    e57.write(folder / "b.e57", [of_scan(Scan("S1", 1_000.0 * POINTS))], spherical=False)
    image = libe57.ImageFile(str(folder / "c.e57"), "w")
    image.extensionsAdd("", libe57.E57_V1_0_URI)
    prototype, scan = libe57.StructureNode(image), libe57.StructureNode(image)
    buffers, kept = libe57.VectorSourceDestBuffer(), []
    for i, axis in enumerate("XYZ"):
        prototype.set(f"cartesian{axis}", libe57.ScaledIntegerNode(image, 0, -(2**20), 2**20, 1e-4, 0.0))
        kept.append(POINTS[:, i].copy())
        buffers.append(libe57.SourceDestBuffer(image, f"cartesian{axis}", kept[-1], COUNT, True, True))
    prototype.set("cartesianInvalidState", libe57.IntegerNode(image, 0, 0, 2))
    kept.append((np.arange(COUNT) % 3).astype(np.int8))
    buffers.append(libe57.SourceDestBuffer(image, "cartesianInvalidState", kept[-1], COUNT, True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    root, vector = image.root(), libe57.VectorNode(image, True)
    root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("data3D", vector)
    scan.set("guid", libe57.StringNode(image, "{1}"))
    scan.set("points", points)
    vector.append(scan)
    writer = points.writer(buffers)
    writer.write(COUNT)
    writer.close()
    image.close()
    return (folder / "c.e57").read_bytes()


def _scene(folder):
    points = np.random.default_rng(0).normal(0.0, 1_000.0, (500, 3))
    labels = PointLabels("s", ("p",), np.zeros(500, int), np.zeros(500, int))
    store.write_scene(folder / "a.h5", Scene("a", "structure", (Scan("s", points),)), Truth((labels,)), {"a": 1})
    return (folder / "a.h5").read_bytes()


@functools.cache
def good_files() -> dict[str, list[tuple[str, bytes]]]:
    """Return good files, name and content, by format."""
    table = "x;y;z;intensity\n" + _rows(";", ";7", ",")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return {
            "e57": [("a.e57", _e57(folder, False)), ("b.e57", _e57(folder, True)), ("c.e57", _integers(folder))],
            "las": [("a.las", _las("1.2", 1, "las")), ("b.las", _las("1.4", 6, "las"))],
            "laz": [("a.laz", _las("1.2", 3, "laz")), ("b.laz", _las("1.4", 7, "laz"))],
            "ply": [
                ("a.ply", _ply("ascii", "<")),
                ("b.ply", _ply("binary_little_endian", "<")),
                ("c.ply", _ply("binary_big_endian", ">")),
            ],
            "pcd": [(f"{data}.pcd", _pcd(data)) for data in ("ascii", "binary", "binary_compressed")],
            "ptx": [("a.ptx", _ptx().encode())],
            "pts": [("a.pts", f"{COUNT}\n{_rows(more=' -99 1 2 3')}".encode())],
            "text": [
                ("a.xyz", _rows().encode()),
                ("b.csv", table.encode()),
                ("c.txt", ("# 扫描\n" + _rows("\t")).encode("gb18030")),
            ],
            "h5": [("a.h5", _scene(folder))],
        }


# --- damage --------------------------------------------------------------------------------------------------------


def damaged(format_: str, number: int) -> tuple[str, bytes]:
    """Return the file name and content of one damaged file; the same for the same number."""
    rng = random.Random(f"{format_} {number}")
    files = good_files()[format_]
    name, content = files[number % len(files)]
    changed = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        rng.choice(WAYS)(changed, rng)
    if name.endswith(".e57") and rng.random() < 0.8:
        changed = bytearray(with_check_sums(bytes(changed)))
    return name, bytes(changed)


def _place(content, rng):
    """Pick a place, often near the beginning or the end, where formats have their counts and tables."""
    size = max(len(content), 1)
    way = rng.random()
    if way < 0.4:
        return rng.randrange(min(size, 400))
    if way < 0.6:
        return rng.randrange(max(0, size - 2_500), size)
    return rng.randrange(size)


def _flip(content, rng):
    for _ in range(rng.choice((1, 1, 2, 8))):
        if content:
            content[_place(content, rng) % len(content)] ^= 1 << rng.randrange(8)


def _set(content, rng):
    for _ in range(rng.choice((1, 1, 2, 8))):
        if content:
            content[_place(content, rng) % len(content)] = rng.choice((0, 255, 127, 128, 57, rng.randrange(256)))


def _truncate(content, rng):
    del content[rng.randrange(len(content) + 1) :]


def _duplicate(content, rng):
    start = _place(content, rng)
    block = content[start : start + rng.choice((1, 4, 64, 1_024, 5_000))]
    at = _place(content, rng)
    content[at:at] = block


def _remove(content, rng):
    start = _place(content, rng)
    del content[start : start + rng.choice((1, 4, 64, 1_024))]


def _zero(content, rng):
    start = _place(content, rng)
    length = min(rng.choice((4, 8, 64, 1_024)), max(0, len(content) - start))
    content[start : start + length] = bytes(length)


def _edit_number(content, rng):
    found = list(re.finditer(rb"-?\d+(\.\d+)?", bytes(content)))
    if found:
        among = found[:40] if rng.random() < 0.6 else found
        one = rng.choice(among)
        content[one.start() : one.end()] = rng.choice(NUMBERS).encode()


def _edit_field(content, rng):
    """Put an extreme integer or a strange float where a binary field may be."""
    form, value = rng.choice(
        (
            ("<I", 0xFFFFFFFF), ("<I", 0x7FFFFFFF), ("<I", 0), ("<Q", 2**63), ("<Q", 2**40), ("<Q", 2**64 - 1),
            ("<H", 0xFFFF), ("<d", float("nan")), ("<d", 1e308), ("<d", float("inf")), ("<q", -1), ("<I", 10**8),
        )
    )  # fmt: skip
    size = struct.calcsize(form)
    if len(content) > size:
        at = _place(content, rng) // 2 * 2 % (len(content) - size)
        struct.pack_into(form, content, at, value)


def _swap(content, rng):
    size = rng.choice((2, 4, 8))
    if len(content) > 4 * size:
        a, b = (_place(content, rng) // size * size % (len(content) - size) for _ in range(2))
        content[a : a + size], content[b : b + size] = content[b : b + size], content[a : a + size]


WAYS = (_flip, _set, _truncate, _duplicate, _remove, _zero, _edit_number, _edit_field, _swap)


@functools.cache
def _crc_table():
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    return table


def with_check_sums(content: bytes) -> bytes:
    """Give each page of 1024 bytes of an E57 file the check sum (CRC-32C) that its content asks for."""
    table, out = _crc_table(), bytearray(content)
    if len(out) >= 24:
        struct.pack_into("<Q", out, 16, len(out))  # the length, which a reader looks at first
    for start in range(0, len(content) - 1023, 1024):
        crc = 0xFFFFFFFF
        for byte in content[start : start + 1020]:
            crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
        struct.pack_into(">I", out, start + 1020, crc ^ 0xFFFFFFFF)
    return bytes(out)
