"""What the report shows of an adjustment: tables, pictures, and the live figures of the page."""

import dataclasses
import io
import json

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from processor.evaluation.evaluate import ErrorReport
from processor.model import StepRun
from processor.pipeline import Execution
from processor.preassembly.chain import joint_measures
from processor.preassembly.result import Deviations
from processor.report import all_tables, page, style
from processor.report.preassembly import figures, interactive_view, joint_figures
from processor.report.style import Drawn, default_settings, rounded
from processor.results import to_json
from tests.support.pages.report_pages import Page, by_file, drawn, rendered
from tests.support.results.bridge_results import (
    OWN,
    PROVENANCE,
    SECTION,
    adjusted,
    arch_scene,
    assembled,
    judged_joints,
    of_bridge,
    trade_off,
    verdicts,
)

NAN = float("nan")
CSV, PAGE = 1e-6, 5e-3  # what rounding leaves of a number in tables of files (6 decimals) and of the page (2)


def bridge_and_step():
    """An adjusted bridge, and its step in results.json."""
    execution = of_bridge()
    return execution, to_json.results_json(execution, ErrorReport())["steps"]["preassemble"]


def number(text):
    return None if text in ("", "–") else float(text)


# --- tables --------------------------------------------------------------------------------------------------------


def test_table_what_to_do_has_the_numbers_of_results_json():
    execution, step = bridge_and_step()
    on_page = Page(rendered(execution)).tables["Joints: what to do, method adjustment"][2:]
    rows = by_file("what-to-do", execution)
    assert [row["joint"] for row in rows] == ["J1", "J2"]
    for row, shown, joint, verdict in zip(rows, on_page, step["joint_measures"], step["joints"], strict=True):
        assert row["verdict"] == verdict["verdict"] == "fail"
        assert row["proposal"] == shown[2] == joint["proposal"]["sentence"]
        measures = joint["measures"]
        names = ("misalignment", "groove_gap_least", "groove_gap_greatest")
        wanted = [measures[name][part] for name in names for part in ("value", "ci95")]
        assert [float(cell) for cell in list(row.values())[3:9]] == pytest.approx(wanted, abs=CSV)
        assert [float(cell) for cell in shown[3:9]] == pytest.approx(wanted, abs=PAGE)
        turns = {axis: measures[f"rotation_{axis}"] for axis in "xyz"}
        largest = max(abs(one["value"]) for one in turns.values())
        assert largest == pytest.approx(abs(float(row["rotation_mrad"])), abs=CSV)
        assert turns[row["rotation_about"]]["ci95"] == pytest.approx(float(row["rotation_ci95_mrad"]), abs=CSV)
        assert number(row["probability_now"]) == pytest.approx(joint["probability"], abs=CSV)
        assert number(row["probability_after"]) == pytest.approx(joint["proposal"]["probability"], abs=CSV)
    assert float(rows[0]["greatest_groove_gap_mm"]) == 3.5
    assert float(rows[1]["least_groove_gap_mm"]) == -1.75


def test_table_of_limits_has_clause_and_verification():
    execution, step = bridge_and_step()
    rows = by_file("limits", execution)
    wanted = [limit for joint in step["joint_measures"] for limit in joint["limits"]]
    assert len(rows) == len(wanted) == 4
    for row, limit in zip(rows, wanted, strict=True):
        assert (row["limit"], row["verdict"], row["clause"]) == (limit["what"], limit["verdict"], limit["clause"])
        cells = [number(row[f"{name}_mm"]) for name in ("value", "ci95", "least", "greatest")]
        for cell, name in zip(cells, ("value", "ci95", "low", "high"), strict=True):
            assert cell == (None if limit[name] is None else pytest.approx(limit[name], abs=CSV))
    assert {limit["verified"] for limit in wanted} == {True, False}
    page = rendered(execution)
    (note,) = {limit["clause"] for limit in wanted if not limit["verified"]}
    (said,) = [line for line in Page(page).text.splitlines() if "to be confirmed" in line]  # once, below all else
    assert note in said


