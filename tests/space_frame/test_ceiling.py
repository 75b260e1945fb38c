"""Hangers of a ceiling below a space frame."""

import csv
import dataclasses
import io
import json
import shutil
from pathlib import Path

import ezdxf
import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from processor import pipeline
from processor.api import runs
from processor.language.messages import messages
from processor.model import Ceiling, InputError, Scan, Scene, StepRun
from processor.report.space_frame import dxf, hanger_report
from processor.report.table import csv_text
from processor.scan_folder import folder
from processor.space_frame import hanger_lengths
from processor.space_frame.hanger_lengths import with_hangers
from processor.space_frame.result import Tubes
from tests.support.results.ball_results import balls, whole

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"


def scene(**ceiling):
    return Scene("roof", "space-frame", (Scan("s", np.zeros((1, 3))),), ceiling=Ceiling(**ceiling))


def slope(a, b, c, size=1e5):
    """Two triangles of the plane z = a x + b y + c."""
    plan = size * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return {"vertices": np.column_stack([plan, plan @ [a, b] + c]), "faces": [[0, 1, 2], [0, 2, 3]]}


# --- plumb lines ---------------------------------------------------------------------------------------------------


def test_heights_are_those_of_an_independent_interpolation():
    rng = np.random.default_rng(0)
    plan = rng.uniform(0.0, 20_000.0, (400, 2))
    z = 300.0 * np.sin(plan[:, 0] / 4000.0) + 0.02 * plan[:, 1]
    mesh = Delaunay(plan)
    places = rng.uniform(-2_000.0, 22_000.0, (2000, 2))
    expected = LinearNDInterpolator(mesh, z)(places)
    height, _ = hanger_lengths.heights(Ceiling(vertices=np.column_stack([plan, z]), faces=mesh.simplices), places)
    assert np.array_equal(np.isfinite(height), np.isfinite(expected))
    assert np.nanmax(np.abs(height - expected)) < 1e-6  # by slopes of triangles as thin as 1e-6


def test_the_highest_of_several_surfaces_counts_and_walls_do_not():
    low, high = slope(0.0, 0.0, 0.0), slope(0.0, 0.0, 12.0)
    vertices = np.vstack([low["vertices"], high["vertices"]])
    faces = np.vstack([low["faces"], np.array(high["faces"]) + 4, [[0, 1, 5], [0, 5, 4]]])
    both, wall = (Ceiling(vertices=vertices, faces=some) for some in (faces, faces[-2:]))
    assert hanger_lengths.heights(both, np.array([[1.0, 2.0]]))[0] == pytest.approx([12.0])
    assert np.isnan(hanger_lengths.heights(wall, np.array([[0.0, -1e5]]))[0]).all()


# --- hangers -------------------------------------------------------------------------------------------------------


def test_lengths_to_a_level():
    result = whole()
    found = with_hangers(result, scene(level=5000.0))
    assert found.hangers.length[:2] == pytest.approx([1000.0 - 45.1, 988.0 - 60.2])
    assert found.hangers.ci95[:2] == pytest.approx([1.96 * 0.1, 1.96 * 0.2], rel=1e-3)  # 1.95996
    assert np.isnan(found.hangers.length[2])  # not found
    assert [str(one) for one in found.hangers.verdict] == ["pass", "indeterminate", "none", "indeterminate", "pass"]
    assert with_hangers(result, dataclasses.replace(scene(level=0.0), ceiling=None)) is result


def test_the_interval_over_a_slope_is_that_of_a_simulation():
    """Centre and radius vary together; the ceiling falls by 30 % along x and rises by 50 % along y."""
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(4, 4))
    covariance = factor @ factor.T
    result = balls(radii=(45.0,), flag=("ok",))
    sd = np.sqrt(covariance[2, 2] + covariance[3, 3] - 2.0 * covariance[2, 3])
    result = dataclasses.replace(
        result, balls=dataclasses.replace(result.balls, covariance=covariance[None], lowest_sd=np.array([sd]))
    )
    found = with_hangers(result, scene(**slope(-0.3, 0.5, -900.0)))
    x, y, z, r = rng.multivariate_normal([0.0, 1000.0, 2000.0, 45.0], covariance, 200_000).T
    simulated = z - r - (-0.3 * x + 0.5 * y - 900.0)
    assert found.hangers.ci95[0] == pytest.approx(1.96 * simulated.std(), rel=0.01)  # 200,000 draws: 0.16 %


