"""Figures of results compared with a truth, by results made by hand: values within their intervals are counted."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from processor.defects.result import Result as DefectsResult
from processor.deviation.result import Result as DeviationResult
from processor.evaluation import defects, deviation, error_statistics, inspection, space_frame, stitching
from processor.geometry import rigid
from processor.inspection.result import AxisDepartures, InspectedComponent, Quantity
from processor.model import (
    BodyTruth,
    DefectTruth,
    DesignBodies,
    FrameTruth,
    PoseTruth,
    RecordError,
    Scan,
    Scene,
    StationTruth,
    Statistic,
    StructureDesign,
    StructureTruth,
    Truth,
)
from processor.space_frame.result import Tubes
from processor.stitching.result import Pairs, Scans
from processor.stitching.result import Result as StitchResult
from tests.support.clouds import arch_clouds
from tests.support.results import ball_results, surface_rows

ROUNDING_MM = 1e-6  # float64 at 90 m is 1e-11: of inverse transforms
PROJECT = rigid.transform(rigid.rotation_from_vector(np.array([0.1, -0.2, 2.0])), np.array([9e4, -3e4, 700.0]))


def figures(metrics):
    return {one.name: one for one in metrics}


# --- deviation --------------------------------------------------------------------------------------------------------


def slab(error, turn=0.0, half=True, by_stations=(), posed=(False,)):
    """A slab of which x > 0 moved up by 5 mm, measured ``error`` too high with an LOD95 of 0.5, in a frame of its own.

    The pose found is turned by ``turn`` mrad about the middle of the part that did not move.
    """
    x, y = (
        v.ravel() for v in np.meshgrid(np.arange(-2000.0, 2000.0, 50.0) + 25.0, np.arange(-500.0, 500.0, 50.0) + 25)
    )
    at = np.column_stack([x, y, 0.0 * x])
    up = np.tile([0.0, 0.0, 1.0], (len(at), 1))
    moved = 5.0 * (x > 0.0) * half
    middle = np.array([-1000.0, 0.0, 0.0]) if half else np.zeros(3)
    R = rigid.rotation_from_vector(np.array([0.0, 1e-3 * turn, 0.0]))
    off = rigid.transform(R, middle - R @ middle)
    seen = at + moved[:, None] * up
    core = surface_rows.core_points(at, up, rigid.apply(off, seen)[:, 2] + error, 0.5)
    found = core.distance
    result = DeviationResult(
        status="ok", method="default", T_design_scan=off @ PROJECT, core=core, covariance=1e-6 * np.eye(6),
        min_ci95=found.min() + np.array([-0.5, 0.5]), max_ci95=found.max() + np.array([-0.5, 0.5]),
        mean_ci95=found.mean() + np.array([-0.045, 0.045]),
    )  # fmt: skip
    truth = Truth(structure=StructureTruth(at, up, moved[:, None] * up), pose=PoseTruth(PROJECT, by_stations))
    poses = [{"T_project_scan": np.eye(4)} if known else {} for known in posed]
    scene = Scene("slab", "structure", tuple(Scan(f"s{k}", at, **pose) for k, pose in enumerate(poses)))
    return figures(deviation.check(scene, result, truth))


def test_deviations_are_evaluated_against_the_truth_in_the_frame_of_the_structure():
    found = slab(0.3)
    # The truth is a plane through the nearest points: at the step it is neither side's.
    assert found["deviations within their 95 % intervals"].value > 95.0
    assert found["least and greatest deviations within their 95 % intervals"].value == 100.0
    assert found["unmoved steel beyond LOD95"].value == found["moved steel within LOD95"].value == 0.0
    assert found["pose, shift of the middle"].value == pytest.approx(0.0, abs=ROUNDING_MM)
    assert (found["pose, shift of the middle"].limit, found["pose, turn"].limit) == (0.5, 0.05)
    beyond = slab(0.7)
    assert beyond["deviations within their 95 % intervals"].value < 5.0  # none but at the step
    assert beyond["unmoved steel beyond LOD95"].value == 100.0


def test_deviations_of_scans_that_came_without_poses_are_not_evaluated():
    assert slab(0.1, posed=(True, False)) == slab(0.1, posed=(False, False)) == {}
    assert slab(0.1, posed=(True, True)).keys() == slab(0.1, posed=(False,)).keys() != set()


def test_bodies_that_touch_have_each_its_own_truth():
    """Two plates side by side, one 3 mm up: with bodies named, the truth beside the joint is that of each plate."""
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 2000.0, 50.0) + 5.0, np.arange(0.0, 1000.0, 50.0)))
    at, of_point = np.stack([x, y, np.zeros(len(x))], axis=1), (x > 1000.0).astype(np.int32)
    # The edge of the second plate, seen from the first, faces it: its points are of no face that core points are on.
    edge = np.stack([np.full(20, 1000.0), np.arange(20) * 50.0, np.full(20, -2.0)], axis=1)
    at, of_point = np.vstack([at, edge]), np.append(of_point, np.ones(20, np.int32))
    up = np.vstack([np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.tile([-1.0, 0.0, 0.0], (20, 1))])
    moved = 3.0 * of_point[:, None] * [0.0, 0.0, 1.0]
    bodies = BodyTruth(("a", "b"), of_point, [[0.0] * 3, [0.0, 0.0, 3.0]], np.zeros((2, 3)))
    core = surface_rows.core_points(at[: len(x)], up[: len(x)], moved[: len(x), 2], 0.1)
    result = DeviationResult(status="ok", method="default", T_design_scan=np.eye(4), core=core)
    name, scene = "deviations within their 95 % intervals", Scene("plates", "structure", (Scan("s", at),))
    of_bodies = figures(deviation.check(scene, result, Truth(structure=StructureTruth(at, up, moved, bodies))))
    assert of_bodies[name].value == 100.0
    assert of_bodies["unmoved steel beyond LOD95"].value == of_bodies["moved steel within LOD95"].value == 0.0
    assert figures(deviation.check(scene, result, Truth(structure=StructureTruth(at, up, moved))))[name].value < 90.0
    with pytest.raises(RecordError, match="a row for each of 5 points, found 820"):
        StructureTruth(at[:5], up[:5], moved[:5], bodies)


def test_near_points_of_the_truth_count_more_by_their_squared_distance_and_50_mm():
    """One point moved by 1 mm, four about it stay: of weights 1 / 50^2 and 1 / (3 50^2 + 50^2) it has a half."""
    ring = 50.0 * np.sqrt(3.0) * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    at, up = np.vstack([np.zeros(3), ring]), np.tile([0.0, 0.0, 1.0], (5, 1))
    core = surface_rows.core_points(at[:1], up[:1], np.zeros(1), 0.1)
    result = DeviationResult(status="ok", method="default", T_design_scan=np.eye(4), core=core)
    truth = StructureTruth(at, up, np.diag([1.0, 0.0, 0.0, 0.0, 0.0])[:, [1, 2, 0]])
    # The bound of 1e-12 that keeps the equations solvable, beside weights of 1e-3.
    assert deviation.true_deviation(result, truth, np.eye(4)) == pytest.approx(0.5, rel=1e-8)


def test_turned_pose_shows_in_its_error_and_in_significant_unmoved_steel():
    found = slab(0.0, turn=1.0)
    assert found["pose, turn"].value == pytest.approx(1.0, rel=1e-6)  # sine of 1e-3
    assert found["pose, shift of the middle"].value == pytest.approx(0.0, abs=ROUNDING_MM)
    # Of the unmoved part what is farther than 500 mm from its middle is 0.5 mm off, of 2000 mm.
    assert found["unmoved steel beyond LOD95"].value == pytest.approx(50.0, abs=3.0)  # of 40 rows of points: 2.5 % each
    assert found["deviations within their 95 % intervals"].value > 95.0  # what is true of that pose


def test_limits_of_a_pose_include_the_motion_by_station_errors():
    """99 % of the draws of a motion by the covariance that the truth states, beside what the method may be off by."""
    rng = np.random.default_rng(0)
    turns, shifts = 25e-6 * rng.standard_normal((200_000, 3)), 0.12 * rng.standard_normal((200_000, 3))
    most_turn, most_shift = (np.quantile(np.linalg.norm(x, axis=1), 0.99) for x in (turns, shifts))
    about_middle = np.diag([25e-6**2] * 3 + [0.12**2] * 3)
    found = slab(0.0, turn=0.09, by_stations=rigid.about_origin(about_middle, np.array([-1000.0, 0.0, 0.0])))
    # A quantile of 99 % of 200,000 draws is known to 0.3 %.
    assert found["pose, turn"].limit == pytest.approx(np.hypot(0.05, 1e3 * most_turn), rel=0.01)
    assert found["pose, shift of the middle"].limit == pytest.approx(np.hypot(0.5, most_shift), rel=0.01)
    assert found["pose, turn"].passed
    assert not slab(0.0, turn=0.09)["pose, turn"].passed


def test_steel_as_designed_has_the_mean_and_the_pose_of_the_truth():
    found = slab(0.04, half=False)
    assert found["mean of steel as designed"].value == pytest.approx(0.04)
    assert found["mean of steel as designed"].passed
    assert found["means within their 95 % intervals"].value == 100.0  # 0.04 of 0.045
    beyond = slab(-0.06, half=False)
    assert not beyond["mean of steel as designed"].passed
    assert beyond["means within their 95 % intervals"].value == 0.0
    assert found["poses within their 95 % intervals"].value == 100.0
    assert slab(0.04, half=False)["wrong poses called ok"].passed
    assert not slab(0.04, turn=3000.0, half=False)["wrong poses called ok"].passed
    assert slab(0.04, turn=10.0, half=False)["poses within their 95 % intervals"].value == pytest.approx(500.0 / 6.0)


# --- defects ----------------------------------------------------------------------------------------------------------


def test_depths_and_volumes_have_their_coverage_and_parts_that_are_gone_have_none():
    found = surface_rows.defects(
        defect_class=("dent", "bulge", "missing-part"), component=("web",) * 3, centre=np.diag([1e3, 2e3, 3e3]),
        area_mm2=[900.0, 1000.0, 5000.0], depth_max=[5.2, -8.0, 0.0], depth_ci95=[0.3, 0.3, 0.3],
        volume_mm3=[1500.0, -2600.0, 0.0], volume_ci95=[50.0, 50.0, 50.0],
    )  # fmt: skip
    nan = float("nan")
    truth = DefectTruth(
        ids=[1, 2, 3], classes=("dent", "bulge", "missing-part"), components=("web",) * 3,
        centres=np.diag([1e3, 2e3, 3e3]), area_mm2=[1000.0, 1000.0, 5000.0], depth_max_mm=[5.0, -9.0, nan],
        volume_mm3=[1460.0, -2620.0, nan],
    )  # fmt: skip
    result = DefectsResult(status="ok", method="default", defects=found, examined_mm2=1e6)
    told = figures(defects.check(Scene("s", "structure"), result, Truth(defects=truth)))
    assert told["depths within their 95 % intervals"].value == 50.0  # 0.2 of 0.3; 1.0 of 0.3
    assert told["volumes within their 95 % intervals"].value == 100.0
    assert (told["depths, number"].value, told["areas, bias"].value) == (2.0, pytest.approx(-5.0))
    assert told["depth error, max"].value == pytest.approx(1.0)


def of_bodies(*rows):
    """Return the figures of defects by class, component, place along x, depth and side; b moved, a has a dent at 0."""
    classes, components, x, depth, side = zip(*rows, strict=True)
    found = surface_rows.defects(
        defect_class=classes, component=components, centre=np.outer(x, [1.0, 0.0, 0.0]), depth_max=depth,
        axes=np.multiply.outer(side, np.eye(3)),
    )  # fmt: skip
    true = DefectTruth(
        ids=[0, 1], classes=("dent", "misalignment"), components=("a", "b"), centres=[[0.0] * 3, [1e3, 0.0, 0.0]],
        area_mm2=[1e4, 1e4], depth_max_mm=[5.0, 5.0], volume_mm3=[0.0, 0.0],
    )  # fmt: skip
    moved = BodyTruth(("a", "b"), np.zeros(1, np.int32), [[0.0] * 3, [5.0, 0.0, 0.0]], np.zeros((2, 3)))
    structure = StructureTruth(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)), moved)
    design = StructureDesign("s", np.zeros((3, 3)), [[0, 1, 2]], DesignBodies(("a", "b"), [0]))
    result = DefectsResult(status="ok", method="default", defects=found, examined_mm2=1e6)
    scene, truth = Scene("s", "structure", structure=design), Truth(structure=structure, defects=true)
    told = figures(defects.check(scene, result, truth))
    names = (
        "defects of another body than the true one",
        "moved bodies that are not one misalignment",
        "bodies called misaligned that did not move",
        "other sides of dents and bulges",
    )
    return [*(told[name].value for name in names), told["false alarms"].value]


DENT, MOVED = ("dent", "a", 0.0, 5.0, 1.0), ("misalignment", "b", 1000.0, 5.0, 1.0)


def test_defects_are_matched_with_the_truth_by_body_names():
    assert of_bodies(DENT, MOVED) == [0, 0, 0, 0, 0]
    assert of_bodies(("dent", "b", 0.0, 5.0, 1.0), MOVED) == [1, 0, 0, 0, 0]
    assert of_bodies(("misalignment", "a", 0.0, 5.0, 1.0), MOVED) == [0, 0, 1, 0, 0]
    assert of_bodies(DENT, MOVED, ("misalignment", "b", 1010.0, 5.0, 1.0)) == [0, 1, 0, 0, 1]
    assert of_bodies(DENT, ("misalignment", "a", 1000.0, 5.0, 1.0), MOVED) == [0, 0, 1, 0, 1], "by its name"
    assert of_bodies(DENT) == [0, 1, 0, 0, 0]


def test_the_other_side_of_a_dented_plate_is_no_false_alarm():
    assert of_bodies(DENT, MOVED, ("unknown", "a", 30.0, -4.0, -1.0)) == [0, 0, 0, 1, 0]
    assert of_bodies(DENT, MOVED, ("unknown", "a", 30.0, -4.0, 1.0)) == [0, 0, 0, 0, 1], "the same side"
    assert of_bodies(DENT, MOVED, ("unknown", "b", 30.0, -4.0, -1.0)) == [0, 0, 0, 0, 1], "another body"
    assert of_bodies(DENT, MOVED, ("unknown", "a", 30.0, 4.0, -1.0)) == [0, 0, 0, 0, 1], "inward, too"
    assert of_bodies(DENT, MOVED, ("unknown", "a", 90.0, -4.0, -1.0)) == [0, 0, 0, 0, 1], "beside it"
    assert of_bodies(DENT, MOVED, ("unknown", "b", 1030.0, -4.0, -1.0)) == [0, 0, 0, 0, 1], "what moved has no dent"


# --- stitching --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shift", "share"), [(0.15, 100.0), (0.25, 500.0 / 6.0)])
def test_poses_of_pairs_are_compared_with_the_truth_in_any_frame(shift, share):
    """Standard deviations of 0.1 mm and 0.01 mrad at a frame's origin 90 m off: one axis is off by ``shift``."""
    true = np.stack([np.eye(4), PROJECT])
    T_a_b = rigid.transform(np.eye(3), np.array([shift, 0.0, 0.0])) @ PROJECT
    nan = np.full((2, 3), np.nan)
    scans = Scans(
        name=("a", "b"), status=("ok", "ok"), reasons=((), ()), T_project_scan=true,
        covariance=np.zeros((2, 6, 6)), position=true[:, :3, 3], position_sd=nan, rotation_sd=nan,
        rivalry=np.zeros(2), T_rival_scan=np.full((2, 4, 4), np.nan), from_frame=("a", "b"), to_frame=("p", "p"),
    )  # fmt: skip
    pairs = Pairs(
        a=("a",), b=("b",), overlap=[0.5], residual=[0.1], used=[True], reasons=((),), shared=[9], T_a_b=T_a_b[None],
        covariance=np.diag([1e-5] * 3 + [0.1] * 3)[None] ** 2, scale=[1.0002], scale_sd=[0.0001],
        from_frame=("b",), to_frame=("a",),
    )  # fmt: skip
    result = StitchResult(status="ok", method="automatic", reference="a", scans=scans, pairs=pairs)
    truth = Truth(stations=StationTruth(("a", "b"), true, np.zeros(2), np.zeros(2), np.zeros((2, 2))))
    told = figures(stitching.check(Scene("s", "structure"), result, truth))
    assert told["poses of pairs within their 95 % intervals"].value == pytest.approx(share)
    assert told["scales within their 95 % intervals"].value == 0.0


