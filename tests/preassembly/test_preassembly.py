"""The source paper's preassembly on a bridge made with numpy: attitudes, features, errors, and reported failures."""

import dataclasses
from unittest import mock

import numpy as np
import pytest

from processor import diagnostics
from processor.evaluation import preassembly as preassembly_evaluation
from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import InputError, Scene, Status, UsageError, Verdict, reason
from processor.preassembly import assembly_errors
from processor.preassembly import step as preassembly_step
from processor.preassembly.baselines import edge_features, joint_alignment, methods
from processor.preassembly.params import PAPER_METHODS, BoxParams, MatchParams, SliceParams, SystematicParams
from processor.preassembly.parts import attitude
from processor.registration import icp, pose_search
from tests.support.clouds import arch_clouds
from tests.support.scenes import known_attitudes

SPACING_MM = 10.0  # the paper's methods need it at every joint
KEY_POINT_MM = 0.12  # by faces of thousands of points with noise of 1 mm, extrapolated to corners


@pytest.fixture(scope="module")
def bridge():
    return arch_clouds.bridge(spacing_mm=SPACING_MM, sigma_mm=1.0, seed=1, count=3)


@pytest.fixture(scope="module")
def together():
    """Three parts, the result of the adjustment by few points, the truth, and the calls of the search for attitudes.

    The attitudes are the true ones: the search is tested by single parts.
    """
    scene, truth = arch_clouds.bridge(spacing_mm=30.0, sigma_mm=1.0, seed=1, count=3)
    find, kept = mock.Mock(side_effect=known_attitudes.find_by(truth)), {}
    with mock.patch.object(attitude, "find", find):
        adjusted = preassembly_step.run(scene, preassembly_step.Params(), kept)
        preassembly_step.run(scene, preassembly_step.Params(method="corner"), kept)
    return scene, truth, adjusted, find.call_args_list


@pytest.fixture(scope="module")
def runs(bridge):
    """Results of the paper's methods; features are common to the three."""
    scene, truth = bridge
    with mock.patch.object(attitude, "find", known_attitudes.find_by(truth)):
        parts = methods.extract(scene.scans, scene.arch, preassembly_step.Params(method="corner"))
    return {one: methods.assemble(parts, scene.arch, preassembly_step.Params(method=one)) for one in PAPER_METHODS}


def test_the_attitude_of_a_scan_is_searched_for_once_for_all_methods(together, monkeypatch):
    scene, _, _, calls = together
    by_part = {call.args[1].name: call.args[0] for call in calls}
    assert len(calls) == len(by_part) == len(scene.scans)
    find = mock.Mock(side_effect=InputError)  # alone, a method searches with the same points in the same order
    monkeypatch.setattr(attitude, "find", find)
    for scan, part in zip(scene.scans, scene.arch.parts, strict=True):
        with pytest.raises(InputError):
            methods.extract([scan], scene.arch, preassembly_step.Params(method="corner"))
        np.testing.assert_array_equal(find.call_args.args[0], by_part[part.name])


def test_a_symmetric_rib_without_its_mark_is_ambiguous(monkeypatch):
    rng = np.random.default_rng(0)
    points, T = arch_clouds.scan_points(2, 30.0, 1.0, rng), arch_clouds.random_pose(rng)
    monkeypatch.setattr(pose_search, "FINE_POINTS", 5_000)
    found = attitude.find(rigid.apply(T, points), bare_of_its_mark(arch_clouds.design().parts[2]))
    assert found.status == "ambiguous"
    assert [one.code for one in found.reasons] == ["preassemble.rival-rotation"]
    turns = [np.degrees(rigid.rotation_angle((pose @ T)[:3, :3])) for pose in (found.T_surface, found.T_rival)]
    # By the search's points alone: 1 mm over the root of hundreds, at half a metre.
    assert sorted(turns) == pytest.approx([0.0, 180.0], abs=0.5)
    assert found.reasons[0].values["degrees"] == pytest.approx(180.0, abs=0.5)


def bare_of_its_mark(part):
    whole = part.faces[: -2 * 800]  # the pad is the last face
    return dataclasses.replace(part, faces=whole, vertices=part.vertices[: whole.max() + 1])