def test_limits_of_the_chain_stand_beside_those_of_joints():
    execution, step = bridge_and_step()
    (chain,) = step["chain_limits"]
    (limit,) = chain["limits"]
    (row,) = by_file("limits-chain", execution)
    assert chain["verdict"] == row["verdict"] == limit["verdict"] == "indeterminate"
    stated = [limit[key] for key in ("limit", "source", "edition", "verified")]
    assert stated == ["span_mm", "project.toml", "1", False]
    assert [float(row[f"{name}_mm"]) for name in ("value", "least", "greatest")] == [-1.25, -1.0, 1.0]
    assert row["source"] == "project.toml"
    parsed = Page(rendered(execution))
    assert "Whole chain: indeterminate" in parsed.text
    head, *rows = parsed.tables["Characteristics"]
    held = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert (held["chain span"]["verdict"], held["chain span"]["limits"]) == ("indeterminate", "± 1")
    # What was stated and is held against nothing is said.
    assert step["limits_not_held"] == ["bow_mm"]
    assert by_file("limits-not-held", execution) == [{"key": "bow_mm", "limit": "bow of a unit preassembled"}]
    on_terminal = [
        str(table.title) for table in all_tables.tables_of_run(execution, ErrorReport()) if table.on_terminal
    ]
    assert {"Limits of the whole chain, method adjustment", "Limits that nothing is compared with"} <= set(on_terminal)


def test_gaps_have_intervals_in_the_joints_axes_too():
    execution, step = bridge_and_step()
    rows = by_file("gaps", execution)
    assert list(rows[0])[:8] == ["joint", "point", "dx_mm", "dy_mm", "dz_mm", "ci95_dx_mm", "ci95_dy_mm", "ci95_dz_mm"]
    for j, joint in enumerate(step["joint_measures"]):
        for k, key in enumerate(f"P{i}" for i in range(1, 9)):
            gap, half = joint["gaps_joint_axes"][key], joint["gaps_joint_axes_ci95"][key]
            assert half == pytest.approx([1.96 * 0.1] * 3, rel=1e-4)  # 1.95996: of a gap of sd 0.1
            for one, value, ci95 in zip(("along", "left", "up"), gap, half, strict=True):
                assert float(rows[8 * j + k][f"{one}_mm"]) == pytest.approx(value, abs=CSV)
                assert float(rows[8 * j + k][f"ci95_{one}_mm"]) == pytest.approx(ci95, abs=CSV)
    assert len(by_file("gaps-line", execution)[0]) == 8


def test_ambiguous_part_is_listed_with_both_poses():
    rows = by_file("candidates", of_bridge())
    assert [row["candidate"] for row in rows] == ["as assembled", "the other pose"]
    assert [float(row["turned_deg"]) for row in rows] == [0.0, 180.0]
    assert [float(row["xt_mm"]) for row in rows] == [0.0, 5.0]
    assert len(Page(rendered(of_bridge())).tables["Parts that fit in two poses"]) == 3


def test_accuracy_budget_is_written_and_shown_on_the_terminal():
    rows = by_file("accuracy", of_bridge())
    assert rows[0]["statement"].startswith("J1 P1: ± 0.087 mm (95 %), 69% of the variance from the end face")
    assert rows[1]["statement"].startswith("a scan of rib1 that shows more of the end face")
    assert any(
        table.file == "accuracy" and table.on_terminal for table in all_tables.tables_of_run(of_bridge(), ErrorReport())
    )


def linear_error(execution):
    """Caption of the linear error of all methods, and the numbers of curves and bands of its upper panel."""
    made = []
    with default_settings(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "png", made.append)
        caption, _ = figures._linear_error(execution.scene, execution.runs)
    upper = made[0].axes[0]
    return str(caption), len([line for line in upper.lines if len(line.get_xdata()) > 2]), len(upper.collections)


def test_failed_method_is_listed_with_its_reason_and_not_drawn():
    execution = of_bridge()
    (row,) = by_file("components-compared", execution)
    assert row == {"method": "line", "component": "foot2", "status": "failed", "remark": "J2: no joint edges found"}
    caption, *shown = linear_error(execution)
    assert "without a band, because they state no uncertainty: line" in caption
    assert shown == [4, 2]  # both edges by two methods, bands of one
    line = execution.runs[1]
    linear = line.result.linear
    nothing = Deviations(deviation=np.full(120, NAN))
    result = dataclasses.replace(line.result, linear=dataclasses.replace(linear, assembled=nothing, best_fit=nothing))
    silent = dataclasses.replace(execution, runs=(execution.runs[0], dataclasses.replace(line, result=result)))
    caption, *shown = linear_error(silent)
    assert "without a result, so not drawn: line" in caption
    assert shown == [2, 2]
    blank = page.html(silent, ErrorReport(), {"preassemble": Drawn({})})
    data = json.loads(Page(blank).scripts[0][1])["steps"]["preassemble"]
    assert [one["method"] for one in data["linear"]] == ["adjustment"]


