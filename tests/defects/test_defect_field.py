"""Which cells of a design are examined, and how errors of unnamed views are estimated."""

import dataclasses
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.stats import norm

from processor.adjustment import scanner_class_errors
from processor.defects import (
    alignment,
    component_deviations,
    deviation_field,
    regions,
    scan_statistic,
    shape_models,
    surface_charts,
    to_result,
)
from processor.defects import step as defects_step
from processor.defects.component_deviations import ComponentShape
from processor.defects.observations import Pairs
from processor.model import Scan, Scene, StructureDesign
from tests.support.scenes.at_design import AT_DESIGN

EDGE, SIGMA, POINTS = 8.0, 0.5, 12
SCANNER = np.array([[1000.0, -9000.0, 4000.0]])


def stations_at(names, positions):
    """What alignment and field read of views: without positions, one cloud has views of which nothing is known."""
    return SimpleNamespace(
        names=names, positions=positions, unnamed=len(names) == 1 and not np.isfinite(positions).all()
    )


UNNAMED, NAMED = stations_at(("merged",), np.full((1, 3), np.nan)), stations_at(("S1",), SCANNER)


@cache
def surface_of(boxes, cell):
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=np.array(bounds, float)) for bounds in boxes])
    return surface_charts.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64), cell)


BOX = (((0, 0, 0), (1000, 600, 400)),)


def pairs_of(surface, seed, mean=None):
    """Pairs of one station on every cell, and on some cells another ``mean``."""
    rng, cells = np.random.default_rng(seed), np.flatnonzero(surface.share > 0.5)
    value = rng.normal(0.0, SIGMA / np.sqrt(POINTS), len(surface.share)) if mean is None else mean
    n, count = len(cells), np.full(len(cells), POINTS)
    none = np.zeros(n, np.int64)
    return Pairs(cells, none, count, none, value[cells], SIGMA**2 * (count - 1.0), none)


def field_of(surface, pairs, stations=NAMED):
    still = alignment.none(surface, 1, 0.0)
    return deviation_field.of_pairs(pairs, surface, stations, still, deviation_field.inner_cells(surface, EDGE))


@pytest.mark.parametrize("cell", [5.0, 20.0, 25.0])
def test_no_examined_cell_comes_nearer_to_the_border_than_asked(cell):
    surface = surface_of(BOX, cell)  # each size is a whole number of cells
    inner = field_of(surface, pairs_of(surface, 1)).inner > 0
    off = np.minimum(surface.centres, np.array([1000.0, 600.0, 400.0]) - surface.centres)
    border = np.where(np.abs(surface.outward) > 0.5, np.inf, off).min(axis=1) - 0.5 * cell
    assert border[inner].min() >= EDGE - 0.5 * cell / surface_charts.PER_SIDE - 1e-6
    assert inner[border > EDGE + cell].all()


def test_the_foot_of_a_rib_is_a_border_of_the_web():
    surface = surface_of((((0, 0, 0), (2000, 20, 1000)), ((993, -130, 0), (1007, 0, 1000))), 25.0)
    web = (surface.outward[:, 1] < -0.5) & (np.abs(surface.centres[:, 1]) < 1e-6)
    inner = field_of(surface, pairs_of(surface, 1)).inner > 0
    from_foot = np.abs(surface.centres[:, 0] - 1000.0) - 7.0 - 12.5  # of the cell's near side
    assert not (inner & web & (from_foot < EDGE - 3.2)).any()
    away = web & (from_foot > EDGE + 25.0)
    inside = (np.abs(surface.centres[:, 0] - 1000.0) < 900.0) & (np.abs(surface.centres[:, 2] - 500.0) < 400.0)
    assert inner[away & inside].all()


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_area_hidden_by_a_touching_body_is_the_contact_area(turn):
    R = trimesh.transformations.rotation_matrix(turn, [1, 2, 3])
    web, rib = ([[0, 0, 0], [2000, 20, 1000]], [[989, -130, 200], [1021, 0, 800]])
    bodies = [trimesh.creation.box(bounds=np.array(bounds, float)) for bounds in (web, rib)]
    mesh = trimesh.util.concatenate(bodies).apply_transform(R)
    surface = surface_charts.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64), 20.0)
    hidden = surface.hidden & surface.covered
    up = surface.outward @ R[:3, :3] @ [0.0, -1.0, 0.0] > 0.5
    foot = surface.outward @ R[:3, :3] @ [0.0, 1.0, 0.0] > 0.5
    sample_mm2 = (20.0 / surface_charts.PER_SIDE) ** 2
    for side in (up, foot):  # the web beneath the rib, and the rib's end
        assert hidden[side].sum() * sample_mm2 == pytest.approx(32.0 * 600.0, rel=0.1)  # a sample at either border
    assert not hidden[~(up | foot)].any()


