"""A whole ray-cast roof by method ray: blind, with its design, with one of another frame or of other nodes."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from designgen import recipe_files
from designgen.scenes.make import make
from processor import pipeline
from processor.adjustment import scanner_class_errors
from processor.evaluation import space_frame
from processor.geometry import rigid, thread_ranges
from processor.model import FrameDesign, Scan, Tolerance, reason
from processor.space_frame import to_result
from processor.space_frame.design.movement import judge
from processor.space_frame.points.source import SceneSource
from processor.space_frame.spheres import baselines
from processor.space_frame.step import Params, run
from tests.support.made import made
from tests.support.results.reasons import codes

ROOF = ["frame.nodes_x=6", "frame.nodes_y=5", "scan.stations=[2,2]", "scan.clutter=6", "scan.step_mrad=2.2"]


@pytest.fixture(scope="module")
def roof():
    return made(make, "roof", recipe_files.overridden(recipe_files.load("frame-1040")[1], ROOF), 3)


@pytest.fixture(scope="module")
def designed(roof):
    """The roof measured with its design."""
    return run(roof[0], Params())


def errors(result, truth, rows=slice(None)):
    """Distances (k,) of the balls of the design's nodes, in its order, from the true ones."""
    return np.linalg.norm(result.balls.centres[rows] - truth.frame.centres[rows], axis=1)


def test_every_ball_is_found_without_a_design(roof):
    scene, truth = roof
    with scanner_class_errors.without():  # its scanner has none
        result = run(dataclasses.replace(scene, frame=None), Params())
    assert result.status == "ok"
    assert len(result.balls.ids) == len(truth.frame.ids)
    checks = {one.name: one for one in space_frame.check(dataclasses.replace(scene, frame=None), result, truth)}
    assert all(metric.passed for metric in checks.values())
    assert checks["nodes found within 3 mm"].value == 100.0
    assert checks["nodes that are none"].value == 0.0
    assert "spheres.joined-only" in codes(result.reasons)
    # What stations that agree may be off together, 0.04 mm, is in the intervals alone. Those of the balls are 0.1 mm,
    # of points that four stations scatter: 0.603 came.
    assert 0.6 < checks["centres, rms of error by standard deviation"].value < 1.3


def test_rows_are_the_designs_nodes_in_its_order(roof, designed):
    (scene, truth), result = roof, designed
    assert result.balls.ids.tolist() == scene.frame.ids.tolist()
    assert result.movement_reference.gauge == "design-coordinates"
    assert errors(result, truth).max() < 0.6  # 0.29 came, as with a ball that was not built
    true = truth.frame.centres - scene.frame.centres
    with scanner_class_errors.without():
        balls = run(scene, Params()).balls
    pull = (balls.movement - true) / (balls.movement_ci95 / 1.96)
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 1.3  # as above: 0.72 came
    # An offset of all ranges lifts all nodes: a best fit takes that out, and leaves how its direction varies.
    added = [
        np.mean(getattr(result.balls, name)[:, 2] ** 2 - getattr(balls, name)[:, 2] ** 2)
        for name in ("design_ci95", "best_fit_ci95")
    ]
    assert 0.0 < added[1] < 0.1 * added[0]  # rays 1 in 3 off the vertical at the edges lift them by 5 % less


@pytest.mark.parametrize("stations", ["agree", "apart"])
def test_an_offset_that_all_ranges_have_in_common_is_inside_the_intervals(roof, stations):
    """All stations measure 0.5 mm too long, or two stand 0.8 mm off as well: no residual shows what they share."""
    scene, truth = roof
    scans = []
    for k, scan in enumerate(scene.scans):
        longer = scan.points * (1.0 + 0.5 / np.linalg.norm(scan.points, axis=1))[:, None]
        off = np.array([0.8 * (-1.0) ** k, 0.0, 0.0]) if stations == "apart" and k < 2 else np.zeros(3)
        scans.append(dataclasses.replace(scan, points=longer + off))
    balls = run(dataclasses.replace(scene, scans=tuple(scans)), Params()).balls
    height = np.abs(balls.centres - truth.frame.centres)[:, 2]
    # 0.5 mm are 1.6 sds of the mean of four that scatter by 0.5, and of 0.2.
    assert np.mean(height < 1.96 * np.sqrt(balls.covariance[:, 2, 2])) > 0.92


