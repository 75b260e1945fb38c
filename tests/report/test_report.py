"""results.json, tables, figures and the page, from results written by hand."""

import csv
import dataclasses
import io
import json
import os

import matplotlib as mpl
import numpy as np
import pytest

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.model import FrameDesign, InputError, Scan, Scene, StepRun, UsageError, reason
from processor.pipeline import Execution
from processor.preassembly.result import Deviations
from processor.report import all_figures, all_tables, page, write_results
from processor.report import columns as report_columns
from processor.report import table as report_table
from processor.report.columns import Column, columns, under
from processor.results import to_json
from processor.space_frame import step as space_frame_step
from processor.store import store
from tests.support.pages.report_pages import TablesOfPage, by_file, drawn
from tests.support.results import step_results
from tests.support.results.ball_results import balls, whole
from tests.support.results.bridge_results import KEYS, NAN, PROVENANCE, adjusted, arch_scene, assembled
from tests.support.results.metrics import metric
from tests.support.results.records import assert_equal


def frame_scene(k=3):
    design = FrameDesign(np.arange(k) + 7, np.arange(3.0 * k).reshape(k, 3) * 1000.0, np.full(k, 45.0))
    return Scene("frame", "space-frame", (Scan("s", np.zeros((2, 3))),), frame=design)


def of_bridge(scene=None, **kwargs):
    runs = [
        StepRun("preassemble", m, "{}", assembled(m, scale=s, **kwargs)) for m, s in (("design-aided", 1), ("line", 40))
    ]
    return Execution(scene or arch_scene(**kwargs), tuple(runs), PROVENANCE)


def of_frame():
    runs = (
        StepRun("spheres", "ransac", "{}", balls()),
        StepRun("spheres", "least-squares", "{}", balls("least-squares", (44.0, NAN, 60.0))),
    )
    true = np.array([45.0, 50.0, 60.0])
    report = ErrorReport((metric("a", 1.0, 0.5, step="spheres"),), {"ransac": true, "least-squares": true})
    return Execution(frame_scene(), runs, PROVENANCE), report


def render(execution, report):
    figures = drawn(execution) if report == ErrorReport() else all_figures.draw_figures(execution, report)
    return page.html(execution, report, figures)


# --- results.json --------------------------------------------------------------------------------------------------


def strict(text):
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_results_json_has_the_names_that_scripts_rely_on():
    made = to_json.results_json(of_bridge(), ErrorReport())
    found = strict(json.dumps(made, allow_nan=False))
    assert (found["format"], found["format_version"], found["checks"]) == ("processor-results", "1.0", [])
    step = found["steps"]["preassemble"]
    first, _, last = step["components"]
    assert first["T_bridge_scan"] == np.eye(4).tolist()
    assert first["key_points_scan"]["start"] == {}
    assert first["key_points_scan"]["end"] == {key: [3.0 * i, 3.0 * i + 1, 3.0 * i + 2] for i, key in enumerate(KEYS)}
    assert first["key_points_sd"] == {"start": {}, "end": {}}
    assert first["covariance"] == [[None] * 6] * 6
    assert (last["status"], last["T_bridge_scan"]) == ("failed", [[None] * 4] * 4)
    one, two = step["joints"]
    assert (one["name"], one["left"], one["right"], one["verdict"]) == ("J1", "foot1", "rib1", "indeterminate")
    assert one["points"]["P3"] == {"gap": pytest.approx([3.0, -3.1, 3.2]), "ci95": [None] * 3}
    assert two["points"]["P3"]["gap"] == [None] * 3
    assert step["splicing_error"] == {"mean": 4.6, "max": 8.2}
    linear = step["linear_error"]
    assert (linear["mean"], linear["max"]) == (2.0, 3.0)
    assert len(linear["stations"]) == len(linear["deviation"]) == len(linear["edge"]) == 120
    assert step["trade_off"] == []
    assert [one["method"] for one in found["comparison"]["preassemble"]] == ["line"]


