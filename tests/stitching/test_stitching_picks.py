"""Method ``three-point``: six parameters and seven, pooled standard deviations, and the file of picks."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.geometry import rigid
from processor.model import InputError, Picks, Scan, Scene
from processor.scan_folder import folder
from processor.stitching import step as stitching_step
from processor.stitching import three_point
from processor.stitching.coarse import pairwise
from processor.stitching.common_point_checks import UnitSlip
from tests.support.clouds.stitch_clouds import four, pose
from tests.support.results.reasons import codes
from tests.support.scenes.picked_networks import network
from tests.support.scenes.stitched_rooms import STEP_MRAD, errors

ROUNDING_MM = 1e-9  # at 40 km float64 is 7e-12 mm; it goes through some tens of sums
SCALES = {"stitch.scale", "stitch.scale-by-blunder", "stitch.scale-of-units"}
BLUNDERS = {"stitch.scale-by-blunder", "stitch.picks-scatter"}
CORNERS = np.array([[0.0, 0.0, 0.0], [9000.0, 0.0, 500.0], [2000.0, 7000.0, 4000.0], [8000.0, 6000.0, 100.0]])


def of_pairs(result):
    return [one.values["reason"] for one in result.reasons if one.code == "stitch.of-pair"]


def picked(scene, **params):
    return stitching_step.run(scene, stitching_step.Params(method="three-point", **params))


def off_at_middles(scene, result, T):
    """Errors (k, 3) of the middles of the scans' points, where ``position_sd`` holds."""
    want = rigid.invert(T[0]) @ T
    middles = [scan.points.mean(axis=0) for scan in scene.scans]
    return np.array([rigid.apply(a, p) - rigid.apply(b, p)
                     for a, b, p in zip(result.scans.T_project_scan, want, middles, strict=True)])  # fmt: skip


def test_seven_parameters_absorb_a_scale_that_six_show():
    R = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    a = 1.0005 * CORNERS @ R.T + [100.0, 200.0, 300.0]
    free, fixed = (three_point.fit_pair(a, CORNERS, scale_free=one) for one in (True, False))
    assert np.abs(free.residuals).max() < ROUNDING_MM
    np.testing.assert_allclose(free.T_a_b[:3, :3], 1.0005 * R, atol=1e-12)  # rounding
    np.testing.assert_allclose(free.T_a_b[:3, 3], [100.0, 200.0, 300.0], atol=ROUNDING_MM)
    assert (free.scale, fixed.scale) == pytest.approx((1.0005, 1.0005), abs=1e-12)  # rounding
    assert np.abs(fixed.residuals).max() > 1.0  # a scale of 5e-4 over metres


@pytest.mark.parametrize("scale", [0.995, 1.005])
@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_written_matrix_of_seven_parameters_includes_the_scale(scale, noise):
    """Places of the structure by each scan's matrix, against the truth: the pose that is judged is the one written."""
    worst, pulls = [], []
    for seed in range(10):
        T, scene = network(seed, noise, scale=1.0 / scale, count=2, points=8)
        result = picked(scene, scale="free")
        in_b, found = scene.picks.in_b, result.scans.T_project_scan[1]
        true = rigid.apply(rigid.invert(T[0]) @ T[1], scale * in_b)
        worst.append(np.sqrt(((in_b @ found[:3, :3].T + found[:3, 3] - true) ** 2).sum(axis=1).mean()))
        assert result.scans.scale[1] == pytest.approx(np.linalg.det(found[:3, :3]) ** (1 / 3), abs=1e-12)  # rounding
        pulls.append((result.scans.scale[1] - scale) / max(result.scans.scale_sd[1], 1e-12))
    assert max(worst) < 3.0 * noise + ROUNDING_MM  # three times the noise of a pick
    assert noise == 0.0 or np.mean(np.abs(pulls) < 1.96) >= 0.8  # of ten, two by a chance of 9 %