@pytest.mark.parametrize("stated", [None, "own"])
def test_a_list_of_nodes_in_coordinates_of_the_site_gives_the_sag_and_the_best_fit_beside_it(roof, stated):
    scene, truth = roof
    share = (truth.frame.centres - truth.frame.centres.min(axis=0)) / np.ptp(truth.frame.centres, axis=0)
    sag = np.column_stack([np.zeros((len(share), 2)), -4.0 - 42.0 * share[:, 0] ** 2 * share[:, 1]])
    listed = FrameDesign(scene.frame.ids, truth.frame.centres - sag, scene.frame.radii, coordinates=stated)
    result = run(dataclasses.replace(scene, frame=listed), Params())
    row = {number: k for k, number in enumerate(result.balls.ids.tolist())}
    rows = [row[number] for number in listed.ids.tolist()]
    by_design, by_fit = result.balls.design_movement[rows], result.balls.best_fit_movement[rows]
    assert np.abs(by_design - sag).max() < 0.5  # as above: 0.26 came
    assert result.gauges.largest_difference == pytest.approx(np.linalg.norm(by_design - by_fit, axis=1).max())
    assert result.gauges.largest_difference > 4.0  # else void
    answer = {None: by_design, "own": by_fit}[stated]
    np.testing.assert_array_equal(result.balls.movement[rows], answer)
    gauge, basis = {None: ("design-coordinates", "stations"), "own": ("best-fit", "stated")}[stated]
    assert (result.gauges.gauge, result.gauges.basis, result.movement_reference.gauge) == (gauge, basis, gauge)
    (matched,) = [one for one in result.reasons if one.code == "spheres.matched"]
    assert (matched.values["frame"] == "same frame") == (gauge == "design-coordinates")
    assert {f"spheres.{gauge}-{basis}"} < set(codes(result.reasons))


def test_order_chunks_and_threads_give_the_same_bytes(roof, designed, monkeypatch):
    (scene, _), first = roof, designed
    pools, pool = set(), thread_ranges._pool
    monkeypatch.setattr(thread_ranges, "usable", lambda: 3)
    monkeypatch.setattr(thread_ranges, "_pool", lambda count: (pools.add(count), pool(count))[1])
    monkeypatch.setattr(to_result, "SceneSource", partial(SceneSource, chunk_size=12_345))
    rng = np.random.default_rng(1)
    scans = []
    for scan in scene.scans:
        order = rng.permutation(len(scan.points))
        columns = {name: getattr(scan, name) for name in ("points", "intensity", "grid_row", "grid_column")}
        scans.append(dataclasses.replace(scan, **{k: v[order] if len(v) else v for k, v in columns.items()}))
    again = run(dataclasses.replace(scene, scans=tuple(scans)), Params())
    assert pools == {3}
    for name in ("balls", "tubes", "stations", "matching"):
        for field in dataclasses.fields(getattr(first, name)):
            one, other = getattr(getattr(first, name), field.name), getattr(getattr(again, name), field.name)
            same = one.tobytes() == other.tobytes() if isinstance(one, np.ndarray) else repr(one) == repr(other)
            assert same, f"{name}.{field.name}"
    assert repr((first.status, first.reasons, first.datum)) == repr((again.status, again.reasons, again.datum))


# --- a square roof -------------------------------------------------------------------------------------------------

SQUARE = [
    "frame.nodes_x=5", "frame.nodes_y=5", "frame.shape='flat'", "frame.radii_mm=[45.0,50.0,60.0]",
    "asbuilt.wrong_sizes=3", "scan.stations=[2,2]", "scan.clutter=4", "scan.step_mrad=2.2",
]  # fmt: skip