@pytest.mark.parametrize(
    ("level", "verdict"), [(5900.0, "fail"), (5854.9, "indeterminate"), (5854.0, "pass")]
)  # the lowest point of ball 10 is at 5954.9, its interval 0.2
def test_a_clash_is_a_failed_verdict(level, verdict):
    found = with_hangers(whole(), scene(level=level, clearance_mm=100.0))
    assert str(found.hangers.verdict[0]) == verdict
    row = found.limits.of.index("ball 10")
    assert (str(found.limits.verdict[row]), found.limits.low[row]) == (verdict, 100.0)


def test_hangers_that_are_too_long_fail():
    found = with_hangers(whole(), scene(level=5000.0, longest_mm=900.0))
    assert str(found.hangers.verdict[0]) == "fail"
    assert "length of a hanger" in found.limits.what


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
def test_clearance_of_a_tube_is_that_of_its_lowest_line(degrees):
    """A tube of radius 40 mm from (0, 0, 500) upwards: its lowest line begins 40 cos(angle) below its axis."""
    angle = np.deg2rad(degrees)
    end = np.array([0.0, 0.0, 500.0]) + 2000.0 * np.array([np.cos(angle), 0.0, np.sin(angle)])
    tubes = Tubes(
        a=[10], b=[11], start=[[0.0, 0, 500]], end=[end], radii=[40.0], bow=[0.0], radius_ci95=[0.3],
        start_ci95=[[0.4, 0.4, 0.4]], end_ci95=[[0.4, 0.4, 0.4]],
    )  # fmt: skip
    found = with_hangers(dataclasses.replace(whole(), tubes=tubes), scene(level=300.0, clearance_mm=170.0))
    row = found.limits.of.index("tube 0, balls 10 and 11")
    assert found.limits.value[row] == pytest.approx(200.0 - 40.0 * np.cos(angle))
    assert found.limits.ci95[row] == pytest.approx(0.5)
    assert str(found.limits.verdict[row]) == ("pass" if degrees > 45.0 else "fail")


def tube_above(slopes, a=10, b=11):
    """A level tube of radius 40 mm in 500 mm height, its axis known to 2, 3 and 0.4 mm along x, y and z."""
    tubes = Tubes(
        a=[a], b=[b], start=[[0.0, 0, 500]], end=[[2000.0, 0, 500]], radii=[40.0], bow=[0.0], radius_ci95=[0.3],
        start_ci95=[[2.0, 3.0, 0.4]], end_ci95=[[2.0, 3.0, 0.4]],
    )  # fmt: skip
    return with_hangers(dataclasses.replace(whole(), tubes=tubes), scene(**slope(*slopes, 300.0), clearance_mm=10.0))


def test_the_interval_of_a_tube_over_a_slope_contains_its_place():
    found = tube_above((0.1, -0.2))
    row = found.limits.of.index("tube 0, balls 10 and 11")
    assert found.limits.ci95[row] == pytest.approx(np.hypot(0.4 + 0.1 * 2.0 + 0.2 * 3.0, 0.3))
    level = tube_above((0.0, 0.0))
    assert level.limits.ci95[row] == pytest.approx(0.5)


@pytest.mark.parametrize(("a", "b", "name"), [(-1, 5, "tube 0, ball 5 and a free end"), (-1, -1, "tube 0, no balls")])
def test_a_tube_with_a_free_end_is_named_without_a_ball_there(a, b, name):
    assert name in tube_above((0.0, 0.0), a, b).limits.of


# --- files ---------------------------------------------------------------------------------------------------------


def clashing():
    return with_hangers(whole(), scene(level=5900.0, clearance_mm=100.0))


def test_the_drawing_has_lowest_points_hangers_and_clashes():
    found = clashing()
    space = ezdxf.read(io.StringIO(dxf.drawing(found).decode("utf-8"))).modelspace()
    lowest = sorted(tuple(np.round(one.dxf.location, 4)) for one in space.query('POINT[layer=="LOWEST"]'))
    there = np.isfinite(found.balls.lowest).all(axis=1)
    assert lowest == sorted(map(tuple, np.round(found.balls.lowest[there], 4)))
    lines = list(space.query('LINE[layer=="HANGERS"]'))
    assert len(lines) == there.sum()
    assert all(line.dxf.end.z == pytest.approx(5900.0) for line in lines)
    assert len(space.query('CIRCLE[layer=="CLASHES"]')) == [str(one) for one in found.hangers.verdict].count("fail") > 0