def test_span_closure_budget_and_trade_off_as_tables():
    execution = of_bridge()
    span, along, *rest = by_file("span", execution)
    assert (span["departure"], span["ci95"], span["unit"], span["beyond_its_interval"]) == ("-1.25", "0.5", "mm", "yes")
    assert (along["departure"], along["ci95"], along["unit"]) == ("1.0", "0.25", "mm")
    assert [row["unit"] for row in rest] == ["mm", "mm", "mrad", "mrad", "mrad"]
    assert [row["beyond_its_interval"] for row in rest] == ["yes", "yes", "no", "no", "yes"]
    assert by_file("budget", execution)[2] == {"source": "scanner offset", "sd_mm": "0.2"}
    assert [row["linear_max_mm"] for row in by_file("trade-off", execution)] == ["2.0", "3.0", "9.0"]
    measures = by_file("measures", execution)
    assert len(measures) == 22
    low, value, high = (float(measures[0][name]) for name in ("low95", "value", "high95"))
    assert low < value < high


def test_methods_without_intervals_have_no_tables_of_the_adjustment():
    runs = (StepRun("preassemble", "line", "{}", assembled("line")),)
    execution = Execution(arch_scene(), runs, PROVENANCE)
    files = {table.file for table in all_tables.tables_of_run(execution, ErrorReport())}
    assert not files & {"what-to-do", "limits", "measures", "span", "budget", "trade-off"}
    assert not set(drawn(execution)["preassemble"].figures) & OWN
    assert "What limits the accuracy" not in rendered(execution)


def test_page_has_verdict_then_picture_then_actions_then_the_appendix():
    text = rendered(of_bridge())
    order = ('<div class="banner bad">', "2 of 2 joints fail", "data:image/png", "What to do", "joint J1 (fail)",
             "a scan of rib1", "<table>", "Inspected", 'class="appendix"', "J1 P1: ±")  # fmt: skip
    places = [text.index(one) for one in order]
    assert places == sorted(places)
    assert "<details open" not in text


def unknown(result, joints, parts):
    """Take away what is known of these joints and parts."""
    before = result.adjustment
    gaps, distance = result.joints.gaps.copy(), before.residuals.distance.copy()
    gaps[joints], distance[np.isin(before.residuals.component, parts)] = NAN, NAN
    records = list(before.joints.measures)
    for j in joints:
        records[j] = joint_measures.measure(np.full((8, 3), NAN), np.full((24, 24), NAN), np.eye(4), SECTION)
    adjustment = dataclasses.replace(
        before,
        joints=judged_joints(result.joints.name, records),
        residuals=dataclasses.replace(before.residuals, distance=distance),
        span_departure=NAN,
        span_ci95=NAN,
        closure=np.full((2, 3), NAN),
        closure_ci95=np.full((2, 3), NAN),
    )
    return dataclasses.replace(
        result,
        joints=dataclasses.replace(result.joints, gaps=gaps, verdict=verdicts(adjustment)),
        trade_off=trade_off(np.full((3, 4), NAN)),
        adjustment=adjustment,
    )


@pytest.mark.parametrize(("joints", "parts", "pictures"), [((1,), (2,), 1), ((0, 1), (0, 1, 2), 0)])
def test_unknown_joints_are_reported_and_not_drawn(joints, parts, pictures):
    execution = of_bridge()
    result = unknown(execution.runs[0].result, list(joints), parts)
    execution = dataclasses.replace(execution, runs=(dataclasses.replace(execution.runs[0], result=result),))
    found = drawn(execution)["preassemble"].figures
    assert ("gap-vectors.png" in found) == pictures
    parsed = Page(rendered(execution))
    last = parsed.tables["Joints: what to do, method adjustment"][-1]
    assert last[:2] == ["J2", "indeterminate"]
    assert "scan both ends" in last[2]
    assert set(last[3:]) <= {"–", ""}
    assert "Closure by" not in parsed.text
    data = json.loads(parsed.scripts[0][1])["steps"]["preassemble"]
    assert data["joints"][1]["gap"] == [[None] * 3] * 8