def test_a_loop_of_scans_of_different_scales_closes():
    T, scene = network(4, 0.0)
    sizes = dict(zip((scan.name for scan in scene.scans), (1.0, 1.003, 0.996, 1.001, 1.004), strict=True))
    picks = scene.picks
    scaled = {
        "in_a": picks.in_a / np.array([sizes[name] for name in picks.scan_a])[:, None],
        "in_b": picks.in_b / np.array([sizes[name] for name in picks.scan_b])[:, None],
    }
    scaled_scene = dataclasses.replace(scene, picks=dataclasses.replace(picks, **scaled))
    result = picked(scaled_scene, scale="free")
    want = rigid.invert(T[0]) @ T
    want[:, :3, :3] *= np.array(list(sizes.values()))[:, None, None]
    np.testing.assert_allclose(result.scans.T_project_scan, want, atol=ROUNDING_MM)
    assert result.closures.mm[0] < ROUNDING_MM


def test_likely_cause_of_a_scale():
    slips = [three_point.cause_of_scale(scale, 1e-6, 1000.0) for scale in (1000.3, 1.0 / 25.4)]
    assert [slip.code for slip in slips] == ["stitch.scale-of-units"] * 2
    assert [slip.values["units"] for slip in slips] == [UnitSlip.M_MM, UnitSlip.INCHES_MM]
    assert three_point.cause_of_scale(1.02, 1e-4, 1000.0).code == "stitch.scale-by-blunder"
    assert three_point.cause_of_scale(1.00024, 1e-5, 1000.0).code == "stitch.scale"
    assert three_point.cause_of_scale(1.0001, 1e-4, 1000.0) is None


@pytest.mark.parametrize(
    "points", [CORNERS[:2], np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), np.zeros((3, 3))], ids=["two", "line", "place"]
)
def test_too_few_points_are_rejected(points):
    with pytest.raises(three_point.TooFewError):
        three_point.fit_pair(points, points, scale_free=False)


def test_covariance_of_a_pair_is_the_scatter_of_noisy_picks():
    """Draws of 5 mm: the scatter of the poses compared with the mean of the stated covariances."""
    rng = np.random.default_rng(7)
    T = pose([4000.0, -3000.0, 200.0], 70.0, 10.0)
    a = rigid.apply(T, CORNERS)
    drawn, stated = [], []
    for _ in range(1000):
        fit = three_point.fit_pair(a + rng.normal(0, 5.0, a.shape), CORNERS + rng.normal(0, 5.0, a.shape), False)
        turn = Rotation.from_matrix(fit.T_a_b[:3, :3] @ T[:3, :3].T).as_rotvec()
        drawn.append([*turn, *(fit.T_a_b[:3, 3] - T[:3, 3])])
        stated.append(fit.covariance)
    # A standard deviation of 1000 draws scatters by 2.2 %.
    np.testing.assert_allclose(np.std(drawn, axis=0), np.sqrt(np.diag(np.mean(stated, axis=0))), rtol=0.06)


def test_a_chain_of_all_scans_with_picks_of_5_mm():
    worst, pulls = [], []
    for seed in range(20):
        T, scene = network(seed, 5.0)
        result = picked(scene)
        assert result.status in ("ok", "partial")  # partial if a scan is weak by chance
        assert "failed" not in result.scans.status
        worst.append(np.abs(errors(result.scans.T_project_scan, T)[0]).max())
        pulls.append(off_at_middles(scene, result, T)[1:] / result.scans.position_sd[1:])
    assert np.median(worst) < 30.0  # 5 mm, by turns of 5 mm in 4 m, at places 15 m beside the picks
    assert 0.85 < (np.abs(pulls) < 1.96).mean() <= 0.99  # 240 numbers, of which twelve share errors: 95 +- 4 %
    assert len(result.closures) == 1


def test_exact_picks_give_exact_poses_and_close_the_loop():
    T, scene = network(1, 0.0)
    result = picked(scene)
    np.testing.assert_allclose(result.scans.T_project_scan, rigid.invert(T[0]) @ T, atol=ROUNDING_MM)
    assert result.closures.mm[0] < ROUNDING_MM
    assert sorted(result.closures.loop[0][1:]) == ["S1", "S2", "S3", "S4", "S5"]


