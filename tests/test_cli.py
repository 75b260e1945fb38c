"""The command line as users and scripts meet it: exit codes, JSON, refusals, and no half-written files."""

import csv
import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from designgen import cli as designgen_cli
from processor import __main__, pipeline
from processor.cli import help_text, main
from processor.evaluation.evaluate import evaluate
from processor.language.messages import label
from processor.limits import standards
from processor.model import FrameDesign, FrameTruth, InputError, Scan, Scene, Status, Truth, UsageError, Verdict
from processor.preassembly.parts import attitude
from processor.report import terminal, write_results
from processor.space_frame.result import Result as FrameResult
from processor.store import store
from tests.support.clouds import arch_clouds
from tests.support.processes import commands

pytestmark = pytest.mark.usefixtures("blank_pictures")

ROOT = Path(__file__).resolve().parents[1]


def processor(*arguments):
    # Linear algebra for another type of processor has other last digits.
    algebra = {name: value for name, value in os.environ.items() if name.startswith("OPENBLAS_")}
    return subprocess.run(
        [sys.executable, "-m", "processor", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "LANG": "C.UTF-8", "MPLBACKEND": "Agg", **algebra},
        check=False,
    )


@pytest.fixture
def called(monkeypatch):
    """``called(*arguments, cwd=ROOT)``: like :func:`processor`, in this process."""

    def call(*arguments, cwd=ROOT):
        monkeypatch.chdir(cwd)
        return commands.here("processor", *arguments)

    return call


def ball_cloud(seed=0, radius=60.0, count=1500):
    rng = np.random.default_rng(seed)
    unit = rng.normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    return np.array([1000.0, -2000.0, 500.0]) + radius * unit + rng.normal(0.0, 0.5, (count, 3))


@pytest.fixture
def frame():
    """Two balls with their design and truth; the second is smaller than designed."""
    points = np.vstack([ball_cloud(1), ball_cloud(2, 50.0) + np.array([3000.0, 0.0, 0.0])])
    centres = np.array([[1000.0, -2000.0, 500.0], [4000.0, -2000.0, 500.0]])
    ids = np.array([7, 9])
    design = FrameDesign(ids, centres, np.array([60.0, 60.0]))
    truth = Truth(frame=FrameTruth(ids, centres, np.array([60.0, 50.0]), centres - [[0, 0, 60.0], [0, 0, 50.0]]))
    return Scene("frame", "space-frame", (Scan("scan", points),), frame=design), truth


@pytest.fixture(scope="module")
def sphere_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere")
    np.savetxt(folder / "target.xyz", ball_cloud() / 1000.0, fmt="%.6f")
    done = processor("run", folder / "target.xyz", "-o", folder / "out", "--steps", "spheres", "--json")
    return folder, done


def test_one_scan_file_to_results(sphere_run):
    folder, done = sphere_run
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed == json.loads((folder / "out" / "results.json").read_text("utf-8"))
    assert (printed["format"], printed["format_version"]) == ("processor-results", "1.0")
    assert printed["input"] == "target.xyz"
    assert printed["units"]["read_as"] == "m"
    assert [one["code"] for one in printed["units"]["reasons"]] == ["units.as-scanners-write"]
    assert printed["units"]["reason"] == printed["units"]["reasons"][0]["text"]
    (ball,) = printed["steps"]["spheres"]["balls"]
    # Five standard deviations: 0.5 sqrt(3 / 1500) = 0.022 of a coordinate, 0.013 of the radius, 0.026 of both.
    np.testing.assert_allclose(ball["centre"], [1000.0, -2000.0, 500.0], atol=0.11)
    assert ball["radius"] == pytest.approx(60.0, abs=0.065)
    assert ball["lowest"][2] == pytest.approx(440.0, abs=0.13)
    assert printed["checks"] == []
    assert "taken as metres" in done.stderr
    made = {"results.h5", "results.json", "report.html", "balls.csv", "lowest.csv"}
    assert {p.name for p in (folder / "out").iterdir()} == made
    assert store.problems(folder / "out" / "results.h5") == []