@pytest.mark.parametrize(("gap", "hidden"), [(0.0, True), (0.3, True), (0.7, False)])
def test_an_open_sheet_within_half_a_millimetre_of_a_body_is_hidden_there(gap, hidden):
    whole = trimesh.creation.box(bounds=np.array(BOX[0], float))
    corners = np.array([[-200.0, -200.0], [1200.0, -200.0], [1200.0, 800.0], [-200.0, 800.0]])
    sheet = trimesh.Trimesh(np.column_stack([corners, np.full(4, -gap)]), [[0, 1, 2], [0, 2, 3]])
    mesh = trimesh.util.concatenate([whole, sheet])
    surface = surface_charts.of_mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int64), 20.0)
    on_sheet = (surface.outward[:, 2] > 0.5) & (surface.centres[:, 2] < 1.0)
    area = (surface.hidden & surface.covered)[on_sheet].sum() * (20.0 / surface_charts.PER_SIDE) ** 2
    assert area == pytest.approx(1000.0 * 600.0 * hidden, rel=0.02)  # a sample at either border


def test_points_alone_on_a_face_are_not_examined():
    surface = surface_of(BOX, 20.0)
    pairs = pairs_of(surface, 1)
    up = surface.outward[pairs.cell, 2] > 0.5
    alone = up & (np.linalg.norm(surface.centres[pairs.cell, :2] - [490.0, 290.0], axis=1) < 11.0)
    rows = np.flatnonzero(~up | alone)
    fewer = Pairs(*(column[rows] for column in vars(pairs).values()))
    seen = field_of(surface, fewer).seen > 0
    assert 1 <= alone.sum() <= 2
    assert not seen[surface.outward[:, 2] > 0.5].any()
    assert seen[surface.outward[:, 2] < -0.5].any()


def ribs(seed, between):
    """The surface of ten plates, and pairs that differ by an error of the view of each side."""
    surface = surface_of(tuple(((500.0 * k, 0, 0), (500.0 * k + 14.0, 400, 600)) for k in range(10)), 20.0)
    rng = np.random.default_rng(seed)
    side = surface.chart
    error = between * rng.normal(size=int(side.max()) + 1)
    noise = rng.normal(0.0, SIGMA / np.sqrt(POINTS), len(side))
    return surface, pairs_of(surface, seed, error[side] + noise)


def test_sd_of_unnamed_views_is_that_between_the_sides_of_plates():
    found = [field_of(*ribs(seed, 0.5), UNNAMED).views for seed in range(10)]
    assert field_of(*ribs(0, 0.5), NAMED).views == 0.0
    # One seed scatters by a third (twenty seeds), the median of ten by 0.13: two of that.
    assert np.median(found) == pytest.approx(0.5, rel=0.25)


