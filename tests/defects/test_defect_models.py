"""Defects of scanned models: bodies that touch, overlap a little or lie a little apart, as designed and as built."""

import dataclasses
from types import SimpleNamespace

import cadquery as cq
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from processor.adjustment import scanner_class_errors
from processor.defects import (
    alignment,
    component_deviations,
    defect_grids,
    detect,
    measures,
    shape_models,
    step,
    surface_charts,
    to_result,
)
from processor.defects.component_deviations import ComponentShape, SignificantShape
from processor.defects.movement import moved_bodies
from processor.defects.regions import Region
from processor.geometry import rigid
from processor.model import NORMAL_95, DesignBodies
from processor.scan_folder import cad
from tests.support.made import made
from tests.support.scenes.at_design import AT_DESIGN
from tests.support.scenes.portal_scenes import box, portal_scene

COARSE, MOVE = {"scan.step_mrad": 3.5}, 10.0
SWEPT = 120.0 * 1200.0 * MOVE  # what the tube sweeps across its axis
DAMAGED = {
    "scan.step_mrad": 2.5, "asbuilt.tube.move_mm": [0.0, 0.0, MOVE], "asbuilt.beam.dent_mm": 5.0,
    "asbuilt.beam.dent_at_mm": [800.0, -75.0, 2115.0], "asbuilt.beam.dent_radius_mm": 70.0,
}  # fmt: skip


def test_moved_body_is_reported_once_by_name_without_false_defects():
    defects = step.run(made(portal_scene, 0.0, DAMAGED), step.Params(), AT_DESIGN).defects
    rows = zip(defects.component, defects.defect_class, defects.doubtful, strict=True)
    sure = {(name, kind.value): k for k, (name, kind, doubtful) in enumerate(rows) if not doubtful}
    assert set(sure) == {("tube", "misalignment"), ("beam", "pit")}
    assert len(sure) == int((~defects.doubtful).sum()), "one report a body"
    row = sure["tube", "misalignment"]
    assert abs(abs(defects.depth_max[row]) - MOVE) < 1.5 * defects.depth_ci95[row]  # 99.7 %
    assert abs(abs(defects.volume_mm3[row]) - SWEPT) < 1.5 * defects.volume_ci95[row]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "step_mrad", "move"),
    [(1, 2.4, (0, 0, 10)), (1, 2.5, (0, 0, 10)), (2, 2.3, (0, 0, 10)), (4, 2.6, (0, 0, -10)), (5, 2.45, (0, 10, 0))],
)
def test_a_moved_body_does_not_draw_the_stations(seed, step_mrad, move):
    settings = {**DAMAGED, "scan.step_mrad": step_mrad, "asbuilt.tube.move_mm": [float(x) for x in move]}
    defects = step.run(made(portal_scene, 0.0, settings, seed), step.Params(), AT_DESIGN).defects
    assert {kind.value for kind in defects.defect_class} == {"misalignment", "pit"}
    assert not defects.doubtful.any()
    row = next(k for k, kind in enumerate(defects.defect_class) if kind.value == "misalignment")
    assert abs(abs(defects.depth_max[row]) - MOVE) < 1.5 * defects.depth_ci95[row]  # 99.7 %
    # 95 % of a bias of 0.3 mm, as of paint, and of as much each by the pose and by what the two sides differ by: 10 %
    assert defects.volume_ci95[row] < 0.11 * SWEPT


def test_a_body_is_moved_as_its_shape_states():
    """A turn about the frame's origin and a shift, against the closed form of a rotation."""
    vertices, faces = box_mesh()
    both, bodies = np.vstack([vertices, vertices + 900.0]), DesignBodies(("box", "other"), np.repeat([0, 1], 12))
    surface = surface_charts.of_mesh(both, np.vstack([faces, faces + 8]), 20.0, bodies)
    frame = shape_models.Frame(np.array([100.0, 50.0, 25.0]), np.eye(3), np.array([100.0, 50.0, 25.0]), 50.0)
    angle, span = 0.02, 100.0
    shape = shape_models.Shape(shape_models.RIGID, (), np.array([1.0, -2.0, 3.0, 0.0, 0.0, angle * span]))
    judged = SignificantShape(shape=shape, peak=3.0, ci95=0.1, volume_ci95=9.0, z=9.0, chance=0.0, margin=9.0)
    fit = ComponentShape(0, frame, None, None)
    design = moved_bodies.design("box", surface, {0: (fit, judged)})
    arm = vertices - frame.origin
    turned = np.stack([arm[:, 0] * np.cos(angle) - arm[:, 1] * np.sin(angle),
                       arm[:, 0] * np.sin(angle) + arm[:, 1] * np.cos(angle), arm[:, 2]], axis=1)  # fmt: skip
    assert design.vertices[:8] == pytest.approx(turned + frame.origin + [1.0, -2.0, 3.0], abs=1e-9)  # float64
    np.testing.assert_array_equal(design.vertices[8:], both[8:])
    assert design.bodies.names == ("box", "other")