@pytest.mark.slow
def test_a_scan_of_something_else_fits_no_attitude():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(20_000, 3))
    points = 3000.0 * ball / np.linalg.norm(ball, axis=1)[:, None]
    assert attitude.find(points, arch_clouds.design().parts[1]).status == "failed"


def test_surface_samples_lie_on_the_mesh_and_cover_it_evenly():
    part = arch_clouds.design().parts[1]
    surface = attitude.sample_surface(part)
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # A spacing of 30 mm: the mean of thousands of even samples is nearer than one of them.
    np.testing.assert_allclose(surface.points.mean(axis=0), (area @ (a + b + c)) / 3.0 / area.sum(), atol=30.0)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)


@pytest.mark.parametrize("turned", [False, True])
def test_surface_that_one_design_alone_has_is_its_mark(turned):
    part = arch_clouds.design().parts[2]
    surface, other = attitude.sample_surface(part), attitude.sample_surface(bare_of_its_mark(part))
    turn = rigid.rotation_from_vector(np.array([1e-4, -1e-4, np.pi * turned]))
    T = rigid.transform(turn, surface.centre - turn @ surface.centre)
    pad = part.vertices[part.faces[-2 * 800 :].ravel()]
    found = attitude.only_in(surface, T, other.mesh, np.eye(4))[0]
    on_pad = ((surface.points >= pad.min(axis=0)) & (surface.points <= pad.max(axis=0))).all(axis=1)
    assert on_pad.sum() > 10
    assert {tuple(one) for one in surface.points[on_pad]} <= {tuple(one) for one in found}
    assert turned or len(found) == on_pad.sum()


def box_end(spacing=4.0, sigma=0.0, width=900.0, height=1100.0, plate=24.0):
    """A straight box that ends at x = 0, in its joint's frame, sampled on outer, inner and end faces."""
    rng = np.random.default_rng(7)
    b, h = 0.5 * width, 0.5 * height
    clouds = []
    for inset in (0.0, plate):
        n = int(600.0 * 2.0 * (width + height) / spacing**2)
        t = rng.uniform(0.0, 4.0, n)
        side, q = np.floor(t), 2.0 * (t % 1.0) - 1.0
        y = np.select([side == 0, side == 1, side == 2], [q * b, b - inset, q * b], -(b - inset))
        z = np.select([side == 0, side == 1, side == 2], [h - inset, q * h, -(h - inset)], q * h)
        inside = (np.abs(y) <= b - inset) & (np.abs(z) <= h - inset)
        clouds.append(np.column_stack([rng.uniform(-600.0, 0.0, n), y, z])[inside])
    n = int(width * height / spacing**2)
    y, z = rng.uniform(-b, b, n), rng.uniform(-h, h, n)
    ring = (np.abs(y) >= b - plate) | (np.abs(z) >= h - plate)
    clouds.append(np.column_stack([np.zeros(n), y, z])[ring])
    points = np.vstack(clouds)
    return points + sigma * rng.normal(size=points.shape)


def test_reduced_boxes_find_the_inner_edges_of_the_plates():
    # As published: the point nearest to P lies on the end's inner edge, a plate's thickness inside the outer edge.
    cut = box_end(width=450.0, height=550.0)
    edges = edge_features.reduced_boxes(cut, 1.0, 4.0, BoxParams(edge_box_mm=36.0), np.random.default_rng(0))
    inner_b, inner_h = 225.0 - 24.0, 275.0 - 24.0
    expected = np.array(
        [[0, inner_b, -inner_h], [0, -inner_b, -inner_h], [0, -inner_b, inner_h], [0, inner_b, inner_h]]
    )
    # The nearest point to an edge is one of points 4 mm apart.
    np.testing.assert_allclose(edges.key_points[:4], expected, atol=4.0)
    np.testing.assert_allclose(edges.key_points[[4, 7]], [[0, 0, -inner_h], [0, inner_b, 0]], atol=4.0)
    cut, rng = box_end(8.0), np.random.default_rng(0)
    assert edge_features.reduced_boxes(cut[np.abs(cut[:, 1]) > 200.0], 1.0, 4.0, BoxParams(), rng) is None
    assert edge_features.reduced_boxes(cut[:20], 1.0, 4.0, BoxParams(), rng) is None


