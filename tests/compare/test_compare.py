"""processor compare: what it writes, in the inputs' own unit and order, and what it refuses."""

import csv
import io
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from processor.__main__ import main
from processor.compare import compare
from processor.compare.compare import Request
from processor.geometry.m3c2 import Distances, Scales
from processor.model import InputError, Scan, Scene, UsageError
from processor.report import cloud_comparison
from processor.report.deviation import core_points_csv
from processor.report.deviation.core_points_csv import COLUMNS
from processor.store import store
from tests.support.clouds.m3c2_clouds import brute, wavy
from tests.support.files.scan_bytes import las_with_keys

pytestmark = pytest.mark.usefixtures("blank_pictures")

UTM = np.array([512_345.25, 5_412_678.5, 231.0])  # metres
COUNT = 2500  # points of a cloud: some tens within a radius of 5 cm
# Coordinates of 5e6 m have steps of 1e-9 m as float64; sums over the points of a cylinder keep twice of that.
ROUNDING_M = 2e-9


def written(path, points, header="", columns="%.17g"):
    np.savetxt(path, points, fmt=columns, header=header, comments="")
    return path


@pytest.fixture
def clouds(tmp_path):
    """Two clouds in metres at UTM coordinates, 5 mm apart, and core points."""
    first, second = wavy(COUNT, 1) / 1000.0 + UTM, wavy(COUNT, 2, 5.0) / 1000.0 + UTM
    core = np.random.default_rng(3).permutation(first)[:50]
    names = ("first.xyz", "second.xyz", "core.xyz")
    return [written(tmp_path / name, one) for name, one in zip(names, (first, second, core), strict=True)]


