"""``processor convert``: a scan folder or file of any format as a scene file, block by block."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import processor
from designgen.export import folder as export_folder
from designgen.export import formats
from processor import large_arrays
from processor.api import conversion
from processor.cli.main import commands
from processor.jobs.exit_codes import BAD_INPUT
from processor.model import InputError, PointLabels, Scan, Truth, UsageError
from processor.scan_folder import folder
from processor.store import store
from processor.writers import e57
from processor.writers.cloud import of_scan
from tests.support import arrays_in_files
from tests.support.files.scan_bytes import las_bytes, put
from tests.support.processes import commands as in_process
from tests.support.scenes.exported_scenes import exported, merged, on_grid, stations_apart

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"
FORMATS = sorted((FIXTURES / "formats").iterdir())
PLACE = FIXTURES / "scan-folder"
FAR = np.array([500_000_000.0, 4_400_000_000.0, 12_000.0])
BLOCK = 97  # rows: of few points several blocks


@pytest.fixture
def blocks(monkeypatch):
    """All arrays lie in files, and are passed over in blocks of few rows."""
    arrays_in_files.limit(monkeypatch, BLOCK)


def full_disk(*_):
    raise OSError(28, "No space left on device")


def in_memory(path, tmp_path):
    """The bytes of the scene file of an input that is read whole."""
    out = tmp_path / "whole.h5"
    store.write_scene(out, folder.read_input(path), None, conversion._provenance(path))
    return out.read_bytes()


def converted(path, tmp_path):
    processor.convert(path, tmp_path / "blocks.h5")
    return (tmp_path / "blocks.h5").read_bytes()


@pytest.mark.parametrize("path", FORMATS, ids=lambda path: path.suffix)
def test_blocks_give_the_bytes_of_a_whole_reading(path, tmp_path, monkeypatch):
    expected = in_memory(path, tmp_path)
    for size in (7, 200, 201):  # within a scan, all of it, one row more
        arrays_in_files.limit(monkeypatch, size)
        assert converted(path, tmp_path) == expected


@pytest.mark.parametrize("format_", ["e57", "laz", "ply", "xyz", "ptx"])
def test_stations_grids_intensities_and_origins_are_those_of_a_whole_reading(format_, tmp_path, monkeypatch):
    scene = stations_apart(FAR) if format_ in ("e57", "ptx") else merged(FAR)
    _, out = exported(scene, tmp_path, format_)
    (out / "truth.h5").unlink(missing_ok=True)
    expected = in_memory(out, tmp_path)
    arrays_in_files.limit(monkeypatch, BLOCK)
    assert converted(out, tmp_path) == expected
    back = store.read_scene(tmp_path / "blocks.h5")
    assert [len(scan.points) for scan in back.scans] == [len(scan.points) for scan in scene.scans]
    assert all(len(scan.intensity) for scan in back.scans)
    if format_ in ("e57", "ptx"):
        for ours, theirs in zip(scene.scans, back.scans, strict=True):
            # Of 4e9 mm: two roundings.
            np.testing.assert_allclose(theirs.T_project_scan, ours.T_project_scan, atol=1e-6)
            assert len(theirs.grid_row) == len(ours.points)
    else:
        assert sorted(back.scans[0].point_station.tolist()) == [0] * 300 + [1] * 200


def test_colours_of_several_scans_in_one_e57(tmp_path, blocks):
    rng = np.random.default_rng(0)
    scans = [
        Scan(name, on_grid(300)[0], colour=rng.integers(0, 256, (300, 3)).astype(np.uint8), T_project_scan=np.eye(4))
        for name in ("a", "b")
    ]
    e57.write(tmp_path / "two.e57", [*map(of_scan, scans)], spherical=False)
    processor.convert(tmp_path / "two.e57", tmp_path / "two.h5")
    back = store.read_scene(tmp_path / "two.h5")
    assert [scan.name for scan in back.scans] == ["a", "b"]
    for ours, theirs in zip(scans, back.scans, strict=True):
        row = np.lexsort(np.round(ours.points, 2).T), np.lexsort(np.round(theirs.points, 2).T)
        np.testing.assert_array_equal(theirs.colour[row[1]], ours.colour[row[0]])


def test_whole_numbers_of_las_are_kept(tmp_path, blocks):
    """The scale and the offset of the file: each coordinate comes back as the whole number it was."""
    rng = np.random.default_rng(1)
    whole = rng.integers(-400_000, 400_000, (500, 3))
    content = las_bytes(whole, scale=0.0001, offset=(431.0, -77.5, 3.0))
    processor.convert(put(tmp_path / "a.las", content), tmp_path / "a.h5")
    (scan,) = store.read_scene(tmp_path / "a.h5").scans
    metres = (scan.points + scan.origin) / 1000.0 - [431.0, -77.5, 3.0]
    back = np.rint(metres / 0.0001).astype(int)
    assert np.abs(metres / 0.0001 - back).max() < 1e-3  # steps; float64 at 500 m has 1e-9 of them
    assert sorted(map(tuple, back.tolist())) == sorted(map(tuple, whole.tolist()))


def test_given_units_are_stored_in_the_scene(tmp_path, blocks):
    points = np.random.default_rng(2).uniform(-100.0, 100.0, (400, 3)).round(3)
    np.savetxt(tmp_path / "a.xyz", points, fmt="%.3f")
    done = CliRunner().invoke(
        commands, ["convert", str(tmp_path / "a.xyz"), "-o", str(tmp_path / "a.h5"), "--units", "inch", "--json"]
    )
    said = json.loads(done.stdout)
    assert (said["units"], said["scans"], said["truth"]) == ("inch", [{"name": "a", "points": 400}], False)
    scene = store.read_scene(tmp_path / "a.h5")
    assert scene.units == "inch"
    back = scene.scans[0].points
    # Half of 0.0001 mm.
    np.testing.assert_allclose(back[np.lexsort(back.T)], 25.4 * points[np.lexsort(points.T)], atol=5.1e-5)


def test_unit_guessed_by_blocks_equals_that_of_the_whole_scene(tmp_path, monkeypatch):
    """Points 0.9 m apart if they were metres: taken as millimetres, by the nearest points of a slab."""
    x, y = np.mgrid[:60, :60]
    points = 0.9 * np.c_[x.ravel(), y.ravel(), 0.01 * (x * y).ravel()]
    np.savetxt(tmp_path / "a.xyz", np.random.default_rng(3).permutation(points), fmt="%.4f")
    expected = in_memory(tmp_path / "a.xyz", tmp_path)
    monkeypatch.setattr("processor.scan_folder.units.SAMPLE", 500)
    arrays_in_files.limit(monkeypatch, BLOCK)
    assert converted(tmp_path / "a.xyz", tmp_path)
    assert store.read_scene(tmp_path / "blocks.h5").units == "mm"
    monkeypatch.undo()
    assert converted(tmp_path / "a.xyz", tmp_path) == expected


def test_the_truth_comes_along_with_its_labels_in_the_order_of_the_points(tmp_path, blocks):
    scene = merged(np.zeros(3))
    points = scene.scans[0].points
    label = PointLabels("scan", ("x",), np.zeros(500), np.zeros(500), range_error_mm=points[:, 0])
    store.write_scene(tmp_path / "t.h5", scene, Truth((label,)), {})
    export_folder.export(tmp_path / "t.h5", tmp_path / "out", "ply", with_truth=True)
    assert conversion.convert(tmp_path / "out", tmp_path / "s.h5").with_truth
    (kept,), (scan,) = store.read_truth(tmp_path / "s.h5").labels, store.read_scene(tmp_path / "s.h5").scans
    # Labels keep float32 of 3e4 mm: 4e-3.
    np.testing.assert_allclose(kept.range_error_mm, scan.points[:, 0] + scan.origin[0], atol=0.01)
    # Of a scan that is clipped the labels do not fit.
    toml = tmp_path / "out/project.toml"
    toml.write_text(toml.read_text() + "\n[[clip]]\nbox = [[-1e5, -1e5, -1e5], [0, 1e5, 1e5]]\n")
    processor.convert(tmp_path / "out", tmp_path / "s.h5")
    assert store.read_truth(tmp_path / "s.h5").labels == ()


def test_clips_of_a_project_are_applied_and_stored_on_conversion(tmp_path, blocks):
    _, out = exported(merged(np.zeros(3)), tmp_path, "ply")
    toml = out / "project.toml"
    toml.write_text(toml.read_text() + "\n[[clip]]\nbox = [[-1e5, -1e5, -1e5], [0, 1e5, 1e5]]\n")
    read = folder.read_input(out)
    processor.convert(out, tmp_path / "s.h5")
    back = store.read_scene(tmp_path / "s.h5")
    assert len(back.scans[0].points) == len(read.scans[0].points) < 500
    assert back.clips.kept == read.clips.kept


@pytest.mark.parametrize(("content", "said"), [("", "the file is empty"), ("1 2 3\n", "has 1 points; expected 4")])
def test_a_file_of_too_few_points_is_bad_input(content, said, tmp_path, blocks):
    (tmp_path / "a.xyz").write_text(content)
    done = CliRunner().invoke(commands, ["convert", str(tmp_path / "a.xyz"), "-o", str(tmp_path / "a.h5")])
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["a.xyz"]


def test_exit_codes(tmp_path):
    store.write_scene(tmp_path / "s.h5", merged(np.zeros(3)), None, {})
    for input_, code, text in (("s.h5", 2, "is a scene file already"), ("no.laz", BAD_INPUT, "there is no such file")):
        done = in_process.here("processor", "convert", tmp_path / input_, "-o", tmp_path / "t.h5")
        assert (done.returncode, text in done.stderr) == (code, True), done.stderr
        assert not (tmp_path / "t.h5").exists()


def test_output_is_checked_before_reading_and_kept_if_writing_fails(tmp_path, monkeypatch):
    np.savetxt(tmp_path / "a.xyz", np.random.default_rng(0).uniform(size=(100, 3)))
    out = tmp_path / "s.h5"
    processor.convert(tmp_path / "a.xyz", out)
    before = out.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("processor.store.scan_tiles.write_scan", full)
    with pytest.raises(InputError, match="cannot be written"):
        processor.convert(tmp_path / "a.xyz", out)
    assert out.read_bytes() == before
    monkeypatch.setattr("processor.pipeline.read", lambda *_: pytest.fail("read before the output was tried"))
    with pytest.raises(InputError, match="cannot be written"):
        processor.convert(tmp_path / "a.xyz", tmp_path / "none/s.h5")
    with pytest.raises(UsageError, match="expected a scene file"):
        processor.convert(tmp_path / "a.xyz", tmp_path / "s.laz")
    with pytest.raises(UsageError, match="where the truth of the input lies"):
        processor.convert(tmp_path, tmp_path / "truth.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.xyz", "s.h5"]


def test_disk_without_room_for_the_points_is_refused_by_file(tmp_path, blocks, monkeypatch):
    np.savetxt(tmp_path / "a.xyz", np.random.default_rng(0).uniform(size=(100, 3)))
    formats.write_ptx(tmp_path / "b.ptx", stations_apart(np.zeros(3)).scans[0], None)

    monkeypatch.setattr("os.posix_fallocate", full_disk)
    for name in ("a.xyz", "b.ptx"):
        with pytest.raises(InputError, match=f"{name}: cannot be read \\(the disk of .* has no room for its points"):
            processor.convert(tmp_path / name, tmp_path / "s.h5")


def test_arrays_in_files_leave_no_file(tmp_path, blocks):
    with large_arrays.in_files(tmp_path):
        array = large_arrays.allocate(1000, 3)
        array[:] = np.arange(3000.0).reshape(-1, 3)
        assert list(tmp_path.iterdir()) == []
    large_arrays.release()
    assert array[999].tolist() == [2997.0, 2998.0, 2999.0]


def test_passes_by_blocks_are_those_of_numpy(blocks):
    rng = np.random.default_rng(0)
    for n in (1, BLOCK - 1, BLOCK, BLOCK + 1, 5 * BLOCK + 3):
        array = rng.normal(size=(n, 3))
        assert large_arrays.extremes(array) == (array.min(), array.max())
        for step in (1, 2, 50, BLOCK, 1000):
            np.testing.assert_array_equal(large_arrays.every(array, step), array[::step])
        rows = rng.integers(0, n, 40)
        np.testing.assert_array_equal(large_arrays.taken(array, rows), array[rows])
        kept = rng.random(n) < 0.5
        np.testing.assert_array_equal(large_arrays.chosen(array, kept), array[kept])
        np.testing.assert_array_equal(large_arrays.contiguous(array[:, 1], np.float32), array[:, 1].astype(np.float32))
    with_nan = np.array([1.0, np.nan, 3.0])
    assert np.isnan(large_arrays.extremes(with_nan)[0])


def test_a_scene_from_a_folder_runs_as_the_folder(tmp_path):
    """The same balls, but for coordinates rounded to 0.0001 mm."""
    processor.convert(PLACE, tmp_path / "frame.h5")
    ours, theirs = (processor.run(place).steps["spheres"].balls for place in (PLACE, tmp_path / "frame.h5"))
    assert ours.flag == theirs.flag
    assert [[one.code for one in row] for row in ours.reasons] == [[one.code for one in row] for row in theirs.reasons]
    for name in ("centres", "radii", "covariance"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), rtol=1e-3, atol=1e-3)  # mm: 10 roundings


@pytest.mark.slow
def test_memory_does_not_grow_with_the_points(tmp_path):
    """Eight million points take 270 MB as arrays; read and written block by block they hardly count."""
    # Not ru_maxrss, which begins with the peak of the process that started this one.
    code = (
        "import re, sys; from processor.api import conversion\n"
        "conversion.convert(sys.argv[1], sys.argv[2])\n"
        "print(int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) // 1024)"
    )
    peak = []
    for count in (100_000, 8_000_000):
        rows = np.zeros(count, [("xyz", "<i4", 3), ("others", "<u1", 8)])
        rows["xyz"] = np.random.default_rng(0).uniform(-50_000.0, 50_000.0, (count, 3))
        header = bytearray(las_bytes(rows["xyz"][:2], scale=0.001, offset=np.zeros(3))[:227])
        header[107:115] = struct.pack("<2I", count, count)
        path = put(tmp_path / f"{count}.las", bytes(header) + rows.tobytes())
        done = subprocess.run(
            [sys.executable, "-c", code, path, tmp_path / "s.h5"], check=True, capture_output=True, text=True
        )
        peak.append(int(done.stdout))
    assert peak[1] < peak[0] + 330, peak


def test_a_scene_read_into_files_is_the_same(tmp_path, monkeypatch):
    scene = merged(FAR)
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    whole = store.scene_hash(store.read_scene(tmp_path / "s.h5"))
    arrays_in_files.limit(monkeypatch, BLOCK)
    monkeypatch.setattr("processor.store.checksums.PART_ITEMS", 100)
    with large_arrays.in_files(tmp_path):
        assert store.scene_hash(store.read_scene(tmp_path / "s.h5")) == whole
    monkeypatch.setattr("os.posix_fallocate", full_disk)
    with large_arrays.in_files(tmp_path), pytest.raises(InputError, match=r"cannot be read \(the disk of"):
        store.read_scene(tmp_path / "s.h5")
