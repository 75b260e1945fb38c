"""The structure of an HDF5 file is looked at in another process: what ends that process is an error of the file."""

import os
import shutil

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from processor.cli.main import commands
from processor.model import InputError, Truth
from processor.pipeline import result_classes
from processor.store import file_structure_checks, store
from processor.store.streaming import points_of
from tests.support.processes.dying import crash, hang
from tests.support.scenes.impossible_scenes import possible

WAYS_IN = {
    "scene": store.read_scene,
    "points": lambda path: points_of(path).__enter__(),
    "truth": store.read_truth,
    "results": lambda path: store.read_results(path, result_classes()),
    "provenance": store.read_provenance,
}


@pytest.fixture
def foreign(tmp_path):
    """A scene that another process has written, as far as this one knows."""
    store.write_scene(tmp_path / "own.h5", possible(), Truth(), {})
    return shutil.copy(tmp_path / "own.h5", tmp_path / "a.h5") and tmp_path / "a.h5"


def test_a_file_that_crashes_the_library_is_an_error_that_names_it(foreign, monkeypatch):
    monkeypatch.setattr(file_structure_checks, "look_quietly", crash)
    with pytest.raises(InputError, match=r"a\.h5: the library that reads it \(HDF5\) crashed; the file is damaged"):
        store.read_scene(foreign)


@pytest.mark.parametrize("way_in", WAYS_IN)
def test_every_way_in_has_the_structure_looked_at_first(foreign, monkeypatch, way_in):
    def crashed(path):
        raise InputError("crashed", path=path)

    monkeypatch.setattr(file_structure_checks, "of_file", crashed)
    with pytest.raises(InputError, match=r"a\.h5: crashed"):
        WAYS_IN[way_in](foreign)


def test_a_file_that_takes_too_long_is_an_error_that_names_it(foreign, monkeypatch):
    monkeypatch.setattr(file_structure_checks, "look_quietly", hang)
    monkeypatch.setattr(file_structure_checks, "LEAST_S", 0.1)
    with pytest.raises(InputError, match=r"a\.h5: its structure took more than 0 s"):
        store.read_scene(foreign)


def test_verify_lists_the_files_after_one_that_crashes_the_library(foreign, monkeypatch):
    shutil.copy(foreign.with_name("own.h5"), foreign.with_name("z.h5"))
    looks = [crash, file_structure_checks.look_quietly, file_structure_checks.look_quietly]
    whole = file_structure_checks.in_process
    monkeypatch.setattr(file_structure_checks, "in_process", lambda _, *given: whole(looks.pop(0), *given))
    ended = CliRunner().invoke(commands, ["verify", str(foreign.parent)])
    assert ended.exit_code == 3
    lines = ended.stdout.splitlines()
    assert [line.split()[:2] for line in lines[:3]] == [["damaged", "a.h5:"], ["whole", "own.h5"], ["whole", "z.h5"]]


def test_a_file_that_this_process_has_written_needs_no_other(foreign, monkeypatch):
    monkeypatch.setattr(file_structure_checks, "look_quietly", crash)
    assert store.read_scene(foreign.with_name("own.h5")).name == "site"


def test_a_file_that_changes_after_it_was_looked_at_is_refused(foreign, monkeypatch):
    def look_and_change(path):
        structure = file_structure_checks.look(os.fspath(path))
        os.utime(path, (1.0, 1.0))
        return structure

    monkeypatch.setattr(file_structure_checks, "of_file", look_and_change)
    with pytest.raises(InputError, match=r"a\.h5: was changed while it was read"):
        store.read_scene(foreign)


def test_a_chunk_beyond_the_file_or_larger_than_what_it_holds_is_refused(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="earliest") as file:
        data = file.create_dataset("x", (64,), "f8", chunks=(64,), compression="gzip")
        data.id.write_direct_chunk((0,), np.random.default_rng(1).bytes(700))  # 512 bytes need no more than 577
    assert "/x: expected a chunk of at most 512 bytes" in file_structure_checks.look(os.fspath(path)).faults[0]