def test_differences_of_unnamed_views_are_no_defect_but_a_dent_is():
    for seed in range(2):
        surface, pairs = ribs(seed, 0.5)
        named, unnamed = (field_of(surface, pairs, stations) for stations in (NAMED, UNNAMED))
        # The scatter of windows alone: it is not known that whole faces move alike.
        first, levels = (scan_statistic.levels_of(field, 1e-8, 0.02) for field in (named, unnamed))
        assert first.inflation[0] > 2.0
        assert (levels.inflation < first.inflation).all()
        assert not scan_statistic.search(unnamed, levels).sign.any()
        assert scan_statistic.search(named, levels).sign.any()
        off = np.linalg.norm(surface.centres[:, 1:] - [200.0, 300.0], axis=1)
        on = (off < 100.0) & (surface.outward[:, 0] > 0.5) & (surface.centres[:, 0] < 20.0)
        dented = unnamed.minus(np.where(on, 10.0 * np.cos(0.5 * np.pi * np.minimum(off / 100.0, 1.0)), 0.0))
        assert scan_statistic.search(dented, levels).sign[on & (off < 60.0)].all()


def test_the_pose_of_unnamed_views_has_the_covariance_of_the_class():
    surface = surface_of(tuple(((900.0 * k, 0, 0), (900.0 * k + 300.0, 400, 500)) for k in range(4)), 40.0)
    pairs = pairs_of(surface, 2)
    stations = stations_at(("merged",), np.full((1, 3), np.nan)), stations_at(("a", "b"), np.full((2, 3), np.nan))
    unnamed, named = (alignment.align(pairs, surface, of, 1.0) for of in stations)
    added = unnamed.covariance - named.covariance
    # 0.2 mm of a shift and 0.2 mm of ranges along each axis; 0.2 mm at half of the points' diagonal. The pose without
    # them has a covariance, too, of 5 % of it.
    arm = 0.5 * np.linalg.norm([3000.0, 400.0, 500.0])
    np.testing.assert_allclose(np.diag(added)[:3], (0.2 / arm) ** 2, rtol=0.06)
    np.testing.assert_allclose(np.diag(added)[3:], 0.08, rtol=0.06)
    assert unnamed.pose_covariance()[3, 3] > scanner_class_errors.SHIFT_SD_MM**2


def test_a_cell_that_a_far_station_sees_alone_has_its_noise():
    """A near station sees most of each face with little noise, a far one a few cells of it alone, with much."""
    surface = surface_of(BOX, 20.0)
    rng, cells = np.random.default_rng(3), np.flatnonzero(surface.share > 0.5)
    alone = rng.random(len(cells)) < 0.05
    sd, count = np.where(alone, 1.2, 0.3), np.where(alone, 5, 20)
    square = sd**2 * rng.chisquare(count - 1.0)
    none, station = np.zeros(len(cells), np.int64), alone.astype(np.int64)
    pairs = Pairs(cells, station, count, none, rng.normal(0.0, sd / np.sqrt(count)), square, none)
    stations = stations_at(("near", "far"), np.vstack([SCANNER, 3.0 * SCANNER]))
    still, inner = alignment.none(surface, 2, 0.0), deviation_field.inner_cells(surface, EDGE)
    field = deviation_field.of_pairs(pairs, surface, stations, still, inner)
    for of_station in (alone, ~alone):
        z = (field.deviation / np.sqrt(field.variance))[cells[of_station]]
        assert np.sqrt((z**2).mean()) == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * len(z)))
    assert (field.dof[cells] > 100.0).all()


