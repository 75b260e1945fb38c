"""Every script of examples runs as it stands there."""

import subprocess
import sys
from pathlib import Path

import pytest

import designgen
import processor

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
# What an example calls and prints.
NEEDS = {
    "fit_target": ([(processor, "read"), (processor, "fit_sphere")], "radius "),
    "compare_clouds": ([(processor, "m3c2")], "largest movement"),
    "simulate_data_set": ([(designgen, "make"), (processor, "run"), (processor, "check")], "noise 2.0 mm, seed 2"),
    "run_folder": ([(processor, "run")], "step spheres: ok"),
}


def run(script, *arguments):
    done = subprocess.run(
        [sys.executable, script, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "LANG": "C.UTF-8", "MPLBACKEND": "Agg"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run():
    assert set(EXAMPLES) == {*NEEDS, "read_results"}


@pytest.mark.parametrize("name", NEEDS)
def test_an_example(name):
    needed, printed = NEEDS[name]
    missing = [f"{module.__name__}.{function}" for module, function in needed if not hasattr(module, function)]
    if missing:
        pytest.skip(f"not in this version yet: {', '.join(missing)}")
    assert printed in run(EXAMPLES[name])


def test_results_are_read(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "processor", "run", ROOT / "fixtures/scan-folder", "-o", tmp_path / "out"],
        capture_output=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed = run(EXAMPLES["read_results"], tmp_path / "out")
    assert "step spheres: ok, method ray" in printed
    assert "ball 3:" in printed
    assert "centres (4, 3) float64" in printed
