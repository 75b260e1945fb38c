"""A bit that flips in scene.h5 or results.h5 is noticed, or all values are the same."""

import json
import os
import shutil
import time

import numpy as np
import pytest

from processor import pipeline
from processor.model import InputError, StepRun
from processor.store import checksums, file_structure_checks, store
from processor.store.streaming import points_of
from tests.support.files.flipped_files import flipped, unnoticed
from tests.support.files.old_files import sealed_again, without_checksums
from tests.support.processes import commands
from tests.support.results.ball_results import whole as ball_results
from tests.support.results.bridge_results import adjusted
from tests.support.results.records import assert_equal
from tests.support.results.step_results import defects, stitching
from tests.support.scenes.store_scenes import a_scene

h5py = pytest.importorskip("h5py")


def read_scene(path):
    return store.read_scene(path), store.read_truth(path), store.read_provenance(path)


def read_results(path):
    return store.read_results(path, pipeline.result_classes()), store.read_provenance(path)


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.h5"
    store.write_scene(path, *a_scene(2_000), {"seed": 1})
    return path


@pytest.fixture
def results_file(results_once, tmp_path):
    return shutil.copy(results_once, tmp_path / "results.h5")


@pytest.fixture(scope="module")
def results_once(tmp_path_factory):
    path = tmp_path_factory.mktemp("once") / "results.h5"
    found = {"defects": defects(), "stitch": stitching(), "preassemble": adjusted(), "spheres": ball_results()}
    store.write_results(path, [StepRun(step, "m", "{}", result) for step, result in found.items()], {"seed": 1})
    return path


# By day one flip of each kind of place is likely to be met; by night (slow) each dataset is met often.
@pytest.mark.parametrize("flips", [12, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("file", "read"), [("scene_file", read_scene), ("results_file", read_results)])
def test_flipped_bits_are_noticed_or_change_nothing(request, file, read, flips):
    noticed, same, wrong = unnoticed(request.getfixturevalue(file), read, flips)
    assert wrong == []
    assert noticed + same == flips
    assert noticed > flips / 4  # most bytes of the file are data


def test_an_error_names_the_dataset(scene_file):
    with h5py.File(scene_file, "r") as file:
        part = file["scene/scans/0000/intensity"].id.get_chunk_info(0)
        small = file["scene/scans/0000/origin"].id.get_offset()
    places = {"/scene/scans/0000/intensity": part.byte_offset + part.size // 2, "/scene/scans/0000/origin": small}
    for name, byte in places.items():
        with flipped(scene_file, byte, 3):
            with pytest.raises(InputError, match=f"{name}: is damaged"):
                store.read_scene(scene_file)
            assert store.damage(scene_file)[1][0].startswith(f"{name}: is damaged")


def test_parts_of_a_column_read_alone_are_checked(scene_file):
    with h5py.File(scene_file, "r") as file:
        part = file["scene/scans/0000/points/x"].id.get_chunk_info(0)
    with flipped(scene_file, part.byte_offset + part.size // 2, 3), points_of(scene_file) as points:
        boxed = points.near([(np.full((1, 3), -1e9), np.full((1, 3), 1e9))] * 2)
        with pytest.raises(InputError, match=r"scene\.h5: /scene/scans/0000/points/x: is damaged"):
            list(boxed.read(0))
        with pytest.raises(InputError, match=r"scene\.h5: /scene/scans/0000/points/x: is damaged"):
            list(points.read(0))


def test_chunks_that_change_places_are_noticed_when_all_are_read(tmp_path):
    """Each chunk has a checksum of its own that still fits; that of the whole does not."""
    path = tmp_path / "s.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("x", data=np.repeat([1, 2], 4), chunks=(4,), fletcher32=True)
        other = np.repeat([2, 1], 4)
        checksums.seal(data.id, data.name, other, [other])
        column = checksums.Column(data)
        assert column[4:8].tolist() == [2] * 4
        assert column[0:4].tolist() == [1] * 4
        with pytest.raises(checksums.ChecksumError, match="/x: is damaged"):
            _ = column[4:8]


def test_removed_member_of_a_file_is_detected(scene_file):
    """A member that may be absent, with its checksums, is one whose absence is noticed."""
    with h5py.File(scene_file, "r+") as file:
        del file["scene/stations"]
    with pytest.raises(InputError, match="the names of what it holds"):
        store.read_scene(scene_file)


def test_old_files_are_read_as_before(scene_file, results_file):
    for path, read in ((scene_file, read_scene), (results_file, read_results)):
        expected = read(path)
        assert_equal(read(without_checksums(path)), expected)
        assert store.damage(path) == (False, [])


def test_a_file_of_this_version_has_all_its_checksums(scene_file):
    with h5py.File(scene_file, "r+") as file:
        del file["scene/name"].attrs[checksums.ATTRIBUTE]
    with pytest.raises(InputError, match="/scene/name: has no checksum"):
        store.read_scene(scene_file)
    with h5py.File(scene_file, "r+") as file:
        del file.attrs[checksums.ATTRIBUTE]
    with pytest.raises(InputError, match="/: has no checksum"):
        store.read_scene(scene_file)


def verify(*arguments):
    return commands.here("processor", "verify", *arguments)


def test_verify_command_counts_whole_damaged_and_unchecked_files(tmp_path, scene_file, results_file):
    ended = verify(tmp_path)
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (0, "2 whole")
    without_checksums(results_file)
    ended = verify(tmp_path)
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (1, "1 whole, 1 no-checksums")
    with h5py.File(scene_file, "r") as file:
        byte = file["scene/scans/0001/points/y"].id.get_offset()
    with flipped(scene_file, byte, 0):
        ended = verify(tmp_path, "--json")
        found = json.loads(ended.stdout)
        assert ended.returncode == 3
        assert found["counts"] == {"whole": 0, "no-checksums": 1, "damaged": 1}
        (damaged,) = (one for one in found["files"] if one["state"] == "damaged")
        assert damaged["file"] == "scene.h5"
        assert "/scene/scans/0001/points/y: is damaged" in damaged["problems"][0]
    (tmp_path / "empty").mkdir()
    assert verify(tmp_path / "empty").returncode == 3
    assert verify(sealed_again(scene_file)).returncode == 0


def test_a_file_is_visited_once_while_it_stays_as_it_was(scene_file, monkeypatch):
    """One that has changed is visited again, and so is one that was just written: it may change within a clock tick."""
    visits = []
    visit = file_structure_checks.of_file
    monkeypatch.setattr(file_structure_checks, "of_file", lambda *given: visits.append(1) or visit(*given))
    os.utime(scene_file)
    for _ in range(2):
        store.read_provenance(scene_file)
    assert len(visits) == 2
    for age_s, expected in ((100.0, 3), (50.0, 4)):
        os.utime(scene_file, (then := time.time() - age_s, then))
        for _ in range(2):
            store.read_provenance(scene_file)
        assert len(visits) == expected
