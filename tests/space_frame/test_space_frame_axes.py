"""Nodes from axes: exact meetings, eccentric ones, strangers, and lines that fix no point."""

import numpy as np
import pytest

from processor.space_frame.members import axis_intersection
from tests.support.clouds.frame_clouds import across


def ends_at(rng, nodes, per_node, sd=0.1, eccentricity=0.0, starts=None, response=None):
    """Random axes through nodes (k, 3), each missing its node by noise of ``sd`` that is known and an eccentricity."""
    k = len(nodes)
    node = np.repeat(np.arange(k), per_node)
    directions = rng.standard_normal((len(node), 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    side = np.array([across(d)[0] for d in directions])
    other = np.cross(directions, side)
    off = np.hypot(sd, eccentricity) * rng.standard_normal((len(node), 2))
    points = nodes[node] + off[:, :1] * side + off[:, 1:] * other - 1500.0 * directions
    covariance = np.zeros((len(node), 5, 5))
    covariance[:, 0, 0] = covariance[:, 1, 1] = 0.5 * sd**2
    covariance[:, 2, 2] = covariance[:, 3, 3] = 0.5 * sd**2 / 1500.0**2
    starts = nodes if starts is None else starts
    if response is None:
        response = np.zeros((len(node), 0, 4, 2))
    return axis_intersection.axis_ends(node, starts, points, directions, side, covariance, response)


def test_an_axis_is_known_at_its_node_by_its_place_and_its_slope():
    """J = (1, t) from place and slope to 1500 mm along the axis: J N J^T of noise, J R of each station's shift."""
    rng = np.random.default_rng(6)
    scale = np.array([1.0, 1.0, 1e-3, 1e-3])
    A, R = scale[:, None] * rng.normal(size=(4, 4)), scale[:, None] * rng.normal(size=(3, 4, 2))
    covariance = np.zeros((1, 5, 5))
    covariance[0, :4, :4] = A @ A.T + np.einsum("sjk,slk->jl", R, R)
    J = np.hstack([np.eye(2), 1500.0 * np.eye(2)])
    ends = axis_intersection.axis_ends(
        np.zeros(1, np.int64), np.array([[0.5, -0.2, 1500.0]]), np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.0, 0.0]]), covariance, R[None],
    )  # fmt: skip
    np.testing.assert_allclose(ends.covariance[0], J @ A @ A.T @ J.T, rtol=1e-9)  # float64
    np.testing.assert_allclose(ends.response[0], J @ R, rtol=1e-9)
    np.testing.assert_allclose(ends.offsets[0], [-0.5, 0.2, 0.0], atol=1e-12)


def test_intersections_of_exact_axes_are_the_nodes():
    rng = np.random.default_rng(1)
    nodes = rng.uniform(-5e4, 5e4, (20, 3))
    starts = nodes + rng.uniform(-20.0, 20.0, nodes.shape)
    met = axis_intersection.intersect_axes(ends_at(rng, nodes, 4, sd=1e-9, starts=starts), starts, 0.05)
    assert np.abs(met.positions - nodes).max() < 1e-7  # axes 1e-9 mm off, some of a node nearly parallel
    assert met.used.all()
    assert (met.axis_count == 4).all()


@pytest.mark.parametrize("eccentricity", [0.0, 1.0])
def test_covariance_agrees_with_errors_with_and_without_eccentric_axes(eccentricity):
    rng = np.random.default_rng(2)
    nodes = rng.uniform(-1e4, 1e4, (500, 3))
    for per_node in (3, 6):
        met = axis_intersection.intersect_axes(ends_at(rng, nodes, per_node, 0.1, eccentricity), nodes, 0.02)
        error = met.positions - nodes
        pull2 = np.einsum("ki,kij,kj->k", error, np.linalg.inv(met.covariance), error) / 3.0
        # 500 nodes: the median to 5 %, the mean, of few axes and an estimated scatter, to as much.
        assert np.sqrt(np.median(pull2) / 0.789) == pytest.approx(1.0, abs=0.12)  # 0.789 = median of chi2(3) / 3
        assert np.sqrt(pull2.mean()) == pytest.approx(1.0, abs=0.15)
        # 1500 axes or more, of 0.1 mm themselves: 2 % of either.
        assert met.eccentricity_mm == pytest.approx(max(eccentricity, 0.02), abs=0.08)


def test_nodes_of_two_axes_are_no_evidence_of_eccentricity():
    nodes = np.random.default_rng(9).uniform(-1e4, 1e4, (40, 3))
    per_node = np.repeat([3, 5, 2, 1], 10)
    both = ends_at(np.random.default_rng(8), nodes, per_node, 0.1, 1.0)
    rows = slice(0, 80)  # of the nodes of three and of five
    without = axis_intersection.AxisEnds(
        both.node[rows], both.offsets[rows], both.across[rows], both.covariance[rows], both.response[rows]
    )
    first, alone = (axis_intersection._first_eccentricity2(ends, k, 0.02) for ends, k in ((both, 40), (without, 20)))
    assert first == pytest.approx(alone, rel=1e-9)  # rounding


def test_outlying_axis_is_excluded_from_its_node():
    rng = np.random.default_rng(3)
    nodes = rng.uniform(-1e4, 1e4, (50, 3))
    ends = ends_at(rng, nodes, 6, 0.1)
    ends.offsets[::6] += 20.0 * ends.across[::6, 0]
    met = axis_intersection.intersect_axes(ends, nodes, 0.05)
    assert not met.used[::6].any()
    assert met.used.sum() >= 5 * 50 - 2  # 4.5 sigma: hardly another one
    assert (np.linalg.norm(met.positions - nodes, axis=1) < 0.5).all()  # five axes of 0.1 mm; their mean would be 3 off
    assert met.eccentricity_mm < 0.1  # it stays what it is at least, 0.05


def test_two_axes_fix_a_point_and_one_or_parallel_ones_do_not():
    rng = np.random.default_rng(4)
    nodes = np.zeros((3, 3))
    direction = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    node = np.array([0, 0, 1, 2, 2])
    side = np.array([across(d)[0] for d in direction])
    covariance = np.tile(np.diag([0.01, 0.01, 1e-9, 1e-9, 0.01]), (5, 1, 1))
    offset = rng.normal(scale=0.1, size=(5, 3))
    ends = axis_intersection.axis_ends(node, nodes, offset, direction, side, covariance, np.zeros((5, 0, 4, 2)))
    met = axis_intersection.intersect_axes(ends, nodes, 0.05)
    assert np.isfinite(met.positions[0]).all()
    assert met.positions[0, 2] == pytest.approx(0.5 * (offset[0, 2] + offset[1, 2]))  # equal weights, by hand
    assert np.isnan(met.positions[1:]).all()


def test_a_station_moves_all_axes_of_a_node_alike():
    """One station alone, off by 2 mm for each axis: so is the node, whatever the axes' scatter."""
    rng = np.random.default_rng(5)
    nodes = np.zeros((1, 3))
    response = np.zeros((6, 1, 4, 2))
    response[:, 0, 0, 0] = response[:, 0, 1, 1] = 2.0
    ends = ends_at(rng, nodes, 6, 0.01, response=response)
    with_noise = ends_at(rng, nodes, 6, 0.01)
    ends = axis_intersection.AxisEnds(ends.node, ends.offsets, ends.across, with_noise.covariance, ends.response)
    met = axis_intersection.intersect_axes(ends, nodes, 0.01)
    assert met.covariance[0] == pytest.approx(4.0 * np.eye(3), abs=1e-3)  # of the ends' own 0.01 mm, squared: 1e-4
