"""processor compare by tiles, with all arrays in files: the same bytes as at once, whatever the tiles are."""

import tracemalloc

import numpy as np
import pytest

from processor import large_arrays
from processor.adjustment import distance_summary
from processor.cli.main import commands
from processor.compare import core_tiles
from processor.compare.compare import Request, compare
from processor.geometry import m3c2, nearest_neighbours, normal_orientation, point_grid
from processor.model import Scan, Scene
from processor.report import cloud_comparison
from processor.store import store
from tests.support import arrays_in_files
from tests.support.clouds.m3c2_clouds import wavy

UTM = np.array([512_345.25, 5_412_678.5, 231.0])  # metres


def site(seed, off, count=900):
    """Waves with a hole, an upright wall, and a few points far away; metres at UTM coordinates."""
    rng = np.random.default_rng(seed)
    ground = wavy(count, seed, off) / 1000.0
    ground = ground[np.hypot(*(ground[:, :2] - 0.4).T) > 0.2]
    x, z = rng.uniform(0.0, 1.0, (2, count // 2))
    wall = np.column_stack([x, 1.05 + off / 1000.0 + rng.normal(0.0, 0.002, count // 2), z])
    far = rng.uniform(0.0, 0.02, (5, 3)) + np.array([4.0, 3.0 + seed, 2.0])
    return np.vstack([ground, wall, far]) + UTM


@pytest.fixture
def inputs(tmp_path):
    """A reference of two scans with a scanner each and one without any, another cloud, and core points."""
    places = site(1, 0.0), site(2, 5.0)
    scans = []
    for part, scanner in zip(np.array_split(places[0], 3), ([0.3, -4.0, 2.0], [0.5, 6.0, 2.0], None), strict=True):
        position = () if scanner is None else 1000.0 * (UTM + scanner)
        scans.append(Scan(f"S{len(scans)}", 1000.0 * (part - UTM), origin=1000.0 * UTM, position=position))
    store.write_scene(tmp_path / "scans.h5", Scene("a", "structure", tuple(scans), units="mm"), None, {})
    for name, points in (
        ("a.xyz", places[0]),
        ("b.xyz", places[1]),
        ("core.xyz", np.vstack([places[0][::7], places[0][-2:]]) + 0.003),
    ):
        np.savetxt(tmp_path / name, points, fmt="%.17g")
    np.savetxt(tmp_path / "b.csv", 1000.0 * places[1], fmt="%.17g", header="x[mm] y[mm] z[mm]", comments="")
    return tmp_path


@pytest.fixture
def tiny(monkeypatch):
    """A function that makes tiles, blocks and parts tiny and puts every array into a file."""

    def make(core_points=67, cloud_points=1500):
        arrays_in_files.limit(monkeypatch, 150, 230)
        monkeypatch.setattr(core_tiles, "CORE_POINTS", core_points)
        monkeypatch.setattr(core_tiles, "CLOUD_POINTS", cloud_points)

    return make


def compared(folder, out, *arguments):
    """The bytes of all files that the command writes."""
    options = [str(folder / one) if (folder / one).is_file() else one for one in arguments]
    commands(["compare", *options, "-o", str(folder / out)], standalone_mode=False)
    return {path.name: path.read_bytes() for path in (folder / out).iterdir()}


CASES = {
    "every point": ("a.xyz", "b.xyz"),
    "core points": ("a.xyz", "b.xyz", "--core", "core.xyz"),
    "scanners": ("scans.h5", "b.csv"),
}


@pytest.mark.parametrize(
    "case", [pytest.param("core points", marks=pytest.mark.slow), "scanners"]
)  # every point: with a sample, below
def test_files_have_the_same_bytes_by_tiles(case, inputs, tiny, request):
    if case != "core points":
        request.getfixturevalue("blank_pictures")
    whole = compared(inputs, "whole", *CASES[case])
    tiny()
    tiled = compared(inputs, "tiled", *CASES[case])
    assert set(whole) == set(tiled) == set(cloud_comparison.OWN_NAMES)
    for name, data in whole.items():
        assert tiled[name] == data, name
    assert b"nan" in whole["compare.csv"]


@pytest.fixture
def few(monkeypatch):
    """Samples of several hundred points are drawn, and joined to surfaces."""
    for module, name in ((normal_orientation, "MOST_JOINED"), (cloud_comparison, "MOST_DRAWN")):
        monkeypatch.setattr(module, name, 700)
        monkeypatch.setattr(module, "SAMPLE", 400)


def test_a_sample_does_not_depend_on_the_tiles(inputs, tiny, few, blank_pictures):
    whole = compared(inputs, "whole", *CASES["every point"])
    assert b"core points, an even sample" in whole["report.html"]
    tiny(90, 1400)
    assert compared(inputs, "tiled", *CASES["every point"]) == whole


def test_normals_follow_the_sample_as_they_follow_the_whole(inputs, monkeypatch):
    request = Request(inputs / "a.xyz", inputs / "b.xyz")
    whole = compare(request)
    monkeypatch.setattr(normal_orientation, "MOST_JOINED", 700)
    monkeypatch.setattr(normal_orientation, "SAMPLE", 400)
    found = compare(request)
    same = (found.normals == whole.normals).all(axis=1) | np.isnan(found.normals).any(axis=1)
    upright = np.abs(whole.normals[:, 1]) > 0.95
    assert upright.sum() > 330
    assert same[upright].all()
    assert (found.turned.up, found.turned.upright) == (whole.turned.up, whole.turned.upright)


def test_a_grid_in_parts_is_that_of_the_whole(tiny):
    rng = np.random.default_rng(4)
    clouds = {
        "surface": wavy(6000, 3),
        "one place": np.tile([[1.0, 2.0, 3.0]], (2000, 1)),
        "line": rng.uniform(0.0, 1e5, (3000, 1)) * [1.0, 0.0, 0.0],  # cells are made larger
        "equal points": np.repeat(wavy(900, 5), 4, axis=0),
    }
    wholes = {
        name: [nearest_neighbours.of_spacing(points), point_grid.of_points(points, 3.0)]
        for name, points in clouds.items()
    }
    tiny()
    for name, points in clouds.items():
        parts = nearest_neighbours.of_spacing(points), point_grid.of_points(points, 3.0)
        for whole, part in zip(wholes[name], parts, strict=True):
            np.testing.assert_array_equal(points[part.order], part.cells.points)
            np.testing.assert_array_equal(np.sort(part.order), np.arange(len(points)))
            for one, other in zip(part.cells, whole.cells, strict=True):
                np.testing.assert_array_equal(one, other, name)


def test_blocks_about_a_box_are_those_of_all_that_meet_it():
    points = np.random.default_rng(1).uniform(-50.0, 50.0, (5000, 3))
    grid = point_grid.of_points(points, 1.5)
    block = np.floor((grid.cells.points - grid.cells.lower) / (4 * grid.cells.size))
    for low, high in np.random.default_rng(2).uniform(-70.0, 70.0, (40, 2, 3)):
        low, high = np.minimum(low, high), np.maximum(low, high)
        first, last = (np.floor((corner - grid.cells.lower) / (4 * grid.cells.size)) for corner in (low, high))
        meets = ((block >= first - 1) & (block <= last + 1)).all(axis=1)
        np.testing.assert_array_equal(point_grid.within(grid, low, high).order, grid.order[meets])
        assert point_grid.count_within(grid, low, high) == meets.sum()


def test_statistics_by_blocks_are_those_of_numpy_to_the_bit(monkeypatch):
    rng = np.random.default_rng(0)
    for block in (100, 331):
        monkeypatch.setattr(large_arrays, "BLOCK_ROWS", block)
        monkeypatch.setattr(large_arrays, "AT_ONCE", block)
        for count in (1, 2, 8, 127, 129, 257, 1000, 4099):
            for values in (rng.normal(0.1, 1.0, count), rng.integers(0, 3, count) * 0.1, np.full(count, 0.3)):
                assert large_arrays.total(values) == np.sum(values)
                assert large_arrays.total(values, np.square) == np.sum(values**2)
                assert large_arrays.median(values) == np.median(values)
                low, high = large_arrays.extremes(values)
                assert large_arrays.first_of(values, low) == np.argmin(values)
                assert large_arrays.first_of(values, high) == np.argmax(values)


def test_a_median_by_blocks_keeps_none_of_them(monkeypatch):
    monkeypatch.setattr(large_arrays, "BLOCK_ROWS", 1 << 14)
    monkeypatch.setattr(large_arrays, "AT_ONCE", 1 << 14)
    values = np.random.default_rng(0).normal(size=1 << 20)
    expected = float(np.median(values))
    tracemalloc.start()
    try:
        assert large_arrays.median(values) == expected
        assert tracemalloc.get_traced_memory()[1] < 0.25 * values.nbytes
    finally:
        tracemalloc.stop()


def test_columns_are_put_back_in_order(tiny, tmp_path):
    tiny()
    rng = np.random.default_rng(0)
    with large_arrays.in_files(tmp_path):
        for count in (0, 1, 229, 231, 1400):
            rows = rng.permutation(count)
            for values in (rng.normal(size=(count, 3)), rng.integers(0, 9, count)):
                expected = np.empty_like(values)
                expected[rows] = values
                np.testing.assert_array_equal(large_arrays.put_back(values, rows), expected)


def test_a_summary_by_blocks_is_that_of_the_whole(tiny):
    rng = np.random.default_rng(3)
    core, normals = 100.0 * rng.random((3000, 3)), rng.normal(size=(3000, 3))
    columns = [rng.normal(size=3000), np.where(rng.random(3000) < 0.2, np.nan, rng.random(3000))]
    found = m3c2.Distances(*columns, *rng.integers(0, 40, (2, 3000)), *rng.random((2, 3000)))
    whole = distance_summary.of_distances(found, core, normals, 2.0, 20)
    tiny()
    assert distance_summary.of_distances(found, core, normals, 2.0, 20) == whole
