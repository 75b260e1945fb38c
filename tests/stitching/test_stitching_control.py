"""Scans fixed by control points: by hand, by another solver, by draws, and from a folder to its tables."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from processor.cli import main
from processor.geometry import rigid
from processor.model import Control, InputError, reason
from processor.results.fields_to_json import as_object
from processor.stitching import step as stitching_step
from processor.stitching.fine import control_points
from tests.support.clouds.stitch_clouds import four, pose
from tests.support.scenes.picked_networks import network
from tests.support.scenes.stitched_rooms import STEP_MRAD, unsearched

SITE = rigid.transform(Rotation.from_euler("zyx", [130.0, 1.0, -2.0], degrees=True).as_matrix(), [5e5, 4.2e6, 310.0])
ROUNDING = 1e-9  # mm, or a share; float64 at 4000 km, of which the middle is taken off, is 5e-10 mm
NAMES = tuple(f"S{i + 1}" for i in range(9))


def turned(T, d):
    """Poses turned about their own origins and shifted."""
    made = T.copy()
    for i, one in enumerate(np.reshape(d, (-1, 6))):
        made[i, :3, :3] = Rotation.from_rotvec(one[:3]).as_matrix() @ T[i, :3, :3]
        made[i, :3, 3] += one[3:]
    return made


def toy(seed, count=6, wrong=None, known_sd=0.5, seen_sd=0.8, each=2):
    """A network of four scans with correlated errors of some mm, and control points of which each scan sees some.

    Returns poses as found, their covariance, the true ones in the site's frame, and the control points.
    """
    rng = np.random.default_rng(seed)
    T = np.array([pose([8000.0 * i, 900.0 * i * i, 1500.0], 40.0 * i, 2.0 * i) for i in range(4)])
    T = np.linalg.inv(T[0]) @ T
    mix = np.random.default_rng(99).normal(size=(18, 18)) @ np.diag(np.tile([1e-4, 1e-4, 1e-4, 0.5, 0.5, 0.5], 3)).T
    scale = np.tile([1e-4, 1e-4, 1e-4, 1.0, 1.0, 1.0], 3)
    C = np.zeros((24, 24))
    C[6:, 6:] = (np.eye(18) + 0.1 * np.sign(mix) @ np.sign(mix).T) * np.outer(scale, scale)
    true = SITE @ turned(T, np.concatenate([np.zeros(6), rng.multivariate_normal(np.zeros(18), C[6:, 6:])]))
    places = np.random.default_rng(7).uniform([-5e3, -8e3, 0.0], [3e4, 12e3, 6e3], (count, 3)) @ SITE[:3, :3].T
    places += SITE[:3, 3]
    known = places + rng.normal(0.0, known_sd, places.shape)
    point = np.repeat(np.arange(count), each)
    scan = (np.arange(count * each) * 3 + point) % 4
    seen = np.array([rigid.apply(rigid.invert(true[s]), places[p]) for p, s in zip(point, scan, strict=True)])
    seen += rng.normal(0.0, seen_sd, seen.shape)
    if wrong is not None:
        known[wrong[0]] += wrong[1]
    rows = point, scan, np.full(len(point), -1), seen, np.full(len(point), seen_sd)
    return T, C, true, Control(tuple(f"P{i}" for i in range(count)), known, np.full(count, known_sd), *rows)


def adjusted(T, C, points, point_mm=1.0):
    return control_points.adjust(points, NAMES[: len(T)], T, C, np.zeros((len(T), 3)), point_mm)


def suspects(found):
    """Kind and names of what was left out."""
    out = [one.values["suspect"] for one in found.reasons if one.code == "stitch.control-left-out"]
    return [(one.code, one.values) for one in out]


def in_site(found):
    return rigid.transform(np.eye(3), found.centre) @ found.T


def test_adjust_on_a_square_of_control_points_equals_residuals_and_covariance_by_hand():
    """Corners alternately 1 mm high and low: no motion takes that up, and a quarter of it shows in each height."""
    square = np.array([[100.0, 100.0, 0.0], [-100.0, 100.0, 0.0], [-100.0, -100.0, 0.0], [100.0, -100.0, 0.0]])
    high = np.array([1.0, -1.0, 1.0, -1.0])
    known = square + np.array([1000.0, 2000.0, 50.0]) + np.outer(high, [0.0, 0.0, 1.0])
    rows = np.arange(4), np.zeros(4, int), np.full(4, -1), square, np.full(4, 1.2)
    points = Control(("A", "B", "C", "D"), known, np.full(4, 1.6), *rows)  # of both together 2 mm
    found = adjusted(np.eye(4)[None], np.zeros((6, 6)), points)
    np.testing.assert_allclose(in_site(found)[0, :3, 3], [1000.0, 2000.0, 50.0], atol=ROUNDING)
    seen = found.control.sightings
    np.testing.assert_allclose(seen.off, np.outer(high, [0.0, 0.0, 1.0]), atol=ROUNDING)
    np.testing.assert_allclose(seen.sd, np.tile(2.0 * np.sqrt([5 / 8, 5 / 8, 1 / 4]), (4, 1)), rtol=ROUNDING)
    np.testing.assert_allclose(seen.share, 0.5, rtol=ROUNDING)
    assert found.control.redundancy == 6
    assert found.control.ratio == pytest.approx(4.0 / 2.0**2 / 6.0)
    # The pose: 2 mm by four points, and 2 mm at 100 mm.
    sd = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(sd, [1e-2, 1e-2, 2.0 / np.sqrt(8e4), 1.0, 1.0, 1.0], rtol=ROUNDING)


def test_the_adjustment_is_that_of_another_solver():
    """All unknowns at once by scipy: the frame, the scans' motions, the points' places; its poses and covariance."""
    T, C, _, points = toy(3)
    found = adjusted(T, C, points)
    whiten = np.linalg.inv(np.linalg.cholesky(C[6:, 6:]))
    start = found.M @ T[0]

    def poses(x):
        M = start.copy()
        M[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix() @ start[:3, :3]
        M[:3, 3] += x[3:6]
        return M @ turned(T, np.concatenate([np.zeros(6), x[6:24]]))

    def off(x):
        X, now = x[24:].reshape(-1, 3), poses(x)
        back = [rigid.apply(rigid.invert(now[s]), X[p]) for p, s in zip(points.point, points.scan, strict=True)]
        return np.concatenate([
            whiten @ x[6:24], ((X - points.positions + found.centre) / points.sd[:, None]).ravel(),
            ((points.seen - back) / points.seen_sd[:, None]).ravel(),
        ])  # fmt: skip

    x0 = np.concatenate([np.zeros(24), (points.positions - found.centre).ravel()])
    other = least_squares(off, x0, x_scale=np.concatenate([np.tile([1e-4] * 3 + [1.0] * 3, 4), np.ones(18)]),
                          xtol=1e-15, ftol=1e-15, gtol=1e-15)  # fmt: skip
    # Both are ends of iterations: they differ by 1.6e-4 mm, 1.4e-8 and, of the cost, 2e-9.
    np.testing.assert_allclose(found.T[:, :3, 3], poses(other.x)[:, :3, 3], atol=2e-4)
    np.testing.assert_allclose(found.T[:, :3, :3], poses(other.x)[:, :3, :3], atol=1e-8)
    assert found.control.ratio * found.control.redundancy == pytest.approx(2.0 * other.cost, rel=1e-7)
    covariance = np.linalg.inv(other.jac.T @ other.jac)

    # Turns and shifts of the scans in the site, by numbers, through the other solver's covariance.
    def moved(x):
        now = poses(x)
        turns = [Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).as_rotvec()
                 for a, b in zip(now, poses(other.x), strict=True)]  # fmt: skip
        return np.hstack([turns, now[:, :3, 3]]).ravel()

    steps = np.sqrt(np.diag(covariance))[:24]
    J = np.column_stack(
        [(moved(other.x + d) - moved(other.x - d)) / (2 * h) for h, d in zip(steps, np.eye(42)[:24] * steps[:, None],
                                                                            strict=True)])  # fmt: skip
    want = J @ covariance[:24, :24] @ J.T
    sd = np.sqrt(np.diag(want))
    # As correlations, by differences over steps of one standard deviation: their second order is 3e-4.
    np.testing.assert_allclose(found.covariance / np.outer(sd, sd), want / np.outer(sd, sd), atol=1e-3)


def test_intervals_cover_and_no_sighting_is_rejected_without_a_blunder():
    draws = 120  # 2880 numbers, of some 750 independent ones: 95 % within 0.8 %
    inside, squares, normal, doubted = [], [], [], 0
    for seed in range(draws):
        T, C, true, points = toy(seed)
        found = adjusted(T, C, points)
        off = in_site(found)[:, :3, 3] - true[:, :3, 3]
        turn = [Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).as_rotvec()
                for a, b in zip(found.T, true, strict=True)]  # fmt: skip
        sd = np.sqrt(np.diag(found.covariance)).reshape(-1, 6)
        inside.append(np.abs(np.hstack([turn, off])) < 1.96 * sd)
        squares.append(found.control.ratio * found.control.redundancy)
        normal.append(found.control.sightings.off / found.control.sightings.sd)
        doubted += not found.control.sightings.used.all() or found.control.loosened > 1.0
    assert 0.935 < np.mean(inside) < 0.965  # two sds, as above
    assert np.all(np.mean(inside, axis=0) > 0.90)  # 95 % of 120 within 2.0 %, the least of 24
    assert np.mean(squares) == pytest.approx(12 * 3 - 6, rel=0.05)  # sqrt(2 / 30 / 120) is 2.4 %
    assert chi2.cdf(squares, 30).std() == pytest.approx(12**-0.5, rel=0.1)  # evenly spread, to 4.1 %
    assert np.std(normal) == pytest.approx(1.0, rel=0.03)  # 4320 numbers: 1.1 %
    assert doubted <= 3  # one in a hundred


@pytest.mark.parametrize("off", [15.0, 200.0, 30_000.0])
def test_a_point_with_a_blunder_is_named_and_left_out(off):
    for seed in range(5):
        T, C, true, points = toy(seed, wrong=(2, [0.6 * off, 0.0, -0.8 * off]))
        found = adjusted(T, C, points)
        assert suspects(found) == [("stitch.suspect-point", {"point": "P2"})]
        assert len(found.reasons) == 2
        seen = found.control.sightings
        np.testing.assert_array_equal(seen.used, [name != "P2" for name in seen.point])
        # Its sightings' mean, which the poses follow by a share: five seeds of each size differ by up to 22 %.
        assert found.reasons[1].values["size_mm"] == pytest.approx(off, rel=0.35)
        assert np.abs(in_site(found)[:, :3, 3] - true[:, :3, 3]).max() < 4.0  # 1.2 to 2.3 came, of twelve each
        left_out = seen.used == 0
        # What is left out is beyond chance.
        assert (np.linalg.norm(seen.off[left_out] / seen.sd[left_out], axis=1) > 3.0).all()


def test_two_points_with_blunders_are_left_out_one_after_the_other():
    T, C, _, points = toy(6, count=8, wrong=([1, 5], [[40.0, 0.0, 0.0], [0.0, -25.0, 10.0]]))
    found = adjusted(T, C, points)
    assert suspects(found) == [("stitch.suspect-point", {"point": name}) for name in ("P1", "P5")]
    assert len(found.reasons) == 3


def test_a_sighting_with_a_blunder_is_left_out_alone():
    T, C, _, points = toy(1, each=3)
    seen = points.seen.copy()
    seen[4] += [0.0, 60.0, 0.0]
    found = adjusted(T, C, dataclasses.replace(points, seen=seen))
    assert suspects(found) == [("stitch.suspect-sighting", {"point": "P1", "scan": NAMES[points.scan[4]]})]
    assert len(found.reasons) == 2
    np.testing.assert_array_equal(found.control.sightings.used, np.arange(18) != 4)


def test_a_scan_that_its_control_points_contradict_is_weak():
    """The network is wrong about one scan by far more than it says: four good points seen there show it."""
    T, C, _, points = toy(5, count=8, each=3)
    wrong = T.copy()
    wrong[2, :3, 3] += [150.0, -80.0, 30.0]
    found = adjusted(wrong, C, points)
    assert [one is not None for one in found.contradictions] == [False, False, True, False]
    assert found.contradictions[2].code == "stitch.control-contradicts"
    # 173 mm, by four sightings of 0.8 mm and their poses; as printed, without a decimal.
    assert 169.95 < found.contradictions[2].values["shift_mm"] < 179.95
    np.testing.assert_array_equal(found.control.sightings.used, points.scan != 2)


def test_intervals_cover_a_blunder_that_cannot_be_located():
    """Three points: one of them 40 mm off, and any of them may be it."""
    T, C, true, points = toy(2, count=3, wrong=(0, [40.0, 0.0, 0.0]))
    found = adjusted(T, C, points)
    assert found.reasons[1].code == "stitch.control-undecided"
    assert found.control.sightings.used.all()
    assert found.control.loosened > 5.0  # by 40 mm among three points of 1 mm: 11 came
    sd = np.sqrt(np.diag(found.covariance)).reshape(-1, 6)[:, 3:]
    assert (np.abs(in_site(found)[:, :3, 3] - true[:, :3, 3]) < 3.0 * sd).all()  # three sds


def test_sightings_without_sd_get_the_assumed_sd_of_single_points():
    """Taken as exact, they would contradict one another; as sure as stated, they give what stated ones do."""
    T, C, _, points = toy(3, seen_sd=0.8)
    blank = dataclasses.replace(points, seen_sd=np.zeros(len(points.seen_sd)))
    stated, found = adjusted(T, C, points), adjusted(T, C, blank, point_mm=0.8)
    np.testing.assert_array_equal(found.T, stated.T)
    assert found.reasons[1] == reason("stitch.control-sd-assumed", sd_mm=0.8)
    assert (found.control.sightings.share > 0.0).all()
    assert (found.control.sightings.share < 1.0).all()


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_control_points_are_not_used(count):
    T, C, _, points = toy(0, count=count)
    found = adjusted(T, C, points)
    shortage = reason("stitch.control-few", points=count)
    assert found.reasons == (reason("stitch.control-not-used", shortage=shortage),)
    np.testing.assert_array_equal(found.T, T)
    np.testing.assert_array_equal(found.covariance, C)
    assert not found.control.sightings.used.any()
    assert not found.control.holds


def test_points_on_a_line_cannot_turn_the_scans_round_it():
    """Three points 3 mm off a line: by noise alone the scans might lie either way round."""
    T, C, _, points = toy(0, count=4, each=1)
    places = SITE[:3, 3] + np.array([[0.0, 0.0, 0.0], [5e3, 3.0, 0.0], [1e4, 0.0, 0.0], [2e4, 0.0, 3.0]])
    found = adjusted(T, C, dataclasses.replace(points, positions=places))
    assert found.reasons == (reason("stitch.control-not-used", shortage=reason("stitch.control-on-a-line")),)


def test_scans_without_a_pose_do_not_affect_the_control_adjustment():
    T, C, _, points = toy(4)
    T, C = T.copy(), C.copy()
    T[3] = np.nan
    C[18:] = C[:, 18:] = np.nan
    found = adjusted(T, C, points)
    assert np.isnan(found.T[3]).all()
    assert np.isnan(found.covariance[18:]).all()
    assert np.isfinite(found.covariance[:18, :18]).all()
    np.testing.assert_array_equal(found.control.sightings.used, points.scan != 3)
    assert np.isnan(found.control.sightings.off[points.scan == 3]).all()


def test_control_points_in_other_units_are_refused():
    T, C, _, points = toy(0)
    with pytest.raises(InputError, match=r"units mixed up \(m and mm\)"):
        adjusted(T, C, dataclasses.replace(points, positions=points.positions / 1000.0))


# --- the step -------------------------------------------------------------------------------------------------------


def targets(T, known_sd=0.3, seen_sd=0.5, seed=0, count=6):
    """Control points in the room of stitch_clouds, known in the site's frame; T (k, 4, 4) leads to the room."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([-5e3, -3e3, 200.0], [6e3, 4e3, 3e3], (count, 3))
    point, scan = np.divmod(np.arange(count * len(T)), len(T))
    seen = np.array([rigid.apply(rigid.invert(T[s]), places[p]) for p, s in zip(point, scan, strict=True)])
    return Control(
        tuple(f"T{i}" for i in range(count)),
        rigid.apply(SITE, places) + rng.normal(0, known_sd, places.shape), np.full(count, known_sd),
        point, scan, np.full(len(point), -1), seen + rng.normal(0, seen_sd, seen.shape), np.full(len(point), seen_sd),
    )  # fmt: skip


