"""Scenes that are valid HDF5 and impossible in meaning are refused with the place, at every way in."""

import dataclasses
import typing

import numpy as np
import pytest

import processor
from processor import record_checks
from processor.model import ArchDesign, Checked, DesignPart, InputError, Scene
from processor.store import store
from tests.support.scenes.impossible_scenes import impossible_scenes, possible

CASES = {name: (scene, place) for name, scene, place in impossible_scenes()}
# Of each kind one: a number, a pose, a reference, a text, and a grid, which reading without points does not look at.
FROM_FILES = (
    "frame/radii: negative", "stations/T_project_station: mirrored", "arch/joint_left: unknown", "name: long",
    "scans/1/grid_row: below",
)  # fmt: skip


def test_a_possible_scene_is_accepted(tmp_path):
    store.write_scene(tmp_path / "s.h5", possible(), None, {})
    assert store.read_scene(tmp_path / "s.h5").name == "site"
    assert store.read_scene(tmp_path / "s.h5", points=False).name == "site"
    assert record_checks.problems(possible()) == []


def test_every_impossible_scene_has_a_fault_with_its_place():
    assert len(CASES) >= 100
    found = {name: record_checks.problems(scene, "/scene") for name, (scene, _) in CASES.items()}
    assert [name for name, faults in found.items() if not faults] == []
    for name, (fault, *_) in found.items():
        assert CASES[name][1] in fault, name
        assert "expected" in fault, name
        assert "found" in fault, name
        assert len(fault) < 1_000, name


@pytest.mark.parametrize("case", FROM_FILES)
def test_an_impossible_scene_is_refused_at_every_way_in(tmp_path, case):
    scene, place = CASES[case]
    path = tmp_path / "s.h5"
    store.write_scene(path, scene, None, {})
    for way_in in (lambda: processor.run(path), lambda: store.read_scene(path, points="grid" in case)):
        with pytest.raises(InputError) as caught:
            way_in()
        assert str(caught.value).startswith(f"{path}: {place}")
    with pytest.raises(InputError, match="expected"):
        processor.run(scene)


def test_every_number_field_of_a_scene_declares_its_meaning():
    """A record that is added later is checked, since it cannot leave out the meaning of its numbers."""
    unsaid = {"Scan.intensity", "Scan.colour"}  # any number
    seen, waiting = set(), [Scene]
    while waiting:
        record = waiting.pop()
        seen.add(record.__name__)
        hints = typing.get_type_hints(record)
        for field in dataclasses.fields(record):
            inner = [
                kind for kind in (hints[field.name], *typing.get_args(hints[field.name])) if isinstance(kind, type)
            ]
            waiting += [kind for kind in inner if issubclass(kind, Checked)]
            number = "shape" in field.metadata or hints[field.name] in (int, float)
            said = "means" in field.metadata or f"{record.__name__}.{field.name}" in unsaid
            assert said or not number, f"{record.__name__}.{field.name} does not say what its numbers mean"
    assert {"Scan", "FrameDesign", "Limit", "DesignBodies", "Control"} <= seen


def test_unknown_poses_are_accepted_and_impossible_ones_are_refused():
    poses = np.stack([np.eye(4), np.full((4, 4), np.nan)])

    @dataclasses.dataclass(frozen=True)
    class Found(Checked):
        T_a_b: np.ndarray = processor.model.column("k", 4, 4)

    assert record_checks.problems(Found(poses)) == []
    (fault,) = record_checks.problems(Found(poses + 1.0))
    assert fault.startswith("/T_a_b, row 0: expected a rotation")


def test_a_fault_names_the_file_of_its_field_and_leaves_values_as_they_are():
    """A name with the signs that separate a fault's parts is neither cut nor changed."""
    arch = ArchDesign(
        (DesignPart("a/b.c: d, e"), DesignPart("f")), ("J1",), ("a/b.c: d, e",), ("g/h",), np.ones((1, 8, 3))
    )
    scene = dataclasses.replace(possible(), arch=arch)
    with pytest.raises(InputError) as caught:
        record_checks.check(scene, "folder", {"arch": "folder/design.json"})
    said = "folder/design.json: arch.joint_right, row 0: expected one of parts.name, found 'g/h'"
    assert str(caught.value).startswith(said)