def test_the_same_bytes_in_give_the_same_bytes_out(called, sphere_run, tmp_path):
    """In another process, another folder and with a relative path."""
    folder, _ = sphere_run
    (tmp_path / "target.xyz").write_bytes((folder / "target.xyz").read_bytes())
    assert called("run", "target.xyz", "-o", "again", "--steps", "spheres", cwd=tmp_path).returncode == 0
    for made in sorted((folder / "out").iterdir()):
        assert made.read_bytes() == (tmp_path / "again" / made.name).read_bytes(), made.name
    assert str(tmp_path) not in (tmp_path / "again" / "results.json").read_text("utf-8")


def test_results_are_replaced_but_nothing_else(called, sphere_run, tmp_path):
    folder, _ = sphere_run
    arguments = ["run", folder / "target.xyz", "-o", tmp_path / "out", "--steps", "spheres"]
    assert called(*arguments).returncode == 0
    first = (tmp_path / "out" / "results.json").read_bytes()
    assert called(*arguments).returncode == 0
    assert (tmp_path / "out" / "results.json").read_bytes() == first
    (tmp_path / "out" / "notes.txt").write_text("keep")
    done = called(*arguments)
    assert (done.returncode, "notes.txt" in done.stderr) == (2, True)
    assert (tmp_path / "out" / "notes.txt").read_text() == "keep"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_the_command_lines_seed_goes_before_the_parameters(tmp_path):
    params = {"spheres": {"seed": 5}}
    assert pipeline.plan(("spheres",), (), params, None)[0].params.seed == 5
    assert pipeline.plan(("spheres",), (), params, 0)[0].params.seed == 0
    assert pipeline.plan(("spheres",), (), {}, None)[0].params.seed == 0
    with pytest.raises(UsageError, match=r"preassemble\.seed"):  # a slip in the table of a step that does not run
        pipeline.plan(("spheres",), (), {"preassemble": {"seed": "x"}}, None)


def test_a_step_named_twice_runs_once():
    assert len(pipeline.plan(("spheres", "spheres"), ("ransac", "ransac"), {}, 0)) == 1


def test_unexpected_error_of_a_step_is_printed_in_one_line(frame, tmp_path, monkeypatch, capsys):
    scene, _ = frame
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    monkeypatch.setattr("processor.space_frame.step.run", lambda *_: [][0])
    for debug in (False, True):
        monkeypatch.setattr(
            sys, "argv", ["processor", "run", str(tmp_path / "s.h5"), "-o", str(tmp_path / "out"), *["--debug"] * debug]
        )
        with pytest.raises(SystemExit) as end:
            __main__.main()
        assert end.value.code == 3
        out, err = capsys.readouterr()
        assert out == ""
        assert "s.h5: internal error in step spheres (ray): IndexError" in err
        assert ("Traceback" in err) == debug
    assert not (tmp_path / "out").exists()


def test_names_with_control_characters_stay_in_one_line(called, tmp_path):
    (tmp_path / "a\n\x1b[31m.xyz").touch()
    done = called("run", "a\n\x1b[31m.xyz", "-o", "out", cwd=tmp_path)
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1
    assert "\x1b" not in done.stderr


def test_file_name_that_is_not_utf8_is_refused(tmp_path):
    path = tmp_path / os.fsdecode(b"b\xff.xyz")
    np.savetxt(path, ball_cloud(count=100) / 1000.0)
    with pytest.raises(InputError, match="not UTF-8"):
        pipeline.read(path, None)


def test_closed_pipe_ends_the_command_without_a_message(sphere_run):
    folder, _ = sphere_run
    command = f"{sys.executable} -m processor verify {folder / 'out'} --json | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stderr == ""