def test_few_degrees_of_freedom_need_larger_deviations():
    surface = surface_of(BOX, 20.0)
    known = dataclasses.replace(field_of(surface, pairs_of(surface, 1)), dof=np.empty(0))
    levels = scan_statistic.levels_of(known, 1e-8, 0.0)
    up = np.flatnonzero((known.seen > 0) & (surface.outward[:, 2] > 0.5))
    deviation = known.deviation.copy()
    deviation[up[len(up) // 2]] = 1.15 * levels.threshold[0] * levels.inflation[0] * np.sqrt(known.variance[up[0]])
    found = {}
    for dof in (30.0, 1e6):
        field = dataclasses.replace(known, deviation=deviation, dof=np.full(len(deviation), dof))
        field = scan_statistic.widened(field, levels)
        found[dof] = bool(scan_statistic.search(field, levels).sign.any())
    assert found == {30.0: False, 1e6: True}


@pytest.mark.parametrize(("fitted", "mean", "variance"), [(True, 0.0, 0.09 + 0.04), (False, 1.0 / 3.0, 0.01)])
def test_a_bend_is_no_movement_where_the_pose_is_not_of_the_design(fitted, mean, variance):
    """The square of the place along a plate: its mean is a shift. A pose that was not fitted shifts it, too."""
    surface = surface_of((((0, 0, 0), (1000, 600, 12)),), 20.0)
    field, none = field_of(surface, pairs_of(surface, 1)), np.zeros(len(surface.share))
    field = dataclasses.replace(field, stations=none + 0.04, stations_free=none + 0.01)
    frame = shape_models.Frame(np.array([500.0, 300.0, 6.0]), np.eye(3), np.array([500.0, 300.0, 6.0]), 300.0)
    top = np.flatnonzero(surface.outward[:, 2] > 0.5)
    blocks = shape_models.Blocks(surface.centres[top], surface.outward[top], none[top], np.ones(len(top)), 20.0)
    bend = shape_models.Shape("bend", (0, 2), np.array([2.0]), np.array([[0.01]]))
    fit, levels = ComponentShape(0, frame, blocks, None), SimpleNamespace(common=np.array([0.1]), systematic_mm=0.2)
    of_pose = SimpleNamespace(fitted=fitted, sd=lambda points, _: np.full(len(points), 0.3))
    field = dataclasses.replace(field, alignment=of_pose)
    value, own, sd, shared = component_deviations._errors(fit, bend, field, levels)
    # Cells of a fiftieth of the length: a ten-thousandth. Signs are those of the front, above or below.
    np.testing.assert_allclose(np.abs(value - own), 2.0 * mean, rtol=1e-3)
    np.testing.assert_allclose(sd, 0.05 * np.abs(value), rtol=1e-9)
    np.testing.assert_allclose(shared**2, 0.05 + variance, rtol=1e-9)


@pytest.mark.parametrize("side", [1, 3, 8])
def test_means_of_windows_scatter_by_the_root_of_their_cells(side):
    surface = surface_of(BOX, 20.0)
    field = field_of(surface, pairs_of(surface, 1, np.zeros(len(surface.share))))
    even = dataclasses.replace(field, variance=np.full(len(field.variance), 0.04), deviation=0.5 + 0.0 * field.variance)
    z, sd = scan_statistic._windows(even, scan_statistic._used(even), side)
    assert sd.min() == pytest.approx(0.2 / side)  # of windows that were seen whole
    assert z.max() == pytest.approx(0.5 * side / 0.2)
    np.testing.assert_allclose(z * sd, 0.5)


def test_a_region_ends_where_its_cells_deviate_less():
    """Squares of four cells are significant from 5.2 sds: with two of 4 sds and two of 1.5, below 2.5, as well."""
    surface = surface_of(BOX, 20.0)
    field = field_of(surface, pairs_of(surface, 1, np.zeros(len(surface.share))))
    levels = scan_statistic.levels_of(field, 1e-8, 0.0)
    assert levels.threshold[1] == pytest.approx(-norm.ppf(0.5e-8 * 400.0 / (len(levels.sides) + 2)))
    off = np.abs(surface.centres[:, :2] - [500.0, 300.0]).max(axis=1)
    up = (field.seen > 0) & (surface.outward[:, 2] > 0.5)
    sds = np.where(up & (off < 80.0), np.where(off < 60.0, 4.0, 1.5), 0.0)
    deviation = sds * np.sqrt(field.variance)
    found = scan_statistic.search(dataclasses.replace(field, deviation=deviation), levels).sign
    np.testing.assert_array_equal(found, sds > 2.5)


def test_single_cell_in_line_with_a_ridge_is_not_part_of_its_region():
    """A ridge of one cell's width, and a cell in line with it that deviates as one in fifteen does by chance."""
    surface = surface_of(BOX, 20.0)
    field = field_of(surface, pairs_of(surface, 1, np.zeros(len(surface.share))))
    levels = scan_statistic.levels_of(field, 1e-8, 0.0)
    up = (field.seen > 0) & (surface.outward[:, 2] > 0.5)
    row = np.flatnonzero(up & (np.abs(surface.centres[:, 1] - surface.centres[up, 1][0] - 300.0) < 1.0))
    row = row[np.argsort(surface.centres[row, 0])]
    ridge, beyond = row[10:18], row[23]
    deviation = np.zeros(len(surface.share))
    deviation[ridge] = 3.5 * np.sqrt(field.variance[ridge])
    deviation[beyond] = 1.5 * np.sqrt(field.variance[beyond])
    found = scan_statistic.search(dataclasses.replace(field, deviation=deviation), levels).sign
    assert set(np.flatnonzero(found)) == set(ridge)


def test_a_region_is_significant_by_its_own_cells():
    """Nine cells of 1.7 standard deviations are 5.1 together, four are 3.4; what is missing needs no deviation."""
    surface = surface_of(BOX, 20.0)
    field = field_of(surface, pairs_of(surface, 1, np.zeros(len(surface.share))))
    levels = dataclasses.replace(
        scan_statistic.levels_of(field, 1e-8, 0.0), threshold=np.full(len(scan_statistic.SIDES), 5.0)
    )
    cells = np.flatnonzero((field.seen > 0) & (surface.outward[:, 2] > 0.5))[:9]
    deviating = dataclasses.replace(field, deviation=np.sqrt(field.variance) * 1.7 * levels.inflation.max())
    chart = int(np.searchsorted(surface.charts.first, cells[0], side="right")) - 1
    for number, sign, expected in ((9, 1, True), (4, 1, False), (4, 0, True)):
        region = regions.Region(chart, cells[:number], sign, 9.0, 0.0)
        assert regions.is_significant(region, deviating, levels) is expected
    region = regions.Region(chart, cells[:9], 1, 9.0, 0.0)
    mean_sd = float(np.sqrt(field.variance[cells[:9]].mean() / 9.0)) * levels.inflation.max()
    differing = dataclasses.replace(deviating, views=mean_sd)  # the deviation is 5.1 / sqrt(2) standard deviations
    assert not regions.is_significant(region, differing, levels)


BOXES = tuple(((2_000 * i, 0, 0), (2_000 * i + 1_000, 600, 400)) for i in range(6))


@pytest.mark.parametrize(
    ("off", "of_one", "common"),
    [
        (0.2, 0.2, 0.2),
        (0.2, 5.0, 0.2),  # one of six bodies moved
        (0.8, 0.8, 0.0),  # more than a scanner is off
        (0.0, 5.0, 0.0),
    ],
)
def test_what_all_bodies_are_off_by_is_a_bias(off, of_one, common):
    surface = surface_of(BOXES, 25.0)
    body = surface.component
    noise = np.random.default_rng(8).normal(0.0, SIGMA / np.sqrt(POINTS), len(body))
    field = field_of(surface, pairs_of(surface, 8, np.where(body == 0, of_one, off) + noise))
    # Medians of thousands of cells: SIGMA / sqrt(12 * 1000) = 0.005 each, of which the median of six is taken.
    assert deviation_field.common_bias(field) == pytest.approx(common, abs=0.01)


@pytest.mark.parametrize("off", [0.3, 0.0])
def test_a_bias_of_all_bodies_is_stated_with_its_size_and_is_no_defect(off):
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=np.array(bounds, float)) for bounds in BOXES])
    points, face = trimesh.sample.sample_surface(mesh, 60_000, seed=4)
    away = off + np.random.default_rng(5).normal(0.0, SIGMA, len(points))
    scan = Scan("merged", points + away[:, None] * mesh.face_normals[face], T_project_scan=np.eye(4))
    design = StructureDesign("boxes", np.array(mesh.vertices), np.array(mesh.faces, np.int64))
    result = defects_step.run(Scene("boxes", "structure", (scan,), structure=design), defects_step.Params(), AT_DESIGN)
    stated = [reason.values["bias"] for reason in result.reasons if reason.code == "defects.common-bias"]
    assert stated == pytest.approx([off] if off else [], abs=0.02)  # 60,000 points: SIGMA / sqrt(10,000) of a body
    assert not len(result.defects.centre)


