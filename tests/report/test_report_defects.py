"""The live view of defects: what it is given, how it is thinned, and its size."""

import dataclasses
import json
import re

import numpy as np
import pytest

from processor.defects import alignment, defect_grids, surface_charts
from processor.defects.deviation_field import Field
from processor.defects.result import Result
from processor.evaluation.evaluate import ErrorReport
from processor.report import page
from processor.report.charts import surface_view
from processor.report.defects import figures, interactive_view
from processor.results.fields_to_json import as_object
from tests.support.pages.report_pages import Page
from tests.support.results import step_results


def drawn(result):
    return interactive_view.interactive_data(None, step_results.execution(("defects", "default", "{}", result)).runs)


def test_the_view_holds_the_surface_and_an_outline_a_defect():
    result = step_results.defects()
    found = drawn(result)
    first, *outlines = found["parts"]
    assert str(first["text"]) == "surface"
    # Places are written in whole millimetres, deviations with three decimals.
    at = np.array(first["points"]).reshape(-1, 3) + found["origin"]
    np.testing.assert_allclose(at, result.surface.points, atol=0.51)
    np.testing.assert_allclose(first["residual"], result.surface.deviation, atol=6e-4)
    assert first["region"] == result.surface.defect.tolist()
    classes = result.defects.defect_class
    assert [str(one["text"]) for one in outlines] == [f"{i}: {kind}" for i, kind in enumerate(classes)]
    ring = np.array(outlines[2]["edges"][0]) + found["origin"]
    np.testing.assert_array_equal(ring[0], ring[-1])
    np.testing.assert_allclose(ring[:-1].mean(axis=0), result.defects.centre[2], atol=0.1)  # a decimal is written
    np.testing.assert_allclose(np.linalg.norm(np.diff(ring, axis=0), axis=1), result.defects.extent[2, 0], atol=0.2)
    assert [mark["part"] for mark in found["marks"]] == list(range(1, len(outlines) + 1))
    assert str(found["marks"][0]["text"]) == "dent, depth 1.500 ± 0.300 mm, area 13500 mm2, component-1"
    assert found["places"][0]["outward"] == [0.0, -1.0, 0.0]


def test_failed_search_has_no_view():
    assert drawn(Result(status="failed", method="default")) is None


def test_many_defects_and_places_keep_the_page_small(monkeypatch):
    """6 MB for 60,000 points and 400 outlines are at most 3 MB of outlines and 50 bytes a point."""
    assert (surface_view.MOST_POINTS, surface_view.MOST_REGIONS) == (60_000, 400)
    monkeypatch.setattr(surface_view, "MOST_POINTS", 3_000)
    result = step_results.defects(surface_view.MOST_REGIONS + 1, places=2 * surface_view.MOST_POINTS)
    text = page.html(step_results.execution(("defects", "default", "{}", result)), ErrorReport(), {})
    assert len(text.encode()) < 3_000_000 + 50 * surface_view.MOST_POINTS
    found = json.loads(Page(text).scripts[0][1])["steps"]["defects"]
    assert len(found["parts"][0]["residual"]) <= surface_view.MOST_POINTS
    assert len(found["marks"]) == surface_view.MOST_REGIONS
    assert len(found["parts"]) == 2 + surface_view.MOST_TICKS
    assert found["parts"][-1]["text"] == "further ones"
    assert len(found["parts"][-1]["edges"]) == surface_view.MOST_REGIONS - surface_view.MOST_TICKS


# --- places that are drawn ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plates():
    """A plate of 2 m by 1 m and a strip of 2 m by 20 mm, and cells of 10 mm, all seen."""
    corners = np.array([[0.0, 0, 0], [2000, 0, 0], [2000, 0, 1000], [0, 0, 1000]])
    strip = np.array([[0.0, 500, 0], [2000, 500, 0], [2000, 500, 20], [0, 500, 20]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    found = surface_charts.of_mesh(np.vstack([corners, strip]), np.vstack([faces, faces + 4]), 10.0)
    ones = np.ones(len(found.share))
    none = np.zeros(len(ones), np.int64)
    still = alignment.none(found, 1, 0.0)
    return found, Field(found, still, 1e-3 * found.centres[:, 0], ones, none + 1, none, ones, ones, ones, none, none)


@pytest.mark.parametrize("most", [2000, 60])
def test_few_points_are_all_drawn_and_many_thinned_evenly_on_every_face(plates, most):
    found, field = plates
    origin = np.array([1000.0, 2000.0, 0.0])
    whole = defect_grids.of_surface([], field, origin)
    np.testing.assert_array_equal(whole.points, found.centres + origin)
    assert (whole.defect == -1).all()
    made = defect_grids.of_surface([], field, np.zeros(3), most)
    at = made.points
    assert 0.3 * most < len(at) <= most
    np.testing.assert_allclose(made.deviation, 1e-3 * at[:, 0])
    strip = at[at[:, 1] == 500.0]
    steps = np.diff(np.unique(at[at[:, 1] == 0.0][:, 0]))
    np.testing.assert_allclose(steps, steps[0])
    assert len(np.unique(strip[:, 0])) >= 2000.0 / steps[0] - 1


def test_small_defects_are_drawn_in_full_above_large_ones(plates):
    found, field = plates
    away = np.linalg.norm(found.centres - [1000.0, 0.0, 500.0], axis=1)
    small, large = np.flatnonzero(away < 60.0), np.flatnonzero(found.centres[:, 1] == 0.0)
    made = defect_grids.of_surface([large, small], field, np.zeros(3), 500)
    count = np.bincount(made.defect + 1, minlength=3)
    assert count[2] == len(small)
    assert 300 < count[1] < 500
    unseen = dataclasses.replace(field, count=np.where(away < 60.0, 0, 1))
    assert (defect_grids.of_surface([small], unseen, np.zeros(3), 500).defect == -1).all()


def test_every_defect_has_a_page():
    result = step_results.defects(3)
    (name, pdf), *none = figures.files(result).items()
    assert (name, none) == ("defects.pdf", [])
    assert len(re.findall(rb"/Type /Page\b", pdf)) == len(result.pictures) > 0
    assert pdf == figures.files(result)[name]
    assert figures.files(Result(status="failed", method="default")) == {}


def test_results_json_has_the_documented_keys_and_a_deflection_where_it_was_measured():
    first, second, *_ = as_object(step_results.defects())["defects"]
    assert (first["deflection"]["along"][0], second["deflection"], first["class"]) == (-200.0, None, "dent")
    keys = {"id", "class", "confidence", "component", "centre", "area_mm2", "depth_max", "depth_ci95", "volume_mm3"}
    assert keys <= set(first)