def test_results_json_of_balls():
    execution, report = of_frame()
    found = strict(json.dumps(to_json.results_json(execution, report), allow_nan=False))
    ok, _, missing = found["steps"]["spheres"]["balls"]
    assert {"id", "centre", "radius", "lowest", "covariance", "points", "visible_fraction", "evidence", "flag"} <= set(
        ok
    )
    assert (ok["id"], ok["radius"], ok["centre"], ok["lowest"]) == (7, 45.5, [0, 1000, 2000], [0, 1000, 1954.5])
    assert np.shape(ok["covariance"]) == (4, 4)
    assert (missing["radius"], missing["centre"], missing["flag"]) == (None, [None] * 3, "not-found")
    assert found["checks"] == [
        {
            "step": "spheres", "name": "a", "method": "", "quantity": "a", "statistic": "value", "value": 1.0,
            "limit": 0.5, "unit": "mm", "better": "low", "passed": False,
        }
    ]  # fmt: skip


# --- tables --------------------------------------------------------------------------------------------------------


def test_csv_of_gaps_and_stations():
    gaps = by_file("gaps", of_bridge())
    assert len(gaps) == 16
    assert list(gaps[2].values()) == ["J1", "P3", "3.0", "-3.1", "3.2", "", "", ""]
    assert gaps[10]["dx_mm"] == ""
    linear = by_file("linear", of_bridge())
    assert (linear[61]["edge"], linear[61]["chainage_mm"], linear[61]["deviation_mm"]) == ("right", "200.0", "1.2")


def test_csv_of_balls_holds_the_error_against_the_true_radius():
    first, second, third = by_file("balls", *of_frame())
    assert (first["radius_mm"], first["true_radius_mm"], first["radius_error_mm"]) == ("45.5", "45.0", "0.5")
    assert second["radius_error_mm"] == "10.0"
    assert (third["radius_mm"], third["radius_error_mm"]) == ("", "")
    assert float(first["formal_ci95_radius_mm"]) == pytest.approx(1.96 * 0.2, abs=1e-4)  # written to 1e-4
    (ransac, least) = by_file("summary", *of_frame())
    assert (ransac["fitted"], ransac["largest_mm"]) == ("2", "10.0")
    assert (least["fitted"], least["median_mm"]) == ("2", "0.5")


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@a", "\t=x", "\r=x", "\n=x", "＝1", '"', 'a",=1'])
def test_no_name_becomes_a_formula_in_a_spreadsheet(name):
    table = all_tables.Table("t", columns("a", "b"), ((name, -1.5),))
    _, row = csv.reader(io.StringIO(report_table.csv_text(table), newline=""))
    assert row[1] == "-1.5"
    assert not row[0].startswith(("=", "+", "-", "@", "\t", "\r", "\n", "＝"))
    if name.isprintable():
        assert row[0].removeprefix("'") == name


def test_terminal_text_is_aligned_and_without_control_characters():
    table = all_tables.Table(
        "t\x1b[31m",
        (*columns("name"), *under("a long heading here", "linear_mean_mm", "linear_max_mm")),
        (("钢 1", 1.0, NAN), ("a\x1b]0;b\n", -22.5, 3.0)),
        units=("mm",),
    )
    assert report_table.plain_text(table).splitlines() == [
        "t�[31m (mm)",
        "           a long heading here",
        "  name       mean          max",
        "  钢 1       1.00            –",
        "  a�]0;b�  -22.50         3.00",
    ]


TURNED = (*columns("joint"), *under("rotation", "rotation_mrad", "rotation_ci95_mrad", "rotation_about"))
FREE = columns("least_mm", "area_mm2", "mrad")
ENGLISH = ("joint", "rotation", "ci95", "about", "least{}", "area (mm2)", "mrad")
CHINESE = ("接口", "转角", "95% 置信区间半宽", "转轴", "最小", "面积 (mm²)", "mrad")


@pytest.mark.parametrize(
    ("lang", "units", "title", "group", "headings"),
    [
        ("en", (), "t", "rotation (mrad)", [one.format(" (mm)") for one in ENGLISH]),
        ("en", ("mm", "mrad"), "t (mm, mrad)", "rotation", [one.format("") for one in ENGLISH]),
        ("zh", ("mm",), "t (mm)", "rotation (mrad)", CHINESE),
    ],
)
def test_a_unit_stands_once_in_title_group_or_heading(lang, units, title, group, headings):
    table, catalogue = all_tables.Table("t", TURNED + FREE, (), units=units), messages(lang)
    assert report_table.title(table, catalogue) == title
    assert report_table.groups(table, catalogue) == [("", 1), (group, 3), ("", 3)]
    assert report_table.headings(table, catalogue) == tuple(headings)


