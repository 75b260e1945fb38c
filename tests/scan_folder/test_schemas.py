"""The schemas of docs/schemas: valid, those of the declarations, and met by every folder that designgen exports."""

import json
from pathlib import Path

import jsonschema
import pytest

from designgen import recipe_files
from designgen.export import folder as export_folder
from designgen.scenes.make import make
from docs.scripts import make_schemas
from processor.model import InputError
from processor.scan_folder import text_files
from processor.scan_folder.folder import read_input
from processor.store import store
from tests.support.made import made

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS = {path.name.removesuffix(".schema.json"): path for path in sorted((ROOT / "docs/schemas").glob("*.json"))}
SQUARE = [[0.0, 0.0, 0.0], [2000.0, 0.0, 0.0], [0.0, 2000.0, 0.0], [2000.0, 2000.0, 0.0]]
RECIPES = {
    "arch-s1": ["scan.spacing_mm=100"],
    "frame-1040": ["frame.nodes_x=5", "frame.nodes_y=6", "frame.shape=flat", "scan.step_mrad=15", "scan.merged=true"],
    "truss-bridge-picks": ["scan.step_mrad=15"],
}


def schema(name):
    return json.loads(SCHEMAS[name].read_text("utf-8"))


def problems(name, content):
    return [error.message for error in jsonschema.Draft202012Validator(schema(name)).iter_errors(content)]


def problems_of_folder(path):
    found = problems("project", text_files.tomllib.loads((path / "project.toml").read_text("utf-8")))
    if (path / "design.json").exists():
        design = json.loads((path / "design.json").read_text("utf-8"))
        found += problems({"arch-bridge": "design-arch", "space-frame": "design-frame"}[design["kind"]], design)
    if (path / "stations.json").exists():
        found += problems("stations", json.loads((path / "stations.json").read_text("utf-8")))
    return found


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_schema_is_valid(name):
    jsonschema.Draft202012Validator.check_schema(schema(name))


def test_the_schemas_are_those_of_the_declarations():
    stored = {name: path.read_text("utf-8") for name, path in SCHEMAS.items()}
    made = {name: make_schemas.as_text(content) for name, content in make_schemas.schemas().items()}
    assert stored == made, "run make docs"


def test_the_stored_scan_folder_is_valid():
    assert problems_of_folder(ROOT / "fixtures/scan-folder") == []


@pytest.mark.parametrize("name", RECIPES)
def test_exported_folders_are_valid(name, tmp_path):
    _, recipe = recipe_files.load(name)
    scene, truth = made(make, name, recipe_files.overridden(recipe, RECIPES[name]))
    store.write_scene(tmp_path / "scene.h5", scene, truth, {})
    export_folder.export(tmp_path / "scene.h5", tmp_path / "folder", "ply", with_truth=False)
    assert problems_of_folder(tmp_path / "folder") == []
    assert (tmp_path / "folder/stations.json").exists() == (name == "frame-1040")
    assert (tmp_path / "folder/picks.csv").exists() == (name == "truss-bridge-picks")


NODE = {"id": 0, "centre": [0, 0, 0], "radius": 60.0}


def frame(**changes):
    nodes = [NODE | {"id": i, "centre": centre} for i, centre in enumerate(SQUARE)]
    members = [{"a": 0, "b": 1, "tube_diameter": 60.0}]
    return {"units": "mm", "kind": "space-frame", "nodes": nodes, "members": members} | changes


def assert_refused(place, file, text):
    (place / file).write_text(text)
    (place / "scan.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    with pytest.raises(InputError):
        read_input(place)


@pytest.mark.parametrize(
    "changes",
    [
        {"units": "furlong"}, {"nodes": []}, {"nodes": [NODE | {"centre": [0, 0]}]},
        {"nodes": [NODE | {"radius": -1.0}]}, {"nodes": [NODE | {"id": 1.5}]},
        {"members": [{"a": 0, "b": 1}]}, {"bolts": []},
    ],
)  # fmt: skip
def test_what_the_frame_schema_refuses_is_refused_by_the_reader(changes, tmp_path):
    assert problems("design-frame", frame()) == []
    assert problems("design-frame", frame(**changes))
    assert_refused(tmp_path, "design.json", json.dumps(frame(**changes)))


@pytest.mark.parametrize(
    "text",
    [
        'kind = "tower"',
        'colour = "red"',
        "[[scan]]\ncomponent = 'rib1'",
        "[[scan]]\nfile = '../scan.xyz'",
        "[[scan]]\nfile = 'scan.xyz'\nsigma_mm = 0.0",
        "[[scan]]\nfile = 'scan.xyz'\npose = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
        "[tolerance]\nstandard = 'none'",
        "[tolerance]\nmisalignment_mm = [1.0, 2.0]",
        "[[control]]\nname = 'T1'\nposition = [0, 0, 0]",
        "[[control]]\nname = 'T1'\nseen = [0, 0, 0]",
    ],
)
def test_what_the_project_schema_refuses_is_refused_by_the_reader(text, tmp_path):
    assert problems("project", text_files.tomllib.loads(text))
    assert_refused(tmp_path, "project.toml", text)
