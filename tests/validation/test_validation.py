"""The matrix, its cells, the history, the certificate and what a CI server reads: by stubbed cells."""

import dataclasses
import json
import math
import multiprocessing
import runpy
import sqlite3
import time
from contextlib import closing
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from processor.jobs import process
from processor.language.messages import text
from processor.model import InputError, UsageError
from processor.validation import cell_runner, cells, certificate, coverage, history, matrix, night, software_identity
from processor.validation.cells import Outcome
from processor.validation.history import History
from tests.support.processes import batches
from tests.support.results import validation_nights

NIGHT = "2026-11-21"
TWO_CELLS = """
[[cell]]
recipe = "frame-small"
steps = ["spheres"]
methods = ["ransac", "ray"]
seeds = [1, 2]
set."scan.sigma_mm" = [1.0, 2.0]
set.frame.radii_mm = [[45.0, 50.0]]
params.spheres.catalogue = "none"

[[cell]]
recipe = "arch-s1"
steps = ["preassemble"]
full = true
"""


def read(tmp_path, text, full=False):
    (tmp_path / "m.toml").write_text(text, "utf-8")
    return matrix.read(tmp_path / "m.toml", full)


# --- matrix and cells -----------------------------------------------------------------------------------------------


def test_lists_of_settings_are_combined_and_fresh_seeds_differ_by_night(tmp_path):
    found = read(tmp_path, TWO_CELLS)
    tonight = found.cells(night.number_of(NIGHT))
    assert [(c.case.settings[0], c.seed) for c in tonight if c.fixed] == [
        (f"scan.sigma_mm={sigma}", seed) for sigma in (1.0, 2.0) for seed in (1, 2)
    ]
    assert tonight[0].case.settings[1] == "frame.radii_mm=[45.0, 50.0]"
    assert tonight == found.cells(night.number_of(NIGHT))
    fresh = [[c.seed for c in found.cells(night.number_of(day)) if not c.fixed] for day in (NIGHT, "2026-11-22")]
    assert len({*fresh[0], *fresh[1]}) == 4
    assert len(read(tmp_path, TWO_CELLS, full=True).cells(1)) == 8


def test_key_of_a_cell_depends_on_all_settings_but_methods(tmp_path):
    keys = {cell.key for cell in read(tmp_path, TWO_CELLS).cells(1)}
    for old, new in (("2.0]", "3.0]"), ("[1, 2]", "[1, 3]"), ('"none"', '"common"'), ('["ransac", "ray"]', '["ray"]')):
        others = {cell.key for cell in read(tmp_path, TWO_CELLS.replace(old, new)).cells(1)}
        assert others - keys
    one, other = validation_nights.case(), validation_nights.case(text="[scan]\n")
    assert one.key != other.key
    assert validation_nights.case(methods=("ray", "ransac")).key == one.key  # its figures stay comparable


CELL = '[[cell]]\nrecipe = "frame-small"\nsteps = ["spheres"]\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1", "unknown key 'x'"),
        ("fixed_seeds = [1]", "at least one"),
        ('[[cell]]\nrecipe = 3\nsteps = ["spheres"]', "a name or a TOML file as 'recipe', found 3"),
        ('[[cell]]\nsteps = ["spheres"]', "recipe = a name"),
        ("cell = []", "at least one"),
        ('[[cell]]\nrecipe = "frame-small"\nsteps = []', "names of those to run"),
        (CELL + "fresh = -1", "from 0 to 10000 as 'fresh', found -1"),
        ('[[cell]]\nrecipe = "frame-small"', "names of those to run"),
        (CELL.replace("spheres", "stich"), r"cell 1: no step 'stich' \(did you mean 'stitch'\?\); there are"),
        (CELL + 'methods = ["magic"]', "no method 'magic'"),
        (CELL.replace("frame-small", "nothing"), "no recipe 'nothing'"),
        (CELL + "seeds = [-1]", "whole numbers from 0"),
        (CELL + 'set."a.b" = []', "list of values is empty"),
        (CELL + "params.spheres.x = 1", "spheres.x: unknown parameter"),
        (CELL + 'generator = "b"', "exclude each other"),
        ('[[cell]]\ngenerator = "nothing"\nsteps = ["spheres"]', "no generator 'nothing'"),
        (f'coverage.least = "few"\n{CELL}', "a whole number as 'least', found 'few'"),
        (f"aim = 1\n{CELL}", "low, high or a number as 'aim', found 1"),
        (f'aim.x = "up"\n{CELL}', "low, high or a number"),
    ],
)
def test_mistakes_in_a_matrix_are_refused_by_name(tmp_path, text, said):
    with pytest.raises(UsageError, match=said):
        read(tmp_path, text)


