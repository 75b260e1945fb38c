"""Coarse registration of a scan beside those already placed, with given scores."""

import itertools
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from processor.geometry import rigid
from processor.model import Status
from processor.stitching import automatic, to_result
from processor.stitching.coarse import network, pairwise
from processor.stitching.coarse.pairwise import ScoredPose
from processor.stitching.fine.pairs_and_loops import Pair
from processor.stitching.params import Params
from processor.stitching.planes import free_space, scan_planes
from tests.support.clouds import stitch_clouds
from tests.support.scenes.stitched_rooms import adjusted

HERE = np.eye(4)


def along(x):
    return rigid.transform(np.eye(3), np.array([x, 0.0, 0.0]))


def shift(pose, other=HERE):
    return float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))


def scans(count):
    return [SimpleNamespace(side_mm=700.0)] * count


def placed_and_rated(count, candidates):
    return network.rated(network.place(scans(count), candidates, 0, False), 0)


@pytest.fixture
def scored(monkeypatch):
    """Give poses by a function of (network, i, j, pose) for their scores; those within 500 mm are the same."""
    monkeypatch.setattr(pairwise, "same", lambda T, S, side, b: shift(T, S) < 500.0)
    return lambda score: monkeypatch.setattr(network.Network, "score_beside", score)


def test_a_group_of_equal_poses_has_the_score_of_its_best_member(scored):
    """Beside scan 0 the right pose of scan 2 is 250 mm off and contradicted by others; beside scan 1 it is exact."""
    right, near, turned = along(0.0), along(250.0), along(50_000.0)

    def score(self, i, j, pose, still=None):
        return ScoredPose(pose, 600.0, 10.0 if shift(pose, turned) < 1.0 else 0.05 * shift(pose, right), 0.4)

    scored(score)
    candidates = {(i, 2): [ScoredPose(first, 1.0, 0.0, 0.4), ScoredPose(turned, 0.9, 0.0, 0.4)]
                  for i, first in enumerate((near, right))}  # fmt: skip
    placed = network.Network(scans=scans(3), candidates=candidates, T=np.tile(HERE, (3, 1, 1)), placed=[0, 1])
    assert network.joint_score(placed, 2, [0], near) < network.joint_score(placed, 2, [0], turned)
    ranked = network.rank_poses(placed, 2, [0, 1])
    np.testing.assert_array_equal(ranked[0][1], right)
    np.testing.assert_array_equal(ranked[1][1], turned)
    assert ranked[0][0] > 0.9 > 0.1 > ranked[1][0]  # by ten contradictions against none


def test_a_pose_by_a_single_overlap_is_refuted_by_free_space():
    """A bridge turned end for end: most patches match, and a few lie in free space of the other scan."""
    right, turned, separate = (ScoredPose(HERE, 50.0, a, o) for a, o in ((0.02, 0.3), (1.1, 0.5), (2.0, 0.01)))
    for poses, count, refuted in (
        ({(0, 1): right}, 2, [0.0, 0.0]),
        ({(0, 1): turned}, 2, [0.0, 1.1 / 50.0]),
        # Two overlaps that agree are not both wrong; a pair with almost no overlap is no support.
        ({(0, 1): right, (0, 2): turned, (1, 2): turned}, 3, [0.0, 0.0, 0.0]),
        ({(0, 1): right, (0, 2): turned, (1, 2): separate}, 3, [0.0, 2.02 / 50.0, 3.1 / 50.0]),
    ):
        np.testing.assert_allclose(network.refuted(poses, count, 0), refuted)


def test_applied_motion_is_not_a_rival_of_the_resulting_pose(monkeypatch, scored):
    """Every motion seems better than the pose at hand: the rivals in the result are those of the last poses."""
    poses = []

    def moves(placed, coarse, reference):
        poses.append(placed.T.copy())
        return [network.Move(scans=[1], M=along(100.0), ratio=2.0)]

    scored(lambda self, i, j, pose, still=None: ScoredPose(HERE, 600.0, 0.0, 0.4))
    monkeypatch.setattr(network, "_moves", moves)
    placed = placed_and_rated(2, {(0, 1): [ScoredPose(HERE, 1.0, 0.0, 0.4)]})
    np.testing.assert_array_equal(poses[-1], placed.T)
    np.testing.assert_allclose((placed.T_rival[1] @ rigid.invert(placed.T[1]))[:3, 3], [100.0, 0.0, 0.0])