def test_full_headings_state_group_and_unit_and_csv_files_the_names():
    table = all_tables.Table("t", TURNED, (), units=("mrad",))
    assert report_table.full_headings(table, messages("en")) == (
        "joint", "rotation: rotation (mrad)", "rotation: ci95 (mrad)", "rotation: about",
    )  # fmt: skip
    assert report_table.csv_text(table) == "joint,rotation_mrad,rotation_ci95_mrad,rotation_about\n"


@pytest.mark.parametrize(
    "column",
    [
        Column("lod95_mm", "lod95", "mm"),
        Column("mm", "", "mm"),
        Column("curvature_per_m", "curvature", "1/m"),
        Column("splicing_mean_mm", "mean", "mm"),
        Column("left_part", "left part", are_names=True),
    ],
    ids=lambda column: column.name,
)
def test_heading_and_unit_of_a_column_follow_from_its_name(column):
    assert columns(column.name) == (column,)
    assert list(report_columns.COLUMNS) == [one.name for one in report_columns.COLUMNS.values()]


def test_long_tables_are_cut_on_the_terminal_with_a_remark():
    table = all_tables.Table("t", columns("a"), tuple((i,) for i in range(50)), "long")
    lines = report_table.plain_text(table, most=10).splitlines()
    assert len(lines) == 13
    assert lines[-1] == "  ... and 40 more in long.csv"


def test_gaps_stand_as_in_the_source_paper_and_none_as_a_dash():
    tables = TablesOfPage(render(of_bridge(), ErrorReport())).tables
    found = tables["Splicing error, method design-aided (mm)"]
    assert found[0] == ["", "J1: foot1 & rib1", "J2: rib1 & foot2"]
    assert found[1] == ["point", "dx", "dy", "dz", "dx", "dy", "dz"]
    assert found[4] == ["P3", "3.00", "-3.10", "3.20", "–", "–", "–"]
    assert len(found) == 10
    found = tables["Joints, method design-aided (mm)"]
    assert found[1] == ["J1", "foot1", "rib1", "4.60", "8.20", "P8, z", "indeterminate"]
    assert found[2] == ["J2", "rib1", "foot2", "–", "–", "", "indeterminate"]


# --- figures and page ----------------------------------------------------------------------------------------------


def test_figures_are_the_same_bytes_whatever_the_users_settings(drawn_pictures):
    first = all_figures.draw_figures(*of_frame())["spheres"].figures
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 20.0, "savefig.facecolor": "black"}):
        again = all_figures.draw_figures(*of_frame())["spheres"].figures
        assert mpl.rcParams["font.size"] == 20.0
    assert set(first) == {"radius-errors.png"}
    assert first == again
    for _, png in first.values():
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        assert b"tEXt" not in png


def test_any_name_can_be_drawn_and_shown(drawn_pictures):
    names = ("_$\\frac$", "桥拱\n一", "<b>&amp;" + "x" * 5000)
    execution = of_bridge(names=names, joints=("$x", "J2"))
    rows = TablesOfPage(render(execution, ErrorReport())).tables["Components"][1:4]
    assert [row[0] for row in rows] == [report_table.shown(name) for name in names]


def test_a_run_without_any_answer_is_drawn_too(drawn_pictures):
    given = assembled()
    unknown = Deviations(deviation=np.full(120, NAN))
    nothing = dataclasses.replace(
        given,
        joints=dataclasses.replace(given.joints, gaps=np.full((2, 8, 3), NAN)),
        linear=dataclasses.replace(given.linear, assembled=unknown, best_fit=unknown),
    )
    none = balls(radii=(NAN, NAN), flag=("not-found",) * 2)
    empty = space_frame_step.Result("failed", "ransac", (reason("spheres.no-ball", points=9),))
    exact = balls(radii=(45.0, 45.0), flag=("ok", "ok"))
    frame = frame_scene(2)
    for scene, result, radii, said in (
        (arch_scene(), nothing, None, "Preassembly: partial"),
        (frame, none, np.full(2, NAN), "0 of 2 balls"),
        (frame, empty, None, "o ball stands out"),
        (frame, exact, np.full(2, 45.0), "2 of 2 balls"),
    ):
        step = "preassemble" if result is nothing else "spheres"
        report = ErrorReport() if radii is None else ErrorReport((), {"ransac": radii})
        assert said in render(Execution(scene, (StepRun(step, result.method, "{}", result),), PROVENANCE), report)


