"""The comparer of results: what differs between two files is reported by its place, and what does not is equal."""

import json
import math

import h5py
import numpy as np
import pytest

from tests.bench.comparer import differences, scenes, table
from tests.bench.comparer.differences import compared, renamed, values_of

CENTRES = np.array([[1200.0, -3.5, 0.0], [40.0, 900.0, 7.0]])
REASONS = [json.dumps([{"code": "spheres.datum", "values": {"sd": 0.75, "stations": 2}}]), "[]"]
LEAVES = {"seed": 0, "steps": {"spheres": {"status": "ok", "rms": [0.25, None], "balls": [{"id": 1, "size": 60.0}]}}}


@pytest.fixture
def read(tmp_path):
    """Return a reader of a folder of results with some datasets (None: without it) and JSON leaves changed."""

    def values(datasets=(), leaves=None):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        content = {
            "centres": CENTRES, "ids": np.array([1, 2]), "rms": np.array([0.25, math.nan]), "status": np.bytes_("ok"),
            "reasons": np.array(REASONS, "S"), "T": np.eye(4), "heights": np.float32([1.5, 2.5]),
            "covariance": 1e-12 * np.eye(3),
        } | dict(datasets)  # fmt: skip
        with h5py.File(folder / "results.h5", "w") as file:
            file.attrs["units"] = np.bytes_("mm")
            file["provenance"] = json.dumps({"software": {"processor": str(folder)}, "seed": 0})
            for name, value in content.items():
                if value is not None:
                    file[f"results/0000/{name}"] = value
                    file[f"results/0000/{name}"].attrs["sha256"] = str(folder)
        (folder / "results.json").write_text(json.dumps(leaves or LEAVES), "utf-8")
        return values_of(folder)

    return values


def places(comparison):
    return [one.place.removeprefix("results.h5:results/0000/") for one in comparison.differences]


def test_same_content_is_equal_whatever_checksums_and_software(read):
    found = compared(read(), read())
    assert found.differences == ()
    assert (found.worst, found.worst_place) == (0.0, "")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("centres", CENTRES * (1.0 + 1e-8)),
        ("rms", np.array([0.25, 0.5])),
        ("rms", np.array([math.nan, math.nan])),
        ("rms", np.array([0.25, math.inf])),
        ("ids", np.array([1, 3])),
        ("status", np.bytes_("weak")),
        ("centres", CENTRES[:1]),
        ("heights", np.float32([1.5, 2.500002])),
        ("covariance", 1.00000001e-12 * np.eye(3)),
        ("ids", np.array([b"1", b"2"])),
        ("status", None),
    ],
)
def test_what_differs_is_reported_by_name(read, name, value):
    assert places(compared(read(), read({name: value}))) == [name]


def test_size_of_a_difference_is_relative_to_the_number(read):
    found = compared(read(), read({"centres": CENTRES * (1.0 + 1e-8)}))
    assert found.worst == pytest.approx(1e-8, rel=1e-6)
    assert found.worst_place == "results.h5:results/0000/centres"
    assert "6 of 6" not in found.differences[0].text
    assert compared(read(), read({"centres": CENTRES * (1.0 + 1e-8)}), 1e-7).differences == ()


def test_numbers_of_json_in_a_dataset_and_of_results_json_are_compared_leaf_by_leaf(read):
    new = json.dumps([{"code": "spheres.ranges", "values": {"sd": 0.75000001, "stations": 2}}])
    assert places(compared(read(), read({"reasons": np.array([new, "[]"], "S")}))) == [
        "reasons/0/0/code", "reasons/0/0/values/sd",
    ]  # fmt: skip
    leaves = json.loads(json.dumps(LEAVES).replace("60.0", "60.001").replace("null", "1"))
    found = compared(read(), read(leaves=leaves))
    assert places(found) == ["results.json:steps/spheres/rms", "results.json:steps/spheres/balls/0/size"]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("centres", CENTRES * (1.0 + 1e-12)),
        ("centres", np.add(CENTRES, [[0.0, 1e-8, 0.0], [0.0, 0.0, 0.0]])),  # of a point 1.2 m away
        ("heights", np.nextafter(np.float32([1.5, 2.5]), np.float32(9))),
        ("T", np.eye(4) + 1e-11),
        ("rms", np.array([0.25 + 1e-11, math.nan])),
    ],
)
def test_last_digits_are_equal(read, name, value):
    assert compared(read(), read({name: value})).differences == ()


def test_a_rotation_counts_by_itself_beside_a_long_translation():
    old, new = np.eye(4), np.eye(4)
    old[0, 3] = new[0, 3] = 1e5
    new[0, 1] = 1e-7
    assert differences.relative_differences(old, new, 1e-9).max() == pytest.approx(1e-7)


def test_renamed_places_are_those_of_whole_names(read):
    old, new = read(), read({"centres": None, "places": CENTRES})
    assert places(compared(renamed(old, {"0000/centres": "0000/places"}), new)) == []
    assert places(compared(renamed(old, {"0000/centre": "0000/places"}), new)) == ["centres", "places"]
    assert places(compared(old, new, left_out=("*/centres", "*/places"))) == []


def test_verdicts_alone_leave_figures_out(read):
    changed = {"centres": CENTRES + 1.0, "ids": None}
    assert compared(read(), read(changed), verdicts_alone=True).differences == ()
    found = compared(read(), read({**changed, "status": np.bytes_("weak")}), verdicts_alone=True)
    assert places(found) == ["status"]
    assert found.differences[0].of_verdict


def test_exit_code_states_a_difference_before_the_time(read, tmp_path, capsys):
    facts = {"reference": "abc", "time judged": True}
    equal, other = compared(read(), read()), compared(read(), read({"ids": np.array([1, 3])}))
    then, same, slow = {"seconds": 10.0}, {"seconds": 10.4}, {"seconds": 10.6}
    assert table.reported([table.row("ring", "1", equal, then, same)], facts, None) == 0
    assert table.reported([table.row("ring", "1", equal, then, slow)], facts, None) == 2
    assert table.reported([table.row("ring", "1", equal, then, slow)], {**facts, "time judged": False}, None) == 0
    path = tmp_path / "table/table.json"
    assert table.reported([table.row("ring", "1", other, then, slow)], facts, path) == 1
    assert "results/0000/ids: 2 -> 3 at [1]" in capsys.readouterr().out
    assert json.loads(path.read_text("utf-8"))["rows"][0]["differences"][0]["text"] == "2 -> 3 at [1]"


def test_recipes_of_the_references_are_those_of_designgen():
    from designgen import recipe_files

    for recipe in scenes.recipes().values():
        recipe_files.overridden(recipe_files.load(recipe["recipe"])[1], recipe["set"])
        assert set(recipe.get("change", ())) <= set(scenes.CHANGES)
        assert recipe["run"][0] == "--steps"
    assert len(scenes.recipes()) >= 12


def test_recipes_of_the_references_run_every_step_and_method():
    from processor import pipeline

    runs = [dict(zip(one["run"][::2], one["run"][1::2], strict=True)) for one in scenes.recipes().values()]
    methods = {name for run in runs for name in run.get("--method", "").split(",")}
    for name, module in pipeline.step_modules().items():
        assert any(name in run["--steps"].split(",") for run in runs), name
        assert set(module.METHODS[1:]) <= methods
