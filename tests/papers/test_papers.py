"""The comparison with the source papers: what counts as reproduced, and every paper on a tiny data set."""

import json
import math
import time

import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli.main import commands
from processor.jobs import process
from processor.jobs.causes import Cause
from processor.language.messages import NO_NUMBER, text
from processor.model import UsageError, reason
from processor.report.charts import line_chart as drawing
from tests.bench.papers import bolt_balls, command, measuring, parameters, preassembly
from tests.bench.papers.data_sets import DataSet, Found, Measured
from tests.bench.papers.rows import Outcome, Row, Rule, holds, is_smaller

TINY = {
    "000": ("arch-s1", ("scan.spacing_mm=25.0", "scan.sigma_mm=0.001", "scan.net=true")),
    "001": ("balls-100", ("frame.nodes_x=3", "frame.nodes_y=3", "scan.spacing_mm=5.0")),
    "002": ("stadium-roof", ("structure.trusses=4", "structure.bays=1", "scan.spacing_mm=120.0")),
    "003": ("truss-bridge-chain", ("structure.bays=4", "scan.step_mrad=9.0")),
    "004": ("plates-defects", ('structure.components=["none", "dent"]', "scan.step_mrad=3.0")),
}


def row(published, values, rule):
    return Row(
        paper="000",
        place=text("table {number}", number="2"),
        data="D1",
        method="line",
        quantity=text("splicing error, mean"),
        unit="mm",
        published=published,
        values=values,
        rule=rule,
        reason=reason("papers.beside"),
    )


@pytest.mark.parametrize(
    ("rule", "published", "values", "outcome", "worst"),
    [
        (Rule.AT_MOST, 1.0, (0.2, 1.2, 9.0), Outcome.YES, 9.0),
        (Rule.AT_MOST, 1.0, (1.3, 1.3, 0.1), Outcome.NO, 1.3),
        (Rule.NEAR, 20.0, (19.0, 21.0, 40.0), Outcome.YES, 40.0),
        (Rule.NEAR, 20.0, (1.0, 1.0, 20.0), Outcome.NO, 1.0),
        (Rule.NEAR, -20.0, (-21.0, -19.0), Outcome.YES, -19.0),
        (Rule.MAGNITUDE, 5.8, (2.0, 17.0, 9.0), Outcome.YES, 17.0),
        (Rule.MAGNITUDE, 5.8, (0.05, 0.05), Outcome.NO, 0.05),
        (Rule.HOLDS, 1.0, (1.0, 1.0), Outcome.YES, 1.0),
        (Rule.HOLDS, 1.0, (1.0, 0.0, 1.0), Outcome.NO, 0.0),
        (Rule.NEAR, 1.0, (), Outcome.NOT_MADE, math.nan),
        (Rule.NEAR, 1.0, (math.nan,), Outcome.NOT_MADE, math.nan),
        (Rule.AT_MOST, math.nan, (3.0, 1.0), None, 3.0),
        (Rule.AT_MOST, math.nan, (), None, math.nan),
        (Rule.HOLDS, 1.0, (math.nan, math.nan), Outcome.NOT_MADE, math.nan),
    ],
)
def test_outcome_of_a_statement_follows_its_rule(rule, published, values, outcome, worst):
    made = row(published, values, rule)
    assert made.outcome == outcome
    np.testing.assert_equal(made.worst, worst)
    assert json.dumps(made.as_object(), allow_nan=False)


def test_a_comparison_of_methods_needs_both():
    assert is_smaller((1.0, 2.0), (2.0, 1.0)) == (1.0, 0.0)
    np.testing.assert_equal(is_smaller((math.nan, 1.0), (1.0, math.nan)), (math.nan, math.nan))
    np.testing.assert_equal(holds((3.0, math.nan), lambda value: value > 2.0), (1.0, math.nan))


def test_a_seed_that_failed_does_not_refute_a_statement():
    figures = {"ransac: radius, median": 1.0, "total station: radius, median": 2.0}
    first, second = (bolt_balls.data_sets(seed)[0] for seed in range(2))
    found = bolt_balls.rows(Found([Measured(first, figures), Measured(second, failed="out of paper")]))
    (statement,) = [one for one in found if one.rule is Rule.HOLDS and "total station" in one.method]
    np.testing.assert_equal(statement.values, (1.0, math.nan))
    assert statement.outcome is Outcome.YES


def test_where_a_data_set_failed_no_statement_is_made_and_no_median_is_stated():
    for number in ("000", "001", "002", "004"):
        module = measuring.module_of(number)
        failed = Found([Measured(one, failed="out of paper") for one in module.data_sets(0)])
        found = module.rows(failed)
        assert not [str(one.quantity) for one in found if one.outcome in (Outcome.YES, Outcome.NO)]
        for one in found:
            said = one.as_object()
            assert json.dumps(said, allow_nan=False)
            if "median" in one.reason.values or "times" in one.reason.values:
                assert NO_NUMBER in said["reason"]["text"]


def hanging_job(job):
    time.sleep(60.0)


def test_measuring_ends_at_its_limit(tmp_path, monkeypatch):
    ended = process.Ended(Cause.EXIT, 0, "", 1.0, 1.0, 1.0)
    monkeypatch.setattr(process, "run", lambda *_, **__: ended)
    monkeypatch.setattr(measuring, "measured", hanging_job)
    monkeypatch.setattr(measuring, "MEASURING_S", 0.5)
    made = measuring.make_and_measure(DataSet("001", "100 balls", "balls-100", (), 0), scratch=str(tmp_path))
    assert made.failed == "measuring took longer than 0 s"
    stopped = measuring.make_and_measure(
        DataSet("001", "100 balls", "balls-100", (), 0), lambda: True, scratch=str(tmp_path)
    )
    assert "longer" not in stopped.failed


