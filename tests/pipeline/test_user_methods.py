"""Methods of the user's own: run beside the built-in ones, named by the user alone."""

import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from processor import pipeline, user_methods
from processor.cli.main import commands
from processor.model import InputError, Scene, UsageError
from processor.scan_folder import folder

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/own-method.md").read_text("utf-8")
EXAMPLE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL).group(1)
COMMAND = re.search(r"```console\nprocessor (.*?)\n```", PAGE, re.DOTALL).group(1)


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("my_module", "other_module"):
        monkeypatch.delitem(user_methods.sys.modules, name, raising=False)
    yield tmp_path
    for name in ("my_module", "other_module"):
        user_methods.sys.modules.pop(name, None)


def test_the_example_of_the_page_runs_beside_ours(place):
    shutil.copytree(ROOT / "fixtures/scan-folder", place / "my-frame")
    (place / "my_module.py").write_text(EXAMPLE, "utf-8")
    done = CliRunner().invoke(commands, COMMAND.split(), standalone_mode=False)
    assert done.exception is None, done.output
    found = json.loads((place / "results/results.json").read_text("utf-8"))
    assert [one["method"] for one in found["comparison"]["spheres"]] == ["my_module.my_method"]
    assert "my_module:my_method" in json.dumps(found)  # among the parameters
    assert "my_module.my_method" in (place / "results/report.html").read_text("utf-8")
    assert (place / "results/balls-my_module.my_method.csv").exists()
    runs, _ = pipeline.read_runs(place / "results/results.h5")
    assert [run.method for run in runs] == ["ray", "my_module.my_method"]


def test_user_method_receives_its_named_arguments_and_its_result_is_checked(place):
    (place / "other_module.py").write_text(
        "def fine(scene, params, earlier=None):\n    return earlier\n"
        "def short(scene, params):\n    return 3\n"
        "def every(scene, params, **more):\n    return more\n"
        "number = 3\n"
    )
    given = {"earlier": {"a": 1}, "points": 2}
    call = user_methods.call
    fine = user_methods.load("other_module:fine")
    assert call(fine, "m:f", None, None, given, dict) == {"a": 1}
    assert call(user_methods.load("other_module:every"), "m:f", None, None, given, dict) == given
    with pytest.raises(UsageError, match=r"expected it to return a builtins.dict, got 3"):
        call(user_methods.load("other_module:short"), "m:f", None, None, given, dict)
    for name, said in [
        ("other_module:number", "expected a function 'number'"),
        ("other_module:none", "expected a function 'none'"),
        ("no_such_module:run", "cannot be imported"),
        ("no_such.module:run", "cannot be imported"),
        ("../other_module:fine", "expected module:function"),
        (":fine", "expected module:function"),
    ]:
        with pytest.raises(UsageError, match=said):
            user_methods.load(name)


def test_a_module_that_fails_is_named_in_one_line(place):
    (place / "other_module.py").write_text("raise RuntimeError('two\\nlines')\n")
    with pytest.raises(UsageError, match=r"RuntimeError: two lines"):
        user_methods.load("other_module:run")
    assert "other_module" not in user_methods.sys.modules


def test_a_method_that_fails_ends_in_one_line(place):
    (place / "other_module.py").write_text("def run(scene, params):\n    raise KeyError('radius')\n")
    jobs = pipeline.plan(("spheres",), ("other_module:run",), {}, 0)
    with pytest.raises(InputError, match=r"internal error in step spheres \(other_module.run\): KeyError"):
        pipeline.execute(place / "s.h5", Scene(name="x", kind="space-frame"), jobs)


def test_the_step_of_a_method_must_be_clear(place):
    (place / "other_module.py").write_text("def run(scene, params):\n    return None\n")
    with pytest.raises(UsageError, match="--steps"):
        pipeline.plan(("stitch", "deviation"), ("other_module:run",), {}, 0)
    (job,) = pipeline.plan(("deviation",), (), {"deviation": {"method": "other_module:run"}}, 0)
    assert job.method == "other_module.run"
    assert callable(job.function)


def test_a_scan_folder_cannot_name_code(place):
    shutil.copytree(ROOT / "fixtures/scan-folder", place / "theirs")
    (place / "theirs/other_module.py").write_text("raise SystemExit('run from a scan folder')\n")
    project = place / "theirs/project.toml"
    for line in ('method = "other_module:run"\n', '[spheres]\nmethod = "other_module:run"\n'):
        written = project.read_text("utf-8") if project.exists() else ""
        project.write_text(line + written if line.startswith("method") else written + "\n" + line, "utf-8")
        with pytest.raises(InputError):
            folder.read_input(place / "theirs")
        project.write_text(written, "utf-8")