def test_a_movement_sweeps_the_volume_of_faces_that_were_seen():
    """Down by 3 mm: the bottom comes out and the top goes in, by as much; only one of them was seen."""
    vertices, faces = box_mesh()
    surface = surface_charts.of_mesh(vertices, faces, 20.0)
    frame = shape_models.Frame(np.array([100.0, 50.0, 25.0]), np.eye(3), np.array([100.0, 50.0, 25.0]), 50.0)
    shape = shape_models.Shape(shape_models.RIGID, (), np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]))
    for up in (1.0, -1.0):
        seen = SimpleNamespace(surface=surface, seen=(up * surface.outward[:, 2] > 0.5).astype(float))
        cells = component_deviations.swept_cells(seen, ComponentShape(0, frame, None, None), shape)
        np.testing.assert_allclose(surface.outward[cells], np.tile([0.0, 0.0, up], (len(cells), 1)), atol=1e-12)
        assert surface.share[cells].sum() * 20.0**2 == pytest.approx(200.0 * 100.0, rel=0.3)  # whole cells of 20 mm


@pytest.mark.parametrize(("seen_from", "share"), [((0.0, 0.0, 1.0), 1.0), (None, 0.0)], ids=["one side", "all sides"])
def test_a_bias_of_the_scanner_moves_what_is_seen_from_one_side(seen_from, share):
    """0.3 mm, as of another paint, is a movement of a plate seen from one side, and none of a body seen all around."""
    vertices, faces = box_mesh()
    surface = surface_charts.of_mesh(vertices, faces, 5.0)
    frame = shape_models.Frame(np.array([100.0, 50.0, 25.0]), np.eye(3), np.array([100.0, 50.0, 25.0]), 50.0)
    at = np.flatnonzero(surface.share > 0.5)
    at = at if seen_from is None else at[surface.outward[at] @ seen_from > 0.9]
    ones = np.ones(len(at))
    blocks = shape_models.Blocks(surface.centres[at], surface.outward[at], 0.0 * ones, ones, 5.0)
    moved = shape_models.rigid_motion(dataclasses.replace(blocks, mean=ones), frame)
    still = SimpleNamespace(sd=lambda points, outward: np.zeros(len(points)), fitted=True)
    field = SimpleNamespace(
        surface=surface, alignment=still, seen=0.0 * surface.share, drift=0.0, stations_sd=lambda *_, **__: 0.0
    )
    field.seen[at] = 1.0
    levels = SimpleNamespace(common=np.zeros(1), systematic_mm=0.0)
    shape = dataclasses.replace(moved, covariance=np.zeros((6, 6)))
    fit = ComponentShape(0, frame, blocks, None)
    shared = component_deviations._errors(fit, shape, field, levels)[3]
    np.testing.assert_allclose(shared, share * scanner_class_errors.known().incidence_mm, atol=0.01)


def test_the_corrected_pose_takes_back_the_movement_of_the_whole():
    """A structure that was moved by a turn about a centre and a shift, written out with SciPy's rotation."""
    pose = rigid.transform(Rotation.from_rotvec([0.2, -0.1, 1.0]).as_matrix(), np.array([10.0, 20.0, 30.0]))
    moved = SimpleNamespace(whole=np.array([0.1, -0.2, 0.3, 4.0, -5.0, 6.0]), centre=np.array([700.0, -300.0, 90.0]))
    points = np.random.default_rng(6).uniform(-900.0, 900.0, (5, 3))
    where = rigid.apply(pose, points)
    turned = Rotation.from_rotvec(moved.whole[:3]).apply(where - moved.centre) + moved.centre + moved.whole[3:]
    back = alignment.corrected_pose(rigid.transform(np.eye(3), np.zeros(3)), moved)
    np.testing.assert_allclose(rigid.apply(back, turned), where, atol=1e-9)


