"""Every script of examples runs as it stands there."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import designgen
import processor
from tests.support.scenes.coarse_scans import coarsely

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
# What an example calls and prints.
NEEDS = {
    "fit_target": ([(processor, "read"), (processor, "fit_sphere")], "radius "),
    "register_scan": (
        [(designgen, "scan"), (processor, "register"), (processor, "export"), (processor, "convert")],
        "read as mm (given in project.toml)",
    ),
    "compare_clouds": ([(processor, "m3c2")], "largest movement"),
    "simulate_data_set": ([(designgen, "make"), (processor, "run"), (processor, "check")], "noise 2.0 mm, seed 2"),
    "run_folder": ([(processor, "run")], "step spheres: ok"),
}


@pytest.fixture
def run(monkeypatch, capsys):
    """``run(script, *arguments)``: run a script as Python does, in this process, and return what it prints."""

    def run_here(script, *arguments):
        monkeypatch.chdir(ROOT)
        monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        runpy.run_path(str(script), run_name="__main__")
        return capsys.readouterr().out

    return run_here


def test_every_example_is_run():
    assert set(EXAMPLES) == {*NEEDS, "read_results"}


@pytest.fixture
def coarse_scans(monkeypatch):
    """Few points in what examples make."""
    for function in ("make", "scan"):
        coarsely(monkeypatch, function, step_mrad=8.0)


@pytest.mark.usefixtures("coarse_scans")
@pytest.mark.parametrize("name", NEEDS)
def test_an_example(run, name):
    needed, printed = NEEDS[name]
    missing = [f"{module.__name__}.{function}" for module, function in needed if not hasattr(module, function)]
    if missing:
        pytest.skip(f"not in this version yet: {', '.join(missing)}")
    assert printed in run(EXAMPLES[name])


def test_results_are_read(tmp_path):
    """The script needs nothing of this project: it runs in a process of its own."""
    processor.run(ROOT / "fixtures/scan-folder", tmp_path / "out")
    done = subprocess.run(
        [sys.executable, EXAMPLES["read_results"], tmp_path / "out"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "LANG": "C.UTF-8"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "step spheres: ok, method ray" in done.stdout
    assert "ball 3:" in done.stdout
    assert "centres (4, 3) float64" in done.stdout
