"""Tiles of one scene on a cluster: the same results as here, whatever happens to workers."""

import os
from collections import Counter

import numpy as np
import pytest

from processor import tiles
from processor.adjustment import mixed_pixels
from processor.api import runs
from processor.cli.main import commands
from processor.compare import core_tiles
from processor.compare.compare import Request, compare
from processor.deviation import cloud, large_cloud
from processor.jobs import runner, tile_cluster
from processor.model import InputError, Scan, Scene, Stations, UsageError
from processor.space_frame.spheres import alternating_fit
from processor.store import store
from processor.tiles import Shared
from tests.support.clouds import frame_clouds
from tests.support.clouds.m3c2_clouds import wavy
from tests.support.processes import tile_functions
from tests.support.processes.dask_cluster import dask_cluster  # noqa: F401
from tests.support.processes.living import alive
from tests.support.scenes.bracket_scenes import scene_of

TILES = [np.full(3, float(k)) for k in range(7)]


def no_log(_):
    """Drop a line of progress."""


def test_tiles_are_computed_here_in_order():
    found = tiles.mapped(tile_functions.scaled, TILES, Shared(np.array([2.0])))
    assert [int(part[0]) for part, _, _ in found] == [0, 2, 4, 6, 8, 10, 12]


def test_tiles_are_generated_one_by_one():
    """The next tile is made only when the result of the last one was taken: many tiles need no memory."""
    made = []
    found = tiles.mapped(np.sum, (made.append(k) or tile for k, tile in enumerate(TILES)))
    next(found)
    assert made == [0]


def test_ranges_cover_all_rows():
    assert [(part.start, part.stop) for part in tiles.ranges(10, 4)] == [(0, 4), (4, 8), (8, 10)]
    assert tiles.ranges(0, 4) == []


def test_tiles_on_a_cluster_come_in_order_from_its_workers(dask_cluster):  # noqa: F811
    factor = Shared(np.array([2.0]))
    with tile_cluster.on_cluster(dask_cluster.address, no_log):
        for _ in range(2):
            found = list(tiles.mapped(tile_functions.scaled, iter(TILES), factor))
            assert [int(part[0]) for part, _, _ in found] == [0, 2, 4, 6, 8, 10, 12]
            assert all(writeable for _, writeable, _ in found)
            assert {pid for *_, pid in found} <= {one.pid for one in dask_cluster.workers}
        assert [pid for *_, pid in tiles.mapped(tile_functions.scaled, TILES[:1], factor)] == [os.getpid()]
    assert {pid for *_, pid in tiles.mapped(tile_functions.scaled, TILES, factor)} == {os.getpid()}


def test_errors_of_tiles_are_raised(dask_cluster):  # noqa: F811
    with tile_cluster.on_cluster(dask_cluster.address, no_log):
        with pytest.raises(InputError, match="tile 0: refused"):
            list(tiles.mapped(tile_functions.refused, TILES))
        with pytest.raises(InputError, match="a worker has too little memory for a tile"):
            list(tiles.mapped(tile_functions.without_memory, TILES))


def test_a_worker_with_other_software_is_named(dask_cluster, monkeypatch):  # noqa: F811
    other = {**tile_cluster.software(), "numpy": "1.0"}
    monkeypatch.setattr(tile_cluster, "software", lambda: other)
    message = rf"--cluster {dask_cluster.address}: tcp://.*: a worker has other software: numpy .*, not 1.0"
    with pytest.raises(UsageError, match=message), tile_cluster.on_cluster(dask_cluster.address, no_log):
        pass
    monkeypatch.setattr(tile_cluster, "_check_workers", lambda _: None)  # as of a worker that joins later
    with (
        pytest.raises(InputError, match=r"a worker has other software: numpy .*, not 1.0"),
        tile_cluster.on_cluster(dask_cluster.address, no_log),
    ):
        list(tiles.mapped(np.sum, TILES))