def test_a_scan_that_overlaps_with_none_where_it_was_placed_loses_to_any_rival(scored):
    """Moved there with others, it has a score of 0, which is not ranked."""
    scored(
        lambda self, i, j, pose, still=None: ScoredPose(
            pose, 60.0, 0.0, 0.3 if shift(pose, along(9000.0)) < 1.0 else 1e-9
        )
    )
    candidates = {(0, 1): [ScoredPose(along(9000.0), 60.0, 0.0, 0.3)]}
    placed = network.Network(scans=scans(2), candidates=candidates, T=np.tile(HERE, (2, 1, 1)), placed=[0, 1])
    rated = network._rated(placed, 0)
    assert rated.rivalry[1] > 1.0  # any rival is better
    np.testing.assert_array_equal(rated.T_rival[1], along(9000.0))


@pytest.mark.parametrize(("against", "ambiguous"), [(0.05, True), (3.0, False)])
def test_scans_beyond_a_rival_pose_are_ambiguous_together(scored, against, ambiguous):
    """Free space decides between two bays, if it contradicts one of them; else all that lies beyond is ambiguous."""
    step, off = along(6000.0), along(12000.0)
    T = np.stack([along(6000.0 * i) for i in range(4)])

    def score(self, i, j, pose, still=None):
        apart = (rigid.invert(self.T[i]) @ pose)[0, 3] / 6000.0 * (1 if j > i else -1)
        if abs(i - j) == 1 and apart == 1.0:
            return ScoredPose(pose, 60.0, 0.0, 0.3)
        if {i, j} == {1, 2} and apart == 2.0:
            return ScoredPose(pose, 60.0, against, 0.3)
        return ScoredPose(pose, 0.0, 0.0 if abs(apart) >= 2.0 and {i, j} != {2, 3} else 9.0, 1e-9)

    scored(score)
    poses = {(i, i + 1): [ScoredPose(step, 60.0, 0.0, 0.3)] for i in range(3)}
    poses[1, 2].append(ScoredPose(off, 60.0, 0.05, 0.3))
    placed = placed_and_rated(4, poses)
    np.testing.assert_allclose(placed.T, T)
    assert (placed.rivalry[2:] > network.AMBIGUOUS).tolist() == [ambiguous] * 2
    assert (placed.rivalry[:2] < network.AMBIGUOUS).all()


def test_scans_that_join_only_through_an_ambiguous_one_are_ambiguous():
    links = [(0, 1), (1, 2), (0, 3)]
    for state in (Status.OK, Status.WEAK):
        status = [Status.OK, Status.AMBIGUOUS, state, Status.OK]
        for given, apart in ((links, [2]), ([*links, (2, 3)], []), (None, [])):
            assert to_result._not_joined(given, status, 0) == apart


def test_closures_run_over_the_pairs_that_are_known_best():
    """Of four scans in a ring and across it, the two worst pairs close loops over the others."""
    sd = {(0, 1): 1.0, (1, 2): 9.0, (2, 3): 2.0, (0, 3): 3.0, (0, 2): 5.0}
    pairs = [
        Pair(a, b, 9, along(6000.0 * (b - a)), np.diag([1e-12] * 3 + [each**2] * 3), 1.0, 1.0)
        for (a, b), each in sd.items()
    ]
    found = to_result._closures("ABCD", SimpleNamespace(pairs=pairs))
    assert [sorted(set(loop)) for loop in found.loop] == [["A", "C", "D"], ["A", "B", "C", "D"]]


