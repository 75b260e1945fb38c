"""The report of an inspection: table, page in both languages, results.json and the store."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.inspection.result import AxisDepartures, Characteristics, InspectedComponent, Quantity, Result
from processor.model import StepRun, Verdict, reason
from processor.report import all_tables, headline, page
from processor.report.table import csv_text
from processor.results.to_json import results_json
from processor.store import store
from tests.support.pages.pages import left_in_english
from tests.support.results import step_results
from tests.support.results.records import assert_equal

NAN = float("nan")
IDS = (
    "length",
    "twist",
    "sweep",
    "end",
    "squareness",
    "over",
    "width",
    "rib1",
    "rib2",
    "inspect",
    "mm",
    "GB",
    "part",
    "ISO",
)


@pytest.fixture(scope="module")
def result():
    found = Characteristics(
        id=("length", "twist", "sweep", "end-squareness-over-width"),
        quantity=(Quantity.LENGTH, Quantity.TWIST, Quantity.SWEEP, Quantity.SQUARENESS),
        nominal=[12000.0, 0.0, 0.0, 0.0],
        actual=[12003.5, 1.25, -2.0, NAN],
        deviation=[3.5, 1.25, -2.0, NAN],
        ci95=[0.5, 0.2, 0.3, NAN],
        lower=[-4.8, NAN, -6.0, -2.0],
        upper=[4.8, NAN, 6.0, 2.0],
        unit=("mm",) * 4,
        verdict=(Verdict.PASS, Verdict.NONE, Verdict.FAIL, Verdict.INDETERMINATE),
        limit=("part_length_mm", "", "part_sweep_mm", "part_squareness_mm"),
        clause=("GB", "", "GB", "GB"),
        verified=[False, False, False, False],
        reasons=((), (), (), (reason("inspect.end-not-measured", ends=("end",)),)),
    )
    axis = AxisDepartures(chainage=[100.0, 300.0], sideways=[0.0, -2.0], sideways_ci95=[0.1, 0.3], up=[0.0, 1.0],
                          up_ci95=[0.1, 0.2])  # fmt: skip
    parts = (
        InspectedComponent(name="rib1", characteristics=found, axis=axis),
        InspectedComponent(name="rib2", status="failed", reasons=(reason("inspect.not-registered"),)),
    )
    return Result(status="partial", method="default", components=parts)


@pytest.fixture(scope="module")
def execution(result):
    return step_results.execution(("inspect", "default", "{}", result))


def test_the_table_has_a_row_a_characteristic(execution):
    tables = {table.file: table for table in all_tables.tables_of_run(execution, ErrorReport())}
    rows = list(csv.DictReader(io.StringIO(csv_text(tables["inspect"]))))
    assert [row["characteristic"] for row in rows][-1] == "end-squareness-over-width"
    assert (rows[0]["component"], float(rows[0]["deviation"]), rows[0]["verdict"]) == ("rib1", 3.5, "pass")
    assert rows[3]["actual"] == ""
    assert rows[3]["unit"] == "mm"
    assert rows[3]["remark"] == "not measured at: end"
    assert len(tables["inspect-axes"].rows) == 2


def test_results_json_has_the_keys_of_the_interface(execution):
    step = results_json(execution, ErrorReport())["steps"]["inspect"]
    first, second = step["components"]
    assert (step["verdict"], second["name"], second["reasons"][0]["code"]) == ("fail", "rib2", "inspect.not-registered")
    keys = {"id", "quantity", "nominal", "actual", "deviation", "ci95", "lower", "upper", "unit", "verdict"}
    assert keys <= set(first["characteristics"][0])
    assert first["characteristics"][3]["actual"] is None
    assert second["characteristics"] == []


def test_the_result_goes_through_the_store(result, tmp_path):
    store.write_results(tmp_path / "r.h5", [StepRun("inspect", "default", "{}", result)], {})
    (back,) = store.read_results(tmp_path / "r.h5", {"inspect": Result})
    assert_equal(back.result, result)
    assert np.isnan(back.result.components[0].characteristics.actual[3])


def test_the_page_is_in_chinese_but_for_names(execution):
    assert left_in_english(page.html(execution, ErrorReport(), {}, "zh"), *IDS) == []
    english = page.html(execution, ErrorReport(), {})
    assert "Limits not checked against the standard: verdicts are provisional." in english
    assert headline.of_run(execution) == (
        "Inspection of components: partial, 3 of 4 characteristics of 2 components measured; "
        "1 of 3 limits is not kept: rib1 sweep; 1 indeterminate; 1 passes"
    )