# --- pictures ------------------------------------------------------------------------------------------------------


def test_pictures_show_something_and_change_with_their_data_alone(drawn_pictures, monkeypatch):
    """Pictures of other residuals or weights are other pictures; the rest stay as they are."""
    monkeypatch.setattr(style, "DPI", 40)  # most of the time goes by pixels
    execution = of_bridge()
    before = drawn(execution)["preassemble"].figures
    assert set(before) == OWN | {"linear-error.png"}
    for name, (caption, png) in before.items():
        pixels = matplotlib.image.imread(io.BytesIO(png))[:, :, :3]
        assert 0.005 < (pixels.min(axis=2) < 0.9).mean() < 0.9, name  # neither a blank nor a black picture
        assert caption
    assert "95 %" in str(before["linear-error.png"][0])


@pytest.mark.parametrize(
    ("value", "wanted"), [(0.3, 1.0), (1.0, 1.0), (4.99, 2.0), (5.0, 5.0), (760.0, 500.0), (1e4, 1e4)]
)
def test_scales_are_round_numbers(value, wanted):
    assert rounded(value) == pytest.approx(wanted)


def test_residuals_of_noise_have_no_colour_and_those_of_a_bow_do():
    """The median of a cell of noise is grey at 95 %; a bow of 3 mm is coloured, and does not widen the grey band."""
    execution = of_bridge()
    run = execution.runs[0]
    given = run.result.adjustment
    rng = np.random.default_rng(4)
    x, y = (one.ravel() for one in np.meshgrid(np.arange(0.0, 3000.0, 25.0), np.arange(0.0, 450.0, 25.0)))
    points = np.stack([x, y, np.zeros(len(x))], axis=1)
    for bow in (0.0, 3.0):
        distance = rng.normal(0.0, 0.2, len(x)) + bow * np.sin(np.pi * x / 3000.0)
        residuals = dataclasses.replace(
            given.residuals, component=np.zeros(len(x), np.int64), points=points, distance=distance
        )
        result = dataclasses.replace(run.result, adjustment=dataclasses.replace(given, residuals=residuals))
        data = interactive_view.interactive_data(execution.scene, [dataclasses.replace(run, result=result)])
        shown = np.abs(np.array(data["parts"][0]["residual"], float))
        grey = (shown < data["grey"]).mean()
        assert grey > 0.927 if not bow else grey < 0.2  # two sds of the share of 346 cells below .95
        assert data["limit"] > 1.9 * data["grey"]  # colours begin pale


def test_numbers_of_large_gaps_fit_their_frames_and_missing_gaps_are_stated(monkeypatch, drawn_pictures):
    figures_made = []

    def kept(figure):
        FigureCanvasAgg(figure).draw()
        figures_made.append(figure)
        return b""

    monkeypatch.setattr(joint_figures, "png", kept)
    result = unknown(adjusted(), [1], ())
    wide = joint_measures.measure(np.outer(np.arange(8.0), [-6.6, 3.0, 3.0]), 0.2 * np.eye(24), np.eye(4), SECTION)
    records = (wide, result.adjustment.joints.measures[1])
    judged = dataclasses.replace(result.adjustment.joints, measures=records)
    adjustment = dataclasses.replace(result.adjustment, joints=judged)
    joint_figures.gap_vectors(dataclasses.replace(result, adjustment=adjustment))
    shown, silent = figures_made[0].axes
    numbers = [one for one in shown.texts if one.get_text().startswith("P")]
    assert len(numbers) == 8
    frame = shown.get_window_extent()
    for one in numbers:
        box = one.get_window_extent()
        inside = frame.x0 <= box.x0 < box.x1 <= frame.x1 and frame.y0 <= box.y0 < box.y1 <= frame.y1
        assert inside, one.get_text()
    assert [one.get_text() for one in silent.texts] == ["no gaps computed"]
    assert silent.get_title() == "J2: INDETERMINATE"