# --- inspection -------------------------------------------------------------------------------------------------------


def test_the_true_width_and_sweep_of_a_part_are_of_both_edges():
    """A left edge 2 mm and a right edge 0.5 mm to the left of the design's: 1.5 mm wider, and straight."""
    design = arch_clouds.design()
    part, chainage, zero = design.parts[1], np.linspace(500.0, 4500.0, 5), np.zeros(5)
    edges = np.stack([part.bottom_edge_left, part.bottom_edge_right])
    edges[:, :, 1] += [[2.0], [0.5]]
    ends = np.array(inspection.design_ends(design, 1))
    truth = SimpleNamespace(names=(part.name,), key_points_bridge=ends[None], edges_bridge=edges[None])
    component = InspectedComponent(name=part.name, axis=AxisDepartures(chainage, zero, zero, zero, zero))
    true = inspection._of_part(design, component, truth)
    assert true["middle-width-bottom"] == pytest.approx(1.5, abs=ROUNDING_MM)
    assert true["sweep"] == pytest.approx(0.0, abs=ROUNDING_MM)


def test_errors_of_characteristics_have_the_rms_of_their_kind():
    """Errors of 0.3 and -0.4 mm of two lengths: sqrt((0.09 + 0.16) / 2); a bow has no sign."""
    design = arch_clouds.design()
    part = design.parts[1]
    edges = np.stack([part.bottom_edge_left, part.bottom_edge_right])
    ends = np.array(inspection.design_ends(design, 1))
    arch = SimpleNamespace(names=(part.name,), key_points_bridge=ends[None], edges_bridge=edges[None])
    at = np.linspace(500.0, 4500.0, 5)
    straight = InspectedComponent(name=part.name, axis=AxisDepartures(at, *np.zeros((4, 5))))
    ids = sorted(inspection._of_part(design, straight, arch))[:2]
    measured = SimpleNamespace(
        id=[*ids, "unknown"],
        quantity=[Quantity.LENGTH, Quantity.LENGTH, Quantity.LENGTH],
        unit=["mm", "mm", "mm"],
        deviation=np.array([0.3, -0.4, 9.0]),
        ci95=np.array([0.35, 0.35, 1.0]),
    )
    component = SimpleNamespace(name=part.name, axis=straight.axis, characteristics=measured)
    scene = SimpleNamespace(arch=design)
    truth = SimpleNamespace(arch=arch, frame=None, structure=None)
    found = {
        one.statistic: one.value for one in inspection.check(scene, SimpleNamespace(components=[component]), truth)
    }
    assert found[Statistic.RMS] == pytest.approx(np.sqrt(0.125), abs=ROUNDING_MM)
    assert found[Statistic.COVERAGE] == 50.0


