"""Diagnostics of the stages of the papers' methods: numbers in results.h5, clouds on request; results do not change."""

import csv
from pathlib import Path
from threading import Thread
from unittest import mock

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial import cKDTree

from processor import diagnostics, pipeline
from processor.api import runs
from processor.defects import baseline
from processor.geometry import rigid
from processor.model import Status
from processor.preassembly.parts import attitude
from processor.report import write_results
from processor.store import store
from tests.support.clouds import arch_clouds
from tests.support.scenes import known_attitudes


def turned(angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    return rigid.transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array(shift))


def test_notes_are_recorded_in_their_own_thread_while_recording():
    diagnostics.note("a", x=1.0)
    with diagnostics.recording() as notes:
        with diagnostics.at("joint"), diagnostics.at("top"):
            diagnostics.note("a", x=2.0, y=np.inf)
        thread = Thread(target=lambda: diagnostics.note("a", x=4.0))
        thread.start()
        thread.join()
        diagnostics.keep("cloud", np.zeros((3, 3)))
    diagnostics.note("a", x=5.0)
    assert notes.rows == [("a", "joint, top", "x", 2.0), ("a", "joint, top", "y", np.inf)]
    assert notes.clouds == []  # not wanted
    table = notes.table()
    assert table.value[0] == 2.0
    assert np.isnan(table.value[1])


def test_clouds_are_in_the_outermost_frame():
    points = np.random.default_rng(1).normal(size=(7, 3))
    inner, outer = turned(0.3, [1.0, 2.0, 3.0]), turned(-1.1, [10.0, 0.0, -5.0])
    frames = diagnostics.placed(outer, "bridge"), diagnostics.placed(inner)
    with diagnostics.with_clouds(), diagnostics.recording() as notes, frames[0], frames[1]:
        diagnostics.keep("cloud", points)
    (kept,) = notes.clouds
    assert kept.frame == "bridge"
    # Two products of the same matrices: rounding of float64.
    np.testing.assert_allclose(kept.points, rigid.apply(outer, rigid.apply(inner, points)), atol=1e-12)


def test_clouds_of_density_clusters_and_of_noise_are_all_points_between_them():
    points, clustered = np.random.default_rng(2).normal(size=(9, 3)), np.arange(9) % 3 > 0
    with diagnostics.with_clouds(), diagnostics.recording() as notes:
        baseline._say_clusters(points, clustered, 2, 25.0, np.array([1e3, 0.0, 0.0]))
    numbers = {"radius_mm": 25.0, "points": 9.0, "clusters": 2.0, "kept": 6.0}
    assert notes.rows == [("density clusters", "", *each) for each in numbers.items()]
    assert [cloud.stage for cloud in notes.clouds] == ["density clusters", "noise"]
    for cloud, rows in zip(notes.clouds, (clustered, ~clustered), strict=True):
        np.testing.assert_allclose(cloud.points, points[rows] + [1e3, 0.0, 0.0], atol=1e-12)


# --- the paper's methods of preassembly ---

PARAMS = {"preassemble": {"match": {"pfh_iterations": 300}}}  # poses need not be good
METHODS = "line,design-aided"


@pytest.fixture(scope="module")
def bridge():
    """A bridge whose parts' attitudes are known: the search for them does not use the module under test."""
    assert "diagnostics" not in Path(attitude.__file__).read_text("utf-8")
    scene, truth = arch_clouds.bridge(spacing_mm=50.0, sigma_mm=0.5, seed=3)
    with mock.patch.object(attitude, "find", known_attitudes.find_by(truth)):
        yield scene


@pytest.fixture(scope="module")
def folder(bridge, tmp_path_factory):
    """Results of two methods with the clouds of their stages."""
    out = tmp_path_factory.mktemp("diagnostics") / "out"
    with diagnostics.with_clouds():
        runs.run(bridge, out, steps="preassemble", method=METHODS, params=PARAMS)
    return out


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_results_hold_the_numbers_of_every_stage_of_each_method(folder):
    stored = store.read_results(folder / "results.h5", pipeline.result_classes())
    assert [run.method for run in stored] == METHODS.split(",")
    for run in stored:
        assert run.result.status is Status.OK
        table = run.diagnostics
        stages = {"cut end", "strip", "line consensus", "edge points", "slices", "fused features", "histograms"}
        assert set(table.stage) == stages | {"iterative closest point"}
        # five parts in a row have eight ends at joints, with four edges each
        strips = [row for row in zip(table.stage, table.place, table.quantity, strict=True) if row[2] == "L_edge_mm"]
        assert len(strips) == len(set(strips)) == 8 * 4
        rounds = table.value[[quantity == "rounds" for quantity in table.quantity]]
        aligned = 5 if run.method == "design-aided" else 4  # the first part is aligned with the design alone
        assert len(rounds) == aligned
        assert rounds.min() >= 1
    listed = rows(folder / "steps" / "diagnostics.csv")
    assert len(listed) == sum(len(run.diagnostics.value) for run in stored)


def test_clouds_of_a_scan_are_points_of_that_scan(folder, bridge):
    listed = [row for row in rows(folder / "steps" / "clouds.csv") if row["method"] == "line"]
    scans = {f"scan {scan.name}": cKDTree(scan.points + scan.origin) for scan in bridge.scans}
    seen = set()
    for row in listed:
        vertex = PlyData.read(folder / "steps" / row["file"])["vertex"]
        own = np.array(vertex["place"]) == int(row["place_number"])
        points = np.stack([np.array(vertex[axis])[own] for axis in "xyz"], axis=1)
        assert len(points) == int(row["points"]) > 0
        if row["frame"] in scans:
            seen.add(row["stage"])
            assert scans[row["frame"]].query(points)[0].max() < 1e-6
    assert seen == {"cut end", "strip", "nearest points", "edge points", "slices"}
    assert {row["frame"] for row in listed} == {*scans, "bridge"}


def test_the_clouds_change_no_result(folder, bridge, tmp_path):
    plain = runs.run(bridge, steps="preassemble", method=METHODS, params=PARAMS).execution
    assert plain.clouds == ()
    store.write_results(tmp_path / "results.h5", plain.runs, plain.provenance)
    assert (tmp_path / "results.h5").read_bytes() == (folder / "results.h5").read_bytes()
    write_results.check_output(folder, None)  # may be replaced, as results without clouds
