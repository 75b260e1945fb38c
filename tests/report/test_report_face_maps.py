"""Maps of deviations: which core points make a face, the steps of colour, and the text of a map."""

import numpy as np
import pytest

from processor.geometry.m3c2 import Distances
from processor.language.messages import text
from processor.model import Limit, Scene, Tolerance
from processor.report.charts import stepped_colours
from processor.report.charts.stepped_colours import Band
from processor.report.deviation import face_maps, section
from processor.report.style import default_settings


def plate(count=900, side=1000.0, thickness=20.0, seed=1):
    """Both sides of a plate: core points, normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, side, (2 * count, 3))
    facing = np.repeat([1.0, -1.0], count)
    points[:, 1] = np.where(facing > 0, thickness, 0.0)
    return points, facing[:, None] * np.array([0.0, 1.0, 0.0])


def of(distance, lod95=0.5):
    count = np.full(len(distance), 10)
    half = np.broadcast_to(np.asarray(lod95, float), distance.shape).copy()
    return Distances(distance=distance, lod95=half, n1=count, n2=count, std1=half, std2=half)


BAND = Band(-1.0, 2.0, text("allowed"))


def test_the_two_sides_of_a_plate_are_two_faces_and_a_gap_parts_one():
    points, normals = plate()
    found = face_maps.faces(points, normals)
    assert [(side, len(rows)) for side, rows in found] == [("+y", 900), ("-y", 900)]
    apart = points.copy()
    apart[points[:, 0] > 500.0, 0] += 600.0
    found = face_maps.faces(apart, normals)
    right = int((points[:900, 0] > 500.0).sum())
    wanted = {("+y", right), ("+y", 900 - right)}
    assert {(side, len(rows)) for side, rows in found if side == "+y"} == wanted
    # They do not cover each other: one panel a side. Behind each other they need two.
    everything = np.ones(len(points), bool)
    assert sorted(p.side for p in face_maps._panels(apart, normals, everything)[0]) == ["+y", "-y"]
    double = np.concatenate([points, points + np.array([0.0, 500.0, 0.0])])
    panels, left_out = face_maps._panels(double, np.tile(normals, (2, 1)), np.ones(len(double), bool))
    assert (sorted(p.side for p in panels), left_out) == (["+y", "+y", "-y", "-y"], 0)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_allowed_band_is_one_colour_step_and_the_other_levels_are_round(scale):
    band = Band(-1.0 * scale, 2.0 * scale, text("allowed"))
    norm, colours, levels = stepped_colours.stepped_colours(scale * np.linspace(-9.0, 9.0, 1001), band)
    assert levels == sorted(levels)
    assert len(levels) == 2 * (stepped_colours.STEPS + 1)
    assert {-1.0 * scale, 2.0 * scale} <= set(levels)
    grey = colours(norm(0.0))
    assert len(set(np.round(grey[:3], 3))) == 1
    assert colours(norm(1.9 * scale)) == grey != colours(norm(2.1 * scale))
    assert colours(norm(-0.9 * scale)) == grey != colours(norm(-1.1 * scale))
    assert 9.0 * scale <= levels[-1] <= 12.0 * scale
    steps = np.diff(levels[stepped_colours.STEPS + 2 :]) / scale
    np.testing.assert_allclose(steps, steps[0])
    assert np.isclose(steps[0] / 10.0 ** np.floor(np.log10(steps[0])), [1.0, 2.0, 5.0], rtol=1e-6).any()  # float64


def test_the_map_keeps_a_dent_and_evens_out_noise():
    rng = np.random.default_rng(3)
    points, normals = plate(4000)
    dent = -6.0 * np.exp(-((points[:, 0] - 300.0) ** 2 + (points[:, 2] - 600.0) ** 2) / 100.0**2) * (normals[:, 1] > 0)
    noise = rng.normal(0.0, 0.3, len(points))
    (panel,) = [p for p in face_maps._panels(points, normals, np.ones(8000, bool))[0] if p.side == "+y"]
    places = points[panel.rows][:, [panel.right, panel.up]]
    at = tuple((places // panel.cell).astype(int).T)
    shape = tuple(int(axis.max()) + 1 for axis in at)
    only_noise, has_value = face_maps._smooth(at, noise[panel.rows], shape)
    assert has_value.mean() > 0.95
    assert only_noise.std() < 0.6 * 0.3  # less than a mean of 3 points has
    smooth, _ = face_maps._smooth(at, (dent + noise)[panel.rows], shape)
    low = np.unravel_index(np.argmin(smooth), shape)
    # The lowest of cells about a flat bottom.
    np.testing.assert_allclose((np.array(low) + 0.5) * panel.cell, [300.0, 600.0], atol=2.0 * panel.cell)
    assert -6.5 < smooth.min() < -4.8  # the kernel evens out a fifth of a dent of 100 mm; noise of 0.18 mm beside it


def test_unseen_core_points_are_counted_and_the_limit_of_the_project_is_drawn():
    points, normals = plate()
    known = np.where(normals[:, 1] > 0, 0.5, np.nan)
    with default_settings():
        caption, png = face_maps.face_maps(points, normals, of(np.zeros(1800), known), BAND, ("distance", "mm"))
    assert "900 of 1,800 core points are on faces not drawn" in str(caption)
    assert png.startswith(b"\x89PNG")
    limit = Limit("deviation_mm", "deviation", low=-3.0, high=4.0)
    scene = Scene("s", "structure", tolerance=Tolerance("", "", (limit,)))
    band = section._band(scene, None)
    assert (band.low, band.high, str(band.name)) == (-3.0, 4.0, "allowed, -3 to 4 mm")


@pytest.mark.parametrize("count", [0, 1, 3, 11])
def test_a_few_points_draw_an_empty_map(count):
    points, normals = plate(max(count, 1))
    with default_settings():
        found = face_maps.face_maps(points[:count], normals[:count], of(np.zeros(count)), BAND, ("distance", ""))
    assert found[1].startswith(b"\x89PNG")
