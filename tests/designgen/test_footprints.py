"""Footprints at edges: how far mixed pixels reach, against closed forms and against cutting every ray into sub-rays."""

import dataclasses

import numpy as np
import pytest

from designgen.designs import boxes_and_tubes
from designgen.scanning import edge_footprints, scanner, survey
from designgen.scanning import returns as scanning_returns
from designgen.scanning.ray_kernels import Beam
from designgen.scanning.raycast import Grid
from designgen.scanning.surfaces import Builder

QUIET = scanner.Scanner(**{**scanner.preset("plain-2mm"), "noise_mm": 0.0})


def scan(surfaces, device, step_mrad, T=None, **settings):
    """What a station at the origin sees of matt surfaces."""
    T = np.eye(4) if T is None else T
    params = scanner.Params(step_mrad=step_mrad, specular=0.0, **settings)
    return scanning_returns.scan_station(surfaces, T, device, params, 0, "S1").returns


def mark_every_ray(monkeypatch):
    """Cut every ray of a strip into sub-rays."""
    mark = edge_footprints.mark_edges

    def every(surface, t, thin, used, margin, *rest):
        edge, near = mark(surface, t, thin, used, margin, *rest)
        edge[margin.side : margin.side + used] = True
        return edge, near

    monkeypatch.setattr(edge_footprints, "mark_edges", every)


def thin_objects():
    """Rods and beads all around, thinner than the steps of the rays."""
    builder, rng = Builder(), np.random.default_rng(4)
    for i in range(60):
        at, axis = rng.uniform(-6000.0, 6000.0, 3), rng.normal(size=3)
        builder.cone(i, "rod", at, axis / np.linalg.norm(axis), (3.0, 3.0), 900.0)
        builder.sphere(i, "bead", rng.uniform(-6000.0, 6000.0, 3), 6.0, [])
    return builder.to_surfaces()


def before_a_wall():
    """A half plane, x < 0, at y = 4000 before a wall at y = 7000, and a wide beam of no noise."""
    builder = Builder()
    half = np.array([[-3000.0, 4000.0, -900.0], [0.0, 4000.0, -900.0], [0.0, 4000.0, 900.0], [-3000.0, 4000.0, 900.0]])
    wall = np.array([[-3000.0, 7000.0, -900.0], [3000.0, 7000.0, -900.0], [3000.0, 7000.0, 900.0]])
    builder.polygon(0, "half", half)
    builder.polygon(1, "wall", np.vstack([wall, [-3000.0, 7000.0, 900.0]]))
    device = dataclasses.replace(QUIET, divergence_mrad=1.0, beam_waist_mm=40.0)  # 22 mm at the half plane: 5.5 mrad
    return builder.to_surfaces(), device


OUTERMOST = 1.0 * np.cos(np.radians(30.0))  # of the middle to an edge upright: the six stand at 30, 90 degrees, ...


@pytest.mark.parametrize("step_mrad", [1.0, *(pytest.param(step, marks=pytest.mark.slow) for step in (0.5, 0.2))])
def test_mixed_pixels_reach_as_far_from_an_edge_as_the_beam(step_mrad):
    surfaces, device = before_a_wall()
    returns = scan(surfaces, device, step_mrad)
    columns = round(2.0 * np.pi / (1e-3 * step_mrad))
    lowest, step = np.radians(-60.0), 1e-3 * step_mrad
    turn = 2.0 * np.pi * returns.column / columns - 0.5 * np.pi  # of the edge at x = 0, to the left
    level = np.cos(lowest + step * returns.row)
    R = 4000.0 / (level * np.cos(turn))
    angle = 0.5 * np.hypot(1e-3, 40.0 / R)
    low = np.abs(lowest + step * returns.row) < 0.12
    # A sub-ray turned to the side by a moves the ray by atan(a / level) about the axis.
    reach = np.arctan(OUTERMOST * angle / level)
    off = np.abs(turn) - reach
    sure = low & (np.abs(off) > 0.02 * reach) & (np.abs(turn) < 0.02)  # the range is a neighbour's
    mixed = returns.source == scanning_returns.MIXED
    np.testing.assert_array_equal(mixed[sure], off[sure] < 0.0)
    rows = len(np.unique(returns.row[low]))
    width = 2.0 * OUTERMOST * 0.5 * np.hypot(1e-3, 40.0 / 4000.0)
    assert (mixed & low & (np.abs(turn) < 0.02)).sum() / rows * 2.0 * np.pi / columns == pytest.approx(
        width,
        abs=2.0 * step,  # a ray at either side
    )


