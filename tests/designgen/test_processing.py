"""What other software does to clouds, on points whose results are known by hand."""

import dataclasses

import numpy as np
import pytest

import designgen
from designgen.scanning import processing
from processor.model import PointLabels, Scan, Scene, Truth, UsageError

POINTS = np.array([[0.2, 0.2, 0.0], [0.9, 0.2, 0.0], [0.5, 0.8, 0.0], [1.4, 0.5, 0.0], [3.5, 0.5, 0.0]])


def processed(points, **keys):
    """Rows that are left, by their labels, and the points in the scan's frame; the origin is not at 0."""
    count = len(points)
    scan = Scan("s", points - [100.0, 0.0, 0.0], origin=np.array([100.0, 0.0, 0.0]), intensity=np.arange(count) * 1.0,
                grid_row=np.arange(count, dtype=np.int32), grid_column=np.zeros(count, np.int32))  # fmt: skip
    labels = PointLabels("s", ("a",), np.arange(count, dtype=np.int32), np.zeros(count, np.uint8))
    scene, truth = processing.process(
        Scene("x", "structure", (scan,)), Truth(labels=(labels,)), processing.Params(**keys), 0
    )
    (scan,), (labels,) = scene.scans, truth.labels
    assert scan.intensity.tolist() == labels.part.tolist()
    assert len(scan.grid_row) in (0, len(scan.points))
    return labels.part.tolist(), scan.points + scan.origin


@pytest.mark.parametrize(
    ("thin", "rows", "x"),
    [
        ("voxel", [0, 3, 4], [0.5333, 1.4, 3.5]),  # (0.53, 0.4) is 0.39, 0.42 and 0.40 from the first three
        ("nearest", [2, 3, 4], [0.5, 1.4, 3.5]),  # (0.5, 0.5, 0.5) is 0.42, 0.5 and 0.3 from them in the plane
        ("octree", [2, 4], [0.5, 3.5]),  # a cube of 3.3 mm from (0.2, 0.2), halved once; its first cell's centre 1.025
    ],
)
def test_one_point_of_each_cell_is_left(thin, rows, x):
    left, points = processed(POINTS, thin=thin, cell_mm=1.0)
    assert left == rows
    np.testing.assert_allclose(points[:, 0], x, atol=1e-4)


def test_coordinates_are_rounded_in_the_frame_of_the_file():
    _, points = processed(POINTS, round_mm=0.5)
    assert points[:, 0].tolist() == [0.0, 1.0, 0.5, 1.5, 3.5]
    assert processed(POINTS, round_mm=0.5)[0] == [0, 1, 2, 3, 4]


def test_a_share_of_the_points_occurs_twice():
    points = np.random.default_rng(0).normal(size=(4_000, 3))
    rows, twice = processed(points, duplicate=0.3)
    assert 0.27 < len(rows) / 4_000 - 1.0 < 0.33  # 0.3 with a standard deviation of 0.007
    assert np.unique(twice, axis=0).shape == (4_000, 3)


@pytest.mark.parametrize(("how", "left"), [("mean", 8.0**-0.5), ("mls", 20.0**-0.5)])
def test_smoothing_takes_noise_off_a_plane(how, left):
    """The mean of 8 neighbours has the noise by the root of 8; a plane of 20 in their middle by that of 20."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0.0, 400.0, (5_000, 2)), rng.normal(0.0, 0.5, 5_000)])
    _, smooth = processed(points, smooth=how)
    inner = (np.abs(points[:, :2] - 200.0) < 150.0).all(axis=1)
    # 2800 points in groups of 8 or 20 that overlap: 3 and 6 %. A point is not quite in the middle of its neighbours.
    assert smooth[inner, 2].std() == pytest.approx(0.5 * left, rel=0.12)
    aside = np.linalg.norm((smooth - points)[inner, :2], axis=1)
    assert bool(np.median(aside) > 0.5) == (how == "mean")  # onto a plane points move straight


def test_a_wrong_registration_is_in_the_truth():
    settings = {"scan.step_mrad": 8.0, "structure.components": ["none"]}
    scene, truth = designgen.make("plates-defects", seed=1, settings=settings)
    off = {"processing.register_mm": 2.0, "processing.register_mrad": 0.1}
    moved, moved_truth = designgen.make("plates-defects", seed=1, settings=settings | off)
    assert truth.pose is None
    T = moved_truth.pose.T_design_project
    here, there = (
        np.vstack([(scan.points + scan.origin) @ scan.pose[:3, :3].T + scan.pose[:3, 3] for scan in one.scans])
        for one in (scene, moved)
    )
    np.testing.assert_allclose(there @ T[:3, :3].T + T[:3, 3], here, atol=1e-8)
    assert np.arccos((np.trace(T[:3, :3]) - 1.0) / 2.0) == pytest.approx(1e-4, rel=1e-3)
    assert np.linalg.norm((there - here).mean(axis=0)) == pytest.approx(2.0, abs=0.2)  # clouds of one weight each
    np.testing.assert_allclose(moved.stations.positions @ T[:3, :3].T + T[:3, 3], scene.stations.positions, atol=1e-8)


def test_impossible_settings_are_refused():
    for keys, message in (
        ({"thin": "grid"}, r"processing\.thin: expected one of voxel, octree, nearest"),
        ({"duplicate": 1.5}, r"processing\.duplicate: expected a share"),
        ({"cell_mm": 0.0}, r"processing\.cell_mm"),
    ):
        with pytest.raises(UsageError, match=message):
            processing.Params(**keys)
    scene, truth = designgen.make("arch-s1", seed=1, settings={"scan.spacing_mm": 200.0})
    with pytest.raises(UsageError, match="no structure"):
        processing.process(scene, truth, dataclasses.replace(processing.Params(), register_mm=1.0), 0)
