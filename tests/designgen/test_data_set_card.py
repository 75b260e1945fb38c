"""The card of a data set: splits by scene, content of the files, law of the noise; the same set, the same card."""

import hashlib
import json
from unittest import mock

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from designgen import card, recipe_files
from designgen.cli import commands
from processor.jobs import process

DENTS = ("--set", 'structure.components=["none", "dent"]', "--set", "scan.step_mrad=30", "--set", "scan.stations=2")


def make(folder, recipe, *more):
    done = CliRunner().invoke(commands, ["make", recipe, "-o", str(folder), *map(str, more)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads((folder / "card.json").read_text("utf-8"))


def test_splits_are_of_scenes_and_never_move():
    splits = [card.split_of(seed) for seed in range(1000)]
    shares = {name: splits.count(name) / 1000 for name in set(splits)}
    assert shares == pytest.approx({"train": 0.7, "validation": 0.15, "test": 0.15})
    assert all(set(splits[first : first + 8]) == set(shares) for first in range(900))


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Plates of two seeds at two noises, with a dent in one plate of each."""
    folder = tmp_path_factory.mktemp("card") / "set"
    varied = ("--vary", "scanner.noise_mm=0.3,1")
    with mock.patch.object(process, "in_process", lambda function, job, _: function(job)):
        return folder, make(folder, "plates-defects", "--seed", 2, "--count", 2, *varied, *DENTS)


def test_card_states_the_counts_of_the_files(plates):
    folder, made = plates
    points, defects, sources, names = [], 0, np.zeros(3, dtype=int), set()
    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:  # read without the code under test
            labels = list(file["truth/labels"].values())
            points.append(sum(len(scan["source"]) for scan in labels))
            sources += np.sum([np.bincount(scan["source"], minlength=3) for scan in labels], axis=0)
            defects += len(file["truth/defects/ids"])
            names |= {name.decode() for scan in labels for name in scan["part_names"][:]}
            present = {name for name in card.MEANINGS if len(labels[0][name])}
    assert made["points"] == {"all": sum(points), "least": min(points), "most": max(points)}
    assert list(made["points_by_source"].values()) == sources.tolist()
    assert made["defects"] == defects > 0
    assert {one["dataset"].rsplit("/", 1)[1] for one in made["labels"]} == present >= {"part", "defect"}
    assert set(next(one["names"] for one in made["labels"] if one["dataset"].endswith("/part"))) == names
    assert made["index"]["sha256"] == hashlib.sha256((folder / "index.csv").read_bytes()).hexdigest()
    assert (made["scenes"], made["failed"], made["seeds"]) == (4, 0, [2, 3])
    assert made["splits"]["scenes"] == {"train": 2, "validation": 2, "test": 0}
    assert made["varied"] == {"scanner.noise_mm": ["0.3", "1"]}


def test_a_card_states_the_law_of_the_noise(plates):
    _, made = plates
    assert made["noise"]["mode"] == "rays"
    assert "noise_signal_mm signal^signal_power" in made["noise"]["law"]
    assert made["noise"]["numbers"]["noise_ppm"] == 5.0
    sampled = card.noise_of(recipe_files.named()["frame-small"])
    assert sampled["numbers"] == {"sigma_mm": 2.0, "outlier_share": 0.0}


def test_markdown_card_states_the_values_of_the_json_card(plates):
    folder, made = plates
    page = (folder / "card.md").read_text("utf-8")
    for said in (f"{made['points']['all']:,}", made["index"]["sha256"], "0.3, 1", "seeds 2 to 3", made["about"]):
        assert said in page
