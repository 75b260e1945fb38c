"""Numbers, names, positions and points of views, beside sets of points that are known one by one."""

import numpy as np
import pytest

from processor.geometry import rigid
from processor.model import Scan, Scene, Stations
from processor.views import views

TURN = rigid.transform(rigid.rotation_from_vector(np.array([0.1, -0.2, 0.7])), np.array([10.0, 20.0, 30.0]))
POSE = rigid.transform(rigid.rotation_from_vector(np.array([0.0, 0.4, 0.0])), np.array([3e6, 4e6, 0.0]))
STATIONS = Stations(("S1", "S2", "S3"), 3e6 + np.arange(9.0).reshape(3, 3))
FAR = np.array([1e6, 2e6, 0.0])


def random(seed, count):
    return np.random.default_rng(seed).uniform(-500.0, 500.0, (count, 3))


@pytest.fixture
def scene():
    """Two merged clouds that name stations in part, one of which nothing is known, and a scan with its position."""
    scans = (
        Scan("a", random(1, 5), origin=FAR, point_station=[1, -1, 0, 1, 0], T_project_scan=POSE),
        Scan("b", random(2, 3), position=FAR, origin=FAR, station="T1", T_project_scan=POSE),
        Scan("c", random(3, 4), point_station=[1, 1, 1, -1]),
        Scan("d", random(4, 2)),
        Scan("e", random(5, 2), station="T1", component="other", position=np.zeros(3)),
    )
    return Scene("x", "structure", scans, stations=STATIONS)


def test_stations_come_first_and_then_each_scan_with_what_names_none(scene):
    seen = views(scene)
    assert seen.names == ("S1", "S2", "S3", "a", "T1", "c", "d", "e")  # e has no name of a station of its own
    assert seen.placed().view.tolist() == [1, 3, 0, 1, 0, 4, 4, 4, 1, 1, 1, 5, 6, 6, 7, 7]
    assert np.isfinite(seen.positions).all(axis=1).tolist() == [True] * 3 + [False, True, False, False, True]
    alone = views(Scene("x", "structure", scene.scans[1:2], stations=STATIONS))
    assert (alone.names, alone.of_points(0, [2, 2], 2).tolist()) == (("T1",), [0, 0])  # its position is its own


@pytest.mark.parametrize(("T", "origin"), [(None, None), (TURN, np.array([3e6, 4e6, 100.0]))])
@pytest.mark.parametrize("size", [0, 2])
def test_points_and_positions_in_another_frame_by_sums_of_whole_coordinates(T, origin, size, scene):
    seen, to = views(scene, T, origin), np.eye(4) if T is None else T
    given = np.concatenate([rigid.apply(to @ scan.pose, scan.points + scan.origin) for scan in scene.scans])
    blocks = list(seen.blocks(size))
    # Sums of 1e6 have steps of 1e-10, and a turn adds some of them.
    np.testing.assert_allclose(np.concatenate([block.points for block in blocks]) + seen.origin, given, atol=1e-8)
    assert b"".join(block.points.tobytes() for block in blocks) == seen.placed().points.tobytes()
    if origin is None:
        np.testing.assert_allclose(seen.origin, rigid.apply(POSE, FAR), atol=1e-8)
    np.testing.assert_allclose(seen.positions[:3] + seen.origin, rigid.apply(to, STATIONS.positions), atol=1e-8)
    np.testing.assert_allclose(seen.positions[4] + seen.origin, rigid.apply(to @ POSE, FAR), atol=1e-8)


def test_the_points_of_one_view_are_those_of_all_scans_that_name_it(scene):
    seen = views(scene)
    points, view = seen.placed()
    for number in range(len(seen.names)):
        own = [block.points for block in seen.blocks(2, view=number)]
        np.testing.assert_array_equal(np.concatenate([np.empty((0, 3)), *own]), points[view == number])


def test_positions_are_unknown_where_points_have_none(scene):
    seen = views(scene)
    assert seen.scanners(np.array([0, 1, 4, 7])) is seen.positions
    assert seen.scanners(np.array([0, 3])) is None
    assert seen.scanners(np.empty(0, int)) is seen.positions


@pytest.mark.parametrize(
    ("scans", "unnamed"),
    [((0,), False), ((1,), False), ((3,), True), ((3, 4), False)],  # rows of the scene's scans
)
def test_one_cloud_of_which_nothing_is_known_is_unnamed(scans, unnamed, scene):
    some = tuple(scene.scans[row] for row in scans)
    assert views(Scene("x", "structure", some, stations=STATIONS)).unnamed is unnamed
