"""Boxes that clip scans: compared with NumPy, in frames and units, on every column; mistakes are refused by name."""

import json
import re

import numpy as np
import pytest

from processor.model import InputError, Scan
from processor.scan_folder.clips import Clipper
from processor.scan_folder.folder import read_input
from processor.scan_folder.project_file import ClipBox
from tests.support.processes import commands

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SHIFT = np.array([7.0, -3.0, 0.5])


def cloud(seed, count=2000):
    return np.random.default_rng(seed).uniform(-5.0, 5.0, (count, 3)).round(4)


def folder_of(tmp_path, toml, clouds=(1, 2), units="m"):
    (tmp_path / "project.toml").write_text(f'units = "{units}"\n{toml}', "utf-8")
    for seed in clouds:
        np.savetxt(tmp_path / f"s{seed}.xyz", cloud(seed), fmt="%.4f")
    return tmp_path


def within(points, low, high):
    return ((points >= low) & (points <= high)).all(axis=1)


POSED = f"""
[[scan]]
file = "s1.xyz"
[[scan]]
file = "s2.xyz"
pose = {np.block([[TURN, SHIFT[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist()}
"""


@pytest.mark.parametrize(("units", "mm"), [("m", 1000.0), ("mm", 1.0)])
def test_boxes_are_in_the_frame_and_units_of_the_project(tmp_path, units, mm):
    boxes = """
[[clip]]
box = [[-2, -3, -4], [4, 3, 4]]
[[clip]]
box = [[2, -5, -5], [9, 5, 5]]
scan = "s2"
[[clip]]
box = [[0, 0, 0], [3, 3, 3]]
keep = false
"""
    scene = read_input(folder_of(tmp_path, POSED + boxes, units=units))
    first, second = cloud(1), cloud(2)
    moved = second @ TURN.T + SHIFT
    keep1 = within(first, [-2, -3, -4], [4, 3, 4]) & ~within(first, 0, 3)
    keep2 = (within(moved, [-2, -3, -4], [4, 3, 4]) | within(moved, [2, -5, -5], [9, 5, 5])) & ~within(moved, 0, 3)
    assert 0 < keep1.sum() < len(first)
    assert 0 < keep2.sum() < len(second)
    for scan, wanted in zip(scene.scans, (first[keep1], second[keep2]), strict=True):
        np.testing.assert_allclose(scan.points + scan.origin, mm * wanted, atol=1e-6 * mm)  # of 10 m: 1e-12
    clips = scene.clips
    inside = [
        within(first, [-2, -3, -4], [4, 3, 4]).sum() + within(moved, [-2, -3, -4], [4, 3, 4]).sum(),
        within(moved, [2, -5, -5], [9, 5, 5]).sum(),
        within(first, 0, 3).sum() + within(moved, 0, 3).sum(),
    ]
    assert clips.inside.tolist() == inside
    assert (clips.read, clips.kept) == (4000, keep1.sum() + keep2.sum())


def test_all_columns_of_the_points_stay_together():
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.0, 1.0, (500, 3))
    row = np.arange(500)
    scan = Scan("s", points, intensity=row * 1.0, grid_row=row.astype(np.int32), colour=rng.integers(0, 255, (500, 3)))
    made = Clipper([ClipBox(np.array([[-0.5] * 3, [0.5] * 3]))]).clip(scan)
    kept = np.flatnonzero(within(points, -0.5, 0.5))
    np.testing.assert_array_equal(made.points, points[kept])
    np.testing.assert_array_equal(made.intensity, kept)
    np.testing.assert_array_equal(made.grid_row, kept)
    np.testing.assert_array_equal(made.colour, scan.colour[kept])
    assert not len(made.point_station)