def test_a_report_is_made_again_without_running_the_steps(called, frame, tmp_path):
    scene, truth = frame
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    run_in_process(tmp_path / "s.h5", tmp_path / "out", ("ransac", "least-squares"))
    before = {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()}
    (tmp_path / "out" / "report.html").unlink()
    done = called("report", tmp_path / "out", tmp_path / "s.h5")
    assert done.returncode == 0, done.stderr
    assert {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()} == before
    (tmp_path / "out" / "report.html").unlink()
    assert called("report", tmp_path / "out").returncode == 0  # the input lies beside
    assert {p.name: p.read_bytes() for p in (tmp_path / "out").iterdir() if p.is_file()} == before
    (tmp_path / "s.h5").rename(tmp_path / "moved.h5")
    done = called("report", tmp_path / "out")
    assert done.returncode == 2
    assert "expected its input 's.h5'" in done.stderr
    store.write_scene(tmp_path / "s.h5", dataclasses.replace(scene, name="another"), truth, {})
    done = called("report", tmp_path / "out", tmp_path / "s.h5")
    assert done.returncode == 3
    assert "was made from 's.h5' as it was then" in done.stderr


def run_in_process(path, out, methods=()):
    scene = pipeline.read(path, None)
    execution = pipeline.execute(path, scene, pipeline.plan(pipeline.steps_for(scene), methods, {}, 0))
    report = evaluate(path, execution)
    write_results.write_results(out, execution, report)
    return json.loads((out / "results.json").read_text("utf-8")), report


def test_truth_in_the_file_changes_no_result(frame, tmp_path):
    scene, truth = frame
    for name, its_truth in (("with", truth), ("without", None)):
        (tmp_path / name).mkdir()
        store.write_scene(tmp_path / name / "s.h5", scene, its_truth, {})
    found, report = run_in_process(tmp_path / "with" / "s.h5", tmp_path / "a", ("ransac", "least-squares"))
    blind, _ = run_in_process(tmp_path / "without" / "s.h5", tmp_path / "b", ("ransac", "least-squares"))
    assert (tmp_path / "a" / "results.h5").read_bytes() == (tmp_path / "b" / "results.h5").read_bytes()
    assert report.metrics
    assert found.pop("checks")
    assert blind.pop("checks") == []
    assert found == blind


