"""No file of the folder that a command runs in, nor of an input, is executed or read as settings of a library."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from processor.jobs import process
from tests.support.structure import ROOT, SOURCES

# Modules that any of the libraries may look for, and files that Python, pytest, Numba, Matplotlib and ezdxf look for.
LIBRARIES = ("numpy", "scipy", "numba", "yaml", "click", "h5py", "matplotlib", "cadquery", "sitecustomize", "conftest")
MODULES = sorted({*sys.stdlib_module_names, *LIBRARIES, "usercustomize", "processor", "designgen"} - {"__future__"})
SETTINGS = {
    ".numba_config.yaml": "cache_dir: kernels\ndisable_jit: 1\n",
    "matplotlibrc": "backend: module://evil\nlines.linewidth: 77\n",
    "ezdxf.ini": "[core]\nload_proxy_graphics = 0\n",
    "pyproject.toml": "[tool.pytest.ini_options]\naddopts = '--evil'\n",
}
CHILD = (
    "import csv, decimal, json, random, os, numpy, h5py, ezdxf, matplotlib; from numba import config; "
    "print(os.getcwd(), config.CACHE_DIR, config.DISABLE_JIT, matplotlib.rcParams['lines.linewidth'], "
    "ezdxf.options.load_proxy_graphics)"
)


@pytest.fixture
def hostile(tmp_path):
    """A folder of a scan, whose other files leave a mark if one of them is executed."""
    folder = tmp_path / "scans of a stranger"
    folder.mkdir()
    for name in MODULES:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'a').write(__file__ + '\\n')\n")
    for name, text in SETTINGS.items():
        (folder / name).write_text(text)
    for seed, name in enumerate(("a.xyz", "b.xyz")):
        directions = np.random.default_rng(seed).normal(size=(400, 3)) * [1.0, 1.0, 0.3] + [0.0, 0.0, 2.0]
        np.savetxt(folder / name, directions / np.linalg.norm(directions, axis=1)[:, None] * 0.075, fmt="%.5f")
    return folder


def executed(folder):
    mark = folder.parent / "executed"
    return mark.read_text().split() if mark.exists() else []


def test_a_child_process_sees_no_file_of_the_current_folder(hostile, monkeypatch, tmp_path):
    monkeypatch.chdir(hostile)
    for path in ("", ".", str(hostile)):  # a console, a relative PYTHONPATH, python -m
        monkeypatch.syspath_prepend(path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", "kernels")
    with (tmp_path / "said").open("wb") as said:
        ended = process.run(process.isolated("import processor; " + CHILD), stdout=said)
    assert ended.code == 0, ended.last_line
    assert (tmp_path / "said").read_text().split() == ["/", "0", "1.5", "True"]
    assert executed(hostile) == []
    assert not (hostile / "kernels").exists()


def test_settings_of_libraries_are_not_read_from_the_current_folder(hostile, tmp_path):
    """What imports processor there, as a notebook does; what the user's environment says holds."""
    script = tmp_path / "script.py"
    script.write_text("import processor\n" + CHILD)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "own")}
    done = subprocess.run(
        [sys.executable, script], cwd=hostile, env=environment, check=True, capture_output=True, text=True
    )
    assert done.stdout.removeprefix(f"{hostile} ").split() == [str(tmp_path / "own"), "0", "1.5", "True"]
    assert executed(hostile) == []


def test_one_module_starts_processes():
    calls = r"Popen\(|subprocess\.(run|call|check_)|import multiprocessing"
    start = re.compile(calls + r"|os\.(exec|fork|spawn|posix_spawn|system|popen)")
    found = {str(path.relative_to(ROOT)) for path in SOURCES if start.search(path.read_text("utf-8"))}
    assert found == {"processor/jobs/process.py"}


COMMANDS = (
    "processor init .",
    "processor run . -o R",
    "processor run . -o limited --timeout-s 100 --memory-mb 4000",
    "processor batch . -o ../B --steps spheres",
    "processor compare a.xyz b.xyz -o C --normal-diameter 0.1 --projection-diameter 0.05 --max-depth 0.05",
    "processor convert . -o scene.h5",
    "processor report R",
    "processor check R",
    "processor verify R",
    "processor export R -o X --what merged --format ply",
    "processor history . -o H",
    "processor validate matrix.toml -o V",
    "processor papers -o P --only 004 --seeds 1",
    "designgen list",
    "designgen make frame-small -o F.h5",
    "designgen make frame-small -o set --count 1",
    "designgen export F.h5 -o E --format xyz",
    "designgen import design.step -o I",
    "designgen scan design.stl -o M.h5 --stations 1 --set scan.step_mrad=20",
)
MATRIX = """
[[cell]]
name = "a"
recipe = "frame-small"
steps = ["spheres"]
seeds = [1]
set = { "scan.sigma_mm" = -1.0 }
"""
SOLID = "solid a\n" + "".join(
    "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face) + "endloop\nendfacet\n"
    for face in (
        ((0, 0, 0), (0, 900, 0), (900, 0, 0)),
        ((0, 0, 0), (900, 0, 0), (0, 0, 900)),
        ((900, 0, 0), (0, 900, 0), (0, 0, 900)),
        ((0, 0, 0), (0, 0, 900), (0, 900, 0)),
    )
)
SOLID += "endsolid a\n"


@pytest.fixture
def program(tmp_path):
    """Programs as an installer writes them."""
    for name in ("processor", "designgen"):
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(f"from {name}.__main__ import main\nmain()\n")
    return lambda name: [sys.executable, str(tmp_path / "bin" / name)]


def run(program, folder, command):
    name, *words = command.split()
    return subprocess.run([*program(name), *words], cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_no_command_executes_a_file_of_its_folder(hostile, program):
    (hostile / "matrix.toml").write_text(MATRIX)
    (hostile / "design.stl").write_text(SOLID)
    (hostile / "design.step").write_text("ISO-10303-21;\nHEADER;\nENDSEC;\nDATA;\nENDSEC;\nEND-ISO-10303-21;\n")
    for command in COMMANDS:
        done = run(program, hostile, command)
        assert "Traceback" not in done.stderr, command
        assert "internal error" not in done.stderr, command
        assert executed(hostile) == [], command
        assert not (hostile / "kernels").exists(), command
    assert Path(hostile, "R/report.html").exists()
    assert Path(hostile, "set/index.csv").exists()


def test_a_project_cannot_name_a_program(hostile):
    from processor.model import InputError
    from processor.scan_folder import folder

    (hostile / "model.py").write_text(f"open({str(hostile.parent / 'executed')!r}, 'a').write('model')\n")
    for line in ('design = "model.py"', '[[scan]]\nfile = "model.py"'):
        (hostile / "project.toml").write_text(line + "\n")
        with pytest.raises(InputError):
            folder.read_input(hostile)
    assert executed(hostile) == []
