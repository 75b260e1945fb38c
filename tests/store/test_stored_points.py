"""Points of a scene file piece by piece."""

import numpy as np
import pytest

from processor.model import Scan, Scene, Stations
from processor.space_frame.points.source import SceneSource
from processor.store import store
from processor.store.streaming import points_of
from processor.views import views


@pytest.fixture
def path(tmp_path):
    rng = np.random.default_rng(1)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], [10.0, 20.0, 30.0]
    first, second = (rng.uniform(-5e3, 5e3, (count, 3)) for count in (70_000, 30_000))
    far, intensity, station = np.array([5e8, 4e9, 0.0]), rng.uniform(size=70_000), rng.integers(-1, 2, 30_000)
    scans = (
        Scan("a", first, origin=far, intensity=intensity, position=far, T_project_scan=turn),
        Scan("b", second, origin=far, point_station=station.astype(np.int32)),
        Scan("empty"),
    )
    stations = Stations(("S1", "S2"), np.array([[5e8, 4e9, 1.0], [5e8, 4e9, 2.0]]), np.tile(np.eye(4), (2, 1, 1)))
    scene = Scene("s", "space-frame", scans, stations=stations)
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    return tmp_path / "s.h5"


def test_the_same_points_as_in_memory(path):
    whole, alone = store.read_scene(path), store.read_scene(path, points=False)
    assert [len(scan.points) for scan in alone.scans] == [0, 0, 0]
    in_memory = list(SceneSource(views(whole)).chunks())
    with points_of(path) as points:
        source = SceneSource(views(alone, reader=points))
        assert source.count == 100_000
        for _ in range(2):
            pieces = list(source.chunks())
            assert b"".join(c.points.tobytes() for c in pieces) == b"".join(c.points.tobytes() for c in in_memory)
            stations = np.concatenate([c.station for c in pieces])
            assert np.array_equal(stations, np.concatenate([c.station for c in in_memory]))
    # Scan a has a scanner of its own after the two stations; points of scan b name theirs.
    assert (set(stations[:70_000]), set(stations[70_000:])) == ({2}, {-1, 0, 1})


def test_points_are_moved_into_the_project(path):
    whole = store.read_scene(path)
    source = SceneSource(views(whole))
    first = next(iter(source.chunks())).points
    scan = whole.scans[0]
    true = (scan.points[:100] @ scan.T_project_scan[:3, :3].T) + (
        scan.T_project_scan[:3, :3] @ scan.origin + scan.T_project_scan[:3, 3] - source.origin
    )
    assert np.abs(first[:100] - true).max() < 1e-6  # mm; sums of 4e9 have steps of 5e-7


def test_a_scene_read_without_points_has_the_same_hash(path):
    with points_of(path) as points:
        assert store.scene_hash(store.read_scene(path, points=False), points.pieces) == store.scene_hash(
            store.read_scene(path)
        )