def test_unreadable_matrix_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a matrix in TOML"):
        read(tmp_path, "[[cell")
    with pytest.raises(InputError, match="expected a matrix in TOML"):
        matrix.read(tmp_path / "none.toml", False)


def test_the_default_matrix_covers_every_step_that_is_there():
    from processor import pipeline

    covered = {step for entry in matrix.read(matrix.DEFAULT, False).entries for step in entry.case.steps}
    assert covered == set(pipeline.step_modules())


def test_foreign_cells_name_settings_that_their_generators_have():
    foreign = [e.case for e in matrix.read(matrix.DEFAULT, True).entries if e.case.origin is cells.Origin.FOREIGN]
    assert {case.recipe for case in foreign} == {path.stem for path in matrix.FOREIGN.glob("[a-z]*.py")}
    for case in foreign:
        known = runpy.run_path(str(matrix.FOREIGN / f"{case.recipe}.py"))["SETTINGS"]
        assert {setting.split("=")[0] for setting in case.settings} <= set(known), case.name


def test_outside_a_checkout_the_default_matrix_has_the_scenes_of_designgen_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(matrix, "FOREIGN", tmp_path / "none")
    assert {entry.case.origin for entry in matrix.read(matrix.DEFAULT, True).entries} == {cells.Origin.OWN}
    with pytest.raises(UsageError, match="part of the sources"):
        read(tmp_path, '[[cell]]\ngenerator = "steelwork"\nsteps = ["deviation"]')


def test_figures_are_separated_by_method():
    found = validation_nights.results({"radii, bias": 0.5, "ransac | radii, bias": None, "other: x": (2.0, 1.0, "%")})
    found["comparison"] = {"spheres": [{"method": "ransac"}]}
    figures = cells.checks_of(found)
    assert [(f["method"], f["name"]) for f in figures] == [
        ("ray", "radii, bias"),
        ("ransac", "radii, bias"),
        ("ray", "other: x"),
    ]
    assert [(f["value"], f["limit"]) for f in figures] == [(0.5, None), (None, None), (2.0, 1.0)]


# --- a night --------------------------------------------------------------------------------------------------------


def of_cell(cell):
    return {"radii, bias": 0.001 * cell.seed, "lowest": (0.5, 1.0, "mm")}


def run(out, asked, figures_of=of_cell, day=NIGHT, done=None, **more):
    more.setdefault("made_by", validation_nights.SOFTWARE)
    with night.locked_output(out):
        return night.run(asked, out, day, validation_nights.runner(figures_of, done), **more)


def stored(out, query):
    with closing(sqlite3.connect(out / "history.sqlite")) as db:
        return db.execute(query).fetchall()


def test_one_row_a_figure_with_all_that_made_it(tmp_path):
    asked = validation_nights.matrix(
        validation_nights.case(settings=("a=1",)), validation_nights.case(settings=("a=2",))
    )
    told = run(tmp_path / "out", asked)
    assert (told.passed, len(told.cells), told.failed) == (True, 8, [])
    rows = stored(tmp_path / "out", "SELECT night, name, software, commit_, recipe_sha256, seed, fixed FROM rows")
    assert len(rows) == 16
    assert {json.loads(row[2])["numpy"] for row in rows} == {"2"}
    assert {row[3] for row in rows} == {validation_nights.SOFTWARE.commit}
    assert {row[4] for row in rows} == {asked.entries[0].case.recipe_sha256}
    assert sorted({row[5] for row in rows if row[6]}) == [1, 2, 3]


