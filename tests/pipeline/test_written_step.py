"""The step that docs/write-a-step.md writes runs, is stored and reported, and refuses what is wrong."""

import importlib
import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree

import processor.report
from processor import pipeline, scene_cloud
from processor.cli.main import commands
from processor.model import InputError, Scene, UsageError
from processor.scan_folder import folder

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/write-a-step.md").read_text("utf-8")
FILES = dict(re.findall(r"`(processor/\S+\.py)`:\n\n```python\n(.*?)```", PAGE, re.DOTALL))
COMMAND = re.search(r"```console\nprocessor (.*?)\n```", PAGE, re.DOTALL).group(1)


def forget():
    pipeline.step_modules.cache_clear()
    importlib.invalidate_caches()
    for name in [name for name in sys.modules if ".density" in name]:
        del sys.modules[name]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The files of the page as if they lay in the folders that it names, and a scan folder."""
    for file, content in FILES.items():
        path = tmp_path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, "utf-8")
    monkeypatch.chdir(tmp_path)
    for package, below in ((processor, "processor"), (processor.report, "processor/report")):
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path / below)])
    shutil.copytree(ROOT / "fixtures/scan-folder", tmp_path / "my-frame")
    forget()
    yield tmp_path
    monkeypatch.undo()
    forget()


def test_the_step_of_the_page_has_at_most_100_lines():
    assert len(FILES) == 4
    assert sum(len(content.splitlines()) for content in FILES.values()) <= 100


def test_the_step_of_the_page_runs_and_is_stored_and_reported(place):
    done = CliRunner().invoke(commands, COMMAND.split(), standalone_mode=False)
    assert done.exception is None, done.output
    (run,), _ = pipeline.read_runs(place / "results/results.h5")
    points = scene_cloud.merged(folder.read_input(place / "my-frame"), with_scanner=False).points
    apart = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    assert (run.step, run.method, run.result.points) == ("density", "median", len(points))
    # By the eighth neighbour on a surface; of random places the nearest is half as far as on a square grid.
    assert 0.7 * apart < run.result.spacing < 2.5 * apart
    found = json.loads((place / "results/results.json").read_text("utf-8"))
    written = found["steps"]["density"]
    assert (written["points"], written["spacing"]) == (len(points), pytest.approx(run.result.spacing, abs=1e-6))
    page = (place / "results/report.html").read_text("utf-8")
    assert "spacing of the points, median" in page
    assert f"{run.result.points} points, {run.result.spacing:.1f} mm apart" in page


def test_the_step_of_the_page_judges_by_its_parameter_and_refuses_what_is_wrong(place):
    module = pipeline.step_modules()["density"]
    scene = folder.read_input(place / "my-frame")
    spacing = module.run(scene, module.Params()).spacing
    assert module.run(scene, module.Params(most_spacing_mm=1.01 * spacing)).status == "ok"
    assert module.run(scene, module.Params(most_spacing_mm=0.99 * spacing)).status == "weak"
    with pytest.raises(UsageError, match=r"density\.most_spacing_mm: expected a number above 0 and below 1e"):
        pipeline.plan(("density",), (), {"density": {"most_spacing_mm": -1.0}}, 0)
    with pytest.raises(InputError, match=r"expected two points or more, found 0"):
        module.run(Scene(name="x", kind="structure"), module.Params())
    assert "density" not in pipeline.steps_for(scene)
