"""The report of an inspection: table, page in both languages, results.json and the store."""

import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.report import headline, page
from processor.results.to_json import results_json
from tests.support.pages.pages import left_in_english
from tests.support.pages.report_pages import by_file
from tests.support.results import step_results

NAMES = ("length", "twist", "sweep", "end", "squareness", "over", "width", "rib1", "rib2", "inspect", "mm", "GB",
         "part", "ISO")  # fmt: skip


@pytest.fixture(scope="module")
def execution():
    return step_results.execution(("inspect", "default", "{}", step_results.inspection()))


def test_the_table_has_a_row_a_characteristic(execution):
    rows = by_file("inspect", execution)
    assert [row["characteristic"] for row in rows][-1] == "end-squareness-over-width"
    assert (rows[0]["component"], float(rows[0]["deviation"]), rows[0]["verdict"]) == ("rib1", 3.5, "pass")
    assert rows[3]["actual"] == ""
    assert rows[3]["unit"] == "mm"
    assert rows[3]["remark"] == "not measured at: end"
    assert len(by_file("inspect-axes", execution)) == 2


def test_results_json_has_the_keys_of_the_interface(execution):
    step = results_json(execution, ErrorReport())["steps"]["inspect"]
    first, second = step["components"]
    assert (step["verdict"], second["name"], second["reasons"][0]["code"]) == ("fail", "rib2", "inspect.not-registered")
    keys = {"id", "quantity", "nominal", "actual", "deviation", "ci95", "lower", "upper", "unit", "verdict"}
    assert keys <= set(first["characteristics"][0])
    assert first["characteristics"][3]["actual"] is None
    assert second["characteristics"] == []


def test_the_page_is_in_chinese_but_for_names(execution):
    assert left_in_english(page.html(execution, ErrorReport(), {}, "zh"), *NAMES) == []
    english = page.html(execution, ErrorReport(), {})
    assert english.count("to be confirmed against the published text") == 1
    assert headline.of_run(execution) == (
        "FAIL: 1 of 3 characteristics fail: rib1 sweep -2.00 ± 0.30 mm; "
        "Inspection of components: partial, 3 of 4 characteristics of 2 components measured; "
        "largest deviation: rib1 twist +1.25 ± 0.20 mm"
    )