def test_many_points_are_clipped_in_pieces_alike(monkeypatch):
    scan = Scan("s", cloud(3))
    box = ClipBox(np.array([[0.0] * 3, [4.0] * 3]), keep=False)
    whole = Clipper([box])
    wanted = whole.clip(scan)
    monkeypatch.setattr("processor.large_arrays.BLOCK_ROWS", 7)
    pieces = Clipper([box])
    np.testing.assert_array_equal(pieces.clip(scan).points, wanted.points)
    assert pieces.record().inside.tolist() == whole.record().inside.tolist()


def test_input_without_clip_boxes_has_no_clip_record(tmp_path):
    assert read_input(folder_of(tmp_path, "")).clips is None


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("clip = 3", "expected a list as 'clip'"),
        ("[[clip]]\nkeep = true", "clip 1: expected numbers of shape 2 x 3 as 'box', found nothing"),
        ("[[clip]]\nbox = [[0, 0, 0], [1, nan, 1]]", "expected numbers of shape 2 x 3"),
        ("[[clip]]\nbox = [[0, 0, 5], [1, 1, 1]]", "put the lower corner first"),
        ("[[clip]]\nbox = [[0, 0, 0], [1, 1, 1]]\ninside = true", "unknown key 'inside'; known are box, keep, scan"),
        ("[[clip]]\nbox = [[-4, -4, -4], [4, 4, 4]]\nscan = 's9'", "there is no scan 's9'; there are s1, s2"),
        (
            "[[clip]]\nbox = [[-4, -4, -4], [4, 4, 4]]\n[[clip]]\nbox = [[90, 90, 90], [91, 91, 91]]",
            "clip 2: no point lies in the box; it is in the project's frame and units",
        ),
        ("[[clip]]\nbox = [[90, 90, 90], [91, 91, 91]]", "[[clip]] keeps 0 of the 2000 points of scan 's1'"),
        ("[[clip]]\nbox = [[-9, -9, -9], [9, 9, 9]]\nkeep = false", "[[clip]] keeps 0 of the 2000 points of scan 's1'"),
    ],
)
def test_each_mistake_is_named(tmp_path, toml, said):
    with pytest.raises(InputError, match=re.escape(said)) as raised:
        read_input(folder_of(tmp_path, toml))
    assert "project.toml" in str(raised.value)


def test_clipped_points_are_counted_and_absent_from_exports(tmp_path):
    place = tmp_path / "in"
    place.mkdir()
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(4000, 3))
    ball = 0.05 * direction / np.linalg.norm(direction, axis=1)[:, None] + rng.normal(0.0, 2e-4, (4000, 3))
    clutter = rng.uniform(0.4, 0.6, (500, 3))
    np.savetxt(place / "s1.xyz", np.concatenate([ball, clutter]), fmt="%.5f")
    box = "box = [[0.3, 0.3, 0.3], [0.7, 0.7, 0.7]]"
    (place / "project.toml").write_text(f'units = "m"\n[[clip]]\n{box}\nkeep = false\n')
    done = commands.here("processor", "run", place, "-o", tmp_path / "out", "--steps", "spheres", "--pdf")
    assert "500 of 4,500 points clipped by 1 box" in done.stderr, done.stdout
    found = json.loads((tmp_path / "out/results.json").read_text("utf-8"))["clip"]
    assert (found["points_read"], found["points_clipped"]) == (4500, 500)
    assert found["boxes"] == [{"box": [[300.0] * 3, [700.0] * 3], "keep": False, "scan": None, "points": 500}]
    assert (tmp_path / "out/report.pdf").read_bytes().startswith(b"%PDF")
    exported = ("export", tmp_path / "out", "-o", tmp_path / "clean", "--what", "clean", "--format", "xyz")
    done = commands.here("processor", *exported)
    assert done.returncode == 0, done.stderr
    (written,) = (tmp_path / "clean").rglob("*.xyz")
    text = [line.split()[:3] for line in written.read_text().splitlines() if line[:1] in "-0123456789"]
    assert np.array(text, float).max() < 200.0  # mm: the ball is of 50 mm, the clutter 400 mm away
    assert len(text) > 3000
