"""Bad files end in one InputError that names the file: never in a traceback, a hang or a silent wrong answer."""

import struct
import time

import numpy as np
import pytest

from processor import readers
from processor.model import InputError
from tests.support.files.scan_bytes import TURNED, las_bytes, pcd_header, ply_header, put

BINARY_PLY, ASCII_PLY = ply_header("binary_little_endian", "double"), ply_header("ascii", "float")


def las_with(offset, form, value):
    content = bytearray(las_bytes(np.arange(9).reshape(3, 3), 0.001, [0.0, 0.0, 0.0]))
    struct.pack_into(form, content, offset, value)
    return bytes(content)


CASES = {
    "empty": ("a.ply", b"", "is empty"),
    "no suffix": ("scan", b"1 2 3", "found no suffix"),
    "other suffix": ("a.dwg", b"1 2 3", r"expected a scan file .*\.e57.*found .dwg"),
    "Z+F": ("a.ZFS", b"1 2 3", "export the scan to E57"),
    "PLY of text": ("a.ply", "hello\n" * 10, "no PLY header"),
    "PLY cut off": ("a.ply", BINARY_PLY + bytes(71), "declares 72 bytes .* 71 follow"),
    "PLY too long": ("a.ply", BINARY_PLY + bytes(73), "72 bytes .* 73 follow"),
    "PLY of 1e12 points": ("a.ply", ply_header("ascii", "float", count=10**12) + b"1 2 3\n", "declares 10{12} points"),
    "PLY of -1 points": ("a.ply", ply_header("ascii", "float", count=-1) + b"1 2 3\n", "declares -1 points"),
    "PLY of no points": ("a.ply", ply_header("ascii", "float", count=0), "no points|not a readable"),
    "PLY short of rows": ("a.ply", ASCII_PLY + b"1000 2000 3000\n" * 2, "not a readable PLY"),
    "PLY of other type": ("a.ply", ply_header("ascii", "quad") + b"1 2 3\n" * 3, "not a readable PLY"),
    "PLY without z": ("a.ply", ASCII_PLY.replace(b" z", b" w") + b"1 2 3\n" * 3, "with x, y, z, found"),
    "PLY with NaN": ("a.ply", ASCII_PLY + b"1 2 3\n1 nan 3\n1 2 inf\n",
                     "2 of 3 points .* first in row 2"),
    "PCD of text": ("a.pcd", "hello\n" * 10, "no DATA line"),
    "PCD of 1e9 points": ("a.pcd", pcd_header("binary", 10**9, 10**9) + bytes(48), "declares 10{9} points"),
    "PCD cut off": ("a.pcd", pcd_header("binary") + bytes(47), "declares 3 points"),
    "PCD short of rows": ("a.pcd", pcd_header("ascii") + b"100 200 300 1\n" * 2, "3 points as declared, found 2"),
    "PCD of other size": ("a.pcd", pcd_header("binary", 3, 4) + bytes(48), "is not POINTS 3"),
    "PCD all NaN": ("a.pcd", pcd_header("ascii") + b"nan nan nan 1\n" * 3, "no points"),
    "PCD with inf": ("a.pcd", pcd_header("ascii") + b"1 2 inf 1\n" * 3, "3 of 3 points"),
    "PCD compressed lie": ("a.pcd", pcd_header("binary_compressed") + struct.pack("<II", 8, 2**31) + bytes(8),
                           "not a readable PCD"),
    "LAS of text": ("a.las", "hello\n" * 100, "no LAS header"),
    "LAS of 1e9 points": ("a.las", las_with(107, "<I", 10**9), "declares 10{9} points"),
    "LAS cut off": ("a.las", las_with(107, "<I", 3)[:-1], "declares 3 points"),
    "LAS of 1e9 headers": ("a.las", las_with(100, "<I", 10**9), "counts do not fit"),
    "LAS without scale": ("a.las", las_with(131, "<d", float("nan")), "expected finite scales"),
    "LAZ that is none": ("a.laz", las_with(104, "<B", 0x80), "not a readable LAS"),
    "E57 of text": ("a.e57", "hello\n" * 1000, "not a readable E57"),
    "PTX of text": ("a.ptx", "hello\n" * 10, "no PTX header"),
    "PTX of 1e12 cells": ("a.ptx", "1000000\n1000000\n" + TURNED + "1 2 3 4\n", "declares 10{12} points"),
    "PTX cut off": ("a.ptx", "2\n2\n" + TURNED + "1.0000 2.0000 3.0000 4\n" * 3, "expected 4 cells .* found 3"),
    "PTX too long": ("a.ptx", "1\n2\n" + TURNED + "1 2 3 4\n" * 3, "more cells than declared"),
    "PTX of no returns": ("a.ptx", "1\n2\n" + TURNED + "0 0 0 0.5\n" * 2, "expected points, found none in scan 'a'"),
    "PTX with NaN": ("a.ptx", "1\n2\n" + TURNED + "1 2 3 4\n1 nan 3 4\n", "1 of 2 points"),
    "text of words": ("a.xyz", "hello world and more\n" * 10, "three numbers x y z, found 'hello"),
    "text of two columns": ("a.xyz", "1 2\n3 4\n", "three numbers"),
    "text of blanks": ("a.xyz", "\n\n", "rows of"),
    "binary as text": ("a.xyz", bytes(range(256)) * 4, "found binary data"),
    "text with a word": ("a.xyz", "1 2 3\n4 five 6\n", "five"),
    "text with a short row": ("a.csv", "1,2,3\n4,5\n", "not a readable text"),
    "text with NaN": ("a.xyz", "1 2 3\n4 nan 6\n", "1 of 2 points .* first in row 2"),
    "text declares more": ("a.pts", "9\n1 2 3\n40 50 600\n" + "1 2 3\n" * 6, "expected 9 points as declared, found 8"),
    "text declares fewer": ("a.pts", "1\n1 2 3\n4 5 6\n", "expected 1 points as declared, found more"),
    "text declares 1e15": ("a.pts", "1000000000000000\n1 2 3\n", "declares 10{15} points"),
    "other columns than header": ("a.csv", "x,y,z,r\n1,2,3\n", "names 4 columns .* have 3"),
    "two rows run together": ("a.xyz", "1 2 3\n" * 30 + "1 2 3 4 5 6\n" + "1 2 3\n" * 9, "line 31: expected 3"),
    "two rows without a blank": ("a.xyz", "1.5 2.5 3.5\n" * 9 + "1.5 2.5 3.51.5 2.5 3.5\n", r"line 10: .*'3\.51\.5'"),
    "a row of a table too long": ("a.csv", "x,y,z\n" + "1,2,3\n" * 5 + "1,2,3,4\n" + "1,2,3\n" * 5, "line 7"),
    "text cut within a row": ("a.xyz", "1.25 2.25 3.25\n" * 40 + "1.25 2.25 3.2", r"line 41: .* 2 decimals.*3\.2'"),
    "CSV cut within a row": ("a.csv", "x,y,z\n" + "1,2,3.25\n" * 40 + "1,2,3", "line 42: expected 2 decimals"),
    "PTS cut within a row": ("a.pts", "41\n" + "1.25 2.25 3.25\n" * 40 + "1.25 2.25 3.", "line 42: .* 2 decimals"),
    "PTX cut within a row": ("a.ptx", "30\n2\n" + TURNED + "1 2 3 0.25\n" * 59 + "1 2 3 0.2", "line 70: .*2 decimals"),
    "PTX rows run together": ("a.ptx", "2\n3\n" + TURNED + "1 2 3 4\n" * 3 + "1 2 3 4 1 2 3 4\n" + "1 2 3 4\n",
                              "line 14: expected 4 columns"),
    "PLY rows run together": ("a.ply", ASCII_PLY + b"1 2 3\n1 2 3 1 2 3\n1 2 3\n", "expected 3 columns"),
    "PCD rows run together": ("a.pcd", pcd_header("ascii") + b"1 2 3 1\n1 2 3 1 2\n1 2 3 1\n", "expected 4 columns"),
    "first row of a table damaged": ("a.csv", "x;y;z;i\n3,1;0.5,3;-7,6;7\n" + "3,1;5,3;-7,6;7\n" * 9,
                                     "line 2: expected 4 numbers"),
    "first row damaged": ("a.xyz", "1.5 2..5 3.5\n" + "1.5 2.5 3.5\n" * 9, "line 1: expected 3 numbers or the names"),
    "two units": ("a.csv", "x_mm,y_m,z_m\n1,2,3\n", "different units"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_files(tmp_path, case):
    name, content, why = CASES[case]
    path = put(tmp_path / name, content)
    why = why.replace("10{12}", "1" + "0" * 12).replace("10{9}", "1" + "0" * 9)
    why = why.replace("10{15}", "1" + "0" * 15)
    began = time.process_time()  # other work on the machine does not count
    with pytest.raises(InputError, match=why) as caught:
        readers.read(path)
    assert time.process_time() - began < 5.0
    assert str(caught.value).startswith(str(path))
    assert path.exists()


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        readers.read(tmp_path / "a.ply")
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(InputError, match="a folder"):
        readers.read(tmp_path / "b.ply")
