"""Control points read from a folder and kept in a scene file."""

import dataclasses

import h5py
import numpy as np
import pytest

from processor.model import InputError
from processor.scan_folder import folder
from processor.space_frame import step as space_frame_step
from processor.store import store
from tests.support.files.old_files import without_checksums

POINTS = np.random.default_rng(0).uniform(0.0, 4.0, (50, 3))
TOML = """
units = "mm"
kind = "space-frame"
[[scan]]
file = "a.xyz"
station = "S1"
position = [0.0, 0.0, 1.5]
pose = [[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
[[scan]]
file = "b.xyz"
position = [3.0, 0.0, 1.5]
"""
TABLES = """
[[control]]
name = "T1"
position = [1000.0, 2000.0, 300.0]
sd_mm = 1.0
scan = "S1"
seen = [2000.0, 4000.0, 300.0]
[[control]]
name = "T1"
scan = "b"
seen = [1001.0, 2000.0, 300.0]
seen_sd_mm = 0.5
[[control]]
name = "T2"
position = [0.0, 0.0, 100.0]
sd_mm = 2.0
"""
CSV = """name,scan,x,y,z,sd_mm
T1,,1000.0,2000.0,300.0,1.0
T1,S1,2000.0,4000.0,300.0,
T1,b,1001.0,2000.0,300.0,0.5
T2,,0,0,100,2
"""


def place(tmp_path, toml=TOML, csv=None, name="control.csv"):
    for one in ("a.xyz", "b.xyz"):
        np.savetxt(tmp_path / one, 1000.0 * POINTS)
    (tmp_path / "project.toml").write_text(toml)
    if csv is not None:
        (tmp_path / name).write_text(csv)
    return tmp_path


def same(one, other):
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(one))


def test_control_points_in_toml_and_csv_are_read_alike(tmp_path):
    for name in "abc":
        (tmp_path / name).mkdir()
    found = folder.read_input(place(tmp_path / "a", TOML + TABLES)).control
    assert found.ids == ("T1", "T2")
    np.testing.assert_array_equal(found.positions, [[1000.0, 2000.0, 300.0], [0.0, 0.0, 100.0]])
    np.testing.assert_array_equal(found.seen, [[2000.0, 4000.0, 300.0], [1001.0, 2000.0, 300.0]])
    assert (found.sd.tolist(), found.seen_sd.tolist()) == ([1.0, 2.0], [0.0, 0.5])
    assert (found.point.tolist(), found.scan.tolist(), found.station.tolist()) == ([0, 0], [0, 1], [-1, -1])
    named = place(tmp_path / "c", 'control = "targets.csv"\n' + TOML, CSV, "targets.csv")
    for other in (place(tmp_path / "b", TOML, CSV), named):
        scene = folder.read_input(other)
        assert same(scene.control, found)
        assert len(scene.scans) == 2


def test_sightings_have_the_units_of_scans_and_known_points_of_the_project(tmp_path):
    found = folder.read_input(place(tmp_path, TOML, CSV), units="m").control
    np.testing.assert_array_equal(found.positions[0], [1000.0, 2000.0, 300.0])
    np.testing.assert_array_equal(found.seen[0], [2e6, 4e6, 3e5])


def test_a_csv_is_no_scan_and_may_name_stations_of_a_merged_cloud(tmp_path):
    np.savetxt(
        tmp_path / "roof.xyz", np.column_stack([POINTS, np.tile([1, 2], 25)]), header="x y z station", comments=""
    )
    (tmp_path / "stations.json").write_text('{"S1": {"position": [0, 0, 1]}, "S2": {"position": [4, 0, 1]}}')
    (tmp_path / "control.csv").write_text(CSV.replace("T1,b,", "T1,S2,").replace("000.0", ".0"))
    scene = folder.read_input(tmp_path)
    assert [scan.name for scan in scene.scans] == ["roof"]
    assert (scene.control.scan.tolist(), scene.control.station.tolist()) == ([0, 0], [0, 1])
    (tmp_path / "control.csv").write_text(CSV.replace("T1,b,", "T1,roof,"))
    with pytest.raises(InputError, match="has several stations; name the one"):
        folder.read_input(tmp_path)