def top_of_the_box():
    """The surface of the box in cells of 20 mm, and the cells of its top: 10 by 5."""
    surface = surface_charts.of_mesh(*box_mesh(), 20.0)
    chart = int(np.argmax(surface.charts.axes[:, 2, 2]))
    return surface, Region(chart, np.flatnonzero(surface.outward[:, 2] > 0.5), -1, 9.0, 0.0)


def test_a_face_that_lies_deeper_as_a_whole_has_the_volume_of_its_area():
    """2 mm over 200 x 100 mm. Noise of 0.2 mm of 50 cells of 20 x 20 mm, and what all have in common, 0.01 mm."""
    surface, top = top_of_the_box()
    count = len(surface.share)
    field = SimpleNamespace(
        surface=surface,
        alignment=alignment.none(surface, 1, error_mm=0.006),
        deviation=np.full(count, -2.0),
        variance=np.full(count, 0.04),
        seen=np.ones(count),
        stations_sd=lambda cells: 0.008,
    )
    found = measures.measure(top, field, 1.5, 50.0)
    assert (found.area_mm2, found.depth_mean, found.volume_mm3) == pytest.approx((20_000.0, 2.0, 40_000.0))
    noise, common = 1.5 * 0.2 * np.sqrt(50.0) * 20.0**2, 0.01 * 20_000.0
    assert found.volume_ci95 == pytest.approx(NORMAL_95 * np.hypot(noise, common), rel=1e-9)
    assert found.depth_max == pytest.approx(2.0)
    np.testing.assert_allclose(found.extent, [200.0, 100.0])
    np.testing.assert_allclose(found.centre, [100.0, 50.0, 50.0], atol=1e-9)


def test_a_shape_is_fitted_again_to_finer_blocks():
    """Exact deviations of a rigid motion; the fit to coarse blocks had half of it."""
    surface = surface_charts.of_mesh(*box_mesh(), 20.0)
    frame = component_deviations._frame_of(surface, 0)
    assert (sorted(frame.half), frame.front) == (pytest.approx([25.0, 50.0, 100.0]), pytest.approx(50.0))
    np.testing.assert_allclose(frame.origin, [100.0, 50.0, 25.0], atol=1e-9)
    factors = np.array([1.0, -2.0, 3.0, 0.4, -0.2, 0.6])
    moved = shape_models.Shape(shape_models.RIGID, (), factors).values(frame, surface.centres, surface.outward)
    fine = shape_models.Blocks(surface.centres, surface.outward, moved, np.ones(len(moved)), 20.0)
    coarse = shape_models.Fitted((shape_models.Shape(shape_models.RIGID, (), 0.5 * factors),), (9.0,), np.ones(1), 9.0)
    (again,) = shape_models.refitted(coarse, fine, frame).shapes
    np.testing.assert_allclose(again.factors, factors, rtol=1e-4)  # a weak ridge of 1e-6 of the mean information
    assert shape_models.refitted(dataclasses.replace(coarse, shapes=()), fine, frame).shapes == ()


def test_a_smaller_place_of_the_other_sign_is_the_other_side_of_a_larger_one_behind_it_alone():
    surface, top = top_of_the_box()
    bottom = np.flatnonzero(surface.outward[:, 2] < -0.5)
    places = ((top.cells, 0, 80, -1), (bottom, 20, 60, 1), (bottom, 120, 160, 1), (bottom, 20, 60, -1))
    found = []
    for cells, low, high, sign in places:
        x = surface.centres[cells, 0]
        rows = cells[(x > low) & (x < high)]
        chart = int(np.searchsorted(surface.charts.first, rows[0], side="right") - 1)
        found.append((Region(chart, rows, sign, 9.0, 0.0), SimpleNamespace(component=0)))
    assert to_result._other_sides(surface, found, [0, 1, 2, 3]) == {1}


