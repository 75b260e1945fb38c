"""A run with limits: the cause of its end is reported, and finished steps are stored."""

import numpy as np
import pytest

from processor import pipeline
from processor.api import runs
from processor.cli import limited_run
from processor.jobs.causes import Cause
from processor.jobs.process import Ended
from processor.store import store
from tests.support.processes import commands
from tests.support.results.step_results import scene

pytestmark = pytest.mark.usefixtures("blank_pictures")


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "site.h5"
    store.write_scene(path, scene(), None, {})
    return path


def run(*arguments):
    """The command line in this process; a run with limits has one of its own."""
    return commands.here("processor", *arguments)


def ended(cause, code=0, last_line=""):
    return Ended(cause, code=code, last_line=last_line, seconds=1.0, peak_mb=1.0, max_rss_mb=1.0)


def test_results_so_far_are_stored_before_each_step(tmp_path, site):
    part = tmp_path / "out.part"
    runs.compute(site, steps="deviation", method="default,paper", so_far=part)
    (first,), provenance = pipeline.read_runs(part / "results.h5")
    assert first.step == "deviation"
    assert provenance["planned"] == ["deviation (default)", "deviation (paper)"]
    said = limited_run._what_is_done(part, site)
    assert said.startswith("done: deviation (default); not done: deviation (paper); ")
    assert commands.here("processor", "report", part, site).returncode in (0, 1)
    assert (part / "report.html").is_file()


def test_storing_intermediate_results_does_not_change_the_results(tmp_path, site):
    found = []
    for so_far in (None, tmp_path / "part"):
        execution = runs.compute(site, steps="deviation", so_far=so_far).execution
        store.write_results(tmp_path / "results.h5", execution.runs, execution.provenance)
        found.append((tmp_path / "results.h5").read_bytes())
    assert found[0] == found[1]


def test_limits_end_a_run(tmp_path, site):
    out = tmp_path / "out"
    for option, value, said in (
        ("--memory-mb", 64, "expected the run to take at most 64 MB (--memory-mb), it took more"),
        ("--timeout-s", 0.2, "expected the run to end within 0.2 s (--timeout-s), it did not"),
    ):
        ended = run("run", site, "-o", out, "--steps", "deviation", option, value)
        assert ended.returncode == 3
        assert ended.stderr.splitlines()[-1].startswith(f"error: {site}: {said}; ")
        assert not out.exists()


def test_a_run_within_its_limits_is_as_without(tmp_path):
    out, unit = tmp_path / "out", np.random.default_rng(0).normal(size=(300, 3))
    np.savetxt(tmp_path / "ball.xyz", 0.05 * unit / np.linalg.norm(unit, axis=1)[:, None], fmt="%.5f")
    limits = ("--timeout-s", 500, "--memory-mb", 4_000)
    ended = run("run", tmp_path / "ball.xyz", "-o", out, "--steps", "spheres", *limits)
    assert ended.returncode in (0, 1), ended.stderr
    assert (out / "results.json").is_file()
    assert not (tmp_path / "out.part").exists()
    bad = run("run", tmp_path / "absent", "-o", out, *limits)
    assert (bad.returncode, "no such file" in bad.stderr) == (3, True)


def test_ended_run_has_a_reason_for_each_cause():
    assert limited_run._why(ended(Cause.EXIT), 1.0, 100) == ""
    assert "within 1 s" in limited_run._why(ended(Cause.TIME), 1.0, None)
    assert "100 MB" in limited_run._why(ended(Cause.MEMORY, 86), None, 100)
    assert "more memory" in limited_run._why(ended(Cause.MEMORY, 86), 1.0, None)
    assert limited_run._why(ended(Cause.OUTPUT, 87), 1.0, 100) == ""
    assert "SIGSEGV" in limited_run._why(ended(Cause.SIGNAL, 11), None, 100)