# --- results ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch):
    """Scans of a few thousand points are large, and their slabs small."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 5_000)
    monkeypatch.setattr(cloud, "SAMPLE_POINTS", 4_000)
    monkeypatch.setattr(large_cloud, "SLAB_POINTS", 2_000)
    monkeypatch.setattr(large_cloud, "PASS_POINTS", 2_000)
    monkeypatch.setattr(mixed_pixels, "AT_ONCE", 1_000)
    monkeypatch.setattr(mixed_pixels, "BAND_POINTS", 500)


@pytest.fixture
def used(monkeypatch):
    """The names of the functions whose tiles a cluster computes."""
    names, results = set(), tile_cluster._ClusterWorkers.results

    def noted(self, function, *rest):
        names.add(function.__name__)
        return results(self, function, *rest)

    monkeypatch.setattr(tile_cluster._ClusterWorkers, "results", noted)
    return names


def stored(scene, path, step, cluster):
    """The bytes of results.h5, without the report."""
    execution = runs.compute(scene, steps=step, cluster=cluster).execution
    store.write_results(path, execution.runs, execution.provenance)
    return path.read_bytes()


def test_a_deviation_has_the_same_bytes_as_here(dask_cluster, small, used, tmp_path):  # noqa: F811
    scene = scene_of(scans=2, count=6_000)
    here, there = (stored(scene, tmp_path / "a.h5", "deviation", one) for one in (None, dask_cluster.address))
    of_mixed = {"_neighbours", "_marks_of"}
    assert used == {"_near", "_assigned_of", *of_mixed, "_first_of", "_second_of", "_last_of", "_on_pieces_of"}
    assert here == there


def test_spheres_have_the_same_bytes_as_here(dask_cluster, used, tmp_path, monkeypatch):  # noqa: F811
    points, station = frame_clouds.scanned(frame_clouds.grid(3, 2), np.random.default_rng(1))
    scan = Scan("s", points, point_station=station)
    stations = Stations(("A", "B", "C", "D"), frame_clouds.STATIONS)
    scene = Scene("frame", "space-frame", (scan,), stations=stations, units="mm")
    found = []
    for nodes, cluster in ((200, None), (3, None), (3, dask_cluster.address)):
        monkeypatch.setattr(alternating_fit, "NODES", nodes)
        found.append(stored(scene, tmp_path / "a.h5", "spheres", cluster))
    assert used == {"choose", "fit_final"}
    assert found[0] == found[1] == found[2]


def test_a_comparison_has_the_same_bytes_as_here(dask_cluster, used, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(core_tiles, "CORE_POINTS", 600)
    for name, points in (("a.xyz", wavy(1500, 1)), ("b.xyz", wavy(1500, 2, 5.0))):
        np.savetxt(tmp_path / name, points)
    request, found = Request(tmp_path / "a.xyz", tmp_path / "b.xyz"), []
    for address in (None, dask_cluster.address):
        with tile_cluster.on_cluster(address, no_log):
            found.append(compare(request))
    assert used == {"_normals", "_distances"}
    for name in ("distance", "lod95", "n1", "n2", "std1", "std2"):
        here, there = (getattr(one.distances, name) for one in found)
        assert here.tobytes() == there.tobytes()
    assert found[0].normals.tobytes() == found[1].normals.tobytes()


@pytest.mark.parametrize("command", [("run", "a.xyz", "--steps", "spheres"), ("compare", "a.xyz", "b.xyz")])
def test_commands_take_a_cluster(command, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "CONNECT_S", 0.2)
    for name in ("a.xyz", "b.xyz"):
        np.savetxt(tmp_path / name, wavy(100, 1))
    arguments = [str(tmp_path / one) if one.endswith(".xyz") else one for one in command]
    with pytest.raises(UsageError, match="expected the address of a Dask scheduler that answers"):
        commands([*arguments, "-o", str(tmp_path / "out"), "--cluster", "tcp://127.0.0.1:1"], standalone_mode=False)


def test_dying_worker_has_its_tile_computed_again(dask_cluster, tmp_path):  # noqa: F811
    """The last test of the cluster, as one of its workers ends; its tile and what it had begun are computed again."""
    with tile_cluster.on_cluster(dask_cluster.address, no_log):
        found = list(tiles.mapped(tile_functions.ends_its_worker, TILES, Shared(str(tmp_path))))
    np.testing.assert_array_equal(found, np.sqrt(TILES))
    again = {k for k, n in Counter(one.name.split("-")[0] for one in tmp_path.iterdir()).items() if n > 1}
    assert "2" in again
    assert len(again) <= 2 * tile_cluster.AHEAD, "of those submitted, what it had begun or not handed over"
    assert sum(not alive(one.pid) for one in dask_cluster.workers) == 1
