"""Labels of points in exported scan folders, read by other programs."""

import json

import laspy
import numpy as np
import plyfile
import pytest
from click.testing import CliRunner

from designgen import cli
from processor.readers import read
from processor.store import store
from tests.support.files.e57_fields import e57_field

COLUMNS = ("part", "surface", "mixed", "defect")
PLATES = [
    "make", "plates-defects", "--seed", "3", "--set", "scan.step_mrad=4",
    "--set", "scanner.encoder_urad=0", "--set", 'structure.components=["none", "dent", "pit"]',
]  # fmt: skip


def invoke(*words):
    done = CliRunner().invoke(cli.commands, [str(word) for word in words], standalone_mode=False)
    assert done.exception is None, done.output


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """A scene of plates with defects."""
    path = tmp_path_factory.mktemp("plates") / "plates.h5"
    invoke(*PLATES, "-o", path)
    return path


def columns_of(path, index=0):
    """Labels of a file by another program."""
    if path.suffix == ".ply":
        vertex = plyfile.PlyData.read(str(path))["vertex"]
        return {name: np.array(vertex[name]) for name in COLUMNS if name in vertex.data.dtype.names}
    if path.suffix in (".las", ".laz"):
        las = laspy.read(path)
        return {name: np.array(las[name]) for name in COLUMNS if name in las.point_format.dimension_names}
    return {name: e57_field(path, f"ssc:{name}", index) for name in COLUMNS}


@pytest.mark.parametrize("format_", ["ply", "laz", "e57"])
def test_files_have_the_labels_of_the_truth(plates, format_, tmp_path):
    invoke("export", plates, "-o", tmp_path / "out", "--format", format_)
    truth = store.read_truth(tmp_path / "out/truth.h5")
    for index, label in enumerate(truth.labels):
        path = tmp_path / "out/scans" / ("scans.e57" if format_ == "e57" else f"{label.scan}.{format_}")
        found = columns_of(path, index)
        expected = {"part": label.part, "surface": label.surface, "mixed": label.source == 1, "defect": label.defect}
        assert set(found) == set(COLUMNS)
        for name, column in expected.items():
            np.testing.assert_array_equal(found[name], column, err_msg=name)
    names = json.loads((tmp_path / "out/labels.json").read_text("utf-8"))
    assert names["part"] == list(truth.labels[0].part_names)
    assert names["surface"] == list(truth.labels[0].surface_names)


def test_without_truth_there_are_no_labels(plates, tmp_path):
    invoke("export", plates, "-o", tmp_path / "out", "--format", "ply", "--without-truth")
    assert columns_of(tmp_path / "out/scans/S1.ply") == {}
    assert not (tmp_path / "out/labels.json").exists()
    invoke("export", plates, "-o", tmp_path / "with", "--format", "ply")
    (bare,), (labelled,) = read(tmp_path / "out/scans/S1.ply"), read(tmp_path / "with/scans/S1.ply")
    np.testing.assert_array_equal(bare.points, labelled.points)


def test_points_of_a_defect_are_those_off_the_plate(plates):
    """By the truth of the scene: distances of the points from the plates' planes, less the error of their ranges."""
    scene, truth = store.read_scene(plates), store.read_truth(plates)
    assert truth.defects.classes == ("dent", "pit")
    seen = {0: 0, 1: 0}
    for scan, label in zip(scene.scans, truth.labels, strict=True):
        T = dict(zip(truth.stations.ids, truth.stations.T_project_station, strict=True))[scan.name]
        length = np.linalg.norm(scan.points, axis=1)
        true = scan.points * (1.0 - label.range_error_mm / length)[:, None]
        at = true @ T[:3, :3].T + T[:3, 3]
        on_front = (np.array(label.surface_names)[label.surface] == "0 +n") & (label.source == 0)
        for number in seen:
            rows = np.flatnonzero(on_front & (label.part == number + 1))
            marked = label.defect[rows] == number
            assert (marked | (label.defect[rows] == -1)).all()
            # A plane through the rest: the error of the station's tilt is common to all points.
            plane = np.column_stack([at[rows][:, [0, 2]], np.ones(len(rows))])
            rest = at[rows, 1] - plane @ np.linalg.lstsq(plane[~marked], at[rows, 1][~marked], rcond=None)[0]
            # Labels begin at 0.01 mm; range errors as float32 and the tilt leave up to 0.005 mm (seeds 3, 4, 5).
            assert np.abs(rest[~marked]).max() < 0.02
            assert np.abs(rest[marked]).min() > 0.005
            seen[number] += int(marked.sum())
        assert (label.defect[(label.part != 1) & (label.part != 2)] == -1).all()
    assert min(seen.values()) >= 10