def test_an_edge_box_is_sized_by_the_middle_of_its_plate_where_side_walls_were_scanned_densely():
    """Of 120 mm of side walls at any depth the median would be of their depths, some 60 mm, not the plate's 24 mm."""
    rng, n = np.random.default_rng(0), 60_000
    walls = np.column_stack(
        [rng.uniform(-600.0, 0.0, n), rng.choice([-450.0, 450.0], n), rng.uniform(-550.0, 550.0, n)]
    )
    with diagnostics.recording() as notes:
        edge_features.reduced_boxes(np.vstack([box_end(16.0), walls]), 1.0, 4.0, BoxParams(), rng)
    boxes = {place: value for _, place, quantity, value in notes.rows if quantity == "L_edge_mm"}
    assert boxes["top"] == boxes["bottom"] == 1.5 * 24.0


def test_slices_follow_the_bottom_edges():
    rng = np.random.default_rng(3)
    points = arch_clouds.scan_points(2, 8.0, 0.5, rng)
    part = arch_clouds.design().parts[2]
    left, right = edge_features.slice_edges(points, np.eye(4), 8.0, 0.5, SliceParams())
    for found, design in ((left, part.bottom_edge_left), (right, part.bottom_edge_right)):
        offset = np.linalg.norm(Polyline.through(design).nearest(found)[1], axis=1)
        assert len(found) > 500
        assert np.median(offset) < 2.0 * 8.0  # spacings: the lowest of a slice
        # no points of the end faces, along which the lowest point of a slice moves up
        assert np.quantile(offset, 0.99) < 8.0 * 8.0