@pytest.mark.slow
def test_a_ray_within_an_edge_is_as_far_as_the_mean_of_its_sub_rays():
    """10 mm inside the half plane the beam, of 22 mm, has two of its seven sub-rays on the wall, 13.3 mm away."""
    surfaces, device = before_a_wall()
    device = dataclasses.replace(device, divergence_mrad=6.0, beam_waist_mm=20.0)  # 22 mm at the half plane
    returns = scan(surfaces, device, 0.25)
    columns, step = round(2.0 * np.pi / 2.5e-4), 2.5e-4
    azimuth, elevation = 2.0 * np.pi * returns.column / columns, np.radians(-60.0) + step * returns.row
    x = 4000.0 / np.tan(azimuth)
    own = np.flatnonzero((x > -10.5) & (x < -9.5) & (np.abs(elevation) < 0.1) & (returns.points[:, 1] > 0.0))
    assert len(own) > 500
    places = [(0.0, 0.0)] + [(np.cos(a), np.sin(a)) for a in np.radians([30, 90, 150, 210, 270, 330])]
    for k in own[::25]:
        ca, sa, ce, se = np.cos(azimuth[k]), np.sin(azimuth[k]), np.cos(elevation[k]), np.sin(elevation[k])
        d = np.array([ce * ca, ce * sa, se])
        left, up = np.array([-sa, ca, 0.0]), np.array([-se * ca, -se * sa, ce])
        angle = 0.5 * np.hypot(6e-3, 20.0 / (4000.0 / d[1]))
        energy, ranges = [], []
        for a, b in places:
            ray = d + angle * (a * left + b * up)
            depth = 4000.0 if ray[0] < 0.0 else 7000.0
            ranges.append(depth / ray[1])
            share = 1 / 2 if (a, b) == (0.0, 0.0) else 1 / 12
            energy.append(share * ray[1] / ranges[-1] ** 2)  # matt: by the cosine, and the square of the range
        assert min(ranges) < 4100.0
        assert max(ranges) > 6900.0
        expected = np.dot(energy, ranges) / np.sum(energy)
        assert np.linalg.norm(returns.points[k]) == pytest.approx(expected, abs=0.05)  # x of the ray within 0.5 mm
        assert returns.source[k] == scanning_returns.MIXED


def large_faces():
    """Plates, boxes and balls all around, also overhead, some of them small."""
    builder = Builder()
    rng = np.random.default_rng(9)
    for i in range(40):
        middle = rng.normal(size=3)
        middle *= rng.uniform(2000.0, 9000.0) / np.linalg.norm(middle)
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        size = rng.uniform(150.0, 2500.0, 3)
        for patch in boxes_and_tubes.Box(middle, axes, size).patches():
            builder.patch(i, patch)
        builder.sphere(i, "ball", rng.uniform(-5000.0, 5000.0, 3), 120.0, [])
    for patch in boxes_and_tubes.Box(np.array([30.0, -20.0, 6000.0]), np.eye(3), np.full(3, 900.0)).patches():
        builder.patch(40, patch)
    return builder.to_surfaces()


WIDE = dataclasses.replace(QUIET, divergence_mrad=27.0, beam_waist_mm=5.0, threshold=0.0)


@pytest.mark.parametrize(
    ("surfaces", "divergence_mrad", "step_mrad", "sub_rays", "mixed"),
    [
        (thin_objects, 0.8, 4.0, 7, 300),
        (large_faces, 39.0, 13.0, 19, 3_000),  # three times the step
        pytest.param(large_faces, 600.0, 10.0, 19, 50_000, marks=pytest.mark.slow),  # further than edges are followed
    ],
    ids=["thin", "wide", "wider"],
)
def test_no_mixed_pixel_is_overlooked(surfaces, divergence_mrad, step_mrad, sub_rays, mixed, monkeypatch):
    """Where every ray is cut into sub-rays, no more mixed pixels appear than where only edges and thin things are."""
    surfaces, device = surfaces(), dataclasses.replace(WIDE, divergence_mrad=divergence_mrad)
    found = scan(surfaces, device, step_mrad, sub_rays=sub_rays)
    mark_every_ray(monkeypatch)
    every = scan(surfaces, device, step_mrad, sub_rays=sub_rays)
    assert (every.source == scanning_returns.MIXED).sum() > mixed
    for column in ("row", "source", "points"):
        np.testing.assert_array_equal(getattr(found, column), getattr(every, column))


