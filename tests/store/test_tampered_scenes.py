"""Scene files that somebody else may have made: links, types, sizes and tiles that do not fit are refused by name."""

import h5py
import numpy as np
import pytest

from processor.model import InputError
from processor.store import store
from tests.support.files.old_files import without_checksums
from tests.support.scenes.store_scenes import a_scene

COUNT = 2_000


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.h5"
    store.write_scene(path, *a_scene(COUNT), {})
    return path.read_bytes(), without_checksums(path).read_bytes()


@pytest.fixture
def written(content, tmp_path):
    (tmp_path / "scene.h5").write_bytes(content[1])
    return tmp_path / "scene.h5"


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
    dataset = file.create_dataset(SCAN + "/intensity", (COUNT,), "f8", chunks=(COUNT // 5,), compression="gzip")
    dataset[: COUNT // 5] = np.random.default_rng(0).uniform(size=COUNT // 5)


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
    "columns of points": (set_to(POINTS + "/x", np.zeros(COUNT, "i8")), "columns of int32 or of float64"),
    "length of a column": (set_to(POINTS + "/x", np.zeros(7, "i4")), "differ in length"),
    "NaN points": (lambda f: [set_to(f"{POINTS}/{axis}", np.full(COUNT, np.nan))(f) for axis in "xyz"], "not finite"),
    "NaN origin": (poke(SCAN + "/origin", 0, np.nan), "origin: is not finite"),
    "tile counts": (poke(POINTS + "/count", 0, 3), "does not cover the 2000 points"),
    "tile starts": (poke(POINTS + "/start", 0, 3), "does not cover the 2000 points"),
    "negative counts": (poke(POINTS + "/count", 0, -(2**62)), "does not cover the 2000 points"),
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
    with h5py.File(written, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=why) as caught:
        store.read_scene(written)
    assert str(caught.value).startswith(str(written))
    assert store.problems(written)


def test_all_problems_are_named(written):
    with h5py.File(written, "r+") as file:
        for name in ("scene/units", SCAN + "/component", "scene/arch/parts/0001/faces", "truth/spacing_mm"):
            del file[name]
    found = "\n".join(store.problems(written))
    for name in ("/scene/units", "/scans/0000/component", "/arch/parts/0001/faces", "/truth/spacing_mm"):
        assert f"{name}: missing" in found


def test_cut_off_and_other_files(content, tmp_path):
    content = content[0]
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
