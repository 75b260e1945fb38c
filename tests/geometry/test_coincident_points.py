"""Duplicates are found, used once and said; places that rounding makes one are none."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import processor
from processor import large_arrays, pipeline, scene_cloud
from processor.compare import compare
from processor.geometry import coincident_points
from processor.geometry.coincident_points import used_once
from processor.model import InputError, Scan, Scene, Status
from processor.stitching.result import Result
from processor.store import store
from tests.support import arrays_in_files

SLOPE = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]


def plate(count=6000, spacing=5.0, noise=2.0, step=0.001, seed=0):
    """Points of a sloping plate, one per ``spacing`` squared, rounded to ``step``."""
    rng = np.random.default_rng(seed)
    side = spacing * count**0.5
    flat = np.column_stack([rng.uniform(0.0, side, (count, 2)), noise * rng.normal(size=count)])
    return np.round(flat @ SLOPE / step) * step


@pytest.mark.parametrize("step", [1e-9, 0.1, 3.048])
@pytest.mark.parametrize("copies", [1.3, 2, 4])
def test_of_doubled_points_each_counts_once_whatever_their_order(step, copies):
    once = np.unique(plate(spacing=12.0, step=step), axis=0)
    whole, rest = divmod(copies, 1)
    several = np.vstack([once] * int(whole) + [once[: int(rest * len(once))]])
    several = several[np.random.default_rng(1).permutation(len(several))]
    np.testing.assert_array_equal(np.unique(several[used_once(several)], axis=0), once)
    assert np.count_nonzero(used_once(several)) == len(once)


@pytest.mark.parametrize("spacing", [0.3, 1.0, 5.0, 20.0])
@pytest.mark.parametrize("step", [1.0, 3.048, 10.0])
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_places_that_rounding_makes_one_are_no_duplicates(spacing, step, noise):
    points = plate(spacing=spacing, step=step, noise=noise)
    assert used_once(points) is None
    line = np.round(np.outer(np.arange(3000) * 0.1 * spacing, SLOPE[0]) / step) * step  # of one dense line
    assert used_once(line) is None


def test_coordinates_near_multiples_of_a_step_have_that_step():
    """Off by up to 0.001 of it, the same at each multiple, as of places of a table that was rounded."""
    rng = np.random.default_rng(6)
    points = np.round(25.4 * rng.integers(0, 40, (500, 3)) / 7.0, 2)
    np.testing.assert_allclose(coincident_points.lattice_of(points).step, 25.4 / 7.0, rtol=1e-3)


def test_of_a_dense_cloud_that_was_merged_twice_half_of_each_place_is_used():
    points = plate(spacing=0.5, step=1.0)
    used = used_once(np.vstack([points, points]))
    places, count = np.unique(points, axis=0, return_counts=True)
    assert count.max() > 5
    found, left = np.unique(np.vstack([points, points])[used], axis=0, return_counts=True)
    np.testing.assert_array_equal(found, places)
    np.testing.assert_array_equal(left, count)


def test_a_large_cloud_is_sampled_and_sorted_part_by_part(tmp_path, monkeypatch):
    once = np.unique(plate(count=20_000, step=0.01), axis=0)
    both = np.vstack([once, once[::3]])
    expected = used_once(both)
    monkeypatch.setattr(coincident_points, "SAMPLE", 2000)
    arrays_in_files.limit(monkeypatch, 700, 1500)
    with large_arrays.in_files(tmp_path):
        np.testing.assert_array_equal(used_once(both), expected)
        assert used_once(once) is None
    assert expected[: len(once)].all()
    assert not expected[len(once) :].any()


def test_few_points_and_none_are_left_as_they_are():
    for count in (0, 1, 5):
        assert used_once(np.zeros((count, 3))) is None
    points = plate(count=12)
    assert np.count_nonzero(used_once(np.vstack([points] * 4))) == 12


# --- at the ways in


def test_m3c2_and_compare_count_doubled_points_once(tmp_path):
    rng, lengths = np.random.default_rng(3), {"projection_diameter": 80.0, "max_depth": 50.0, "normal_diameter": 160.0}
    once = [np.column_stack([rng.uniform(0, 1000, (6000, 2)), rng.normal(0, 2, 6000)]).round(3) for _ in range(2)]
    core = np.column_stack([rng.uniform(150, 850, (40, 2)), np.zeros(40)])
    alone = processor.m3c2(*once, core, **lengths)
    doubled = processor.m3c2(*(np.vstack([cloud] * 4) for cloud in once), core, **lengths)
    np.testing.assert_array_equal(doubled.lod95, alone.lod95)
    assert [(one.code, one.values["left_out"]) for one in doubled.reasons] == [("points.coincident", 18_000)] * 2
    assert alone.reasons == ()
    for name, cloud in (("a", once[0]), ("b", once[1]), ("core", core)):
        np.savetxt(tmp_path / f"{name}.xyz", cloud if name == "core" else np.vstack([cloud] * 2), fmt="%.3f")
    request = compare.Request(*(tmp_path / f"{name}.xyz" for name in ("a", "b", "core")), units="mm", **lengths)
    compared = compare.compare(request)
    np.testing.assert_allclose(np.median(compared.distances.lod95), np.median(alone.lod95))
    assert [one.values["left_out"] for one in compared.notes] == [6000, 6000]


def test_a_sphere_of_doubled_points_has_the_interval_of_each_once():
    rng = np.random.default_rng(4)
    at = rng.normal(size=(3000, 3))
    at /= np.linalg.norm(at, axis=1)[:, None]
    at = at[at[:, 0] < -0.2]
    once = (at * (100.0 + 0.5 * rng.normal(size=len(at)))[:, None] + [5000.0, 0, 0]).round(3)
    alone = processor.fit_sphere(once, scanner=[0.0, 0, 0])
    doubled = processor.fit_sphere(np.vstack([once, once]), scanner=np.zeros((2 * len(once), 3)))
    np.testing.assert_array_equal(doubled.covariance, alone.covariance)
    assert doubled.status is alone.status
    assert [one.code for one in doubled.reasons][-1] == "points.coincident"


def test_scans_of_a_scene_count_once_also_where_two_overlap(tmp_path):
    points = plate(step=0.01)
    halves = points[:4000] - [1000.0, 0, 0], points[2000:]
    colour = np.arange(3 * 4000, dtype=np.uint8).reshape(-1, 3)
    scene = Scene(
        "s", "structure", (Scan("a", halves[0], origin=np.array([1000.0, 0, 0]), colour=colour), Scan("b", halves[1]))
    )
    found, reasons = scene_cloud.with_points_once(scene)
    assert [len(scan.points) for scan in found.scans] == [4000, 2000]
    np.testing.assert_array_equal(found.scans[0].colour, colour)
    assert [(one.values["cloud"], one.values["left_out"]) for one in reasons] == [("b", 2000)]
    T = np.eye(4)
    T[0, 3] = 1.0
    apart = (scene.scans[0], dataclasses.replace(scene.scans[1], T_project_scan=T))
    assert scene_cloud.with_points_once(dataclasses.replace(scene, scans=apart))[1] == ()
    with pytest.raises(InputError, match=r"scan 'c': 3000 of its 3000 points are those of a; leave one"):
        scene_cloud.with_points_once(Scene("s", "structure", (scene.scans[0], Scan("c", points[:3000]))))


@dataclasses.dataclass(frozen=True)
class Params:
    method: str = "automatic"
    seed: int = 0


def test_a_run_says_how_many_points_coincide_and_a_large_file_of_them_is_read_at_once(tmp_path, monkeypatch):
    lines, counts = [], []

    def run(scene, params):
        counts.append([len(scan.points) for scan in scene.scans])
        return Result(status=Status.OK, method=params.method)

    once = plate(step=0.01)
    scene = Scene("s", "structure", (Scan("a", np.vstack([once] * 2)),))
    step = SimpleNamespace(run=run, NEEDS=())
    found = pipeline.execute(tmp_path / "s.h5", scene, [pipeline.Job("stitch", step, Params())], lines.append)
    assert counts == [[len(once)]]
    assert [one.values["share"] for one in found.runs[0].result.reasons] == [50.0]
    assert any("coincide with others" in line for line in lines)
    monkeypatch.setattr(pipeline, "PIECEWISE_POINTS", 1000)
    for copies, large in ((1, True), (2, False)):
        scan = Scan("a", np.vstack([once] * copies))
        store.write_scene(tmp_path / "s.h5", Scene("s", "structure", (scan,)), None, {})
        assert pipeline.is_large(tmp_path / "s.h5") is large