def test_links_are_overlaps_that_free_space_does_not_contradict():
    scores = {(0, 1): (60.0, 0.1, 0.3), (0, 2): (60.0, 0.9, 0.3), (1, 2): (6.0, 0.0, 0.03)}
    assert network.links({pair: ScoredPose(HERE, *score) for pair, score in scores.items()}) == [(0, 1)]


def test_scan_of_another_place_is_in_a_group_of_its_own():
    good, bad = ([ScoredPose(HERE, 60.0, against, 0.3)] for against in (0.0, 9.0))
    group = network.groups({(0, 1): bad, (0, 2): good, (1, 2): bad, (2, 3): good, (1, 3): []}, 4, [])
    assert group[0] == group[2] == group[3] != group[1]


def test_far_patches_between_rays_are_no_contradiction():
    """A ray every 1.1 degrees: 480 mm are resolved at 5 m, not at 40 m, and not on a floor at grazing incidence."""
    space = free_space.FreeSpace(np.zeros((6, 82, 82)))
    points = np.array([[5000.0, 0.0, 0.0], [40000.0, 0.0, 0.0], [9000.0, 0.0, -500.0]])
    normals = np.array([[-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    share = space.resolved(points, normals, 480.0)
    assert share[0] == 1.0
    assert share[1] < 0.1  # (240 / 768)^2 = 0.098: half of its width by a step at 40 m
    assert share[2] < 0.1  # 240 / 3100: of a step at 9 m, 173 mm, at an incidence of 500 / 9000


def test_rays_without_a_return_are_free_as_far_as_the_scan_reaches():
    """Walls at 10 m but for a gate, through which rays come back from nothing: what is beyond 10 m is not known."""
    turn, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 1200), np.linspace(-0.4, 0.4, 160))
    rays = np.stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)], axis=-1)
    rays, gate = rays.reshape(-1, 3), (np.abs(np.angle(np.exp(1j * turn))) < 0.3).ravel()
    space = free_space.FreeSpace.from_rays(10_000.0 * rays[~gate], [rays[gate]])
    on_axis = np.array([[5000.0, 0.0, 0.0], [9700.0, 0.0, 0.0], [12000.0, 0.0, 0.0], [-5000.0, 0.0, 0.0]])
    free = space.contains(on_axis, 50.0)
    assert free.tolist() == [free_space.UNANSWERED, free_space.UNANSWERED, 0.0, 1.0]


def test_groups_that_no_sure_pose_joins_are_searched_deeper(monkeypatch):
    """A chain of four scans: of the pair in its middle only the deep search finds the pose."""
    patches = [SimpleNamespace(row=row, patches=SimpleNamespace(weight=np.ones(9))) for row in range(4)]
    sure, contradicted = ScoredPose(along(1.0), 60.0, 0.0, 0.3), ScoredPose(along(2.0), 90.0, 9.0, 0.4)
    deep = []

    def candidates(a, b, most_tilt_rad, efforts):
        if efforts == [pairwise.DEEP]:
            deep.append((a.row, b.row))
        found = (a.row, b.row) in ((0, 1), (2, 3)) or (efforts == [pairwise.DEEP] and (a.row, b.row) == (1, 2))
        return [sure if found else contradicted]

    monkeypatch.setattr(pairwise, "candidate_poses", candidates)
    monkeypatch.setattr(network, "place", lambda scans, found, *_: SimpleNamespace(candidates=found, still=None))
    poses = automatic._place(patches, Params(), 0, ({}, {}, {})).candidates
    assert sorted(deep) == [(0, 2), (0, 3), (1, 2), (1, 3)]
    assert [key for key, (best, *_) in poses.items() if best is sure] == [(0, 1), (1, 2), (2, 3)]
    assert poses[1, 2][1:] == [contradicted]  # as by picks, which remain candidates
    assert network.groups(poses, 4, []).tolist() == [0, 0, 0, 0]


