"""A folder made by hand: kind and units that are read, the step that runs, or the advice."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from processor import pipeline
from processor.model import UsageError
from processor.scan_folder import guess, units
from processor.scan_folder.folder import read_input

ROOT = Path(__file__).resolve().parents[2]


def box(size, spacing, seed=0):
    """Points of five faces of a box, about ``spacing`` apart."""
    rng = np.random.default_rng(seed)
    size = np.asarray(size, float)
    faces = []
    for axis in range(3):
        for side in (0.0, 1.0):
            a, b = (k for k in range(3) if k != axis)
            count = int(size[a] * size[b] / spacing**2) + 1
            points = rng.uniform(size=(count, 3)) * size
            points[:, axis] = side * size[axis]
            faces.append(points)
    return np.vstack(faces[:-1])


def write(path, points):
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, points, fmt="%.4f")


@pytest.mark.parametrize(
    ("size", "spacing", "unit"),
    [
        ((14_500.0, 3000, 2000), 60.0, "mm"),  # 14.5 m: in metres 14.5 km
        ((1500.0, 800, 300), 8.0, "mm"),  # 1.5 m: the points would be metres apart
        ((14.5, 3, 2), 0.06, "m"),
        ((400.0, 60, 20), 0.4, "m"),  # a large hall, thinned
    ],
)
def test_the_unit_is_that_of_a_structure_and_the_one_that_init_writes(tmp_path, size, spacing, unit):
    write(tmp_path / "hall" / "scan.xyz", box(size, spacing))
    scene = read_input(tmp_path / "hall")
    assert scene.units == unit
    assert (scene.units_reason[0].code != "units.as-scanners-write") == (unit == "mm")
    largest = float(np.ptp(scene.scans[0].points, axis=0).max()) / 1000.0
    # The outermost of thousands of points: within a permille of the end.
    assert largest == pytest.approx(size[0] * {"mm": 0.001, "m": 1.0}[unit], rel=0.01)
    if max(size) > units.LARGEST_M or unit == "m":
        assert guess.guess(tmp_path / "hall").units == unit
    assert guess.LARGEST_M == units.LARGEST_M


def test_stated_units_take_precedence_over_guessed_ones(tmp_path):
    write(tmp_path / "hall" / "scan.xyz", box((1500.0, 800, 300), 8.0))
    assert read_input(tmp_path / "hall", "inch").units == "inch"
    (tmp_path / "hall/project.toml").write_text('units = "cm"\n')
    assert read_input(tmp_path / "hall").units == "cm"


def test_the_spacing_does_not_depend_on_the_order_of_a_large_cloud():
    points = box((100.0, 50, 20), 0.17)
    assert len(points) > 3 * units.SAMPLE
    found = [units._spacing(one, 0) for one in (points, np.random.default_rng(1).permutation(points))]
    # Of random places, one on 0.17 m squared, the nearest is 0.47 spacings away in the median, 0.2 % in samples of 2e4.
    assert found == pytest.approx([0.08, 0.08], abs=0.01)


def test_lone_scan_is_refused_with_the_commands_to_run(tmp_path):
    write(tmp_path / "target.xyz", box((1.0, 1, 1), 0.03))
    with pytest.raises(UsageError, match=r"--steps spheres; .*processor init; .*processor compare REFERENCE COMPARED"):
        pipeline.steps_for(read_input(tmp_path / "target.xyz"))


def test_two_scans_alone_are_stitched(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / "two" / f"{name}.xyz", box((4.0, 3, 2), 0.05))
    assert pipeline.steps_for(read_input(tmp_path / "two")) == ("stitch",)


@pytest.mark.usefixtures("cad_here")
def test_a_step_file_beside_a_scan_is_its_design(tmp_path):
    cadquery = pytest.importorskip("cadquery")
    folder = tmp_path / "part"
    write(folder / "scan.xyz", box((0.2, 0.1, 0.02), 0.002))
    cadquery.exporters.export(cadquery.Workplane().box(200.0, 100.0, 20.0), str(folder / "part.step"))
    scene = read_input(folder)
    assert (scene.kind, scene.structure is not None) == ("structure", True)
    assert pipeline.steps_for(scene) == ("defects", "deviation", "inspect")
    shutil.copy(folder / "part.step", folder / "other.step")  # which of them is not for the program to say
    assert read_input(folder).structure is None