def test_done_cells_are_not_done_again_and_failed_ones_are(tmp_path):
    asked, done = validation_nights.matrix(validation_nights.case()), []

    def once(cell):
        return Outcome(failed="no memory") if cell.seed == 2 and len(done) <= 4 else of_cell(cell)

    told = run(tmp_path / "out", asked, once, done=done)
    assert [cell["title"] for cell in told.failed] == ["made seed 2"]
    assert "1 cell failed" in str(told.line)
    told = run(tmp_path / "out", asked, once, done=done)
    assert (done[4:], told.failed) == (["made seed 2"], [])
    run(tmp_path / "out", asked, once, done=done)
    assert len(done) == 5
    # The history is lost: what was kept of the cells makes it again.
    (tmp_path / "out" / "history.sqlite").unlink()
    run(tmp_path / "out", asked, once, done=done)
    assert len(done) == 5
    assert stored(tmp_path / "out", "SELECT COUNT(*) FROM figures") == [(8,)]


def test_night_of_other_software_is_replaced_only_by_again(tmp_path):
    asked, done = validation_nights.matrix(validation_nights.case()), []
    run(tmp_path / "out", asked, done=done)
    other = software_identity.Software("code-2", "", {})
    with pytest.raises(UsageError, match="--again does all of it again"):
        run(tmp_path / "out", asked, made_by=other)
    run(tmp_path / "out", asked, made_by=other, again=True, done=done)
    assert len(done) == 8
    assert stored(tmp_path / "out", "SELECT DISTINCT code FROM rows") == [("code-2",)]


def test_a_regression_stays_until_it_is_accepted(tmp_path):
    from processor.validation import command

    asked, out = validation_nights.matrix(validation_nights.case(), seeds=range(6)), tmp_path / "out"

    def worse(cell):
        return {"sd": 1.2 + 0.001 * cell.seed % 0.01}

    def before(cell):
        return {"sd": 1.0}

    assert run(out, asked, before, "2026-11-01").passed
    for day in ("2026-11-02", "2026-11-03"):
        told = run(out, asked, worse, day)
        assert not told.passed
        assert "1 worse: spheres (ray) sd 20" in str(told.line)
    assert command.accept(out, None, None) == "2026-11-03: 1 figure(s) accepted as they are now"
    assert run(out, asked, worse, "2026-11-04").passed
    better = run(out, asked, before, "2026-11-05")
    assert "1 better: spheres (ray) sd 20" in str(better.line)
    assert (out / "line.txt").read_text("utf-8") == f"{better.line}" + "\n"
    page = (out / "nights.html").read_text("utf-8")
    assert all(day in page for day in ("2026-11-01", "2026-11-05", "nights/2026-11-03/certificate.html", "<polyline"))
    with pytest.raises(UsageError, match="no such night"):
        command.accept(out, None, "2026-10-01")


def test_limits_missed_reach_the_ci_server(tmp_path):
    def over(cell):
        if cell.seed == 3:
            return Outcome(failed="designgen make: exit code 2: \x07 <b>")
        return {"lowest <1>": (2.0, 1.0, "mm")} if cell.seed == 2 else of_cell(cell)

    told = run(tmp_path / "out", validation_nights.matrix(validation_nights.case()), over)
    assert not told.passed
    assert "1 limit missed" in str(told.line)
    suite = ET.parse(tmp_path / "out" / "junit.xml").getroot()[0]
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("4", "1", "1")
    found = {case.get("name"): [(one.tag, one.get("message")) for one in case] for case in suite}
    assert found["made seed 2"] == [("failure", "spheres (ray), lowest <1>: 2 mm, limit 1")]
    assert found["made seed 3"][0][0] == "error"
    assert found["made seed 1"] == []
    (missed,) = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["missed"]
    assert (missed["name"], missed["value"], missed["limit"]) == ("lowest <1>", 2.0, 1.0)