def test_picked_scans_are_laid_to_control_points():
    T, scene = network(1, 2.0)
    free = stitching_step.run(scene, stitching_step.Params(method="three-point"))
    points = targets(T)
    result = stitching_step.run(dataclasses.replace(scene, control=points), stitching_step.Params(method="three-point"))
    want = SITE @ T
    assert (free.frame, result.frame) == ("PRCS", "GLCS")
    scans = result.scans
    off = scans.T_project_scan[:, :3, 3] - want[:, :3, 3]
    assert np.abs(off).max() < 4.0  # 2 mm of picks, and their turns at the scanner
    middle = [scan.points.mean(axis=0) for scan in scene.scans]
    at = [rigid.apply(a, p) - rigid.apply(b, p) for a, b, p in zip(scans.T_project_scan, want, middle, strict=True)]
    assert (np.abs(at) < 4.0 * scans.position_sd).all()  # four sds
    assert (scans.position_sd > 0.0).all()  # the reference is not held
    assert result.control.redundancy == 3 * 30 - 6
    used = result.reasons[0]
    assert (used.code, used.values["points"], used.values["sightings"]) == ("stitch.control-used", 6, 30)
    # the pairs' own poses are as they were
    np.testing.assert_array_equal(result.pairs.T_a_b, free.pairs.T_a_b)
    np.testing.assert_array_equal(result.closures.mm, free.closures.mm)