def test_true_lengths_of_a_body_far_from_the_origin_are_those_of_its_ends():
    """A plate in coordinates of a map, one end moved by 2 mm along it and the other by -0.5 mm."""
    plate = trimesh.creation.box([800.0, 600.0, 400.0]).apply_translation([5e6, 3e6, 400.0])
    design = StructureDesign("plate", np.array(plate.vertices), np.array(plate.faces, np.int64))
    points, facet = trimesh.sample.sample_surface_even(plate, 4_000, seed=1)
    normals = np.array(plate.face_normals[facet])
    moved = np.select([normals[:, 0] > 0.5, normals[:, 0] < -0.5], [2.0, -0.5])[:, None] * [1.0, 0.0, 0.0]
    (found,) = inspection._of_bodies(design, StructureTruth(np.array(points), normals, moved)).values()
    assert found.pop("length") == pytest.approx(2.5)
    assert list(found.values()) == pytest.approx([0.0] * len(found), abs=1e-9)


# --- balls ------------------------------------------------------------------------------------------------------------


def test_sizes_that_are_called_wrong_are_counted():
    balls = ball_results.balls(method="ray", radii=(45.5, 60.0, 55.0), flag=("ok", "wrong-size", "wrong-size"))
    of = balls.balls
    true = FrameTruth(of.ids, np.zeros((3, 3)), of.nominal_radii + np.array([-5.0, 0.1, 0.2]), np.zeros((3, 3)))
    rows = np.arange(3)
    found = {one.quantity: one for one in space_frame._sizes(of, true, rows, rows, True)}
    assert found["right sizes called wrong"].value == 2.0
    assert found["right sizes called wrong"].limit == 0.0
    assert found["wrong sizes called right"].value == 1.0