def test_tables_hold_what_results_json_holds(frame, tmp_path):
    scene, truth = frame
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    found, _ = run_in_process(tmp_path / "s.h5", tmp_path / "out")
    with (tmp_path / "out" / "balls.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row, ball in zip(rows, found["steps"]["spheres"]["balls"], strict=True):
        assert int(row["id"]) == ball["id"]
        # The table has six decimals; a difference of two of its numbers one digit less.
        assert float(row["x_mm"]) == pytest.approx(ball["centre"][0], abs=1e-6)
        assert float(row["radius_error_mm"]) == pytest.approx(ball["radius"] - float(row["true_radius_mm"]), abs=1e-5)
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert f"{found['steps']['spheres']['balls'][0]['radius']:.3f}" in page
    assert "http" not in page.replace("http-equiv", "")


def test_a_missed_limit_exits_with_4(called, frame, tmp_path):
    scene, truth = frame
    wrong = dataclasses.replace(truth.frame, radii=truth.frame.radii + 10.0)
    store.write_scene(tmp_path / "s.h5", scene, dataclasses.replace(truth, frame=wrong), {})
    done = called("run", tmp_path / "s.h5", "-o", tmp_path / "out", "--method", "ransac")
    assert done.returncode == 4
    again = called("check", tmp_path / "out", "--json")
    assert again.returncode == 4
    assert json.loads(again.stdout)["passed"] is False
    assert "MISSED" in called("check", tmp_path / "out").stdout


@pytest.mark.parametrize(
    ("verdict", "fail_on", "code"),
    [("fail", "fail", 5), ("indeterminate", "fail", 0), ("indeterminate", "indeterminate", 5), ("pass", "fail", 0),
     ("fail", None, 0)],
)  # fmt: skip
def test_a_verdict_sets_the_exit_code_where_asked(called, frame, tmp_path, monkeypatch, verdict, fail_on, code):
    monkeypatch.setattr(FrameResult, "overall", Verdict(verdict))
    store.write_scene(tmp_path / "s.h5", frame[0], None, {})
    option = ["--fail-on", fail_on] if fail_on else []
    done = called("run", tmp_path / "s.h5", "-o", tmp_path / "out", *option)
    assert done.returncode == code
    found = json.loads((tmp_path / "out" / "results.json").read_text("utf-8"))
    assert found["verdict"] == found["steps"]["spheres"]["verdict"] == verdict
    assert found["headline"]
    assert found["headline"].startswith(done.stdout.splitlines()[0])
    assert found["headline"] in (tmp_path / "out" / "report.html").read_text("utf-8")


def test_terminal_shows_headline_actions_reasons_and_path_of_the_report(called, frame, tmp_path):
    store.write_scene(tmp_path / "s.h5", frame[0], None, {})
    said = called("run", "s.h5", cwd=tmp_path)
    found = json.loads((tmp_path / "s-results" / "results.json").read_text("utf-8"))
    lines = said.stdout.splitlines()
    assert found["headline"].startswith(lines[0])
    assert lines[-1] == "report: s-results/report.html"
    beside = {one.name + "/" * one.is_dir() for one in (tmp_path / "s-results").iterdir()}
    assert set(lines[-2].removeprefix("s-results: ").split(", ")) == beside
    assert any(line.startswith("Bolt balls is ") or "wrong-size" in line for line in lines) or len(lines) == 3
    assert len(lines) <= terminal.MOST_LINES
    assert "results go to s-results" in said.stderr
    quiet = called("run", "s.h5", "--quiet", cwd=tmp_path)
    assert (quiet.stdout, quiet.stderr) == (found["headline"] + "\n", "")
    verbose = called("run", "s.h5", "--verbose", cwd=tmp_path)
    assert verbose.stdout.splitlines()[0] == lines[0]
    assert "Lowest" in verbose.stdout or "lowest" in verbose.stdout
    assert "Flagged balls" in verbose.stdout  # tables, which are not printed otherwise
    assert "Flagged balls" not in said.stdout
    both = called("run", "s.h5", "--verbose", "--json", cwd=tmp_path)
    assert (both.returncode, "exclude each other" in both.stderr) == (2, True)


def test_terminal_output_is_limited_to_fifteen_lines(frame, tmp_path, monkeypatch):
    store.write_scene(tmp_path / "s.h5", frame[0], None, {})
    _, report = run_in_process(tmp_path / "s.h5", tmp_path / "out")
    execution = pipeline.read_execution(tmp_path / "out" / "results.h5", tmp_path / "s.h5", None)
    monkeypatch.setattr(terminal, "_middle", lambda *_: iter([label("x" * 500)] * 40))
    lines = terminal.lines(execution, report, "page")
    assert len(lines) == terminal.MOST_LINES == 15
    assert max(map(len, lines)) <= terminal.LONGEST
    assert "--verbose" in lines[-2]


@pytest.mark.parametrize("option", [[], ["--quiet"], ["--json"]])
def test_failed_step_prints_its_reason_and_exits_with_1(called, tmp_path, option):
    rng = np.random.default_rng(0)
    np.savetxt(tmp_path / "plane.xyz", np.c_[rng.uniform(size=(3000, 2)), 0.0005 * rng.normal(size=3000)])
    said = called("run", "plane.xyz", "-o", "out", "--steps", "spheres", *option, cwd=tmp_path)
    assert said.returncode == 1
    assert said.stderr.splitlines()[-1].startswith("error: spheres (ray) failed: no ball stands out of 3000 points")
    if not option:
        assert "Bolt balls is failed: no ball stands out" in said.stdout


def test_results_of_another_input_are_not_replaced_by_default(called, frame, tmp_path):
    store.write_scene(tmp_path / "s.h5", frame[0], None, {})
    np.savetxt(tmp_path / "s.xyz", ball_cloud() / 1000.0)
    assert called("run", "s.h5", cwd=tmp_path).returncode in (0, 1)
    said = called("run", "s.xyz", "--steps", "spheres", cwd=tmp_path)
    assert (said.returncode, "holds results of 's.h5', not of 's.xyz'" in said.stderr) == (2, True)


def test_outputs_are_checked_before_processing(called, tmp_path, monkeypatch):
    np.savetxt(tmp_path / "good.xyz", ball_cloud() / 1000.0)
    (tmp_path / "file").touch()
    (tmp_path / "done").mkdir()

    def work(*_, **__):
        raise AssertionError("work before the output was tried")

    for place in ("processor.pipeline.prepare", "processor.compare.compare.compare", "processor.batch.batch.find"):
        monkeypatch.setattr(place, work)
    for arguments in (
        ("run", "good.xyz", "--steps", "spheres"),
        ("compare", "good.xyz", "good.xyz"),
        ("batch", "."),
        ("validate",),
        ("export", "done", "--what", "registered", "--format", "e57"),
    ):
        for out in ("/proc/out", "file/out"):
            said = called(*arguments, "-o", out, cwd=tmp_path)
            assert said.returncode == 3, said.stderr
            assert "cannot be written" in said.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["done", "file", "good.xyz"]


def test_help_of_run_lists_steps_methods_standards_and_examples(called):
    said = called("run", "--help").stdout
    for name, module in pipeline.step_modules().items():
        assert all(word in said for word in (name, *module.METHODS))
    assert all(name in " ".join(said.split()) for name in standards.standards())
    assert "  5  a verdict that --fail-on names" in said
    assert all(command in said for command, _ in help_text.EXAMPLES)
    assert len(help_text.EXAMPLES) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["rum"], "no command 'rum' (did you mean 'run'?)"),
        (["run", "god.xyz"], "god.xyz: there is no such file or folder (did you mean 'good.xyz'?)"),
        (["run", "good.xyz", "--steps", "sphere"], "no step 'sphere' (did you mean 'spheres'?)"),
        (["run", "good.xyz", "--steps", "spheres", "--method", "ransak"], "(did you mean 'ransac'?)"),
        (["compare", "good.xyz", "godo.xyz", "-o", "c"], "(did you mean 'good.xyz'?)"),
        (["batch", "fodler", "-o", "c"], "(did you mean 'folder'?)"),
    ],
)
def test_mistyped_name_is_answered_with_a_similar_one(called, tmp_path, arguments, said):
    np.savetxt(tmp_path / "good.xyz", ball_cloud(count=200) / 1000.0)
    (tmp_path / "folder").mkdir()
    done = called(*arguments, cwd=tmp_path)
    assert done.returncode in (2, 3)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) <= 4