def test_stitching_with_too_few_control_points_equals_stitching_without():
    _, scene = network(1, 2.0)
    few = targets(np.array([np.eye(4)] * 5), count=2)
    results = [
        stitching_step.run(dataclasses.replace(scene, control=one), stitching_step.Params(method="three-point"))
        for one in (None, few)
    ]
    without, with_few = (as_object(dataclasses.replace(one, control=None, reasons=())) for one in results)
    np.testing.assert_equal(with_few, without)
    assert results[0].control is None


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_control_points_of_a_folder_reach_tables_json_and_terminal(tmp_path):
    """From control.csv, in m, one point a blunder, to the tables, the JSON and the terminal."""
    T, scans = (some[:3] for some in four(step_mrad=STEP_MRAD, grid=False))
    points = targets(T)
    known = points.positions.copy()
    known[3] += [0.0, 0.0, 70.0]
    rows = [("name", "scan", "x", "y", "z", "sd_mm")]
    rows += [(name, "", *(place / 1000.0), 0.3) for name, place in zip(points.ids, known, strict=True)]
    rows += [(points.ids[p], f"S{s + 1}", *(seen / 1000.0), "" if p == 1 else 0.5)
             for p, s, seen in zip(points.point, points.scan, points.seen, strict=True)]  # fmt: skip
    folder, out = tmp_path / "room", tmp_path / "out"
    folder.mkdir()
    for scan in scans:
        np.savetxt(folder / f"{scan.name}.xyz", scan.points / 1000.0, "%.5f")
    with (folder / "control.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    (folder / "project.toml").write_text('kind = "structure"\n')
    command = ["run", str(folder), "-o", str(out), "--steps", "stitch", "--verbose"]
    with unsearched(T):
        ran = CliRunner().invoke(main.commands, command)
    assert ran.exit_code in (0, 1), ran.output
    said = ran.output.replace("\n", " ")
    assert "fixed by 5 control points in 15 sightings" in said
    assert "control point T3 is left out: it is 7" in said
    assert "without a standard deviation are given 1." in said  # noise of 2 mm, along the rays
    assert "cannot be decided" not in said
    found = json.loads((out / "results.json").read_text())["steps"]["stitch"]
    at = np.array([one["T_project_scan"] for one in found["scans"]])
    # Five points known to 0.3 mm: 0.13 mm, at some metres from their middle 0.3 mm; five of it.
    np.testing.assert_allclose(at[:, :3, 3], (SITE @ T)[:, :3, 3], atol=1.5)
    assert found["frame"] == "GLCS"
    assert [found["scans"][1][key] for key in ("from", "to")] == ["SOCS(S2)", "GLCS"]
    assert [found["pairs"][0][key] for key in ("from", "to")] == ["SOCS(S2)", "SOCS(S1)"]
    np.testing.assert_allclose(found["T_GLCS_PRCS"], at[0])
    assert found["control"]["holds"] is True
    assert len(found["control"]["sightings"]) == 18
    table = rows_of(out / "control.csv")
    assert [row["used"] for row in table if row["point"] == "T3"] == ["no"] * 3
    # Of sightings of 2 mm, 2.5 sds; others within five.
    assert all(abs(float(row["dz_mm"]) - 70.0) < 5.0 for row in table if row["point"] == "T3")
    assert all(abs(float(row["dz_mm"])) < 5.0 * float(row["sd_z_mm"]) for row in table if row["used"] == "yes")
    poses = rows_of(out / "stitch.csv")
    assert list(poses[0])[-2:] == ["from", "to"]
    assert (poses[2]["from"], poses[2]["to"]) == ("SOCS(S3)", "GLCS")
    page = (out / "report.html").read_text()
    assert "T_GLCS_SOCS(S2)" in page
    assert "T_GLCS_PRCS" in page
    assert "T_PRCS_SOCS" not in page


def test_scans_that_saw_enough_control_points_have_a_pose_by_these():
    rng = np.random.default_rng(5)
    known = rng.uniform(0.0, 20_000.0, (6, 3)) + np.array([5e5, 4.2e6, 0.0])
    T = [SITE @ pose([3000.0 * s, 500.0, 0.0], 70.0 * s, 1.0) for s in range(3)]
    rows = [(p, s) for s, count in enumerate((6, 4, 2)) for p in range(count)]
    seen = np.array([rigid.apply(rigid.invert(T[s]), known[p]) for p, s in rows])
    point, scan = np.array(rows).T
    control = Control(
        tuple("ABCDEF"), known, np.full(6, 0.5), point, scan, np.full(len(rows), -1), seen, np.ones(len(rows))
    )
    found = control_points.poses_of_scans(control, [np.zeros(3)] * 3)
    assert sorted(found) == [0, 1]  # two points are too few
    relative = rigid.invert(found[0]) @ found[1]
    # Of coordinates of 4000 km, of which the middle is taken off.
    np.testing.assert_allclose(relative, rigid.invert(T[0]) @ T[1], atol=1e-7)
    wrong = seen.copy()
    wrong[7] += [0.0, 300.0, 0.0]
    assert sorted(control_points.poses_of_scans(dataclasses.replace(control, seen=wrong), [np.zeros(3)] * 3)) == [0]
    wrong[2] += [0.0, 0.0, 300.0]  # of six sightings: some of the others still fit
    assert control_points.poses_of_scans(dataclasses.replace(control, seen=wrong), [np.zeros(3)] * 3) == {}
    assert control_points.poses_of_scans(None, []) == {}