def called(monkeypatch, *arguments):
    """Exit code of the command within this process."""
    monkeypatch.setattr(sys, "argv", ["processor", "compare", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code or 0


def table(folder):
    with (folder / "compare.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == [column.name for column in COLUMNS]
    return dict(zip(rows[0], np.array([[float(cell) for cell in row] for row in rows[1:]]).T, strict=True))


def test_comparison_at_utm_coordinates_equals_brute_force_and_writes_all_files(clouds, tmp_path, monkeypatch, capsys):
    first, second, core_file = clouds
    out = tmp_path / "out"
    options = ("--normal-diameter", 0.1, "--projection-diameter", 0.08, "--max-depth", 0.06)
    assert called(
        monkeypatch, first, second, "-o", out, "--core", core_file, *options, "--registration-error", 0.0003
    ) == 0  # fmt: skip
    found = table(out)
    core = np.loadtxt(core_file)
    for axis, column in zip("xyz", core.T, strict=True):
        np.testing.assert_array_equal(found[axis], column)  # every bit, in the order of the core file
    normals = np.column_stack([found["nx"], found["ny"], found["nz"]])
    assert (normals[:, 2] > 0.0).all()
    local = [np.loadtxt(path) - UTM for path in (first, second, core_file)]
    distance, lod95, n1, n2, std1, std2 = brute(*local, normals, 0.08, 0.06, 0.0003)
    for name, expected in [("n1", n1), ("n2", n2)]:
        np.testing.assert_array_equal(found[name], expected)
    for name, expected in [("distance", distance), ("lod95", lod95), ("std1", std1), ("std2", std2)]:
        np.testing.assert_allclose(found[name], expected, atol=ROUNDING_M)
    np.testing.assert_array_equal(found["significant"], np.abs(found["distance"]) > found["lod95"])
    record = json.loads((out / "compare.json").read_text())
    assert record["parameters"]["projection_diameter"] == 0.08
    assert record["parameters"]["registration_error"] == 0.0003
    assert set(record["inputs"]) == {"reference", "compared", "core"}
    assert record["summary"]["core_points"] == 50
    assert record["summary"]["mean"] == pytest.approx(np.mean(distance), abs=ROUNDING_M)
    low, high = record["summary"]["significant_share_ci95"]
    assert low <= record["summary"]["significant_share"] <= high
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "median level of detection" in capsys.readouterr().out
    again = called(monkeypatch, first, second, "-o", out, "--core", core_file, *options, "--json")  # in its place
    assert (again, json.loads(capsys.readouterr().out)["summary"]["core_points"]) == (0, 50)


def test_without_options_the_scales_are_made_from_the_density(clouds, tmp_path):
    first, second, _ = clouds
    said = []
    found = compare.compare(Request(first, second), said.append)
    assert len(found.core) == COUNT
    np.testing.assert_array_equal(found.core + found.origin, np.loadtxt(first))
    inside = (found.distances.n1 >= 20) & (found.distances.n2 >= 20)
    assert inside.mean() > 0.95  # all but those near the border
    assert found.scales.normal_diameter_mm >= found.scales.projection_diameter_mm
    text = "\n".join(said)
    used = found.scales
    assert f"normal diameter {used.normal_diameter_mm:.6g}" in text
    assert f"projection diameter {used.projection_diameter_mm:.6g}" in text
    assert f"max depth to either side {used.max_depth_mm:.6g}" in text
    again = compare.compare(Request(first, second))
    np.testing.assert_array_equal(found.distances.lod95, again.distances.lod95)


def test_the_unit_is_that_of_the_files_and_two_are_refused(tmp_path):
    plane = np.array([[x, y, 0.0] for x in range(20) for y in range(20)])
    a = written(tmp_path / "a.csv", plane, "x[mm] y[mm] z[mm]")
    b = written(tmp_path / "b.csv", plane + np.array([0.0, 0.0, 0.5]), "x[mm] y[mm] z[mm]")
    c = written(tmp_path / "c.csv", plane, "x[m] y[m] z[m]")
    found = compare.compare(Request(a, b))
    assert found.unit == "mm"
    np.testing.assert_allclose(found.distances.distance, 0.5, atol=1e-12)  # one rounding of 20, some times
    with pytest.raises(InputError, match="one unit"):
        compare.compare(Request(a, c))


def test_normals_come_from_a_file(clouds, tmp_path):
    first, second, core_file = clouds
    core = np.loadtxt(core_file)
    normals = np.tile([0.6, 0.0, -0.8], (len(core), 1)) * 2.0
    request = {"projection_diameter": 0.08, "max_depth": 0.06}
    tables = [
        written(tmp_path / "three.txt", normals / 2.0),
        written(tmp_path / "six.txt", np.hstack([core, normals / 2.0])),
        written(tmp_path / "named.csv", np.hstack([normals, core]), "nx ny nz x y z"),
    ]
    results = [compare.compare(Request(first, second, core_file, one, **request)) for one in tables]
    for one in results:
        np.testing.assert_allclose(one.normals, normals / 2.0)
        np.testing.assert_array_equal(one.distances.distance, results[0].distances.distance)
    for rows, said in [
        (normals[:-1], "for each of 50"), (normals * 0.0, "no direction"), (core, "expected unit normals"),
        (np.hstack([core, 100.0 * normals]), "expected unit normals"),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=said):
            compare.compare(Request(first, second, core_file, written(tmp_path / "bad.txt", rows), **request))
    moved = written(tmp_path / "moved.txt", np.hstack([core[::-1], normals]))
    with pytest.raises(InputError, match="elsewhere"):
        compare.compare(Request(first, second, core_file, moved, **request))


def test_unused_normal_diameter_is_not_reported_as_a_scale(clouds, tmp_path):
    first, second, core_file = clouds
    normals = written(tmp_path / "up.txt", np.tile([0.0, 0.0, 1.0], (50, 1)))
    for given in (0.0, 0.08):
        said = []
        found = compare.compare(Request(first, second, core_file, normals, normal_diameter=given), said.append)
        text = "\n".join(said)
        assert not re.search(r"normal diameter \d", text)
        assert "normals of file up.txt" in text
        assert ("--normal-diameter is not used" in text) == (given > 0.0)
        parameters = cloud_comparison.as_json(found)["parameters"]
        assert parameters["normal_diameter"] is None
        assert "normal_diameter" not in parameters["given"]


def wall(seed, off=0.0, count=COUNT):
    """An upright wall of 3 m along x, with 2 mm of noise; metres."""
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(0.0, 3.0, (2, count))
    return np.column_stack([x, off + rng.normal(0.0, 0.002, count), z])


def test_results_go_to_a_folder_named_after_both_clouds_if_none_is_named(clouds, tmp_path, monkeypatch, capsys):
    first, second, core = clouds
    monkeypatch.chdir(tmp_path)
    assert called(monkeypatch, first.name, second.name, "--core", core.name, "--lang", "zh") == 0
    assert (tmp_path / "first-second-comparison/compare.json").is_file()
    assert '<html lang="zh">' in (tmp_path / "first-second-comparison/report.html").read_text("utf-8")
    assert "results go to first-second-comparison" in capsys.readouterr().err


def test_distances_of_a_moved_upright_wall_have_one_sign(tmp_path, monkeypatch, capsys):
    first, second = written(tmp_path / "a.xyz", wall(1)), written(tmp_path / "b.xyz", wall(2, 0.05))
    assert called(monkeypatch, first, second, "-o", tmp_path / "out") == 0
    found = table(tmp_path / "out")
    # 2 mm of noise each, of 2 x 2500 points: sd 0.06 mm.
    assert np.nanmean(found["distance"]) == pytest.approx(0.05, abs=1e-3)
    assert (found["distance"] > 0.0).all()
    assert (found["ny"] > 0.0).all()
    said = f"{COUNT} of {COUNT} normals are of upright surfaces"
    assert said in capsys.readouterr().out
    assert said in (tmp_path / "out" / "report.html").read_text()
    turned = json.loads((tmp_path / "out" / "compare.json").read_text())["normals_turned"]
    assert (turned["by_up"], turned["by_convention"], turned["surfaces_by_convention"]) == (0, COUNT, 1)


def test_normals_of_upright_walls_point_to_the_scanners_of_the_reference(tmp_path):
    """Two scanners on either side of two walls, each with a pose of its own."""
    scans = []
    for i, side in enumerate((-1.0, 1.0)):
        points = 1000.0 * wall(i) + [0.0, 2000.0 * side, 0.0]  # seen from the middle
        T = np.eye(4)
        T[:3, 3] = [1500.0, 100.0 * side, 1500.0]
        scans.append(Scan(f"S{i}", points - T[:3, 3], position=np.zeros(3), T_project_scan=T))
    store.write_scene(tmp_path / "a.h5", Scene("a", "structure", tuple(scans), units="mm"), None, {})
    nearer = [1000.0 * wall(i + 2) + [0.0, 1950.0 * side, 0.0] for i, side in enumerate((-1.0, 1.0))]
    moved = written(tmp_path / "b.csv", np.vstack(nearer), "x[mm] y[mm] z[mm]")
    core = np.array([[1500.0, -2000.0, 1500.0], [1500.0, 2000.0, 1500.0], [700.0, 2000.0, 1500.0]])
    core_file = written(tmp_path / "core.csv", core, "x[mm] y[mm] z[mm]")
    for given in (core_file, None):
        found = compare.compare(Request(tmp_path / "a.h5", moved, given))
        np.testing.assert_array_equal(np.sign(found.normals[:, 1]), -np.sign(found.core[:, 1]))
        # 2 mm of noise over the tens of points of a cylinder: sd 0.5 mm.
        np.testing.assert_allclose(found.distances.distance, 50.0, atol=2.0)
        assert found.turned.scanner == len(found.core)


def test_clouds_without_overlap_are_refused_with_the_likely_cause(clouds, tmp_path):
    first, second, _ = clouds
    cloud = np.loadtxt(second) - UTM
    small = {"projection_diameter": 1e-6, "max_depth": 1e-5}
    near = written(tmp_path / "near.xyz", np.loadtxt(first) - UTM)
    cases = [
        (first, written(tmp_path / "mm.xyz", 1000.0 * np.loadtxt(second)), {}, "about 1000: .* different units"),
        (near, written(tmp_path / "ft.xyz", cloud / 0.3048), {}, None),
        (near, written(tmp_path / "inch.xyz", cloud * 39.37), {}, "about 39.37"),
        (near, written(tmp_path / "ten.xyz", cloud * 10.0 + 700.0), {}, "about 10: "),
        (first, written(tmp_path / "far.xyz", cloud + UTM + [1000.0, 0.0, 0.0]), {}, "compared cloud .* lie 999"),
        (first, second, {"core": near}, "core points .* apart"),
        (first, written(tmp_path / "up.xyz", cloud + UTM + [0.0, 0.0, 0.5]), {"max_depth": 0.1}, "--max-depth"),
        (first, second, {"normal_diameter": 1e-6}, "normal-diameter"),
        (first, second, {**small, "normal_diameter": 0.1}, "projection-diameter"),
        (first, written(tmp_path / "one.xyz", cloud[:1] + UTM), {}, "holds 1 point;"),
        (written(tmp_path / "two.xyz", cloud[:2] + UTM), first, {}, "holds 2 points;"),
    ]  # fmt: skip
    for one, other, given, said in cases:
        if said is None:
            assert len(compare.compare(Request(one, other, **given)).core)
            continue
        with pytest.raises(InputError, match=said):
            compare.compare(Request(one, other, **given))


def test_unit_is_stated_only_if_an_input_states_it(tmp_path, monkeypatch, capsys):
    plane = np.array([[x, y, 0.0] for x in range(20) for y in range(20)])
    a, b = written(tmp_path / "a.xyz", plane), written(tmp_path / "b.xyz", plane + np.array([0.0, 0.0, 0.5]))
    core = written(tmp_path / "core.csv", plane, "x[m] y[m] z[m]")
    for named, options, unit in ((a, ("--core", core), ""), (core, (), "m")):
        assert called(monkeypatch, named if unit else a, b, "-o", tmp_path / "out", *options) == 0
        out, err = capsys.readouterr()
        record = json.loads((tmp_path / "out" / "compare.json").read_text())
        assert (record["unit"] == "m") == bool(unit)
        assert (" m," in out) == bool(unit)
        assert "the unit m is given by core.csv only; not by " in out
        assert "the unit m is given by" in err
        assert [note["code"] for note in record["notes"]] == ["compare.unit"]
    found = compare.compare(Request(a, b))
    assert cloud_comparison.as_json(found)["unit_note"] is None


@pytest.mark.parametrize(
    "option", ["--radius", "--cylinder-radius", "--cyl-radius", "--normal-radius", "--projection-radius", "--rad"]
)
def test_radius_option_is_refused_with_the_option_of_the_diameter(clouds, tmp_path, monkeypatch, capsys, option):
    for given in ((option, "0.1"), (f"{option}=0.1",)):
        assert called(monkeypatch, *clouds[:2], "-o", tmp_path / "out", *given) == 2
        said = capsys.readouterr().err
        assert f"No such option: {option}" in said
        assert "--projection-diameter" in said
        assert "twice the radius" in said


def test_the_csv_is_that_of_the_csv_module():
    rng = np.random.default_rng(0)
    scale = 10.0 ** rng.integers(-9, 18, (6, 400))
    numbers = rng.normal(size=(6, 400)) * scale
    numbers[:4, ::7] = np.nan  # values without a result
    counts = rng.integers(0, 9, (2, 400))
    found = Distances(*numbers[:2], *counts, *numbers[2:4])
    core, normals = rng.normal(size=(400, 3)), rng.normal(size=(400, 3))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([column.name for column in COLUMNS])
    significant = (np.abs(found.distance) > found.lod95).astype(int)
    columns = (*core.T, *numbers[:2], significant, *counts, *numbers[2:4], *normals.T)
    writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
    assert core_points_csv.csv_text(np.zeros(3), core, found, normals) == out.getvalue()


def test_bad_input_is_one_line_and_exit_3(clouds, tmp_path, monkeypatch, capsys):
    first, second, _ = clouds
    out = tmp_path / "out"
    empty, text, one = tmp_path / "empty.xyz", tmp_path / "text.xyz", tmp_path / "one.xyz"
    empty.write_bytes(b"")
    text.write_text("no numbers here\n")
    one.write_text("1 2 3\n1 2 3\n1 2 3\n")
    cases = [
        (tmp_path / "none.xyz", second), (first, empty), (text, second), (one, one), (one, first), (first, one),
        (first, tmp_path), (first, second, "--core", text), (first, second, "--normals", tmp_path / "none.txt"),
    ]  # fmt: skip
    for case in cases:
        assert called(monkeypatch, *case, "-o", out) == 3
        said = capsys.readouterr()
        errors = [line for line in said.err.splitlines() if line.startswith("error")]
        assert len(errors) == 1
        assert "Traceback" not in said.err
        assert not out.exists()
    for options in (("--projection-diameter", "0"), ("--max-depth", "-1"), ("--registration-error", "x")):
        assert called(monkeypatch, first, second, "-o", out, *options) == 2
    with pytest.raises(UsageError, match="max-depth"):
        Request(first, second, max_depth=float("nan"))
    assert called(monkeypatch, first, second, "-o", tmp_path) == 2  # holds the inputs
    assert Path(first).exists()


def test_units_of_each_file_and_of_heights(tmp_path, monkeypatch):
    """The same two clouds in m; the compared one in feet; and the reference with its heights in survey feet."""
    first, second = wavy(COUNT, 1) / 1000.0, wavy(COUNT, 2, 5.0) / 1000.0
    us_ft = 1200.0 / 3937.0
    in_m = [written(tmp_path / f"{k}.xyz", one) for k, one in enumerate((first, second))]
    in_ft = written(tmp_path / "ft.xyz", second / 0.3048)
    heights = written(tmp_path / "heights.xyz", first / [1.0, 1.0, us_ft])
    options = ("--normal-diameter", 0.08, "--projection-diameter", 0.05, "--max-depth", 0.04)
    found = []
    for name, units, files in (("a", (), in_m), ("b", ("--units", "m,ft"), (in_m[0], in_ft)),
                               ("c", ("--units", "m/us-ft,ft"), (heights, in_ft))):  # fmt: skip
        assert called(monkeypatch, *files, "-o", tmp_path / name, *options, *units) == 0
        found.append(table(tmp_path / name))
    for other in found[1:]:
        np.testing.assert_allclose(other["distance"], found[0]["distance"], atol=ROUNDING_M)
        np.testing.assert_allclose(other["z"], found[0]["z"], atol=1e-12)  # of 1 m: 1e4 steps
    assert json.loads((tmp_path / "c/compare.json").read_text())["unit"] == "m"


# A coordinate system with x and y in m and z in US survey feet (NAVD88 height, EPSG:6360).
HEIGHTS_IN_FEET = {1024: 1, 3072: 25832, 4096: 6360}


def test_stated_units_count_before_those_of_the_files(tmp_path):
    """Files that state two units are refused until the user states one; then one remark says so."""
    first, second = wavy(COUNT, 1) / 1000.0, wavy(COUNT, 2, 5.0) / 1000.0
    files = [las_with_keys(tmp_path / f"{k}.las", one, HEIGHTS_IN_FEET, 1e-6) for k, one in enumerate((first, second))]
    lengths = {"normal_diameter": 0.08, "projection_diameter": 0.05, "max_depth": 0.04}
    with pytest.raises(InputError, match=r"0\.las: .*x and y are in m, z is in us-ft; state the unit by --units"):
        compare.compare(Request(*files, **lengths))
    plain = [written(tmp_path / f"{k}.xyz", one) for k, one in enumerate((first.round(6), second.round(6)))]
    for units, name in (("m", "m"), ("m/us-ft", "m/us-ft")):
        found = compare.compare(Request(*files, units=units, **lengths))
        expected = compare.compare(Request(*plain, units=name, **lengths))
        np.testing.assert_allclose(found.distances.distance, expected.distances.distance, atol=ROUNDING_M)
        (note,) = [one for one in found.notes if one.code == "compare.over-files"]
        assert [one.values["name"] for one in note.values["files"]] == ["0.las", "1.las"]
    assert not [one for one in expected.notes if one.code == "compare.over-files"]


def test_points_of_a_cylinder_are_said_of_the_sparser_cloud(clouds):
    """A point a square of 2 by 2 in a circle of a diameter of 20: 25 pi; of the denser cloud 100 pi."""
    for spacings in ((2.0, 1.0), (1.0, 2.0)):
        lines = []
        used = Scales(30.0, 20.0, 9.0, *spacings)
        compare._log_scales(Request(*clouds[:2]), used, "mm", lines.append)
        assert lines[-1] == f"a cylinder holds about {25.0 * np.pi:.3g} points of the sparser cloud"


def test_a_stated_unit_has_a_remark_only_where_the_file_states_another(tmp_path):
    path = las_with_keys(tmp_path / "m.las", wavy(COUNT, 1) / 1000.0, {1024: 1, 3072: 25832}, 1e-6)
    for given, stated in (("m", None), ("ft", "m")):
        remark = compare._read(path).otherwise(compare.units.of_files(given, ("reference",))["reference"])
        assert (remark and remark.values["unit"]) == stated


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("furlong", "--units furlong: unknown unit 'furlong'"),
        ("m,m,m", "expected one unit, or two"),
        ("m,", "expected one unit, or two"),
        ("m/", "expected a unit of the heights after the slash"),
    ],
)
def test_mistyped_units_are_refused_by_name(clouds, text, said):
    with pytest.raises(UsageError, match=said):
        compare.compare(Request(clouds[0], clouds[1], units=text))


def test_three_points_give_a_normal(tmp_path):
    """As in PDAL and CloudCompare: a plane through three points; two give none."""
    plane = np.array([[0.0, 0, 0], [1, 0, 0.5], [0, 1, 0], [50, 0, 0], [51, 0, 0], [100, 0, 0]])
    first = written(tmp_path / "first.xyz", plane)
    second = written(tmp_path / "second.xyz", plane + np.array([0.0, 0, 0.1]))
    core = written(tmp_path / "core.xyz", plane[[0, 3, 5]])
    found = compare.compare(
        Request(first, second, core=core, normal_diameter=4.0, projection_diameter=4.0, max_depth=2.0)
    )
    expected = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    np.testing.assert_allclose(found.normals[0], expected, atol=1e-12)  # a plane through three points is exact
    assert np.isnan(found.normals[1:]).all()
    assert found.distances.distance[0] == pytest.approx(0.1 * expected[2])