def test_a_log_file_has_times_levels_and_the_exit_code(called, tmp_path):
    np.savetxt(tmp_path / "good.xyz", ball_cloud(count=200) / 1000.0)
    said = called("run", "good.xyz", "--steps", "magic", "--log-file", "log.txt", cwd=tmp_path)
    assert said.returncode == 2
    assert called("run", "good.xyz", "--steps", "spheres", "-q", "--log-file", "log.txt", cwd=tmp_path).returncode == 0
    lines = (tmp_path / "log.txt").read_text("utf-8").splitlines()
    pattern = r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\dZ (INFO|WARNING|ERROR) \S"
    assert all(re.match(pattern, line) for line in lines)
    assert "INFO run good.xyz --steps magic" in lines[0]
    assert any("ERROR error: no step 'magic'" in line for line in lines)
    assert [line.rpartition(" ")[2] for line in lines if "exit code" in line] == ["2", "0"]
    assert any("INFO spheres (ray): ok" in line for line in lines)
    assert called("check", "nowhere", "--log-file", "log.txt/x", cwd=tmp_path).returncode in (2, 3)
    before = (tmp_path / "log.txt").read_text("utf-8")
    called("run", "nowhere", cwd=tmp_path)
    assert (tmp_path / "log.txt").read_text("utf-8") == before


@pytest.mark.parametrize("program", [main.commands, designgen_cli.commands])
def test_every_command_has_json_and_debug(program):
    for name, command in program.commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert {"--json", "--debug"} <= options, name


