"""Tiles of one scene on a cluster: the same results as here, whatever happens to workers."""

import os
from collections import Counter

import numpy as np
import pytest

import processor
from processor import tiles
from processor.deviation import cloud, large_cloud
from processor.jobs import tile_cluster
from processor.model import InputError, UsageError
from processor.store import store
from processor.tiles import Shared
from tests.support import tile_functions
from tests.support.bracket_scenes import scene_of
from tests.support.dask_cluster import cluster_in, dask_cluster  # noqa: F401

TILES = [np.full(3, float(k)) for k in range(7)]


def said(_):
    """Nobody reads what is said here."""


def test_tiles_are_computed_here_in_order():
    found = tiles.mapped(tile_functions.scaled, TILES, Shared(np.array([2.0])))
    assert [int(part[0]) for part, _, _ in found] == [0, 2, 4, 6, 8, 10, 12]


def test_tiles_are_passed_over_once_and_not_held():
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
    with tile_cluster.on_cluster(dask_cluster.address, said):
        for _ in range(2):
            found = list(tiles.mapped(tile_functions.scaled, iter(TILES), factor))
            assert [int(part[0]) for part, _, _ in found] == [0, 2, 4, 6, 8, 10, 12]
            assert all(writeable for _, writeable, _ in found)
            assert {pid for *_, pid in found} <= {one.pid for one in dask_cluster.workers.values()}
        assert [pid for *_, pid in tiles.mapped(tile_functions.scaled, TILES[:1], factor)] == [os.getpid()]
    assert {pid for *_, pid in tiles.mapped(tile_functions.scaled, TILES, factor)} == {os.getpid()}


def test_errors_of_tiles_are_raised(dask_cluster):  # noqa: F811
    with tile_cluster.on_cluster(dask_cluster.address, said):
        with pytest.raises(InputError, match="tile 0: refused"):
            list(tiles.mapped(tile_functions.refused, TILES))
        with pytest.raises(InputError, match="a worker has too little memory for a tile"):
            list(tiles.mapped(tile_functions.without_memory, TILES))


def test_a_worker_with_other_software_is_named(dask_cluster, monkeypatch):  # noqa: F811
    other = {**tile_cluster.software(), "numpy": "1.0"}
    monkeypatch.setattr(tile_cluster, "software", lambda: other)
    message = rf"--cluster {dask_cluster.address}: tcp://.*: a worker has other software: numpy .*, not 1.0"
    with pytest.raises(UsageError, match=message), tile_cluster.on_cluster(dask_cluster.address, said):
        pass
    monkeypatch.setattr(tile_cluster, "_check_workers", lambda _: None)  # as of a worker that joins later
    with (
        pytest.raises(InputError, match=r"a worker has other software: numpy .*, not 1.0"),
        tile_cluster.on_cluster(dask_cluster.address, said),
    ):
        list(tiles.mapped(np.sum, TILES))


def test_a_worker_that_ends_costs_its_tile_alone(tmp_path):
    """Its tile is computed again; Dask gives up after some attempts, and the message says what to do."""
    with cluster_in(tmp_path) as cluster:
        cluster.add_worker("a")
        cluster.add_worker("b")
        attempts = tmp_path / "attempts"
        attempts.mkdir()
        with tile_cluster.on_cluster(cluster.address, said):
            found = list(tiles.mapped(tile_functions.ends_its_worker, TILES, Shared(str(attempts))))
        np.testing.assert_array_equal(found, np.sqrt(TILES))
        again = {k for k, n in Counter(one.name.split("-")[0] for one in attempts.iterdir()).items() if n > 1}
        assert "2" in again
        assert len(again) <= 2 * tile_cluster.AHEAD, "of those submitted, what it had begun or not handed over"
        assert sum(one.poll() is not None for one in cluster.workers.values()) == 1


# --- results ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch):
    """Scans of a few thousand points are large, and their slabs small."""
    monkeypatch.setattr(cloud, "MOST_POINTS", 5_000)
    monkeypatch.setattr(cloud, "SAMPLE_POINTS", 4_000)
    monkeypatch.setattr(large_cloud, "SLAB_POINTS", 3_000)
    monkeypatch.setattr(large_cloud, "PASS_POINTS", 3_000)


def test_a_deviation_has_the_same_bytes_as_here(dask_cluster, small, tmp_path, monkeypatch):  # noqa: F811
    store.write_scene(tmp_path / "bracket.h5", scene_of(scans=2), None, {})
    used = []
    results = tile_cluster._ClusterWorkers.results
    monkeypatch.setattr(
        tile_cluster._ClusterWorkers,
        "results",
        lambda self, function, *rest: used.append(function.__name__) or results(self, function, *rest),
    )
    for out, cluster in (("here", None), ("there", dask_cluster.address)):
        processor.run(tmp_path / "bracket.h5", tmp_path / out, steps="deviation", cluster=cluster)
    assert {"_near", "_first_of", "_second_of", "_last_of"} <= set(used)
    for name in ("results.h5", "results.json", "deviation.csv"):
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()