@pytest.fixture(scope="module")
def square():
    return made(make, "square", recipe_files.overridden(recipe_files.load("frame-1040")[1], SQUARE), 3)


def elsewhere(frame, without=(), extra=(), radius=50.0):
    """A design in another frame, less some of its nodes, with others (n, 3) that were never built."""
    R, t = rigid.rotation_from_vector(np.array([0.02, -0.01, 1.1])), np.array([5.0e8, 4.3e9, 9e4])
    keep = ~np.isin(frame.ids, without)
    own = ~np.isin(frame.member_a, without) & ~np.isin(frame.member_b, without)
    return dataclasses.replace(
        frame,
        ids=np.append(frame.ids[keep], 900 + np.arange(len(extra))),
        centres=np.vstack([frame.centres[keep], np.reshape(extra, (-1, 3))]) @ R.T + t,
        radii=np.append(frame.radii[keep], np.full(len(extra), radius)),
        member_a=frame.member_a[own],
        member_b=frame.member_b[own],
        tube_diameters=frame.tube_diameters[own],
    ), R  # fmt: skip


def wrong_sizes(result):
    return set(result.balls.ids[np.array(result.balls.flag) == "wrong-size"].tolist())


def truly_wrong(scene, truth):
    return set(scene.frame.ids[np.abs(truth.frame.radii - scene.frame.radii) > 3.0].tolist())


def test_sizes_of_balls_decide_the_turn_of_a_square_roof(square):
    scene, truth = square
    x, _, z = scene.frame.centres.max(axis=0)
    beyond = [[x + 3000.0, 3000.0, z], [x + 3000.0, 6000.0, z], [-3000.0, 0.0, z]]
    assert len(truly_wrong(scene, truth)) == 3
    without = scene.frame.ids[[7, 20]]
    design, R = elsewhere(scene.frame, without, beyond)
    result = run(dataclasses.replace(scene, frame=design), Params())
    assert result.matching.status == "ok"
    # The next pose is a quarter turn off; 0.009 came.
    assert np.degrees(rigid.rotation_angle(result.matching.T_design_scan[:3, :3] @ R.T)) < 0.05
    assert wrong_sizes(result) == truly_wrong(scene, truth) - set(without)
    gone = np.array(result.balls.flag) == "not-found"
    assert gone.sum() == len(beyond)
    assert np.isnan(result.balls.centres[gone]).all()
    assert result.status == "partial"


def test_where_the_pose_stays_ambiguous_no_ball_is_called_wrong_on_its_account(square):
    scene, _ = square
    low = scene.frame.centres.min(axis=0)
    corner = (np.abs(scene.frame.centres[:, :2] - low[:2]) < 100.0).all(axis=1)
    assert corner.sum() == 1
    # of one size but for a corner: which of four that is, one ball does not decide
    radii = np.where(corner, 60.0, 50.0)
    design, _ = elsewhere(dataclasses.replace(scene.frame, radii=radii))
    result = run(dataclasses.replace(scene, frame=design), Params())
    assert result.matching.status == "ambiguous"
    disputed = np.isnan(result.balls.nominal_radii)
    assert disputed.sum() == len(result.matching.rivals) + 1 >= 2
    assert all("spheres.ambiguous-node" in codes(result.balls.reasons[i]) for i in np.flatnonzero(disputed))
    assert not wrong_sizes(result) & set(result.balls.ids[disputed].tolist())
    assert len(wrong_sizes(result)) > 10  # whatever the pose, they are not of the one size


def emptied(scene, truth, row, onward):
    """The scene without what was seen within 130 mm of a ball: those rays end ``onward`` mm farther on; None = gone."""
    scans = []
    for scan in scene.scans:
        T = scan.T_project_scan
        away = np.linalg.norm(rigid.apply(T, scan.points) + T[:3, :3] @ scan.origin - truth.frame.centres[row], axis=1)
        points, near = scan.points.copy(), away < 130.0
        if onward is None:
            points = points[~near]
        else:
            ray = points[near] - scan.position
            points[near] += onward * ray / np.linalg.norm(ray, axis=1)[:, None]
        scans.append(Scan(scan.name, points, scan.origin, T_project_scan=T, position=scan.position))
    return dataclasses.replace(scene, scans=tuple(scans))


