"""Bad files end in one InputError that names the file: never in a traceback, a hang or a silent wrong answer."""

from __future__ import annotations

import random
import struct
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from processor import readers
from processor.model import InputError, PointLabels, Scan, Scene, Truth
from processor.store import store
from tests.support.files.old_files import without_checksums
from tests.support.files.scan_bytes import TURNED, las_bytes, pcd_header, ply_header
from tests.support.scenes.store_scenes import a_scene

DATA = Path(__file__).resolve().parents[2] / "../shared/data"

BINARY_PLY, ASCII_PLY = ply_header("binary_little_endian", "double"), ply_header("ascii", "float")


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


def attempt(read, path):
    """Return a reader's result and None, or None and its message. Any other exception is raised."""
    try:
        return read(path), None
    except InputError as error:
        return None, str(error)


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
        scans, said = attempt(readers.read, path)
        assert said is None or said.startswith(str(path))
        assert all(len(scan.points) and np.isfinite(scan.points).all() for scan in scans or ())
        refused += said is not None
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
        _, said = attempt(store.read_scene, path)
        assert said is None or (said.startswith(str(path)) and found)
        refused += said is not None
    assert refused >= 50


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "scene.h5"
    store.write_scene(path, *a_scene(), {})
    return path


# --- scenes from outside -------------------------------------------------------------------------------------------

SCAN = "scene/scans/0000"
POINTS = SCAN + "/points"


def virtual(file):
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (10,))
    file.create_virtual_dataset("scene/virtual", layout)


def external(file):
    file.create_dataset("scene/outside", (10,), "u1", external=[("/etc/passwd", 0, 10)])


def huge(file):
    del file[SCAN + "/intensity"]
    file.create_dataset(SCAN + "/intensity", (10**12,), "f8", chunks=(65536,), compression="gzip")


def half_written(file):
    del file[SCAN + "/intensity"]
    dataset = file.create_dataset(SCAN + "/intensity", (50_000,), "f8", chunks=(10_000,), compression="gzip")
    dataset[:10_000] = np.random.default_rng(0).uniform(size=10_000)


def set_to(name, value):
    def change(file):
        del file[name]
        file[name] = value

    return change


def poke(name, index, value):
    def change(file):
        file[name][index] = value

    return change


def remove(name):
    return lambda file: file.__delitem__(name)


