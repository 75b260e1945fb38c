"""Scans stitched by the structure itself, against poses that made them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processor.model import InputError, Scan, Scene, UsageError
from processor.steps import stitch
from tests import stitch_clouds
from tests.stitch_clouds import four


def errors(result, T):
    """Shifts (k, 3) of the scanners, mm, and turns (k,), mrad, relative to the first scan."""
    base = np.linalg.inv(T[0])
    shifts, turns = [], []
    for found, true in zip(result.T_project_scan, T, strict=True):
        want = base @ true
        shifts.append(found[:3, 3] - want[:3, 3])
        turns.append(1e3 * Rotation.from_matrix(found[:3, :3] @ want[:3, :3].T).magnitude())
    return np.array(shifts), np.array(turns)


@pytest.fixture(scope="module")
def room():
    T, scans = four()
    return T, scans, stitch.run(Scene("room", "structure", scans), stitch.Params())


def test_four_scans_of_a_room_come_together(room):
    T, _, result = room
    assert result.status == "ok"
    assert set(result.scan_status) == {"ok"}
    shift, turn = errors(result, T)
    # 78 thousand points of 2 mm a scan: the walls alone hold a scan to a few hundredths of a millimetre.
    assert np.abs(shift).max() < 0.2
    assert turn.max() < 0.05
    assert result.used.all()
    assert len(result.pair_a) == 6
    assert len(result.loops) == 3
    assert result.closure_mm.max() < 0.5


def test_what_is_said_of_the_pose_is_true_of_every_frame(room):
    """Covariance: left perturbation in the project's frame, so a point's own follows; positions agree with poses."""
    _, _, result = room
    for T, C, position, sd in zip(
        result.T_project_scan[1:], result.covariance[1:], result.position[1:], result.position_sd[1:], strict=True
    ):
        np.testing.assert_allclose(T[:3, 3], position, atol=1e-9)
        x, y, z = position
        J = np.hstack([np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]]), np.eye(3)])
        np.testing.assert_allclose(np.sqrt(np.diag(J @ C @ J.T)), sd, rtol=1e-4)
    assert not result.covariance[0].any()


def test_the_result_does_not_depend_on_how_a_scan_lies_in_its_frame(room):
    T, scans, first = room
    rng = np.random.default_rng(5)
    turned, back = [], []
    for scan in scans:
        D = np.eye(4)
        D[:3, :3] = Rotation.random(random_state=rng).as_matrix()
        D[:3, 3] = rng.normal(0.0, 3e4, 3)
        turned.append(
            dataclasses.replace(scan, points=scan.points @ D[:3, :3].T, origin=D[:3, 3] + 7.0, position=D[:3, 3] + 7.0)
        )
        D[:3, 3] += 7.0
        back.append(D)
    result = stitch.run(Scene("room", "structure", tuple(turned)), stitch.Params())
    assert result.status == "ok"
    found = [np.linalg.inv(back[0]) @ one @ D for one, D in zip(result.T_project_scan, back, strict=True)]
    shift, turn = errors(dataclasses.replace(first, T_project_scan=np.array(found)), T)
    assert np.abs(shift).max() < 0.2
    assert turn.max() < 0.05


def test_order_of_points_and_threads_do_not_show(room):
    _, scans, first = room
    rng = np.random.default_rng(1)
    mixed = []
    for scan in scans:
        order = rng.permutation(len(scan.points))
        mixed.append(
            dataclasses.replace(
                scan,
                points=scan.points[order],
                grid_row=scan.grid_row[order],
                grid_column=scan.grid_column[order],
            )
        )
    again = stitch.run(Scene("room", "structure", tuple(mixed)), stitch.Params())
    np.testing.assert_allclose(again.T_project_scan, first.T_project_scan, rtol=0.0, atol=1e-4)


def test_a_room_that_looks_the_same_turned_round_is_ambiguous():
    """An empty room with the scanner near the middle: half a turn fits as well, and nothing tells."""
    room = (np.array([-5000.0, -3000.0, 0.0]), np.array([5000.0, 3000.0, 3000.0]))
    T = [stitch_clouds.pose([-1500.0, 300.0, 1500.0], 10.0), stitch_clouds.pose([1200.0, -400.0, 1500.0], 70.0)]
    scans = tuple(stitch_clouds.scan(f"S{i}", one, i, room=room, things=(), step_mrad=20.0) for i, one in enumerate(T))
    # Levelled: upside down the room would fit as well.
    result = stitch.run(Scene("empty", "structure", scans), stitch.Params(levelled_mrad=20.0))
    assert result.status == "partial"
    assert result.scan_status[1] == "ambiguous"
    # The rival is the other answer: one of the two is right.
    true = np.linalg.inv(T[0]) @ T[1]
    off = [np.linalg.norm(one[1][:3, 3] - true[:3, 3]) for one in (result.T_project_scan, result.T_rival_scan)]
    assert min(off) < 5.0


def test_scans_of_different_places_are_never_called_ok():
    _, scans = four()
    other = stitch_clouds.scan(
        "X",
        stitch_clouds.pose([0.0, 0.0, 1500.0], 0.0),
        9,
        room=(np.array([-2000.0, -9000.0, 0.0]), np.array([2500.0, 8000.0, 5200.0])),
        things=((np.array([-2000.0, 3000.0, 0.0]), np.array([-500.0, 4000.0, 2600.0])),),
    )
    result = stitch.run(Scene("two", "structure", (scans[0], other)), stitch.Params())
    assert result.scan_status[1] != "ok"
    assert result.status != "ok"


def test_scans_without_a_grid_or_a_scanner_that_is_known():
    T, scans = four(grid=False)
    result = stitch.run(Scene("room", "structure", scans), stitch.Params(reference="S2"))
    assert result.reference == "S2"
    base = np.linalg.inv(T[1])
    for found, true in zip(result.T_project_scan, T, strict=True):
        np.testing.assert_allclose(found[:3, 3], (base @ true)[:3, 3], atol=0.3)


def test_a_given_pose_of_the_reference_leads_to_the_project():
    T, scans = four(step_mrad=20.0)
    given = stitch_clouds.pose([5e5, 4e6, 300.0], 33.0)
    scans = (dataclasses.replace(scans[0], T_project_scan=given), *scans[1:])
    scene = Scene("room", "structure", scans)
    assert stitch.applies(scene)
    result = stitch.run(scene, stitch.Params())
    want = given @ np.linalg.inv(T[0]) @ T[2]
    np.testing.assert_allclose(result.T_project_scan[0], given)
    np.testing.assert_allclose(result.position[2], want[:3, 3], atol=0.5)


def test_bad_input_is_said_plainly():
    few = Scan("few", np.zeros((20, 3)))
    many = Scan("many", np.random.default_rng(0).normal(size=(500, 3)))
    with pytest.raises(InputError, match="two scans or more, found 1"):
        stitch.run(Scene("s", "structure", (many,)), stitch.Params())
    with pytest.raises(InputError, match="'few' has 20 points"):
        stitch.run(Scene("s", "structure", (many, few)), stitch.Params())
    with pytest.raises(UsageError, match="no scan 'S9'"):
        stitch.run(Scene("s", "structure", (many, dataclasses.replace(many, name="b"))), stitch.Params(reference="S9"))
    with pytest.raises(InputError, match=r"picks\.csv"):
        stitch.run(
            Scene("s", "structure", (many, dataclasses.replace(many, name="b"))), stitch.Params(method="three-point")
        )
    with pytest.raises(UsageError, match=r"stitch\.scale"):
        stitch.Params(scale="loose")


@pytest.mark.parametrize("kind", ["ball of noise", "one plane", "one place"])
def test_scans_that_hold_nothing_to_go_by_fail_without_a_crash(kind):
    rng = np.random.default_rng(3)
    made = {
        "ball of noise": lambda: rng.normal(0.0, 1000.0, (3000, 3)),
        "one plane": lambda: np.hstack([rng.uniform(-1e3, 1e3, (3000, 2)), rng.normal(0.0, 1.0, (3000, 1)) + 500.0]),
        "one place": lambda: np.tile([1000.0, 0.0, 0.0], (3000, 1)),
    }[kind]
    scans = tuple(Scan(name, made()) for name in ("a", "b"))
    result = stitch.run(Scene("s", "structure", scans), stitch.Params())
    assert result.scan_status[1] != "ok"
    assert result.status in ("partial", "failed")


@pytest.mark.slow
def test_intervals_cover_over_seeds():
    """Errors by their standard deviations over seeds: what is called 95 % holds in most of few cases."""
    pulls = []
    for seed in range(1, 5):
        T, scans = four(seed, step_mrad=20.0)
        result = stitch.run(Scene("room", "structure", scans), stitch.Params())
        shift, _ = errors(result, T)
        pulls.append(shift[1:] / result.position_sd[1:])
    assert (np.abs(pulls) < 1.96).mean() > 0.8
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.5