def test_a_ball_that_rays_went_through_is_missing_and_one_that_was_not_seen_has_no_verdict(square):
    scene, truth = square
    row = int(np.argmin(np.linalg.norm(truth.frame.centres - truth.frame.centres.mean(axis=0), axis=1)))
    for onward, flag, code in (
        (900.0, "not-found", "spheres.missing"),
        (None, "low-confidence", "spheres.few-rays"),
        (-900.0, "low-confidence", "spheres.hidden"),
    ):
        result = run(emptied(scene, truth, row, onward), Params())
        assert result.balls.flag[row] == flag, onward
        assert code in codes(result.balls.reasons[row])
        assert reason("spheres.axes-alone", axes=8) in result.balls.reasons[row]
        found = result.balls
        verdicts = [
            judge(size, half, 1.0, evidence != "axes", Tolerance()).verdict
            for size, half, evidence in zip(found.movement_size, found.movement_size_ci95, found.evidence, strict=True)
        ]
        assert verdicts[row] == ("none" if flag == "not-found" else "indeterminate")
        assert "fail" in verdicts
        assert np.isnan(result.balls.centres[row]).all() == (flag == "not-found")


def test_beside_ray_the_papers_methods_are_run_on_its_points(square, tmp_path):
    scene, truth = square
    params = {"spheres": {"min_points": 8, "raw_crops": False}}
    jobs = pipeline.plan(("spheres",), ("ray", "least-squares"), params, 0)
    runs = pipeline.execute(tmp_path / "s.h5", scene, jobs).runs
    ray = runs[0].result
    many = ray.balls.points > 30
    error = {one.method: np.abs(one.result.balls.radii - truth.frame.radii)[many] for one in runs}
    alone = pipeline.execute(tmp_path / "s.h5", scene, jobs[1:]).runs[0].result
    other = runs[1].result
    np.testing.assert_array_equal(other.balls.ids, ray.balls.ids)
    assert baselines.SAME in other.reasons
    # tens of points of a ball and sleeves beside: hundreds are in the crop
    assert (other.balls.points <= 1.3 * ray.balls.points + 10).all()
    assert other.balls.points.sum() < 0.8 * alone.balls.points.sum()
    assert np.median(error["least-squares"]) < 0.7 * np.median(np.abs(alone.balls.radii - truth.frame.radii)[many])
    assert np.median(error["ray"]) < np.median(error["least-squares"])
    assert baselines.SAME not in alone.reasons
    assert baselines.RAW not in alone.reasons


def test_wrong_size_is_flagged_without_a_catalogue(square):
    scene, truth = square
    result = run(scene, Params(catalogue="none"))
    reasons = [result.balls.reasons[i] for i, flag in enumerate(result.balls.flag) if flag == "wrong-size"]
    assert all("spheres.beyond-blank" in codes(one) for one in reasons)
    assert wrong_sizes(result) >= truly_wrong(scene, truth)
    off = truth.frame.radii - scene.frame.radii
    assert wrong_sizes(result) <= set(scene.frame.ids[(off > 1.0) | (off < -0.5)].tolist())
    assert "low-confidence" not in {result.balls.flag[i] for i in np.flatnonzero(result.balls.points > 30)}


def test_wrong_size_missing_in_the_catalogue_is_flagged_by_its_interval(square):
    scene, truth = square
    result = run(scene, Params(radii_mm=(45.0, 50.0)))
    largest = scene.frame.ids[np.argmax(truth.frame.radii)]
    assert wrong_sizes(result) == {largest}
    assert "spheres.beyond-blank" in codes(result.balls.reasons[list(result.balls.ids).index(largest)])
    flag = dict(zip(result.balls.ids.tolist(), result.balls.flag, strict=True))
    assert all(flag[one] != "ok" for one in truly_wrong(scene, truth))
