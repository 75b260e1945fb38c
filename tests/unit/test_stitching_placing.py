"""Coarse registration of a scan beside those already placed, with given scores."""

from types import SimpleNamespace

import numpy as np

from processor.geometry import rigid
from processor.stitching.coarse import network, pairwise


def test_a_group_of_equal_poses_has_the_score_of_its_best_member(monkeypatch):
    """Beside scan 0 the right pose of scan 2 is 250 mm off and contradicted by others; beside scan 1 it is exact."""
    right, turned = (rigid.transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 50_000.0))
    near = rigid.transform(np.eye(3), np.array([250.0, 0.0, 0.0]))

    def distance(pose, other):
        return float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))

    def score_beside(self, i, j, pose):
        against = 10.0 if distance(pose, turned) < 1.0 else 0.05 * distance(pose, right)
        return pairwise.ScoredPose(pose, 600.0, against, 0.4)

    monkeypatch.setattr(network.Network, "score_beside", score_beside)
    monkeypatch.setattr(pairwise, "same", lambda T, S, side, b: distance(T, S) < 500.0)
    candidates = {
        (0, 2): [pairwise.ScoredPose(near, 1.0, 0.0, 0.4), pairwise.ScoredPose(turned, 0.9, 0.0, 0.4)],
        (1, 2): [pairwise.ScoredPose(right, 1.0, 0.0, 0.4), pairwise.ScoredPose(turned, 0.9, 0.0, 0.4)],
    }
    scans = [SimpleNamespace(side_mm=700.0)] * 3
    placed = network.Network(scans=scans, candidates=candidates, T=np.tile(np.eye(4), (3, 1, 1)), placed=[0, 1])
    assert network.joint_score(placed, 2, [0], near) < network.joint_score(placed, 2, [0], turned)
    ranked = network.rank_poses(placed, 2, [0, 1])
    np.testing.assert_array_equal(ranked[0][1], right)
    np.testing.assert_array_equal(ranked[1][1], turned)
    assert ranked[0][0] > 0.9 > 0.1 > ranked[1][0]


def test_a_pose_by_a_single_overlap_is_refuted_by_free_space():
    """A bridge turned end for end: most patches match, and a few lie in free space of the other scan."""
    T = np.eye(4)
    right, turned, separate = (pairwise.ScoredPose(T, 50.0, a, o) for a, o in ((0.02, 0.3), (1.1, 0.5), (2.0, 0.01)))
    np.testing.assert_array_equal(network.refuted({(0, 1): right}, 2, 0), [0.0, 0.0])
    np.testing.assert_allclose(network.refuted({(0, 1): turned}, 2, 0), [0.0, 1.1 / 50.0])
    # Two overlaps that agree are not both wrong; a pair with almost no overlap is no support.
    both = {(0, 1): right, (0, 2): turned, (1, 2): turned}
    np.testing.assert_array_equal(network.refuted(both, 3, 0), [0.0, 0.0, 0.0])
    alone = {(0, 1): right, (0, 2): turned, (1, 2): separate}
    np.testing.assert_allclose(network.refuted(alone, 3, 0), [0.0, 2.02 / 50.0, 3.1 / 50.0])