def test_a_scan_does_not_depend_on_its_strips(monkeypatch):
    surfaces = large_faces()
    found = []
    for strip in (64, 7):
        monkeypatch.setattr(scanning_returns, "STRIP", strip)
        found.append(scan(surfaces, WIDE, 13.0))
    assert (found[0].source == scanning_returns.MIXED).sum() > 2_000
    for other in found[1:]:
        for column in ("row", "column", "points", "source", "part", "range_error_mm"):
            np.testing.assert_array_equal(getattr(other, column), getattr(found[0], column))


def test_mixed_pixels_do_not_depend_on_where_azimuth_begins():
    """Balls all around, seen by a scanner turned by whole columns: other balls lie over the seam of the azimuth."""
    builder = Builder()
    for i, azimuth in enumerate(np.radians(np.arange(0.0, 360.0, 4.0))):
        unit = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        for z in (-800.0, 0.0, 900.0):
            builder.sphere(i, "ball", (4000.0 + 700.0 * (i % 3)) * unit + [0.0, 0.0, z], 130.0, [])
    surfaces = builder.to_surfaces()
    columns = round(2.0 * np.pi / 9e-3)
    scans = []
    for turned in (0, 5, 350):
        T = survey.levelled_pose(np.zeros(3), 2.0 * np.pi * turned / columns)
        returns = scan(surfaces, WIDE, 9.0, T)
        column = (returns.column + turned) % columns
        order = np.lexsort((returns.row, column))
        ranges = np.linalg.norm(returns.points, axis=1)
        scans.append([values[order] for values in (column, returns.row, returns.source, ranges)])
    assert (scans[0][2] == scanning_returns.MIXED).sum() > 2_500
    for other in scans[1:]:
        for values, expected in zip(other[:3], scans[0][:3], strict=True):
            np.testing.assert_array_equal(values, expected)
        np.testing.assert_allclose(other[3], scans[0][3], atol=1e-6)  # float64 at 6 m, turned


@pytest.mark.slow
def test_a_beam_on_two_plates_gives_a_mixed_pixel_by_the_device():
    builder = Builder()
    corners = np.array([[-3000.0, 0.0, -3000.0], [0.0, 0.0, -3000.0], [0.0, 0.0, 3000.0], [-3000.0, 0.0, 3000.0]])
    builder.polygon(0, "near", corners + np.array([0.0, 5000.0, 0.0]))
    builder.polygon(1, "far", np.abs(corners) * [1, 1, 0] + corners * [0, 0, 1] + np.array([0.0, 7000.0, 0.0]))
    surfaces = builder.to_surfaces()
    depth = {}
    for behaviour in ("phase", "pulse"):
        device = dataclasses.replace(QUIET, behaviour=behaviour, divergence_mrad=0.8, encoder_urad=100.0)
        device = dataclasses.replace(device, separation_mm=500.0)
        returns = scan(surfaces, device, 0.4, sub_rays=19)
        edge = (
            (returns.source == scanning_returns.MIXED)
            & (np.abs(returns.points[:, 0]) < 10.0)
            & (np.abs(returns.points[:, 2]) < 2000.0)
        )
        depth[behaviour] = returns.points[edge, 1]
        assert np.abs(returns.range_error_mm[returns.source == scanning_returns.SURFACE]).max() == 0.0
    assert len(depth["phase"]) > 1_000
    assert ((depth["phase"] > 5000.0) & (depth["phase"] < 7000.0)).all()
    assert np.ptp(depth["phase"]) > 800.0
    # A pulse keeps one of the echoes: the one with more energy, and half of the beam gives the near plate (7/5)^2 more.
    off = np.minimum(np.abs(depth["pulse"] - 5000.0), np.abs(depth["pulse"] - 7000.0))
    assert off.max() < 5.0  # half of the beam on either plate: the mean of the echo's footprint
    assert (depth["pulse"] < 6000.0).mean() > 0.5


def marked(surface, t, reach, side=0, used=None, across=0.01, level=1.0):
    """Mark the rays of a grid of steps of 10 mrad whose footprints reach so far, rad; nothing is thin."""
    rows = surface.shape[1]
    beside = np.full(rows, side, np.int32)
    margin = edge_footprints.Margin(
        side=side,
        cast_columns=beside,
        edge_columns=beside,
        whole_rows=np.zeros(rows, bool),
        cos_elevation=np.full(rows, level),
    )
    grid = Grid(step=0.01, lowest=0.0, rows=rows, columns=2.0 * np.pi / across)
    used = len(surface) - 2 * side if used is None else used
    return edge_footprints.mark_edges(surface, t, np.full(t.shape, np.inf), used, margin, grid, Beam(0.0, reach), 1.0)


