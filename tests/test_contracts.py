"""The contracts of every step, reader and recipe, checked over the folders."""

import dataclasses
import importlib
import pkgutil
from types import SimpleNamespace

import numpy as np
import pytest

from designgen import recipe_files
from designgen.scenes.make import make
from processor import pipeline, readers
from processor.model import Scene, StepRun, UsageError
from processor.report.reports_of_steps import step_report
from processor.store import store
from tests.support.results.records import assert_equal

STEPS = pipeline.step_modules()


@pytest.mark.parametrize("name", STEPS)
def test_every_step_has_the_names_of_the_contract(name):
    module = STEPS[name]
    assert isinstance(module.NEEDS, tuple)
    assert module.METHODS[0] == module.Params().method
    for record in (module.Params, module.Result):
        assert dataclasses.is_dataclass(record)
        assert record.__dataclass_params__.frozen
    assert callable(module.run)
    assert callable(importlib.import_module(f"processor.evaluation.{pipeline.package_of(name)}").check)
    assert step_report(name).title


@pytest.mark.parametrize("name", STEPS)
def test_an_empty_result_goes_through_the_store(name, tmp_path):
    result = STEPS[name].Result(status="failed", method=STEPS[name].METHODS[0])
    store.write_results(tmp_path / "r.h5", [StepRun(name, result.method, "{}", result)], {})
    (back,) = store.read_results(tmp_path / "r.h5", pipeline.result_classes())
    assert (back.step, back.method) == (name, result.method)
    assert_equal(back.result, result)


def test_every_reader_declares_its_suffixes():
    every = {
        m.name: importlib.import_module(f"processor.readers.{m.name}") for m in pkgutil.iter_modules(readers.__path__)
    }
    formats = {name: module for name, module in every.items() if hasattr(module, "SUFFIXES")}
    assert set(formats) == {"e57", "las", "ply", "pcd", "ptx", "text"}
    assert sorted(suffix for module in formats.values() for suffix in module.SUFFIXES) == list(readers.SUFFIXES)
    assert all(callable(module.read) for module in formats.values())


# By day one of each kind, mode and way to be built; those that differ from such a one in numbers alone by night.
BY_NIGHT = (
    "arch-d1", "arch-d2", "arch-d3", "arch-d2-as-built", "arch-d3-as-built", "arch-west", "arch-west-sampled",
    "arch-east", "arch-rib", "frame-1040", "frame-1040-phase", "girders-defects", "truss-bridge", "stadium-roof",
)  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in BY_NIGHT else n for n in recipe_files.named()]
)
def test_every_recipe_makes_a_scene_that_goes_through_the_store(name, tmp_path):
    recipe = recipe_files.load(name)[1]
    if recipe.get("frame", {}).get("nodes_x", 0) > 10:
        recipe["frame"] |= {"nodes_x": 4, "nodes_y": 5, "shape": "flat"}
    stations = recipe["scan"].get("stations")
    if "frame" in recipe and isinstance(stations, list):  # rows and columns of them, up to 36 scans
        recipe["scan"]["stations"] = np.minimum(stations, 2).tolist()
    elif isinstance(stations, int):  # of a bridge of arches: of every part
        recipe["scan"]["stations"] = min(stations, 2 if recipe["kind"] == "arch-bridge" else 3)
    if "model" in recipe:  # a part of a smaller bridge: the CAD kernel meshes to 0.05 mm
        for table in (recipe["bridge"], *recipe.get("asbuilt", {}).values()):
            table |= {key: value / 4.0 for key, value in table.items() if key.endswith("_mm")}
    coarse = {"rays": "scan.step_mrad=50", "surface": "scan.spacing_mm=400"}[recipe["scan"]["mode"]]
    if recipe.get("picks", {}).get("at") == "corners":  # three of a pair must be seen in both scans
        coarse = "scan.step_mrad=8"
    recipe = recipe_files.overridden(recipe, [coarse])
    scene, truth = make(name, recipe)
    store.write_scene(tmp_path / "s.h5", scene, truth, {})
    back = store.read_scene(tmp_path / "s.h5")
    assert back.kind == scene.kind
    assert sum(len(s.points) for s in back.scans) == sum(len(s.points) for s in scene.scans)
    assert pipeline.plan(pipeline.steps_for(back), (), {}, 0)


def test_every_recipe_states_what_it_makes():
    assert [name for name in recipe_files.named() if len(recipe_files.load(name)[1]["about"]) <= 20] == []


def test_parameters_are_checked_by_name_and_type():
    filled = pipeline.plan(("preassemble",), (), {"preassemble": {"boxes": {"edge_box_mm": 42}}}, 3)
    assert filled[0].params.boxes.edge_box_mm == 42.0
    assert filled[0].params.seed == 3
    for table, said in [
        ({"preassemble": {"box": {}}}, "preassemble.box: unknown parameter .did you mean 'boxes'"),
        ({"preassemble": {"boxes": {"box_count": 1.5}}}, "preassemble.boxes.box_count: expected a whole number"),
        ({"preassemble": {"boxes": 3}}, "boxes: expected a table"),
        ({"preassemble": {"method": "magic"}}, "method: expected one of"),
        ({"magic": {}}, "no step 'magic'"),
    ]:
        with pytest.raises(UsageError, match=said):
            pipeline.plan(("preassemble",), (), table, 0)
    with pytest.raises(UsageError, match="--steps"):
        pipeline.steps_for(Scene(name="x", kind=""))


@dataclasses.dataclass(frozen=True)
class OneMethod:
    method: str = "only"
    seed: int = 0


def test_steps_run_after_those_they_need_and_are_given_what_these_found(monkeypatch, tmp_path):
    given = {}

    def step(name, *needs):
        def run(scene, params, earlier=None):
            given[name] = earlier
            return SimpleNamespace(status="ok", said=name)

        return SimpleNamespace(NEEDS=needs, METHODS=("only",), Params=OneMethod, run=run, KIND="space-frame")

    modules = {"a": step("a", "c", "b"), "b": step("b"), "c": step("c", "b")}
    monkeypatch.setattr(pipeline, "step_modules", lambda: modules)
    jobs = pipeline.plan(("a", "b", "c"), (), {}, 0)
    assert [job.step for job in jobs] == ["b", "c", "a"]
    pipeline.execute(tmp_path / "s.h5", Scene(name="x", kind="space-frame"), jobs)
    assert given["b"] is None
    assert {name: result.said for name, result in given["a"].items()} == {"c": "c", "b": "b"}
    assert [job.step for job in pipeline.plan(("a", "b"), (), {}, 0)] == ["b", "a"]