@pytest.mark.parametrize(("layer", "apart", "drift"), [(0.3, 0.0, 0.0), (0.0, 0.2, 0.21), (0.3, 0.2, 0.21)])
def test_what_the_sides_of_plates_differ_by_is_without_a_layer_that_all_have(layer, apart, drift):
    """Sums of two sides of 0.2 mm either way: their squares by twice the variance of a side have the median 0.4549."""
    surface = surface_of(tuple(((2_000 * i, 0, 0), (2_000 * i + 1_000, 600, 20)) for i in range(6)), 25.0)
    body, up = surface.component, surface.outward[:, 2]
    noise = np.random.default_rng(8).normal(0.0, SIGMA / np.sqrt(POINTS), len(body))
    off = layer + apart * np.where(up > 0.5, np.where(body % 2 == 0, 1.0, -1.0), 0.0)
    field = field_of(surface, pairs_of(surface, 8, off + noise))
    assert field.drift == pytest.approx(drift, abs=0.02)
    assert field.views == 0.0


def test_faces_that_all_face_one_way_show_no_bias():
    surface = surface_of(BOXES, 25.0)
    up = (surface.outward[:, 2] > 0.9).astype(float)
    field = field_of(surface, pairs_of(surface, 9, np.full(len(up), 0.2)))
    assert deviation_field.common_bias(dataclasses.replace(field, seen=field.seen * up)) == 0.0