def test_tubes_are_compared_with_the_lines_between_the_true_centres():
    """A tube may end anywhere along them; across it is 0.2, 0.2, 0.1 mm off at the start, twice that at the end."""
    along, off = np.array([[1.0, 2.0, 2.0]]) / 3.0, 0.1 * np.array([[2.0, -2.0, 1.0]])
    quarter = np.full((1, 3), 0.25)
    tubes = Tubes(
        a=np.array([7]), b=np.array([8]), start=300.0 * along + off, end=2500.0 * along + 2.0 * off,
        radii=np.array([30.4]), radius_ci95=np.array([0.3]), start_ci95=quarter, end_ci95=quarter,
    )  # fmt: skip
    true = FrameTruth(np.array([7, 8]), np.vstack([0.0 * along, 3000.0 * along]), np.full(2, 60.0), np.zeros((2, 3)))
    design = SimpleNamespace(member_a=np.array([8]), member_b=np.array([7]), tube_diameters=np.array([60.0]))
    found = space_frame._tubes(
        SimpleNamespace(frame=design),
        SimpleNamespace(tubes=tubes, balls=SimpleNamespace(ids=np.array([7, 8]))),
        SimpleNamespace(frame=true, as_built=None),
        np.arange(2),
    )
    shares = {one.quantity: one.value for one in found if one.statistic == Statistic.COVERAGE}
    assert shares == {"radii of tubes": 0.0, "axes of tubes": pytest.approx(100.0 * 4 / 6)}


# --- shares -----------------------------------------------------------------------------------------------------------


def test_errors_without_an_interval_are_not_counted():
    nan = float("nan")
    told = {
        one.statistic: one.value
        for one in error_statistics.covered("x", np.array([0.5, 2.0, 1.0, nan]), np.array([1.0, 1.0, nan, 1.0]))
    }
    assert (told[Statistic.COVERAGE], told[Statistic.NUMBER]) == (50.0, 2.0)
    assert error_statistics.covered("x", np.array([nan]), np.array([1.0])) == []


@pytest.mark.parametrize(("errors", "efficiency"), [([0.3, -0.4], np.sqrt(8.0)), ([0.0, 0.0], np.nan)])
def test_the_efficiency_is_one_over_the_rms_of_errors_in_least_standard_deviations(errors, efficiency):
    """Errors of 0.3 and 0.4 of least standard deviations 1: 1 / sqrt(0.125); without errors there is none."""
    figures = error_statistics.signed("x", np.array(errors), np.ones(2))
    assert figures[-1].statistic == Statistic.EFFICIENCY
    assert figures[-1].value == pytest.approx(efficiency, nan_ok=True)
