"""Scans in space: how far other scans lie from each point, by hand; and the page in a browser."""

import dataclasses

import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.geometry import rigid
from processor.model import Scan
from processor.report import all_figures, page
from processor.report.stitching import interactive_view
from processor.results.fields_to_json import as_object
from tests.support.pages.browser import opened, picture, read_over
from tests.support.results import step_results

NAMES = ("S1", "S2", "S3", "<b>S4</b>")
APART = 4.0  # mm of S2's wall behind that of S1


@pytest.fixture(scope="module")
def made():
    """Two scans of a wall, one placed 4 mm off, one of another wall far away, and one without a place."""
    rng = np.random.default_rng(3)
    wall = np.column_stack([rng.uniform(0.0, 2000.0, 8000), np.full(8000, 3000.0), rng.uniform(0.0, 2000.0, 8000)])
    turn = rigid.transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    poses = np.full((9, 4, 4), np.nan)
    poses[:3] = np.eye(4), turn, np.eye(4)
    poses[1, :3, 3] = [500.0, 100.0, 0.0]
    in_project = [wall[:4000], wall[4000:] + np.array([0.0, APART, 0.0]), wall[:500] + np.array([0.0, 9000.0, 0.0])]
    origin = np.array([1e6, 2e6, 0.0])
    scans = [
        Scan(name, rigid.apply(rigid.invert(pose), points) - origin, origin)
        for name, pose, points in zip(NAMES, poses, in_project, strict=False)
    ]
    scans.append(Scan(NAMES[3], wall[:100], np.zeros(3)))
    stitched = step_results.stitching((*NAMES, "S5", "S6", "S7", "S8", "S9"))
    placed = dataclasses.replace(stitched.scans, T_project_scan=poses, position=poses[:, :3, 3])
    result = dataclasses.replace(stitched, scans=placed)
    execution = step_results.execution(("stitch", "automatic", "{}", result), names=NAMES)
    return dataclasses.replace(execution, scene=dataclasses.replace(execution.scene, scans=tuple(scans)))


def test_a_result_as_json_has_names_truth_values_and_nulls():
    written = as_object(step_results.stitching())
    assert written["closures"][0]["loop"] == ["S1", "S2", "S3", "S1"]
    assert [bool(pair["used"]) for pair in written["pairs"]] == [False, True, True, True, True, True]
    assert written["scans"][0]["T_rival_scan"] is None
    assert (written["scans"][1]["from"], written["scans"][1]["to"]) == ("S2", "PRCS")
    assert written["scans"][1]["reasons"][0]["code"] == "stitch.free-space"
    assert "control" not in written


def test_each_point_has_its_signed_distance_to_the_other_scan(made):
    data = interactive_view.interactive_data(made.scene, made.runs)
    assert [part["name"] for part in data["parts"]] == list(NAMES[:3])
    off = [np.array(part["residual"], float) for part in data["parts"]]
    # What lies behind as its scanner sees it is negative, what lies before it positive; written in 1e-3 mm.
    assert np.isfinite(off[0]).mean() > 0.95
    np.testing.assert_allclose(off[0][np.isfinite(off[0])], -APART, atol=2e-3)
    np.testing.assert_allclose(off[1][np.isfinite(off[1])], APART, atol=2e-3)
    assert np.isnan(off[2]).all()
    assert [mark["name"] for mark in data["marks"]] == list(NAMES[:3])
    places = np.array(data["parts"][0]["points"]).reshape(-1, 3) + data["origin"]
    assert np.abs(places[:, 1] - 3000.0).max() < 1.0  # places are written in whole millimetres


def test_one_scan_alone_has_no_view(made):
    alone = dataclasses.replace(made.scene, scans=made.scene.scans[:1])
    assert interactive_view.interactive_data(alone, made.runs) is None


def test_many_scans_keep_the_page_small(made):
    rng = np.random.default_rng(1)
    scans = [dataclasses.replace(scan, points=rng.normal(0.0, 1e4, (100_000, 3))) for scan in made.scene.scans]
    data = interactive_view.interactive_data(dataclasses.replace(made.scene, scans=tuple(scans)), made.runs)
    assert sum(len(part["residual"]) for part in data["parts"]) <= interactive_view.MOST_POINTS


def test_scans_in_space_react(made, tmp_path):
    report = ErrorReport()
    (tmp_path / "page.html").write_text(page.html(made, report, all_figures.draw_figures(made, report)), "utf-8")
    with opened(tmp_path / "page.html") as shown:
        shown.locator("canvas.space").scroll_into_view_if_needed()
        first = picture(shown)
        ticks = shown.locator(".live fieldset label")
        assert [one.strip() for one in ticks.all_text_contents()] == list(NAMES[:3])
        assert any(
            "mm from the other scans at" in one for one in read_over(shown, 12, [down / 8 for down in range(1, 8)])
        )
        ticks.nth(0).locator("input").uncheck()
        assert picture(shown) != first
