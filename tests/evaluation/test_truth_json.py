"""The truth as JSON, which any generator can write: what is read, and what is wrong named."""

import json

import pytest

from processor.evaluation import truth_json
from processor.model import InputError


def test_truth_in_another_format_is_ignored(tmp_path):
    assert truth_json.read(tmp_path) is None
    for text in ('{"centres": [[0, 0, 0]]}', "[1, 2]", "no json"):
        (tmp_path / "truth.json").write_text(text)
        assert truth_json.read(tmp_path) is None


def test_bodies_of_a_structure_are_read(tmp_path):
    bodies = {"names": ["a"], "of_point": [0], "shift": [[0, 0, 5]], "turn": [[0, 0, 0]]}
    structure = {"points": [[1, 2, 3]], "normals": [[0, 0, 1]], "displacement": [[0, 0, 5]], "bodies": bodies}
    (tmp_path / "truth.json").write_text(json.dumps({"format": "processor-truth", "structure": structure}))
    read = truth_json.read(tmp_path).structure.bodies
    assert (read.names, read.moved.tolist()) == (("a",), [True])


def test_faults_of_a_truth_are_named(tmp_path):
    for table, fault in (
        ({"bridge": {}}, "unknown key 'bridge'"),
        ({"frame": {"ids": [1], "centres": [[0, 0]], "radii": [1]}}, "FrameTruth.centres"),
        ({"frame": {"sizes": [1]}}, "sizes"),
    ):
        (tmp_path / "truth.json").write_text(json.dumps({"format": "processor-truth"} | table))
        with pytest.raises(InputError, match=fault):
            truth_json.read(tmp_path)