def test_foreign_folder_file_or_locked_output_is_refused(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("", "utf-8")
    for path, said in ((tmp_path / "full", "holds no earlier nights"), (tmp_path / "full" / "thesis.txt", "is a file")):
        with pytest.raises(UsageError, match=said), night.locked_output(path):
            pass
    with (
        night.locked_output(tmp_path / "out"),
        pytest.raises(UsageError, match="at work"),
        night.locked_output(tmp_path / "out"),
    ):
        pass
    with pytest.raises(InputError, match="expected a history"):
        History(tmp_path / "full" / "thesis.txt" / "x")
    (tmp_path / "text").write_text("no database, and long enough to be looked at" * 99, "utf-8")
    with pytest.raises(InputError, match="expected a history"):
        History(tmp_path / "text")
    with closing(sqlite3.connect(tmp_path / "later")) as db:
        db.execute("PRAGMA user_version = 9")
    with pytest.raises(InputError, match="version 3, found 9"):
        History(tmp_path / "later")
    with pytest.raises(UsageError, match="expected a date"):
        night.number_of("tomorrow")


@pytest.mark.parametrize("version", [1, 2])
def test_a_history_of_an_earlier_version_keeps_its_nights(tmp_path, version):
    path, line = tmp_path / "history.sqlite", text("{night} {verdict}", night="2026-01-01", verdict=text("ok"))
    with closing(History(path)) as opened:
        opened.begin("2026-01-01", validation_nights.SOFTWARE, "made", "0", "")
        opened.end("2026-01-01", [], line, "now")
        assert [(one["line"], one["message"]) for one in opened.nights()] == [("2026-01-01 ok", line)]
    with closing(sqlite3.connect(path)) as db:
        for column in (name for later, names in history.ADDED.items() if later > version for name in names):
            db.execute("ALTER TABLE {} DROP COLUMN {}".format(*column.split(".")))
        db.execute(f"PRAGMA user_version = {version}")
    with closing(History(path)) as opened:
        kept = line if version > 1 else None
        assert [(one["line"], one["message"]) for one in opened.nights()] == [("2026-01-01 ok", kept)]


FORKS = multiprocessing.get_context("forkserver")  # of a process that has loaded this module once


def slow_night(out, begun):
    """A night in a process that is killed."""

    def slow(cell):
        time.sleep(0.02)
        return of_cell(cell)

    with night.locked_output(out):
        begun.send("begun")
        night.run(killed_matrix(), out, NIGHT, validation_nights.runner(slow), made_by=validation_nights.SOFTWARE)


def killed_matrix():
    return validation_nights.matrix(*(validation_nights.case(settings=(f"a={i}",)) for i in range(15)))


def test_a_night_killed_at_any_moment_loses_and_doubles_nothing(tmp_path):
    out = tmp_path / "out"
    counts = []
    FORKS.set_forkserver_preload([__name__])
    for attempt in range(12):
        here, there = FORKS.Pipe(duplex=False)
        begun = FORKS.Process(target=slow_night, args=(out, there))
        begun.start()
        assert here.poll(60.0)
        if attempt < 3:
            time.sleep((0.15, 0.33, 0.2)[attempt])
            begun.kill()
        begun.join()
        counts.append(stored(out, "SELECT COUNT(*) FROM cells")[0][0])
        if begun.exitcode == 0:
            break
    assert counts == sorted(counts)
    assert counts[0] < 60  # it was killed in the middle
    assert counts[-1] == 60
    run(tmp_path / "whole", killed_matrix())
    query = "SELECT night, title, name, value, seed, fixed FROM rows ORDER BY 1, 2, 3"
    assert stored(out, query) == stored(tmp_path / "whole", query)
    for name in ("certificate.json", "junit.xml", "line.txt"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


# --- the certificate ------------------------------------------------------------------------------------------------


def test_the_certificate_pools_errors_as_if_they_were_one_list(tmp_path):
    rng = np.random.default_rng(4)
    errors = {seed: rng.normal(0.1, 0.5, size=10 + 5 * seed) for seed in (1, 2, 3)}

    def of(cell):
        found = errors.get(cell.seed)
        if found is None:
            return {"other": 1.0}
        return {
            "radii, bias": found.mean(),
            "radii, standard deviation": found.std(ddof=1),
            "radii, 95 % error": np.quantile(np.abs(found), 0.95),
            "radii, number": (float(len(found)), None, ""),
            "radii, efficiency": (0.9, None, ""),
            "radii within their 95 % intervals": (94.0, None, "%"),
        }

    text = '[scan]\nmode = "rays"\nscanner = "phase"\nstep_mrad = 2.0\n'
    asked = validation_nights.matrix(validation_nights.case(settings=("scan.step_mrad=1.5",), text=text))
    run(tmp_path / "out", asked, of, "2026-11-01")
    run(tmp_path / "out", asked, of)  # the fixed seeds again: the same three scenes
    found = json.loads((tmp_path / "out" / "certificate.json").read_text("utf-8"))
    (line,) = found["lines"]
    every = np.concatenate(list(errors.values()))
    assert (line["scenes"], line["number"]) == (3, len(every))
    # The same sums in another order: rounding of float64.
    assert line["bias"] == pytest.approx(every.mean(), rel=1e-12)
    assert line["u_p"] == pytest.approx(every.std(ddof=1), rel=1e-12)
    assert line["U95"] == pytest.approx(2.0 * math.hypot(line["u_p"], line["u_b"]) + abs(line["bias"]), rel=1e-12)
    assert (line["coverage"], line["efficiency"]) == (pytest.approx(94.0), pytest.approx(0.9))
    assert (line["scanner"], line["density"], line["method"]) == ("phase", "1.5 mrad", "ray")
    assert found["nights"] == ["2026-11-01", NIGHT]
    assert any("simulated" in one for one in found["not_shown"])
    page = (tmp_path / "out" / "certificate.html").read_text("utf-8")
    assert "ISO 15530-3" in page
    assert "not traceable" in page


def test_the_bias_of_equal_scenes_has_the_standard_error_of_their_mean(tmp_path):
    def of(cell):
        bias = {1: 0.1, 2: 0.3, 3: 0.5}.get(cell.seed, 0.3)
        return {"gaps, bias": bias, "gaps, standard deviation": 0.2, "gaps, number": (8.0, None, "")}

    run(tmp_path / "out", validation_nights.matrix(validation_nights.case(), fresh=0), of)
    (line,) = json.loads((tmp_path / "out" / "certificate.json").read_text("utf-8"))["lines"]
    assert line["bias"] == pytest.approx(0.3)
    assert line["u_b"] == pytest.approx(0.2 / math.sqrt(3.0))
    assert line["coverage"] is None


def test_figures_of_own_and_foreign_scenes_are_never_pooled(tmp_path):
    """Own intervals hold 95 % of 200 errors, foreign ones 60 %; those of another method and of few are not judged."""
    shares = {"made": (96.0, 94.0), "apart": (90.0, 30.0)}

    def of(cell):
        share = shares[cell.case.recipe][cell.seed % 2]
        return {
            "radii, bias": 0.1 if cell.case.recipe == "made" else 0.9,
            "radii, standard deviation": 0.2,
            "radii, number": (100.0, None, ""),
            "radii within their 95 % intervals": (share, None, "%"),
            "centres, number": (12.0, None, ""),
            "centres within their 95 % intervals": (0.0, None, "%"),
            "ransac | radii, number": (100.0, None, ""),
            "ransac | radii within their 95 % intervals": (8.0, None, "%"),
        }

    apart = validation_nights.case("apart", text="no TOML", origin=cells.Origin.FOREIGN)
    asked = validation_nights.matrix(validation_nights.case(), apart, seeds=(1, 2), fresh=0)
    report = run(tmp_path / "out", asked, of)
    assert not report.passed
    assert "intervals of 1 quantities do not hold, scenes of foreign generators: radii too narrow" in str(report.line)
    found = json.loads((tmp_path / "out" / "certificate.json").read_text("utf-8"))
    lines = [(line["origin"], line["bias"]) for line in found["lines"] if line["method"] == "ray"]
    assert lines == [("designgen", pytest.approx(0.1)), ("foreign generators", pytest.approx(0.9))]
    judged = {(one["origin"], one["quantity"]): one for one in found["coverage"]}
    assert len(judged) == 4  # not those of another method than the one that is used where none is named
    own, other = judged["designgen", "radii"], judged["foreign generators", "radii"]
    assert (own["share"], own["worst"], own["number"], own["holds"]) == (95.0, 94.0, 200, "as stated")
    assert (other["share"], other["worst"], other["holds"]) == (60.0, 30.0, "too narrow")
    assert judged["designgen", "centres"]["holds"] == "too few errors"
    page = (tmp_path / "out" / "certificate.html").read_text("utf-8")
    assert page.index("Scenes of designgen") < page.index("Scenes of foreign generators")
    suites = {suite.get("name"): suite for suite in ET.parse(tmp_path / "out" / "junit.xml").getroot()}
    assert suites[f"intervals.{NIGHT}"].get("failures") == "1"


@pytest.mark.parametrize(("share", "scene", "holds"), [(97.9, 86.0, "as stated"), (93.0, 84.0, "too narrow")])
def test_the_written_limits_of_coverage(share, scene, holds):
    limits, name = coverage.Limits(), ("spheres", "ray")
    rows = [
        history.Row(
            "n",
            "c",
            "r",
            fixed=True,
            input_sha256="",
            name=(*name, "x"),
            quantity="q",
            seed=seed,
            value=value,
            unit="",
            statistic=statistic,
        )
        for seed, n, s in ((1, 50.0, scene), (2, 4950.0, (5000.0 * share - 50.0 * scene) / 4950.0))
        for statistic, value in (("coverage", s), ("number", n))
    ]
    (found,) = coverage.pooled(rows, ["n"], {name}, limits)
    assert (found.share, found.worst, found.holds) == (pytest.approx(share), scene, holds)
    assert coverage.pooled(rows, ["other"], {name}, limits) == ()
    bands = [dataclasses.replace(row, quantity="mean and largest errors") for row in rows]  # of 95 % or more
    (found,) = coverage.pooled(bands, ["n"], {name}, limits)
    assert found.holds == holds


def test_all_of_some_errors_within_their_intervals_is_no_failure():
    """Of n draws that all succeed Clopper and Pearson's interval is from 0.025^(1/n) to 1: 96.2 % of 96."""
    low, high = coverage.share_interval(100.0, 96.0)
    assert (low, high) == (pytest.approx(100.0 * 0.025 ** (1.0 / 96.0)), 100.0)
    assert coverage.share_interval(0.0, 96.0) == (0.0, pytest.approx(100.0 - low))
    key, limits = ("designgen", "spheres", "ray", "centres"), coverage.Limits()
    of_few, of_many = ([(100.0, 96.0)] * scenes for scenes in (2, 5))  # 50 of each count: from 185 on it is above 98
    assert coverage._judged(key, 100.0, of_few, limits).holds == "as stated"
    assert coverage._judged(key, 100.0, of_many, limits).holds == "too wide"
    bands = (*key[:3], "mean and largest errors")  # of 95 % or more
    assert coverage._judged(bands, 100.0, of_many, limits).holds == "as stated"
    assert coverage._judged(key, 86.0, [(86.0, 400.0)] * 2, limits).holds == "as stated"  # 78 to 92 % of 100
    assert coverage._judged(key, 86.0, [(86.0, 400.0)] * 4, limits).holds == "too narrow"


def test_conditions_of_scans_without_rays():
    assert certificate.conditions(validation_nights.case())[1:] == ("1.0 mm", "? mm")


# --- what is true of a real cell ------------------------------------------------------------------------------------

TINY = """
fresh_seeds = 0
[[cell]]
recipe = "tiny.toml"
steps = ["spheres"]
methods = ["ransac", "least-squares"]
seeds = [1]
set."scan.sigma_mm" = 0.5
params.spheres.tau_mm = 3.0

[[cell]]
recipe = "tiny.toml"
name = "impossible"
steps = ["spheres"]
seeds = [1]
set."scan.mode" = "magic"
"""
FOREIGN = """
fresh_seeds = 0
[[cell]]
generator = "mine.py"
steps = ["stitch"]
seeds = [7]
set.size = 3
"""
GENERATOR = """
import json, pathlib, sys
folder, words = pathlib.Path(sys.argv[1]), sys.argv[2:]
assert words == ["--seed", "7", "--set", "size=3"], words
folder.mkdir()
for name in ("a", "b"):
    points = [f"{i % 7} {i // 7 % 7} {i // 49}" for i in range(343)]
    (folder / f"{name}.xyz").write_text("\\n".join(points))
eye = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
truth = {"format": "processor-truth", "stations": {"ids": ["a", "b"], "T_project_station": [eye, eye],
         "zero_offset_mm": [0, 0], "scale_ppm": [0, 0], "tilt": [[0, 0], [0, 0]]}}
(folder / "truth.json").write_text(json.dumps(truth))
"""
RECIPE = """
about = "two by two balls"
kind = "space-frame"
[frame]
nodes_x = 2
nodes_y = 2
layers = 1
radii_mm = [50.0]
[scan]
mode = "surface"
spacing_mm = 8.0
sigma_mm = 1.0
member_reach_mm = 100.0
"""


def test_a_real_cell_through_the_command_line(tmp_path, monkeypatch):
    (tmp_path / "tiny.toml").write_text(RECIPE, "utf-8")
    (tmp_path / "m.toml").write_text(TINY, "utf-8")
    monkeypatch.setattr(process, "run", batches.run_here)
    words = [tmp_path / "m.toml", "-o", tmp_path / "out", "--night", NIGHT, "--json", "--lang", "zh", "--jobs", "2"]
    done = batches.called("validate", words, 1)
    assert 'impossible scan.mode="magic" seed 1: failed: designgen make: exit code 2' in done.stderr
    told = json.loads(done.stdout)
    real = next(cell for cell in told["cells"] if not cell["failed"])
    assert real["figures"] > 20
    assert '<html lang="zh">' in (tmp_path / "out" / "nights.html").read_text("utf-8")
    rows = dict(stored(tmp_path / "out", "SELECT method || ' ' || name, value FROM rows"))
    assert rows["ransac balls not found"] == 0.0
    assert abs(rows["ransac radii, bias"]) < 1.0  # half of the noise of 2 mm: the fit found the balls
    assert rows["least-squares radius error, median"] > rows["ransac radius error, median"]  # sleeves are in the crop
    folder = tmp_path / "out" / "cells" / NIGHT / real["cell"]
    checked = json.loads((folder / "results.json").read_text("utf-8"))
    assert checked["parameters"][0]["tau_mm"] == 3.0
    assert not (tmp_path / "out" / ".making").exists()


def test_a_generator_beside_the_matrix(tmp_path):
    """A script that writes a scan folder and truth.json; its cell has the checks of that truth."""
    (tmp_path / "mine.py").write_text(GENERATOR, "utf-8")
    (tmp_path / "m.toml").write_text(FOREIGN, "utf-8")
    (cell,) = matrix.read(tmp_path / "m.toml", False).cells(1)
    assert (cell.case.origin, cell.case.recipe) == (cells.Origin.FOREIGN, "mine")
    found = cell_runner.do(cell, scratch=str(tmp_path))
    assert not found.failed
    assert found.peak_mb > 50.0  # NumPy and SciPy alone
    assert [check["name"] for check in cells.checks_of(found.results)][:1] == ["scans not placed"]
    (tmp_path / "mine.py").write_text("import sys; sys.exit('no idea')", "utf-8")
    (cell,) = matrix.read(tmp_path / "m.toml", False).cells(1)
    assert cell_runner.do(cell, scratch=str(tmp_path)).failed == "mine: exit code 1: no idea"