TAMPERED = {
    "external link": (lambda f: f["scene"].__setitem__("a", h5py.ExternalLink("/etc/x.h5", "/")), "ExternalLink"),
    "soft link": (lambda f: f["scene"].__setitem__("a", h5py.SoftLink("/truth")), "SoftLink"),
    "second link": (lambda f: f["scene"].__setitem__("a", f["scene/arch"]), "linked a second time"),
    "loop": (lambda f: f["scene"].__setitem__("a", f["scene"]), "linked a second time"),
    "virtual dataset": (virtual, "virtual dataset"),
    "external storage": (external, "data in another file"),
    "lzf": (lambda f: f.create_dataset("scene/l", data=np.zeros(9), chunks=(9,), compression="lzf"), "filter 32000"),
    "objects": (lambda f: f.create_dataset("scene/o", data=["a"], dtype=h5py.string_dtype()), "type object"),
    "references": (lambda f: f.create_dataset("scene/r", data=f["scene"].ref, dtype=h5py.ref_dtype), "type object"),
    "attribute of objects": (lambda f: f.attrs.create("a", "text"), "type object"),
    "declared size": (huge, "declares 8000000000000 bytes but stores 0"),
    "chunks never written": (half_written, "holds 1 of its 5 chunks"),
    "version": (lambda f: f.attrs.__setitem__("format_version", np.bytes_("2.0")), "found 2.0"),
    "format": (lambda f: f.attrs.__setitem__("format", np.bytes_("other")), "expected format processor-scene"),
    "units": (lambda f: f.attrs.__setitem__("units", np.bytes_("m")), "expected units mm, found m"),
    "missing field": (remove(SCAN + "/component"), "/scene/scans/0000/component: missing"),
    "unknown field": (lambda f: f[SCAN].create_group("more"), "/scene/scans/0000/more: unknown"),
    "missing scene": (remove("scene"), "/scene: missing"),
    "missing points": (remove(POINTS), "points: missing"),
    "missing column": (remove(POINTS + "/y"), "expected .*, y, z"),
    "type": (set_to(SCAN + "/origin", np.zeros(3, np.float32)), "expected type f8 .* found <f4"),
    "byte order": (set_to(SCAN + "/origin", np.zeros(3, ">f8")), "found >f8"),
    "shape": (set_to(SCAN + "/origin", np.zeros(4)), r"Scan.origin: expected .*\(4,\)"),
    "axes": (set_to(SCAN + "/origin", np.zeros((1, 3))), "with 1 axes"),
    "length": (set_to(SCAN + "/intensity", np.zeros(7)), "length 7 along 'n'"),
    "number for a text": (set_to(SCAN + "/name", 7), "expected type S"),
    "group for a number": (lambda f: (remove("scene/temperature_C")(f), f["scene"].create_group("temperature_C")),
                           "expected a dataset"),
    "number for a record": (set_to("scene/arch", 7), "expected a group"),
    "not UTF-8": (set_to("scene/name", np.bytes_(b"\xff\xfe")), "not UTF-8"),
    "columns of points": (set_to(POINTS + "/x", np.zeros(50_000, "i8")), "columns of int32 or of float64"),
    "length of a column": (set_to(POINTS + "/x", np.zeros(7, "i4")), "differ in length"),
    "NaN points": (lambda f: [set_to(f"{POINTS}/{axis}", np.full(50_000, np.nan))(f) for axis in "xyz"], "not finite"),
    "NaN origin": (poke(SCAN + "/origin", 0, np.nan), "origin: is not finite"),
    "tile counts": (poke(POINTS + "/count", 0, 3), "does not cover the 50000 points"),
    "tile starts": (poke(POINTS + "/start", 1, 3), "does not cover the 50000 points"),
    "negative counts": (poke(POINTS + "/count", 0, -(2**62)), "does not cover the 50000 points"),
    "tile cells": (poke(POINTS + "/cell", 0, [9, 9, 9]), "lie outside their tile"),
    "tile edge": (set_to(POINTS + "/edge", 0.0), "grid of the tiles"),
    "tile lower": (poke(POINTS + "/lower", 0, np.inf), "grid of the tiles"),
    "members": (lambda f: f.move(SCAN, "scene/scans/7"), "expected groups 0000"),
    "two of one name": (
        set_to("scene/scans/0001/name", np.bytes_("s1")),
        "scans/0001/name: expected another name for each",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", TAMPERED)
def test_tampered_files_are_refused(written, case):
    change, why = TAMPERED[case]
    with h5py.File(without_checksums(written), "r+") as file:
        change(file)
    with pytest.raises(InputError, match=why) as caught:
        store.read_scene(written)
    assert str(caught.value).startswith(str(written))
    assert store.problems(written)


def test_all_problems_are_named(written):
    with h5py.File(without_checksums(written), "r+") as file:
        for name in ("scene/units", SCAN + "/component", "scene/arch/parts/0001/faces", "truth/spacing_mm"):
            del file[name]
    found = "\n".join(store.problems(written))
    for name in ("/scene/units", "/scans/0000/component", "/arch/parts/0001/faces", "/truth/spacing_mm"):
        assert f"{name}: missing" in found


def test_cut_off_and_other_files(written, tmp_path):
    content = written.read_bytes()
    path = tmp_path / "bad.h5"
    for length in (0, 7, 100, 1_000, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert store.problems(path)
        with pytest.raises(InputError, match="damaged, cut off or of another kind"):
            store.read_scene(path)
    path.write_bytes(b"ply\nformat ascii 1.0\n" * 100)
    with pytest.raises(InputError, match="another kind"):
        store.read_scene(path)
    with pytest.raises(InputError, match="no such file"):
        store.read_scene(tmp_path / "absent.h5")
    with pytest.raises(InputError, match="another kind"):
        store.read_scene(tmp_path)  # a folder