def test_a_scan_in_other_units_is_reported():
    _, scene = network(2, 1.0, scale=0.001)
    result = picked(scene)
    assert {one.values["units"] for one in of_pairs(result) if one.code == "stitch.scale-of-units"} == {UnitSlip.M_MM}


def test_picks_are_read_in_the_scans_units(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("A", "B"):
        np.savetxt(tmp_path / f"{name}.xyz", rng.normal(0.0, 3.0, (300, 3)))
    (tmp_path / "picks.csv").write_text(
        "scan_a,scan_b,point,xa,ya,za,xb,yb,zb\nA,B,P1,1,2,3,4,5,6\nB,A,P2,0.1,0,0,0,0,0.2\n"
    )
    picks = folder.read_input(tmp_path).picks
    assert picks.scan_a == ("A", "B")
    np.testing.assert_allclose(picks.in_a, [[1000, 2000, 3000], [100, 0, 0]])
    np.testing.assert_allclose(picks.in_b, [[4000, 5000, 6000], [0, 0, 200]])
    assert folder.read_input(tmp_path, "mm").picks.in_a[0, 0] == 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b,c\n", "expected columns scan_a,scan_b"),
        ("HEAD\nA,C,P,1,2,3,4,5,6\n", "line 2: there is no scan 'C'; there are A, B"),
        ("HEAD\nA,A,P,1,2,3,4,5,6\n", "expected two scans, found 'A' twice"),
        ("HEAD\nA,B,P,1,2,3,4,5\n", "expected 9 cells, found 8"),
        ("HEAD\nA,B,P,1,2,x,4,5,6\n", "expected six numbers"),
        ("HEAD\nA,B,P,1,2,nan,4,5,6\n", "expected finite numbers"),
        ("HEAD\n\n", "holds no points"),
    ],
)
def test_bad_picks_are_rejected_with_a_message(tmp_path, text, message):
    for name in ("A", "B"):
        np.savetxt(tmp_path / f"{name}.xyz", np.random.default_rng(0).normal(0.0, 3.0, (300, 3)))
    (tmp_path / "picks.csv").write_text(text.replace("HEAD", "scan_a,scan_b,point,xa,ya,za,xb,yb,zb"))
    with pytest.raises(InputError, match=message):
        folder.read_input(tmp_path)


def test_automatic_accepts_a_pose_by_picks(monkeypatch):
    """The pose by picks is one of the candidates, here the only one, and is refined on the scans."""
    monkeypatch.setattr(pairwise, "candidate_poses", lambda *_: [])
    T, scans = four(step_mrad=STEP_MRAD)
    want = rigid.invert(T[0]) @ T[1]
    in_b = np.array([[1000.0, 0, 0], [0, 2000.0, 0], [0, 0, 1500.0]])
    picks = Picks(("S1",) * 3, ("S2",) * 3, ("P", "Q", "R"), rigid.apply(want, in_b) + 4.0, in_b)
    scene = Scene("room", "structure", scans[:2])
    assert stitching_step.run(scene, stitching_step.Params()).scans.status[1] == "failed"
    result = stitching_step.run(dataclasses.replace(scene, picks=picks), stitching_step.Params())
    # As by a search, whose ten seeds give 0.21.
    assert np.abs(errors(result.scans.T_project_scan, T[:2])[0]).max() < 0.3


@pytest.mark.parametrize("scale", ["fixed", "free"])
def test_intervals_with_three_points_a_pair_cover(scale):
    """Two or three freedoms a pair: with unpooled standard deviations intervals would cover 78 % and 53 %."""
    inside = []
    for seed in range(30):
        T, scene = network(seed, 5.0, points=3)
        result = picked(scene, scale=scale)
        inside.append(np.abs(off_at_middles(scene, result, T)[1:]) < 1.96 * result.scans.position_sd[1:])
    assert 0.9 <= np.mean(inside) <= 0.99  # 360 numbers, of which twelve share errors: 95 +- 3 %