@pytest.mark.parametrize(
    ("toml", "csv", "said"),
    [
        (TABLES.replace('"b"', '"c"'), None, "unknown scan or station 'c'; expected one of a, b"),
        (TABLES.replace("sd_mm = 1.0", "sd_mm = 0.0"), None, "a number above 0"),
        (TABLES.replace("sd_mm = 1.0", ""), None, "a number above 0 as 'sd_mm', found nothing"),
        (
            TABLES.replace("seen_sd_mm = 0.5", "seen_sd_mm = -1"),
            None,
            "a number of 0 or more as 'seen_sd_mm', found -1",
        ),
        (TABLES.replace("position = [0.0, 0.0, 100.0]", "where = 1"), None, "unknown key 'where'"),
        (TABLES.replace("[2000.0, 4000.0, 300.0]", "[2000.0, nan, 300.0]"), None, "numbers of shape 3"),
        ('[[control]]\nname = "T1"\n', None, "found neither"),
        (
            '[[control]]\nname = "T1"\nposition = [0, 0, 0]\nsd_mm = 1.0\n',
            None,
            "no control point was measured in a scan",
        ),
        ('[[control]]\nname = "T1"\nscan = "a"\nseen = [0, 0, 0]\n', None, "no known coordinates"),
        (TABLES + TABLES, None, "has coordinates already"),
        ("", CSV + "T1,b,0,0,0,\n", "seen in 'b' twice"),
        ("", CSV.replace("sd_mm\n", "sd\n"), "expected columns name,scan,x,y,z,sd_mm"),
        ("", CSV.replace("2000.0", "here"), "line 2: expected name,scan"),
        ("", CSV.replace("2000.0", "inf"), "finite coordinates"),
        ("", CSV.replace(",1.0\n", ",0\n", 1), "sd_mm above 0"),
        ("", "", "expected columns"),
    ],
)
def test_invalid_control_points_are_refused_in_one_line(tmp_path, toml, csv, said):
    with pytest.raises(InputError, match=said) as error:
        folder.read_input(place(tmp_path, TOML + toml, csv))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("value", "said"),
    [("3", "expected a text"), ('"."', "found a folder"), ('"../x.csv"', "leads out"), ('"no"', "no file")],
)
def test_missing_control_file_is_refused(tmp_path, value, said):
    with pytest.raises(InputError, match=said):
        folder.read_input(place(tmp_path, f"control = {value}\n{TOML}"))


def test_control_points_are_stored_and_absent_from_older_files(tmp_path):
    scene = folder.read_input(place(tmp_path, TOML, CSV))
    store.write_scene(tmp_path / "s.h5", scene, None, {})
    again = store.read_scene(tmp_path / "s.h5")
    assert same(again.control, scene.control)
    without = dataclasses.replace(scene, control=None)
    assert store.scene_hash(without) != store.scene_hash(scene)
    store.write_scene(tmp_path / "old.h5", without, None, {})
    with h5py.File(without_checksums(tmp_path / "old.h5"), "r+") as file:
        file.attrs["format_version"] = np.bytes_("1.2")
    assert store.read_scene(tmp_path / "old.h5").control is None


def test_control_points_in_another_frame_are_refused(tmp_path):
    far = CSV.replace("T1,,1000.0", "T1,,500000000.0")
    scene = folder.read_input(place(tmp_path, TOML, far))
    with pytest.raises(InputError, match="control points lie 5e\\+05 m from where"):
        space_frame_step.run(scene, space_frame_step.Params())


@pytest.mark.parametrize(("factor", "said"), [(1000.0, "1000"), (1.0 / 25.4, "1/25.4"), (1.3, "")])
def test_control_points_in_another_unit_are_refused_with_the_factor(tmp_path, factor, said):
    places = np.array([[5000.0, 2000.0, 300.0], [9000.0, 500.0, 100.0], [100.0, 7000.0, 300.0]])
    rows = ["name,scan,x,y,z,sd_mm"]
    for i, (x, y, z) in enumerate(places):
        known = factor * np.array([x, y, z])
        rows += [f"T{i},,{known[0]},{known[1]},{known[2]},1.0", f"T{i},S1,{y},{5.0 - x},{z},"]
    scene = folder.read_input(place(tmp_path, TOML, "\n".join(rows) + "\n"))
    with pytest.raises(InputError, match=f"lie {said} times as far apart" if said else "from where the scans"):
        space_frame_step.run(scene, space_frame_step.Params())