def test_scans_of_known_poses_are_searched_no_deeper(monkeypatch):
    """Control points decide between two scans that hardly overlap; a third is searched for beside both."""
    patches = [SimpleNamespace(patches=SimpleNamespace(weight=np.ones(9)), side_mm=700.0, row=row) for row in range(3)]
    by_control, elsewhere = ScoredPose(along(0.0), 1.0, 0.0, 0.01), ScoredPose(along(6e3), 60.0, 0.0, 0.3)
    searched = []
    monkeypatch.setattr(pairwise, "candidate_poses", lambda a, b, *_: searched.append((a.row, b.row)) or [elsewhere])
    monkeypatch.setattr(pairwise, "refine", lambda a, b, T: (T, None))
    monkeypatch.setattr(pairwise, "same", lambda *_: True)
    monkeypatch.setattr(pairwise, "score_pose", lambda *_: by_control)
    poses = automatic._find_candidates(patches, Params(), ({}, {0: HERE, 1: HERE}, {}))
    assert poses[0, 1] == [by_control]
    assert (0, 1) not in searched
    assert network.groups({(0, 1): [by_control]}, 3, [0, 1]).tolist() == [0, 0, 1]


def test_patches_that_more_scans_look_through_than_see_are_no_evidence():
    """Of scan 0: seen by all, alone, slid along itself, by all but a wrong scan, and alone with one against it."""
    matches = np.array([[1, 1, 1], [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0]], bool)
    against = np.array([[0, 0, 0], [0, 1, 1], [0, 1, 1], [0, 0, 1], [0, 1, 0]], float)
    for undecided, last in ((1.0, False), (3.0, True)):  # less and more than what is sure, a weight of 2
        weight = np.array([1.0, 1.0, 1.0, 1.0, undecided])
        some = [SimpleNamespace(patches=SimpleNamespace(weight=weight))] * 4
        placed = network.Network(some, {}, np.tile(HERE, (4, 1, 1)), [0, 1, 2, 3])
        with mock.patch.object(
            network.Network, "compared", lambda self, a, b, T: (matches[:, b - 1], against[:, b - 1])
        ):
            assert placed.without_moved(placed.T)[0].tolist() == [True, False, False, True, last]
            # Where nothing moves between any two scans
            assert placed.without_moved(placed.T, False)[0].tolist() == [True, False, True, True, True]


@pytest.fixture(scope="module")
def with_crates():
    """Poses and scans of a room, four of it, with a crate that stands elsewhere in each."""
    T = stitch_clouds.four(step_mrad=200.0)[0]
    crates = ((-1500.0, -2500.0), (500.0, 3000.0), (5000.0, 500.0), (2500.0, -3500.0))
    return T, [
        stitch_clouds.scan(
            f"S{i + 1}", T[i], i, step_mrad=20.0,
            things=(*stitch_clouds.THINGS, (np.array([x, y, 0.0]), np.array([x + 900.0, y + 900.0, 2200.0]))),
        )
        for i, (x, y) in enumerate(crates)
    ]  # fmt: skip


def test_scans_are_joined_without_what_moved(with_crates):
    """The others look through the place of each crate."""
    T, scans = with_crates
    clouds = [scan_planes.extract(scan) for scan in scans]
    side = pairwise.cube_side(clouds)
    patches = [pairwise.prepare(cloud, side) for cloud in clouds]
    poses = {
        (a, b): [pairwise.score_pose(patches[a], patches[b], rigid.invert(T[a]) @ T[b])]
        for a, b in itertools.combinations(range(4), 2)
    }
    assert network.nothing_sure(poses)
    placed = network.place(patches, poses, 0, True)
    assert not network.groups(placed.candidates, 4, []).any()  # sure poses join all
    assert network.rated(placed, 0).rivalry.max() < network.AMBIGUOUS


def test_what_moves_between_scans_does_not_contradict_their_poses(with_crates):
    """A crate stands elsewhere in each of four scans of a room, the others look through its place."""
    T, scans = with_crates
    result = adjusted(T, scans)
    assert set(result.scans.status) == {"ok"}
    every = mock.patch.object(
        network.Network,
        "without_moved",
        lambda self, T, *_: [np.ones(len(one.patches.weight), bool) for one in self.scans],
    )
    with every:
        before = adjusted(T, scans)
    assert "ambiguous" in before.scans.status