def test_page_begins_with_the_outcome():
    execution, report = of_frame()
    text = render(execution, report)
    assert text.index("1 of 3 balls without a flag") < text.index("<h2")
    assert text.index('class="appendix"') < text.index("1 of 1 accuracy limits missed") < text.index("MISSED")
    assert "truth" not in render(of_bridge(), ErrorReport())


# --- the folder of results -----------------------------------------------------------------------------------------


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_earlier_results_are_replaced_as_a_whole(tmp_path):
    out = tmp_path / "deep" / "out"
    write_results.write_results(out, *of_frame())
    assert "balls.csv" in contents(out)
    write_results.write_results(out, of_bridge(), ErrorReport())
    found = contents(out)
    assert "balls.csv" not in found
    assert {"results.h5", "results.json", "report.html", "gaps.csv", "figures/linear-error.png"} <= set(found)
    assert [p.name for p in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("where", ["page", "move"])
def test_a_failure_leaves_the_earlier_results(tmp_path, monkeypatch, where):
    out = tmp_path / "out"
    write_results.write_results(out, *of_frame())
    before = contents(tmp_path)
    if where == "page":
        monkeypatch.setattr(page, "html", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    else:
        replace = os.replace

        def failing(source, target):
            if os.fspath(target) == os.fspath(out) and os.fspath(source).endswith("new"):
                raise OSError(28, "No space left on device")
            replace(source, target)

        monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(InputError, match=r"cannot be written \(No space left"):
        write_results.write_results(out, of_bridge(), ErrorReport())
    monkeypatch.undo()
    assert contents(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_with_anything_else_in_it_is_refused(tmp_path):
    source, out = tmp_path / "b.h5", tmp_path / "out"
    source.touch()
    write_results.check_output(out, source)
    out.mkdir()
    write_results.check_output(out, source)
    write_results.write_results(out, *of_frame())
    write_results.check_output(out, source)
    (out / "my-notes.txt").touch()
    with pytest.raises(UsageError, match=r"my-notes\.txt"):
        write_results.check_output(out, source)
    (out / "my-notes.txt").unlink()
    with pytest.raises(UsageError, match="holds the input"):
        write_results.check_output(out, out / "results.h5")
    with pytest.raises(UsageError, match="is a file"):
        write_results.check_output(source, source)
    (out / "results.json").unlink()
    with pytest.raises(UsageError, match="no earlier results"):
        write_results.check_output(out, source)


def listed_defects():
    """Defects of every class, every other one doubtful, the first with a deflection."""
    result = step_results.defects()
    doubtful = np.arange(len(result.defects)) % 2 == 0
    return dataclasses.replace(result, defects=dataclasses.replace(result.defects, doubtful=doubtful))


@pytest.mark.parametrize(
    ("step", "made"),
    [
        ("preassemble", assembled()), ("preassemble", adjusted()), ("spheres", balls()), ("spheres", whole()),
        ("stitch", step_results.stitched_with_control()), ("inspect", step_results.inspection()),
        ("defects", listed_defects()),
    ],
)  # fmt: skip
def test_results_go_through_the_store_unchanged(step, made, tmp_path):
    store.write_results(tmp_path / "r.h5", [StepRun(step, made.method, "{}", made)], {})
    (back,) = store.read_results(tmp_path / "r.h5", {step: type(made)})
    assert_equal(back.result, made)
    assert store.problems(tmp_path / "r.h5") == []


def test_results_json_has_a_row_of_a_table_on_each_line():
    balls = [{"id": 1, "centre": [1.5, None, 0.3], "movement": {"ci95": []}}, {"id": 2, "reasons": [{"code": "ü"}]}]
    content = {"a": 1, "none": {}, "steps": {"spheres": {"balls": balls, "empty": [], "points": [1, 2]}}}
    text = to_json.text_of(content)
    assert json.loads(text) == content
    first, second = (json.dumps(ball, ensure_ascii=False) for ball in balls)
    expected = f"""{{
 "a": 1,
 "none": {{}},
 "steps": {{
  "spheres": {{
   "balls": [
    {first},
    {second}
   ],
   "empty": [],
   "points": [1, 2]
  }}
 }}
}}"""
    assert text.splitlines() == expected.splitlines()