def test_a_blunder_in_one_pair_does_not_widen_the_intervals_of_others():
    T, scene = network(3, 2.0)
    in_a = scene.picks.in_a.copy()
    in_a[0] += 4000.0
    result = picked(dataclasses.replace(scene, picks=dataclasses.replace(scene.picks, in_a=in_a)))
    assert BLUNDERS.intersection(codes(of_pairs(result)))
    # Scans hang on a pair less.
    assert np.nanmax(result.scans.position_sd) < 3.0 * np.nanmax(picked(scene).scans.position_sd)
    # Six picks of 2 mm over some metres, at 30 m.
    assert np.abs(errors(result.scans.T_project_scan, T)[0]).max() < 30.0


@pytest.mark.parametrize("points", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_a_scale_of_one_is_rarely_reported(points):
    """Picks of 5 mm without a scale: 2 % of 200 pairs at most are reported, also with two freedoms a pair."""
    rows = [row for seed in range(40) for row in picked(network(seed, 5.0, points=points)[1]).pairs.reasons]
    assert sum(bool(SCALES.intersection(codes(row))) for row in rows) <= 0.02 * len(rows)


def test_a_single_pair_needs_a_larger_scale_to_be_reported():
    """With two freedoms a scale 5 standard deviations off may be chance (19 in Student's t), with many it is not.

    Their 95 % interval is 4.303 standard deviations.
    """
    assert three_point.cause_of_scale(1.0005, 1e-4, 1000.0, 2) is None
    assert three_point.cause_of_scale(1.0005, 1e-4, 1000.0, 60).code == "stitch.scale"
    # 4.303 of 1e-4.
    assert three_point.cause_of_scale(1.003, 1e-4, 5000.0, 2).values["ci95_ppm"] == pytest.approx(430.3, abs=0.05)


def test_a_true_scale_is_reported_and_its_interval_covers():
    inside, reported = [], []
    for seed in range(30):
        pairs = picked(network(seed, 2.0, scale=1.0 / 1.004)[1]).pairs
        inside += (np.abs(pairs.scale - 1.004) < 1.96 * pairs.scale_sd).tolist()
        reported += [
            codes(row) == ["stitch.scale-by-blunder"]
            and abs(row[0].values["scale"] - 1.004) < 1e-3  # five of 2 mm by 10 m
            for row in pairs.reasons
        ]
    assert 0.88 < np.mean(inside) < 0.99  # 150 numbers: 95 +- 1.8 %
    assert np.mean(reported) > 0.9  # some are within five of their standard deviations


def test_a_scan_that_cannot_be_placed_has_a_reason():
    _, scene = network(1, 2.0)
    picks = scene.picks
    pairs = list(zip(picks.scan_a, picks.scan_b, strict=True))
    left = {("S4", "S5"): 2, ("S1", "S5"): 1}
    rows = [i for i, pair in enumerate(pairs) if pairs[:i].count(pair) < left.get(pair, 9)]
    few = Picks(*([getattr(picks, name)[i] for i in rows] for name in ("scan_a", "scan_b", "points", "in_a", "in_b")))
    lone = Scan("S6", scene.scans[0].points)
    scene = dataclasses.replace(scene, scans=(*scene.scans, lone), picks=few)
    result = picked(scene)
    assert result.scans.status[4:] == ("failed", "failed")
    assert [one.code for one in result.scans.reasons[4]] == ["stitch.too-few-picks"]
    shortages = result.scans.reasons[4][0].values["shortages"]
    assert [(one.values["scan"], one.values["shortage"].code) for one in shortages] == [
        ("S1", "stitch.few-points"), ("S4", "stitch.few-points"),
    ]  # fmt: skip
    assert [one.values["shortage"].values["points"] for one in shortages] == [1, 2]
    assert codes(result.scans.reasons[5]) == ["stitch.no-picks"]


def test_loops_that_misclose_widen_all_intervals():
    """Exact picks of scans that were each scaled against the next: no pair shows it, the loop does."""
    _, scene = network(1, 0.0, scale=1.004, count=3)
    result = picked(scene, scale="free")
    assert "stitch.loops-misclose" in codes(result.reasons)
    assert set(result.scans.status[1:]) == {"weak"}