def test_a_step_covers_the_part_of_its_face_beyond_its_edge():
    """An edge across the box at a quarter of its half length from the middle leaves 75 of 200 mm."""
    surface, top = top_of_the_box()
    frame = shape_models.Frame(np.array([100.0, 50.0, 50.0]), np.eye(3), np.array([100.0, 50.0, 25.0]), 50.0)
    judged = SignificantShape(
        shape=shape_models.Shape("step", (0, 0.25), np.array([-3.0, 0.0])),  # outward and across
        peak=-3.0, ci95=0.2, volume_ci95=700.0, z=9.0, chance=0.0, margin=9.0,
    )  # fmt: skip
    seen = np.ones(len(surface.share))
    search = SimpleNamespace(field=SimpleNamespace(surface=surface, seen=seen), hidden=seen < 1.0)
    values = to_result._shape_defect(search, ComponentShape(0, frame, None, None), top.cells, judged).values
    assert values["extent"] == pytest.approx([75.0, 100.0])
    assert values["area_mm2"] == pytest.approx(75.0 * 100.0, rel=0.1)  # whole cells of 20 mm
    assert (values["depth_max"], values["depth_mean"]) == pytest.approx((3.0, 3.0))
    assert values["volume_mm3"] == pytest.approx(3.0 * values["area_mm2"])
    assert values["centre"][0] == pytest.approx(125.0 + 0.5 * 75.0, abs=10.0)