def test_names_from_outside_are_shown_as_text(frame, tmp_path):
    scene, truth = frame
    store.write_scene(tmp_path / "s.h5", dataclasses.replace(scene, name="<script>alert(1)</script>"), truth, {})
    run_in_process(tmp_path / "s.h5", tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert page.count("<script>") == 1  # the page's own
    assert "alert(1)<" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_a_bridge_through_the_pipeline(tmp_path, monkeypatch):
    scene, truth = arch_clouds.bridge(spacing_mm=40.0, sigma_mm=1.0, seed=2)
    # The search for attitudes takes most of the time: tests/pipeline/test_diagnostics.py runs it on such a bridge.
    known = dict(zip(truth.arch.names, truth.arch.T_bridge_scan, strict=True))
    monkeypatch.setattr(
        attitude, "find", lambda _, part: attitude.Attitude(known[part.name], known[part.name], Status.OK)
    )
    store.write_scene(tmp_path / "b.h5", scene, truth, {})
    found, report = run_in_process(tmp_path / "b.h5", tmp_path / "out", ("design-aided", "corner"))
    answer = found["steps"]["preassemble"]
    assert (answer["status"], answer["method"]) == ("ok", "design-aided")
    assert [c["name"] for c in answer["components"]] == list(arch_clouds.NAMES)
    assert answer["components"][0]["key_points_scan"]["start"] == {}
    assert set(answer["joints"][0]["points"]) == {f"P{i}" for i in range(1, 9)}
    assert len(answer["linear_error"]["stations"]) == len(answer["linear_error"]["deviation"])
    assert found["comparison"]["preassemble"][0]["method"] == "corner"
    gaps = np.array([[p["gap"] for p in j["points"].values()] for j in answer["joints"]])
    assert answer["splicing_error"]["mean"] == pytest.approx(np.abs(gaps).mean())
    assert answer["splicing_error"]["max"] == pytest.approx(np.abs(gaps).max())
    assert {m.name.split(":")[0] for m in report.metrics} >= {"corner"}
    assert (tmp_path / "out" / "figures" / "linear-error.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["run", "nowhere", "-o", "out"], 3, "no such file or folder"),
        (["run", "empty.xyz", "-o", "out"], 3, "empty"),
        (["run", "few.xyz", "-o", "out"], 3, "few.xyz"),
        (["run", "folder", "-o", "out"], 3, "folder"),
        (["run", "cut.h5", "-o", "out"], 3, "cut.h5"),
        (["run", "good.xyz", "-o", "out", "--steps", "magic"], 2, "no step 'magic'"),
        (["run", "good.xyz", "-o", "out", "--steps", "spheres", "--method", "magic"], 2, "no method 'magic'"),
        (["run", "good.xyz", "-o", "out", "--steps", "preassemble"], 3, "design"),
        (["run", "good.xyz", "-o", "taken", "--steps", "spheres"], 2, "not empty"),
        (["run", "good.xyz", "-o", "out", "--units", "parsec"], 2, "parsec"),
        (["run", "good.xyz"], 2, "--steps"),
        (["check", "taken"], 3, "no readable results"),
        (["report", "taken", "good.xyz"], 2, "no earlier results"),
        (["run", "good.xyz", "-o", "good.xyz/out", "--steps", "spheres"], 3, "good.xyz"),
        (["run", "good.xyz", "-o", ".", "--steps", "spheres"], 2, "holds the input"),
    ],
)
def test_unusable_inputs_and_outputs_are_refused_in_one_line(called, tmp_path, arguments, code, said):
    (tmp_path / "empty.xyz").touch()
    (tmp_path / "few.xyz").write_text("0 0 0\n1 0 0\n")
    (tmp_path / "folder").mkdir()
    (tmp_path / "cut.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").write_text("keep")
    np.savetxt(tmp_path / "good.xyz", ball_cloud(count=200) / 1000.0)
    before = sorted(p.name for p in tmp_path.iterdir())
    done = called(*arguments, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert done.stderr.splitlines()[-1].lower().startswith("error: ")
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert (tmp_path / "taken" / "mine.txt").read_text() == "keep"
