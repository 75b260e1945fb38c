"""Bad files end in one InputError that names the file: never in a traceback, a hang or a silent wrong answer."""

from __future__ import annotations

import random
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from processor import readers, store
from processor.model import InputError, PointLabels, Scan, Scene, Truth
from tests.unit.test_readers import TURNED, las_bytes, pcd_header, ply_header

DATA = Path(__file__).resolve().parents[2] / "../shared/data"


def put(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def las_with(offset, form, value):
    content = bytearray(las_bytes(np.arange(9).reshape(3, 3), 0.001, [0.0, 0.0, 0.0]))
    struct.pack_into(form, content, offset, value)
    return bytes(content)


CASES = {
    "empty": ("a.ply", b"", "is empty"),
    "no suffix": ("scan", b"1 2 3", "found no suffix"),
    "other suffix": ("a.dwg", b"1 2 3", r"expected a scan file .*\.e57.*found .dwg"),
    "FARO": ("a.fls", b"1 2 3", "export the scan to E57"),
    "Z+F": ("a.ZFS", b"1 2 3", "export the scan to E57"),
    "Riegl": ("a.rxp", b"1 2 3", "export the scan to E57"),
    "PLY of text": ("a.ply", "hello\n" * 10, "no PLY header"),
    "PLY cut off": ("a.ply", ply_header("binary_little_endian", "double") + bytes(71), "declares 72 bytes .* 71 follow"),
    "PLY too long": ("a.ply", ply_header("binary_little_endian", "double") + bytes(73), "72 bytes .* 73 follow"),
    "PLY of 1e12 points": ("a.ply", ply_header("ascii", "float", count=10**12) + b"1 2 3\n", "declares 10{12} points"),
    "PLY of -1 points": ("a.ply", ply_header("ascii", "float", count=-1) + b"1 2 3\n", "declares -1 points"),
    "PLY of no points": ("a.ply", ply_header("ascii", "float", count=0), "no points|not a readable"),
    "PLY short of rows": ("a.ply", ply_header("ascii", "float", count=3) + b"1000 2000 3000\n" * 2, "not a readable PLY"),
    "PLY of other type": ("a.ply", ply_header("ascii", "quad"), "not a readable PLY"),
    "PLY without z": ("a.ply", ply_header("ascii", "float").replace(b" z", b" w") + b"1 2 3\n" * 3, "with x, y, z, found"),
    "PLY with NaN": ("a.ply", ply_header("ascii", "float") + b"1 2 3\n1 nan 3\n1 2 inf\n",
                     "2 of 3 points .* first in row 2"),
    "PCD of text": ("a.pcd", "hello\n" * 10, "no DATA line"),
    "PCD of 1e9 points": ("a.pcd", pcd_header("binary", 10**9, 10**9) + bytes(48), "declares 10{9} points"),
    "PCD cut off": ("a.pcd", pcd_header("binary") + bytes(47), "declares 3 points"),
    "PCD short of rows": ("a.pcd", pcd_header("ascii") + b"100 200 300 1\n" * 2, "POINTS declares 3, but 2"),
    "PCD of other size": ("a.pcd", pcd_header("binary", 3, 4) + bytes(48), "is not POINTS 3"),
    "PCD all NaN": ("a.pcd", pcd_header("ascii") + b"nan nan nan 1\n" * 3, "no points"),
    "PCD with inf": ("a.pcd", pcd_header("ascii") + b"1 2 inf 1\n" * 3, "3 of 3 points"),
    "PCD compressed lie": ("a.pcd", pcd_header("binary_compressed") + struct.pack("<II", 8, 2**31) + bytes(8),
                           "not a readable PCD"),
    "LAS of text": ("a.las", "hello\n" * 100, "no LAS header"),
    "LAS of 1e9 points": ("a.las", las_with(107, "<I", 10**9), "declares 10{9} points"),
    "LAS cut off": ("a.las", las_with(107, "<I", 3)[:-1], "declares 3 points"),
    "LAS of 1e9 headers": ("a.las", las_with(100, "<I", 10**9), "counts do not fit"),
    "LAS without scale": ("a.las", las_with(131, "<d", float("nan")), "not finite|not a readable"),
    "LAZ that is none": ("a.laz", las_with(104, "<B", 0x80), "not a readable LAS"),
    "E57 of text": ("a.e57", "hello\n" * 1000, "not a readable E57"),
    "PTX of text": ("a.ptx", "hello\n" * 10, "no PTX header"),
    "PTX of 1e12 cells": ("a.ptx", "1000000\n1000000\n" + TURNED + "1 2 3 4\n", "declares 10{12} points"),
    "PTX cut off": ("a.ptx", "2\n2\n" + TURNED + "1.0000 2.0000 3.0000 4\n" * 3, "declares 4 cells .* found 3"),
    "PTX too long": ("a.ptx", "1\n2\n" + TURNED + "1 2 3 4\n" * 3, "declares fewer cells than it holds"),
    "PTX of no returns": ("a.ptx", "1\n2\n" + TURNED + "0 0 0 0.5\n" * 2, "no returns"),
    "PTX with NaN": ("a.ptx", "1\n2\n" + TURNED + "1 2 3 4\n1 nan 3 4\n", "1 of 2 points"),
    "text of words": ("a.xyz", "hello world and more\n" * 10, "three numbers x y z, found 'hello"),
    "text of two columns": ("a.xyz", "1 2\n3 4\n", "three numbers"),
    "text of blanks": ("a.xyz", "\n\n", "rows of"),
    "binary as text": ("a.xyz", bytes(range(256)) * 4, "found binary data"),
    "text with a word": ("a.xyz", "1 2 3\n4 five 6\n", "five"),
    "text with a short row": ("a.csv", "1,2,3\n4,5\n", "not a readable text"),
    "text with NaN": ("a.xyz", "1 2 3\n4 nan 6\n", "1 of 2 points .* first in row 2"),
    "text declares more": ("a.pts", "9\n1 2 3\n40 50 600\n" + "1 2 3\n" * 6, "declares 9 points, but 8"),
    "text declares fewer": ("a.pts", "1\n1 2 3\n4 5 6\n", "declares 1 points, but 2"),
    "text declares 1e15": ("a.pts", "1000000000000000\n1 2 3\n", "declares 10{15} points"),
    "other columns than header": ("a.csv", "x,y,z,r\n1,2,3\n", "names 4 columns .* have 3"),
    "two units": ("a.csv", "x_mm,y_m,z_m\n1,2,3\n", "different units"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_files(tmp_path, case):
    name, content, why = CASES[case]
    path = put(tmp_path / name, content)
    why = why.replace("10{12}", "1" + "0" * 12).replace("10{9}", "1" + "0" * 9)
    why = why.replace("10{15}", "1" + "0" * 15)
    began = time.monotonic()
    with pytest.raises(InputError, match=why) as caught:
        readers.read(path)
    assert time.monotonic() - began < 5.0
    assert str(caught.value).startswith(str(path))
    assert path.exists()


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        readers.read(tmp_path / "a.ply")
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(InputError, match="a folder"):
        readers.read(tmp_path / "b.ply")


def damaged(content, rng):
    """Cut the content off, or change some bytes, more of them where headers are."""
    content = bytearray(content)
    way = rng.randrange(4)
    if way == 0:
        return bytes(content[: rng.randrange(1, len(content))])
    reach = (len(content), min(2_000, len(content)), min(400, len(content)))[way - 1]
    for _ in range(rng.choice([1, 1, 2, 8])):
        content[rng.randrange(reach)] = rng.choice([0, 255, ord("9"), rng.randrange(256)])
    return bytes(content)


FUZZED = (
    "e57/translationWithoutRotation.e57",
    "las/simple.las",
    "las/simple.laz",
    "pcd/bun0.pcd",
    "pcd/room_scan1.pcd",
    "ptx_pts/no-color.ptx",
    "ptx_pts/test.pts",
)


@pytest.mark.skipif(not DATA.is_dir(), reason="the real scans are not on this machine")
@pytest.mark.parametrize("name", FUZZED)
def test_damaged_scans_are_read_or_refused(tmp_path, name):
    content = (DATA / name).read_bytes()
    rng = random.Random(name)
    path = tmp_path / Path(name).name
    refused = 0
    for _ in range(40):
        put(path, damaged(content, rng))
        try:
            for scan in readers.read(path):
                assert len(scan.points)
                assert np.isfinite(scan.points).all()
        except InputError as error:
            assert str(error).startswith(str(path))
            refused += 1
    assert refused >= 5


def test_damaged_scenes_are_read_or_refused(tmp_path):
    points = np.random.default_rng(0).normal(0.0, 1_000.0, (2_000, 3))
    labels = PointLabels("s", ("p",), np.zeros(2_000, int), np.zeros(2_000, int))
    path = tmp_path / "a.h5"
    store.write_scene(path, Scene("a", "structure", (Scan("s", points),)), Truth((labels,)), {"a": 1})
    content, rng = path.read_bytes(), random.Random(4)
    refused = 0
    for _ in range(150):
        put(path, damaged(content, rng))
        found = store.problems(path)
        try:
            store.read_scene(path)
        except InputError as error:
            assert str(error).startswith(str(path))
            assert found
            refused += 1
    assert refused >= 50