def test_points_to_stake_out_are_those_of_balls_without_a_flag():
    rows = list(csv.DictReader(io.StringIO(hanger_report.stake_out(clashing()).decode("utf-8"))))
    assert [row["name"] for row in rows] == ["L10", "C10", "L14", "C14"]
    assert rows[0] == {"name": "L10", "x_m": "0.003", "y_m": "0.004", "z_m": "5.9549", "code": "LOWEST"}
    assert rows[1]["z_m"] == "5.9"


def test_negative_coordinates_to_stake_out_are_numbers():
    found = clashing()
    west = dataclasses.replace(
        found, hangers=dataclasses.replace(found.hangers, top=found.hangers.top - [1234.5, 0.0, 0.0])
    )
    rows = list(csv.DictReader(io.StringIO(hanger_report.stake_out(west).decode("utf-8"))))
    assert float(rows[0]["x_m"]) == pytest.approx(0.003 - 1.2345, abs=6e-5)  # written to 0.1 mm


def test_table_and_plan():
    found = clashing()
    (table,) = hanger_report.tables(found)
    assert csv_text(table).splitlines()[1].startswith("10,fail,54.9,0.19")
    assert set(hanger_report.draw(found)) == {"hangers.png"}
    assert "吊杆" in messages("zh").text(table.title)
    assert hanger_report.tables(whole()) == []


def write_project(place, text):
    shutil.copytree(FIXTURES / "scan-folder", place)
    project = place / "project.toml"
    project.write_text(f"{project.read_text('utf-8')}\n[ceiling]\n{text}\n", "utf-8")
    return place


def test_a_run_with_a_ceiling(tmp_path):
    frame = write_project(tmp_path / "frame", "level = 0.0\nclearance_mm = 20")
    plain = folder.read_input(FIXTURES / "scan-folder")
    results = runs.run(frame, tmp_path / "out")
    hangers = results.steps["spheres"].hangers
    lowest = results.steps["spheres"].balls.lowest[:, 2]
    assert np.nanmax(np.abs(hangers.length - lowest)) < 1e-9  # the level is 0: rounding
    assert {"hangers.csv", "stakeout.csv", "nodes.dxf", "lowest.csv"} <= {
        one.name for one in (tmp_path / "out").iterdir()
    }
    record = json.loads((tmp_path / "out/results.json").read_text("utf-8"))
    assert record["steps"]["spheres"]["hangers"][0]["id"] == int(hangers.ids[0])
    assert any(row["limit"] == "ceiling_clearance_mm" for row in record["steps"]["spheres"]["limits"])
    assert "Hangers" in (tmp_path / "out/report.html").read_text("utf-8")
    again = pipeline.read_execution(tmp_path / "out/results.h5", frame, None)
    assert isinstance(again.runs[0], StepRun)
    assert again.runs[0].result.hangers.length == pytest.approx(hangers.length, nan_ok=True)
    assert again.scene.ceiling.level == 0.0
    assert plain.ceiling is None


def test_a_surface_is_read_in_the_units_of_the_project(tmp_path):
    frame = write_project(tmp_path / "frame", 'surface = "ceiling.obj"')
    (frame / "ceiling.obj").write_text("v 0 0 2\nv 9 0 2\nv 0 9 2\nf 1 2 3\n")
    unit = {"m": 1000.0, "mm": 1.0}["mm" if 'units = "mm"' in (frame / "project.toml").read_text("utf-8") else "m"]
    assert folder.read_input(frame).ceiling.vertices[:, 2] == pytest.approx([2.0 * unit] * 3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("clearance_mm = 20", "'level', a height, or 'surface'"),
        ('level = 1.0\nsurface = "project.toml"', "found level and surface"),
        ("level = 1.0\nclearance_mm = -1", "of 0 or more as 'clearance_mm', found -1"),
        ("level = 1.0\nclearance_mm = 50\nhanger_longest_mm = 40", "'hanger_longest_mm' above it"),
        ("level = 1.0\nlongest_mm = 40", "did you mean 'hanger_longest_mm'"),
        ('surface = "none.ply"', "there is no file"),
    ],
)
def test_a_ceiling_that_makes_no_sense_is_refused(tmp_path, text, said):
    with pytest.raises(InputError, match=said):
        folder.read_input(write_project(tmp_path / "frame", text))