def test_bias_that_more_points_do_not_reduce_is_no_deviation_of_well_seen_windows():
    """Half of the windows have a hundred times the points, and all scatter by 0.3 mm."""
    rng = np.random.default_rng(10)
    sd = np.tile([0.01, 0.1], 2_000)
    inflation, common = scan_statistic._scatter(rng.normal(0.0, np.hypot(sd, 0.3)) / sd, sd, 0.0)
    levels = SimpleNamespace(systematic_mm=0.0)
    well, badly = scan_statistic.mean_sd(1.0 / sd[:2] ** 2, inflation, common, SimpleNamespace(views=0.0), levels)
    assert well > 0.2  # the factor alone makes 0.05
    assert badly > 0.3


def test_the_least_depth_is_the_threshold_of_a_window_of_usual_cells():
    """By hand: 25 points of 0.5 mm a cell are 0.1 mm, of 2 by 2 cells 0.05 mm."""
    levels = SimpleNamespace(
        sides=(1, 2), inflation=np.array([1.0, 2.0]), common=np.array([0.0, 0.4]), threshold=np.array([5.0, 4.0]),
        systematic_mm=0.03,
    )  # fmt: skip
    found = to_result._least_depth(levels, 20.0, 0.5, 25.0, SimpleNamespace(views=0.04))
    assert found.side.tolist() == [20.0, 40.0]
    assert found.depth == pytest.approx([5.0 * np.hypot(0.1, 0.05), 4.0 * np.sqrt(0.05**2 + 0.4**2 + 0.05**2)])