def test_differences_of_methods_by_rigid_motions_leave_no_residual():
    # Corners and middles of a section, gaps changed by a small rotation and a shift of the part.
    rng = np.random.default_rng(1)
    corners = np.array([[0, 700, -900], [0, -700, -900], [0, -700, 900], [0, 700, 900.0]])
    points = np.vstack([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])
    moved = [np.cross(1e-3 * rng.normal(size=3), points) + rng.normal(size=3) for _ in range(4)]
    left, before = preassembly.beyond_rigid(np.hstack(moved))
    assert left < 1e-9  # float64
    assert before > 0.3
    picked = np.hstack(moved) + 0.5 * rng.normal(size=(8, 12))
    # 96 values less 24 of motions determine a standard deviation to 8 %.
    assert preassembly.beyond_rigid(picked)[0] == pytest.approx(0.5, rel=0.25)


def test_tables_of_the_paper_agree_with_its_statement():
    # "At most 1 mm" between both methods, and nothing of it by a motion: see the page.
    tables = {key: np.array(value) for key, value in preassembly.published().items() if key.startswith("table")}
    assert {table.shape for table in tables.values()} == {(8, 12)}
    for line, aided in (("table_4", "table_6"), ("table_5", "table_7")):
        between = tables[aided] - tables[line]
        assert np.abs(between).max() < preassembly.PUBLISHED_DIFFERENCE_MM
        left, before = preassembly.beyond_rigid(between)
        assert left > 0.9 * before  # "nothing of it by a motion"


def test_stated_parameters_stand_beside_those_that_are_used():
    found = {str(one.quantity): one for number in ("000", "002") for one in parameters.rows(number, 2)}
    assert [name for name, one in found.items() if one.outcome is not Outcome.YES] == [
        "thickness of a slice, in spacings"
    ]
    # numbers of the papers' texts and of table 1
    stated = {"boxes per edge": 10.0, "neighbours K of the outlier removal": 20.0, "normal scale": 110.541}
    assert {name: found[name].published for name in stated} == stated
    assert {one.outcome for one in parameters.rows("000", 0)} == {Outcome.NOT_MADE}


def test_four_points_with_one_behind_the_ball_make_a_sphere_of_metres():
    class Design:
        centres, radii = np.zeros((100, 3)), np.full(100, 45.0)

    found = bolt_balls._by_total_station(Design, np.random.default_rng(0))
    assert found[bolt_balls.BLUNDER_ROW, 3] > 1000.0  # "of metres"
    assert np.median(np.abs(found[:, 3] - 45.0)) < 10.0  # some mm at each of four points near each other


@pytest.mark.parametrize(
    "number", [*(pytest.param(number, marks=pytest.mark.slow) for number in ("000", "002", "003", "004")), "001"]
)
def test_a_paper_on_a_tiny_data_set(number, tmp_path):
    recipe, settings = TINY[number]
    module = measuring.module_of(number)
    named = [one.name for one in module.data_sets(3)]
    assert [one.seed for one in module.data_sets(3)] == [3] * len(named)
    made = measuring.make_and_measure(DataSet(number, named[0], recipe, settings, 1), scratch=str(tmp_path))
    assert not made.failed, made.failed
    assert not list(tmp_path.iterdir())
    found = Found([made])
    rows = module.rows(found)
    assert any(len(one.values) for one in rows if one.data == named[0])
    assert {one.paper for one in rows} == {number}
    empty = module.rows(Found([]))
    assert len(empty) == len(rows)
    assert not [one for one in empty if one.outcome in (Outcome.YES, Outcome.NO)]
    assert module.charts(Found([])) == []
    assert all(drawing.png(chart).startswith(b"\x89PNG") for chart in module.charts(found))


def measured_without_scenes(data_set, *_, **__):
    figures = {"ransac: radius, mean": 1.0, "ransac: radius, largest": 9.0, "blunder, m": 6.0}
    if data_set.seed == 1:
        return Measured(data_set, failed="designgen make: out of paper")
    return Measured(data_set, figures, {"ransac": [1.0, 2.0]})


def test_the_command_writes_one_page_and_one_file(tmp_path, monkeypatch):
    monkeypatch.setattr(measuring, "make_and_measure", measured_without_scenes)
    out = tmp_path / "out"
    words = ["papers", "-o", str(out), "--only", "001", "--seeds", "2", "--lang", "zh"]
    for _ in range(2):  # the second replaces the first
        done = CliRunner().invoke(commands, words, standalone_mode=False)
        assert done.return_value == 1  # a data set failed
        assert "2 of 24 published numbers" in done.output
    assert sorted(path.name for path in out.iterdir()) == [command.PAGE, command.JSON] == ["papers.html", "papers.json"]
    content = json.loads((out / command.JSON).read_text("utf-8"))
    assert (content["format"], content["seeds"]) == ("processor-papers", 2)
    mean = content["rows"][0]
    assert (mean["published"], mean["median"], mean["reproduced"]) == (pytest.approx(1.35), 1.0, "yes")
    assert mean["values"] == [1.0, None]
    assert mean["reason"]["text"]
    assert content["rows"][1]["reproduced"] == "no"
    assert [one["failed"] for one in content["data_sets"]] == [*[""] * 2, *["designgen make: out of paper"] * 2]
    page = (out / command.PAGE).read_text("utf-8")
    assert "来源论文逐表对照" in page
    assert "data:image/png;base64," in page
    assert "out of paper" in page


def test_an_unknown_paper_and_a_full_folder_are_refused(tmp_path):
    with pytest.raises(UsageError, match="no paper '007'"):
        command.run(tmp_path / "out", ("007",), 1, 1)
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(UsageError, match="not empty"):
        command.run(tmp_path, ("001",), 1, 1)