def test_edges_are_where_a_neighbour_is_on_another_surface():
    surface = np.full((5, 6), 3, np.int32)
    surface[2, 3] = 7
    expected = np.zeros((5, 6), bool)
    expected[1:4, 2:5] = True
    edge, near = marked(surface, np.where(surface == 7, 500.0, 900.0), 0.0)
    assert edge[:, 0].all()  # what is below the grid is not known
    np.testing.assert_array_equal(edge[:, 1:], expected[:, 1:])
    np.testing.assert_array_equal(near, np.where(expected, 500.0, 900.0))


def test_edges_are_followed_as_far_as_footprints_reach():
    """Over 2.2 steps: two rays more on either side of the two beside the edge, five columns at 60 degrees."""
    surface = np.zeros((40, 30), np.int32)
    surface[:, 15:] = 1
    t = np.where(surface == 1, 500.0, 900.0)
    edge, near = marked(surface, t, 0.022)
    np.testing.assert_array_equal(edge.any(axis=0), [11 < row < 18 or row < 3 for row in range(30)])
    np.testing.assert_array_equal(near[5], [500.0 if row > 11 else 900.0 for row in range(30)])
    edge, _ = marked(np.ascontiguousarray(surface.T), np.ascontiguousarray(t.T), 0.022, level=0.5)
    np.testing.assert_array_equal(edge[:, 5:].any(axis=1), [8 < column < 21 for column in range(30)])
    # What lies beside a strip counts as far as it was cast, and nothing there is marked.
    beside = np.zeros((20, 9), np.int32)
    beside[:2] = 1
    edge, _ = marked(beside, np.full((20, 9), 500.0), 0.022, side=3, used=14)
    np.testing.assert_array_equal(edge[:, 5:].any(axis=1), [2 < column < 5 for column in range(20)])
    edge, _ = marked(beside, np.full((20, 9), 500.0), 0.5, side=3, used=14)
    np.testing.assert_array_equal(edge.any(axis=1), [2 < column < 17 for column in range(20)])


def test_nearest_range_to_surfaces_is_that_worked_by_hand():
    """By hand: over a triangle's middle, beside its edge, beyond its corner; from a ball; without surfaces."""
    corners = np.array([[-100.0, -100.0, 0.0], [300.0, -100.0, 0.0], [-100.0, 300.0, 0.0]])
    plate = Builder()
    plate.polygon(0, "plate", corners)
    cases = [
        ([0.0, 0.0, 70.0], 70.0),
        ([0.0, -140.0, 30.0], 50.0),
        ([-130.0, -140.0, 120.0], 130.0),
        ([200.0, 200.0, 10.0], np.hypot(100.0 * np.sqrt(2.0), 10.0)),
    ]
    for place, expected in cases:
        assert edge_footprints.nearest_mm(plate.to_surfaces(), np.array(place)) == pytest.approx(expected)
    ball = Builder()
    ball.sphere(0, "ball", np.array([300.0, 400.0, 0.0]), 120.0, [])
    assert edge_footprints.nearest_mm(ball.to_surfaces(), np.zeros(3)) == pytest.approx(380.0)
    assert edge_footprints.nearest_mm(ball.to_surfaces(), np.array([300.0, 400.0, 50.0])) == 0.0
    assert edge_footprints.nearest_mm(Builder().to_surfaces(), np.zeros(3)) == np.inf


def test_nearest_range_to_many_triangles_is_that_to_the_nearest_of_them():
    """Each triangle by itself, large and small ones and slivers: none is passed over that may be the nearest."""
    rng = np.random.default_rng(5)
    triangles = [
        rng.uniform(-2000.0, 2000.0, 3)
        + rng.normal(0.0, size, 3) * rng.uniform(-1.0, 1.0, (3, 1))
        + rng.normal(0.0, 5.0, (3, 3))
        for size in rng.choice([10.0, 300.0, 3000.0], 80)
    ]
    every = Builder()
    for corners in triangles:
        every.polygon(0, "plate", corners)
    alone = [Builder() for _ in triangles]
    for one, corners in zip(alone, triangles, strict=True):
        one.polygon(0, "plate", corners)
    single = [one.to_surfaces() for one in alone]
    together = every.to_surfaces()
    for place in rng.uniform(-3000.0, 3000.0, (40, 3)):
        nearest = min(edge_footprints.nearest_mm(one, place) for one in single)
        assert edge_footprints.nearest_mm(together, place) == nearest