def test_linear_error_of_a_lifted_edge_by_hand():
    x = np.arange(0.0, 2000.0, 5.0)
    edge = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    design = Polyline.through(edge[[0, -1]])
    noisy = edge + np.array([0.0, 3.0, 4.0]) + np.random.default_rng(0).normal(0.0, 2.0, edge.shape)
    # Two points of five of the other edge are of an end face: the median of each interval does not see them.
    right = edge + np.where(np.arange(len(edge)) % 5 < 2, 50.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    found = assembly_errors.linear_error([assembly_errors.BottomEdges(noisy, right, design, design)], [np.eye(4)])
    assert set(found.edge) == {"left", "right"}
    left = np.array(found.edge) == "left"
    # The noise does not add to it: 2 mm over the root of 400 points is 0.1.
    assert found.deviation[left].mean() == pytest.approx(5.0, abs=0.3)
    np.testing.assert_allclose(found.deviation[~left], 0.0, atol=1e-12)  # float64
    assert np.diff(found.chainage[left]) == pytest.approx(200.0)


def test_splicing_error_by_hand():
    gaps = np.zeros((2, 8, 3))
    gaps[0, 0] = [-3.0, 1.0, 0.0]
    gaps[1, 7] = np.nan
    mean, largest = assembly_errors.splicing_error(gaps)
    assert mean == pytest.approx(4.0 / 45.0)
    assert largest == 3.0


def assembled(scene, truth, result):
    """Check what results of all methods have in common; return the error of the key points."""
    assert result.status == "ok"
    assert result.components.name == arch_clouds.NAMES[:3]
    assert result.splicing.mean < SPACING_MM
    checks = {metric.name: metric for metric in preassembly_evaluation.check(scene, result, truth)}
    assert checks["wrong poses called ok"].passed
    for left, right, gap, T_left, T_right in zip(
        result.components.key_points_scan[:-1, 1],
        result.components.key_points_scan[1:, 0],
        result.joints.gaps,
        result.components.T_bridge_scan[:-1],
        result.components.T_bridge_scan[1:],
        strict=True,
    ):
        # float64 at tens of metres
        np.testing.assert_allclose(rigid.apply(T_right, right) - rigid.apply(T_left, left), gap, atol=1e-9)
    return checks["key points in the scan, rms"].value


def test_every_method_of_the_paper_assembles_the_bridge(bridge, runs):
    for result in runs.values():
        # The key points lie on the inner edges: corners off by the root of the sum of two thicknesses squared, middles
        # by one thickness: 0.87 of it; the nearest point is off by some mm of a spacing.
        assert assembled(*bridge, result) == pytest.approx(np.hypot(24.0, 24.0) * 0.87, rel=0.2)
    # As found by the source paper: chained by joints alone, the bridge turns with Foot 1's attitude.
    mean = {method: run.linear.assembled.error.mean for method, run in runs.items()}
    assert mean["design-aided"] < 0.5 * mean["line"]
    assert mean["design-aided"] < 0.5 * mean["corner"]


def test_the_adjustment_assembles_the_bridge(together):
    scene, truth, result, _ = together
    joints, trade_off = result.joints, result.trade_off
    assert assembled(scene, truth, result) < KEY_POINT_MM
    off = result.components.key_points_scan - truth.arch.key_points_scan
    known = np.isfinite(result.components.key_points_sd)
    assert known.sum() == 4 * 8 * 3
    assert np.sqrt(((off / result.components.key_points_sd)[known] ** 2).mean()) < 1.3  # see below
    np.testing.assert_array_less(np.abs(joints.gaps), 2.0 * joints.gap_ci95)  # perfect parts: no gap but noise
    assert result.splicing.mean < KEY_POINT_MM
    assert set(joints.verdict) == {result.overall} == {Verdict.PASS}
    # A larger weight of the design moves the edges closer to it and widens the gaps.
    splicing, linear = trade_off.splicing_mean, trade_off.linear_mean
    assert (np.diff(trade_off.weight) < 0.0).all()
    # The adjustment ends within 1e-6 mm of its minimum.
    assert (np.diff(splicing) <= 1e-6).all()
    assert (np.diff(linear) >= -1e-6).all()


@pytest.mark.slow
def test_intervals_of_the_adjustment_are_no_larger_than_they_must():
    scene, truth = arch_clouds.bridge(spacing_mm=SPACING_MM, sigma_mm=1.0, seed=1)
    with mock.patch.object(attitude, "find", known_attitudes.find_by(truth)):
        # No part was bent by the sun
        params = preassembly_step.Params(systematic=SystematicParams(gradient_K=0.0))
        components = preassembly_step.run(scene, params).components
    off = components.key_points_scan - truth.arch.key_points_scan
    known = np.isfinite(components.key_points_sd)
    pull = (off / components.key_points_sd)[known]
    # An end has 19 independent coordinates of 24: 8 ends determine the ratio to a tenth.
    assert 0.7 < np.sqrt((pull**2).mean()) < 1.3
    for size in (off[known], components.key_points_sd[known]):
        assert np.sqrt((size**2).mean()) < KEY_POINT_MM


@pytest.mark.slow
def test_a_warm_bridge_is_assembled_at_the_reference_temperature(bridge):
    scene, truth = bridge
    grown = 1.0 + 12e-6 * 30.0
    warm = tuple(dataclasses.replace(s, points=s.points * grown) for s in scene.scans)
    result = preassembly_step.run(dataclasses.replace(scene, scans=warm, temperature_C=50.0), preassembly_step.Params())
    off = result.components.key_points_scan / grown - truth.arch.key_points_scan
    assert np.sqrt(np.nanmean(off**2)) < KEY_POINT_MM
    assert np.abs(result.joints.gaps).max() < 1.0  # a rib of 6 m grows by 2 mm
    assert reason("preassemble.temperature-corrected") in result.reasons


def ring(length=1400.0, height=1800.0, spacing=25.0):
    """Points along the four edges of a joint, centred."""
    y, z = np.arange(0.0, length, spacing), np.arange(0.0, height, spacing)
    sides = [(y, 0.0 * y), (y, 0.0 * y + height), (0.0 * z, z), (0.0 * z + length, z)]
    return np.vstack([np.column_stack([0.0 * a, a - 0.5 * length, b - 0.5 * height]) for a, b in sides])


def test_a_coarse_pose_is_sought_near_the_principal_axes():
    # The ring lies on itself when turned by 180 degrees about any axis: histograms alone find each of the four poses.
    source = ring()
    start = rigid.transform(rigid.rotation_from_vector(np.array([0.01, -0.02, 0.01])), np.array([30.0, -20.0, 10.0]))
    found = [joint_alignment._coarse(source, ring(), start, MatchParams(), np.random.default_rng(i)) for i in range(4)]
    for T, reasons in found:  # of points 25 mm apart at half a metre, and within a hundred millimetres: no half turn
        assert reasons == ()
        assert np.degrees(rigid.rotation_angle(T[:3, :3])) < 8.0
        assert np.linalg.norm(T[:3, 3]) < 100.0
    nowhere = MatchParams(pfh_limit_mm=1e-6)
    T, reasons = joint_alignment._coarse(source, ring(), start, nowhere, np.random.default_rng(0))
    assert [one.code for one in reasons] == ["preassemble.no-coarse-pose"]
    np.testing.assert_array_equal(T, start)


def test_point_to_line_icp_recovers_the_pose_along_the_lines():
    # Points of one end lie between those of the other; the ends themselves are the same.
    source = ring(spacing=25.0)[5:]
    corners = np.array([[0, 700, -900], [0, -700, -900], [0, -700, 900], [0, 700, 900.0], [0, 700, -900]])
    start = rigid.transform(rigid.rotation_from_vector(np.array([0.004, 0.003, -0.002])), np.array([3.0, 9.0, -8.0]))
    fine = icp.point_to_lines(source, [Polyline.through(corners)], start, max_iterations=200, tolerance=1e-9)
    # Steps along the lines converge linearly: 1e-9 of a step is 1e-2 mm of the rest.
    np.testing.assert_allclose(rigid.apply(fine.T_target_source, source), source, atol=0.01)
    far = icp.point_to_lines(source + 1e4, [Polyline.through(corners)], start, max_distance_mm=10.0)
    assert far.paired_share == 0.0


def test_edge_box_is_sized_by_the_plate_thickness():
    rng = np.random.default_rng(0)
    for plate in (16.0, 40.0):
        end, size = box_end(width=450.0, height=550.0, plate=plate), np.array([450.0, 550.0])
        cut = edge_features.cut_joint_end(end, np.eye(4), 1.0, size, BoxParams())
        across = cut[:, 2].max() - cut[:, 2]
        middle = across[np.abs(cut[:, 1]) < 150.0]
        # Half of the spacing of points at the plate's inner side, 1.5 times, less than a spacing of 4 mm
        assert edge_features.edge_box(middle, BoxParams()) == pytest.approx(1.5 * plate, abs=1.5)
        one_side = np.abs(rng.normal(size=500))
        assert edge_features.edge_box(one_side, BoxParams(plate_mm=20.0)) == 30.0
        assert edge_features.edge_box(middle, BoxParams(edge_box_mm=33.0)) == 33.0


@pytest.mark.slow
def test_a_part_that_leaves_a_wide_gap_is_called_weak(bridge, runs):
    scene, _ = bridge
    widest = np.abs(runs["corner"].joints.gaps).max(axis=(1, 2))
    limit = float(widest.mean())  # one of the two joints gapes wider
    found = preassembly_step.run(scene, preassembly_step.Params(method="corner", gap_limit_mm=limit))
    assert [one == "weak" for one in found.components.status] == [False, *(widest > limit)]
    assert found.status == "partial"
    assert [one.code for row in found.components.reasons for one in row].count("preassemble.wide-gap") == 1


@pytest.mark.slow
def test_origin_of_scans_does_not_change_the_gaps(bridge, runs):
    scene, _ = bridge
    far = np.array([5.0e8, 4.3e9, 1.0e5])
    moved = dataclasses.replace(scene, scans=tuple(dataclasses.replace(s, origin=far) for s in scene.scans))
    found = preassembly_step.run(moved, preassembly_step.Params(method="corner"))
    again, before = found.components, runs["corner"].components
    np.testing.assert_allclose(found.joints.gaps, runs["corner"].joints.gaps, rtol=0.0, atol=1e-9)  # float64 at 24 m
    ends = [rigid.apply(one.T_bridge_scan[1], one.key_points_scan[1, 0]) for one in (again, before)]
    # float64 at 4.3e9 mm is 1e-6, and sums of it.
    np.testing.assert_allclose(again.key_points_scan - far, before.key_points_scan, atol=1e-5)
    np.testing.assert_allclose(*ends, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off", "why"), [(0.0, "preassemble.no-joint-edges"), (600.0, "preassemble.joint-end-misplaced")]
)
def test_missing_joint_end_breaks_the_chain_with_a_reason(bridge, off, why):
    """The rest of the part ends beyond the search, or within it where its principal axes are off towards the joint."""
    scene, truth = bridge
    rib = scene.scans[2]
    T = truth.arch.T_bridge_scan[2]
    start = arch_clouds.CUTS[2] * arch_clouds.ARC
    middle = arch_clouds.position([start], [0.0], [550.0])
    near = np.linalg.norm(rigid.apply(T, rib.points) - middle, axis=1) < 1300.0  # its mark stays
    cut = dataclasses.replace(rib, points=rib.points[~near])
    by_axes = rigid.transform(np.eye(3), np.array([-off, 0.0, 0.0])) @ T
    known = {
        name: attitude.Attitude(one, one, Status.OK)
        for name, one in zip(truth.arch.names, truth.arch.T_bridge_scan, strict=True)
    }
    known[rib.component] = attitude.Attitude(by_axes, T, Status.OK)
    with mock.patch.object(attitude, "find", lambda _, part, *__: known[part.name]):
        scans = (*scene.scans[:2], cut)
        result = preassembly_step.run(dataclasses.replace(scene, scans=scans), preassembly_step.Params(method="line"))
    assert result.status == "partial"
    assert result.components.status == ("ok", "ok", "failed")
    (at_joint,) = (one for one in result.components.reasons[2] if one.code == "preassemble.at")
    ((code, values),) = ((one.code, one.values) for one in at_joint.values["reasons"])
    assert code == why
    # The sphere cuts the edges 1,089 mm from the joint at the corners, 1,219 mm in the middle of the webs.
    assert not off or 1_089.0 < values["distance"] < 1_219.0
    assert np.isnan(result.joints.gaps[1:]).all()


def test_uncorrected_temperature_is_reported(together, monkeypatch):
    scene, *_ = together
    monkeypatch.setattr(methods, "assemble", lambda *_: preassembly_step.Result("ok", "corner"))
    params = preassembly_step.Params(method="corner")
    kept = {"parts": [], "notes": diagnostics.Notes()}
    result = preassembly_step.run(dataclasses.replace(scene, temperature_C=31.5), params, kept)
    assert result.reasons == (reason("preassemble.temperature-not-corrected", temperature=31.5),)


def test_a_part_without_a_scan_does_not_end_the_bridge(together):
    scene, truth, *_ = together
    with mock.patch.object(attitude, "find", known_attitudes.find_by(truth)):
        found = preassembly_step.run(dataclasses.replace(scene, scans=scene.scans[:2]), preassembly_step.Params())
    assert (found.status, found.components.status) == (Status.PARTIAL, (Status.WEAK, Status.WEAK, Status.FAILED))
    assert [one.code for one in found.components.reasons[2]] == ["preassemble.no-scan"]
    assert np.isfinite(found.joints.gaps[0]).all()


def test_missing_design_scan_or_method_is_refused(together):
    scene, *_ = together
    with pytest.raises(InputError, match="arch-bridge design"):
        preassembly_step.run(Scene("x", "arch-bridge", scene.scans), preassembly_step.Params())
    with pytest.raises(InputError, match="expected scans of components foot1, rib1, rib2"):
        preassembly_step.run(dataclasses.replace(scene, scans=()), preassembly_step.Params())
    with pytest.raises(InputError, match="needs scans of all components, rib2 has none"):
        preassembly_step.run(dataclasses.replace(scene, scans=scene.scans[:2]), preassembly_step.Params(method="line"))
    twice = (*scene.scans, dataclasses.replace(scene.scans[1], name="again"))
    with pytest.raises(InputError, match=r"takes one scan per part, rib1 has several"):
        preassembly_step.run(dataclasses.replace(scene, scans=twice), preassembly_step.Params(method="line"))
    with pytest.raises(UsageError, match="unknown method 'magic'"):
        preassembly_step.run(scene, preassembly_step.Params(method="magic"))
