"""Stitching of more points than fit into memory: what is extracted by blocks equals what is extracted at once."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from processor import large_arrays
from processor.model import Scene
from processor.stitching.planes import grid_bands, scan_planes
from processor.store import store
from tests.support import arrays_in_files
from tests.support.clouds import stitch_clouds
from tests.support.scenes.stitched_rooms import adjusted, errors, reordered


@pytest.fixture
def small(monkeypatch, tmp_path):
    """Blocks of a few rows, bands of the grid of two, and all arrays in files."""
    arrays_in_files.limit(monkeypatch, 997)
    monkeypatch.setattr(grid_bands, "BAND_PLACES", 700)
    with large_arrays.in_files(tmp_path):
        yield


def assert_same(ours, theirs):
    for field in dataclasses.fields(theirs):
        one, other = getattr(ours, field.name), getattr(theirs, field.name)
        if dataclasses.is_dataclass(other):
            assert_same(one, other)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


@pytest.mark.parametrize("grid", [True, False])
def test_planes_and_ends_by_blocks_are_those_of_the_whole(grid, request):
    scan = stitch_clouds.scan(
        "S3", stitch_clouds.pose([3500.0, -2000.0, 1500.0], -75.0, 0.1), 1, step_mrad=20.0, grid=grid
    )
    scan = reordered(scan, np.random.default_rng(0).permutation(len(scan.points)))  # those of a file are in any order
    whole = scan_planes.extract(scan)
    assert (len(whole.ends.points) > 50) == grid
    request.getfixturevalue("small")
    assert_same(scan_planes.extract(scan), whole)


def test_points_that_are_not_finite_are_left_out_with_their_places_in_the_grid():
    scan = stitch_clouds.four(1, step_mrad=24.0)[1][0]
    points = scan.points.copy()
    points[::5] = np.nan
    there = scan_planes.extract(reordered(scan, np.arange(len(points)) % 5 > 0))
    assert_same(scan_planes.extract(dataclasses.replace(scan, points=points)), there)


def test_more_points_make_no_more_cells(monkeypatch):
    """The poses are those of the finer cells within their intervals."""
    T, scans = (some[:3] for some in stitch_clouds.four(2, step_mrad=20.0))
    count = sum(len(scan.points) for scan in scans)
    monkeypatch.setattr(scan_planes, "MOST_CELLS", count // 20)
    assert scan_planes.points_a_cell(scans[0], count) == pytest.approx(20.0, rel=0.01)  # count is no multiple of 20
    cells = [scan_planes.extract(scans[0], a_cell=a_cell).cell_mm for a_cell in (5.0, 20.0)]
    assert cells[1] > 1.5 * cells[0]  # a cell of four times the points has twice the side
    result = adjusted(T, scans)
    off = np.abs(errors(result.scans.T_project_scan, T)[0][1:])
    assert (off < 4.0 * result.scans.position_sd[1:]).all()  # four sds
    assert result.scans.status == ("ok",) * 3


@pytest.mark.slow
def test_memory_does_not_grow_with_the_points(tmp_path):
    """Five million points of a scan, with their places in the grid, take 160 MB as arrays, and as much sorted.

    Read and passed over by blocks they take what a band of the grid takes, 64 bytes a point for a million places and
    as much while they are sorted, and the cells: 400,000 of ten moments, in two copies, with half as much for the
    larger cubes.
    """
    code = (
        "import re, sys; from pathlib import Path; from processor import large_arrays\n"
        "from processor.stitching.planes import scan_planes; from processor.store import store\n"
        "with large_arrays.in_files(Path(sys.argv[1]).parent):\n"
        "    (scan,) = store.read_scene(Path(sys.argv[1])).scans\n"
        "    scan_planes.extract(scan, 0.0, scan_planes.points_a_cell(scan, len(scan.points)))\n"
        "print(int(re.search(r'VmHWM:\\s*(\\d+)', open('/proc/self/status').read())[1]) // 1024)"
    )
    peak = []
    for step_mrad in (12.0, 1.7):
        scan = stitch_clouds.scan("S", stitch_clouds.pose([0.0, 500.0, 1700.0], 140.0), 1, step_mrad=step_mrad)
        path = tmp_path / f"{step_mrad}.h5"
        store.write_scene(path, Scene("room", "structure", (scan,)), None, {})
        done = subprocess.run([sys.executable, "-c", code, path], check=True, capture_output=True, text=True)
        peak.append(int(done.stdout))
    assert peak[1] < peak[0] + 64 + 128 + 96, peak  # MEMORY_BYTES, a band, the cells