@pytest.mark.parametrize(("most", "cell"), [(120, 20.0), (3, 60.0)])
def test_a_picture_has_the_cells_of_the_search_or_larger_ones_where_these_are_too_many(most, cell, monkeypatch):
    """Deviations that rise along the face: a cell of a picture has the mean of its three by three."""
    monkeypatch.setattr(defect_grids, "MOST_SIDE", most)
    surface, top = top_of_the_box()
    along = surface.centres @ surface.charts.axes[top.chart, 0]
    field = SimpleNamespace(surface=surface, deviation=along, variance=np.ones(len(along)), count=np.ones(len(along)))
    centre = np.array([100.0, 50.0, 50.0])
    (picture,) = defect_grids.of_defects([(centre, top.cells[:3], field, 0)])
    assert picture.cell == cell
    whole = picture.deviation[: int(along[top.cells].max() - along[top.cells].min() + 20.0) // int(cell)]
    at = centre @ surface.charts.axes[top.chart, 0] + picture.low[0] + cell * (np.arange(len(whole)) + 0.5)
    np.testing.assert_allclose(whole[np.isfinite(whole)], np.broadcast_to(at[:, None], whole.shape)[np.isfinite(whole)])
    assert np.isfinite(whole).sum() >= len(top.cells) / (cell / 20.0) ** 2 - 1
    assert picture.part.sum() == (3 if cell == 20.0 else 1)


@pytest.mark.parametrize("inward", [1.0, -1.0])
@pytest.mark.parametrize(("by_cells", "taken"), [(2.0, True), (1.2, False)])
def test_a_small_bump_is_as_deep_as_its_points_where_cells_show_at_least_a_quarter_of_it(inward, by_cells, taken):
    """6 exp(-(r / 15)^3): by the points it has its depth and the curvature 2 * 6 / 15^2 of the form, in 1 / m."""
    surface, region = top_of_the_box()
    middle = surface.charts.low[region.chart] + 10.0 * surface.charts.shape[region.chart]
    uv = middle + np.random.default_rng(0).uniform(-40.0, 40.0, (3_000, 2))
    deviation = -inward * 6.0 * np.exp(-((np.linalg.norm(uv - middle, axis=1) / 15.0) ** 3))
    field = SimpleNamespace(
        surface=surface,
        alignment=alignment.none(surface, 1, error_mm=1.0),
        noise=np.full(len(surface.share), 0.1),
        stations_sd=lambda cells: 0.75,
    )
    points = SimpleNamespace(about=lambda *_: (uv, deviation), field=field)
    rest = dict.fromkeys((one.name for one in dataclasses.fields(measures.Measures)), 0.0)
    known = {"centre": np.array([100.0, 50.0, 50.0]), "axes": np.eye(3), "diameter": 40.0}
    cells = measures.Measures(**rest | known | {"depth_max": inward * by_cells})
    found = measures.refined(cells, region, points, np.zeros(0), 0.0)
    if not taken:  # a fit to the rest of the points that deviate less than the cells allow is not believed
        assert found is cells
        return
    assert found.depth_max == pytest.approx(inward * 6.0, rel=1e-5)  # as least squares converges
    assert found.curvature_per_m == pytest.approx(2.0 * 6.0 / 15.0**2 * 1000.0, rel=1e-4)
    assert found.diameter == pytest.approx(30.0 * np.log(50.0) ** (1.0 / 3.0), rel=1e-4)  # where it is a fiftieth
    assert found.depth_ci95 == pytest.approx(1.96 * 1.25, rel=1e-4)  # 1 mm of the pose and 0.75 of views


def test_cells_within_30_mm_of_a_steps_edge_mix_both_sides():
    """An edge across the box at a quarter of its half length from the middle; a cell and a half of 20 mm."""
    surface = surface_charts.of_mesh(*box_mesh(), 20.0)
    frame = shape_models.Frame(np.array([100.0, 50.0, 25.0]), np.eye(3), np.array([100.0, 50.0, 25.0]), 50.0)
    step, bend = (shape_models.Shape(kind, (0, 0.25), np.ones(1)) for kind in ("step", "bend"))
    fit = ComponentShape(0, frame, None, None)
    cells = component_deviations.jumps(surface, [fit], {0: [bend, step]})
    np.testing.assert_array_equal(cells, np.flatnonzero(np.abs(surface.centres[:, 0] - 125.0) <= 30.0))
    assert len(component_deviations.jumps(surface, [fit], {0: [bend]})) == 0


def box_mesh():
    mesh = trimesh.creation.box(bounds=[[0, 0, 0], [200, 100, 50]])
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def test_bodies_are_components_even_where_their_corners_coincide():
    vertices, faces = box_mesh()
    both = np.vstack([vertices, vertices + np.array([200.0, 0.0, 0.0])])
    bodies = DesignBodies(("left", "right"), np.repeat([0, 1], 12))
    surface = surface_charts.of_mesh(both, np.vstack([faces, faces + 8]), 20.0, bodies)
    assert surface.names == ("left", "right")
    assert np.bincount(surface.charts.component).tolist() == [6, 6]
    assert surface_charts.of_mesh(both, np.vstack([faces, faces + 8]), 20.0).names == ("component-1",)


@pytest.mark.usefixtures("cad_here")
def test_names_of_a_step_file_reach_the_results(tmp_path):
    whole = cq.Assembly(name="row")
    for k, name in enumerate(("web", "rib", "flange")):
        whole.add(box(300.0 * k, 0, 0, 200, 100, 50), name=name)
    path = tmp_path / "row.step"
    whole.export(str(path))
    _, faces, bodies, _ = cad.read(path, "mm")
    assert bodies.names == ("web", "rib", "flange")
    assert bodies.of_facet.tolist() == np.repeat([0, 1, 2], len(faces) // 3).tolist()
    assert (bodies.shared, bodies.unnamed) == (0, 0)


def test_bodies_of_one_name_and_without_a_name_are_numbered_and_counted():
    named = cad._named(["web", "web (2)", "web", "design-4"], [1, 2, 1, 1])
    assert named.names == ("web", "web (2)", "web (3)", "body 4")
    assert named.of_facet.tolist() == [0, 1, 1, 2, 3]
    assert (named.shared, named.unnamed) == (2, 1)
    said = [one.code for one in detect._of_names(named)]
    assert said == ["defects.names-shared", "defects.names-missing"]


def test_uncertainty_of_a_movement_at_an_unseen_corner_equals_its_scatter():
    """Of a beam of which a third was seen, the fitted movement of the far end is turned by the noise of that third."""
    frame = shape_models.Frame(np.zeros(3), np.eye(3), np.array([1500.0, 150.0, 6.0]), 150.0)
    rng, sigma, trials = np.random.default_rng(4), 0.2, 300
    places = np.stack([rng.uniform(-1500.0, -500.0, 80), rng.uniform(-150.0, 150.0, 80), np.full(80, 6.0)], axis=1)
    up, weight = np.tile([0.0, 0.0, 1.0], (80, 1)), np.full(80, sigma**-2)
    corners, z, beyond = np.array([[1500.0, 150.0, 6.0], [-1000.0, 0.0, 6.0]]), [], 0
    for _ in range(trials):
        blocks = shape_models.Blocks(places, up, rng.normal(0.0, sigma, 80), weight, 50.0)
        seen = shape_models.Observations(blocks, frame, places, up)
        (shape,) = seen.shapes([(shape_models.RIGID, ())])
        z.append(shape.values(frame, corners, up[:2]) / shape.sd(frame, corners, up[:2]))
        everywhere = np.abs(shape.values(frame, places, up)) / shape.sd(frame, places, up)
        beyond += component_deviations.deviate_of_one(float(everywhere.max()), len(shape.factors)) > 1.96
    # Four sds of a root mean square; and a bound, for the three factors that are seen of six.
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(z), axis=0)), 1.0, atol=4.0 / np.sqrt(2.0 * trials))
    assert beyond < 0.05 * trials + 3.0 * np.sqrt(0.05 * trials)
