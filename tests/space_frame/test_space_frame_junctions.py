"""Nodes and pairs from rough lines, worked by hand."""

import numpy as np
import pytest

from processor.space_frame.members.junctions import Lines, graph


def lines_of(*ends):
    """Lines from (start, end) pairs."""
    a, b = np.array([e[0] for e in ends], float), np.array([e[1] for e in ends], float)
    length = np.linalg.norm(b - a, axis=1)
    return Lines(0.5 * (a + b), (b - a) / length[:, None], -0.5 * length, 0.5 * length)


def toward(node, target, first=200.0, last=200.0):
    """Return a line between two nodes that is seen but for its ends."""
    node, target = np.array(node, float), np.array(target, float)
    u = (target - node) / np.linalg.norm(target - node)
    return node + first * u, target - last * u


ORIGIN, X, Y, Z = [0, 0, 0], [3000, 0, 0], [0, 3000, 0], [0, 0, 3000]


def test_three_lines_meet():
    found = graph(lines_of(toward(ORIGIN, X), toward(ORIGIN, Y), toward(ORIGIN, Z)))
    assert np.abs(found.nodes).max() < 1e-9  # rounding
    assert found.rays.tolist() == [3]
    assert len(found.pairs) == 0


def test_a_tetrahedron_is_four_nodes_and_six_members():
    corners = [ORIGIN, X, Y, Z]
    found = graph(lines_of(*[toward(corners[i], corners[j]) for i in range(4) for j in range(i)]))
    assert len(found.nodes) == 4
    assert found.pairs.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


CROSSING = [([-1500, 0, 0], [1500, 0, 0]), ([0, -1500, 0], [0, 1500, 0]), ([0, 0, -1500], [0, 0, 1500])]
NO_NODES = {
    "three cross": CROSSING,
    "two cross": CROSSING[:2],
    "two, one of them broken": [toward(ORIGIN, X, last=1800.0), toward(ORIGIN, X, first=1800.0), toward(ORIGIN, Y)],
    "miss each other": [toward(ORIGIN, X), toward([0, 0, 80], [0, 3000, 80]), toward([-80, 80, 0], [-80, 80, 3000])],
    "one alone": [toward(ORIGIN, X)],
}


@pytest.mark.parametrize("ends", NO_NODES.values(), ids=NO_NODES)
def test_lines_that_make_no_node(ends):
    assert len(graph(lines_of(*ends)).nodes) == 0


def test_a_line_seen_past_a_node_is_two_members():
    corners = [ORIGIN, X, [6000, 0, 0], [1500, 2500, 0], [4500, 2500, 0], [3000, 1200, 2500]]
    joined = [(0, 3), (1, 3), (1, 4), (2, 4), (3, 4), (0, 5), (1, 5), (2, 5), (3, 5), (4, 5)]
    through = ([200, 0, 0], [5800, 0, 0])
    found = graph(lines_of(through, *[toward(corners[i], corners[j]) for i, j in joined]))
    row = [int(np.linalg.norm(found.nodes - c, axis=1).argmin()) for c in np.array(corners)]
    assert len(found.nodes) == 6
    pairs = {tuple(p) for p in found.pairs.tolist()}
    assert {tuple(sorted((row[i], row[j]))) for i, j in [*joined, (0, 1), (1, 2)]} == pairs


def test_a_member_seen_in_two_parts_is_one():
    corners = [ORIGIN, X, Y, Z]
    whole = [toward(corners[i], corners[j]) for i in range(4) for j in range(i) if (i, j) != (1, 0)]
    parts = [toward(ORIGIN, X, last=1700.0), toward(ORIGIN, X, first=1700.0)]
    found = graph(lines_of(*whole, *parts))
    assert len(found.pairs) == 6


def test_a_corner_of_two_members_is_a_node_where_both_lead_to_nodes():
    corners = [ORIGIN, X, Y, [3000, 3000, 0], [6000, 0, 0], [6000, 3000, 0]]  # a ladder of two bays
    ladder = [(0, 1), (1, 4), (2, 3), (3, 5), (0, 2), (1, 3), (4, 5)]
    found = graph(lines_of(*[toward(corners[i], corners[j]) for i, j in ladder]))
    assert sorted(found.rays.tolist()) == [2, 2, 2, 2, 3, 3]
    assert len(found.pairs) == len(ladder)
    # A square alone has no node of three members, and a corner that leads nowhere is none.
    square = [(0, 1), (1, 3), (3, 2), (2, 0)]
    assert len(graph(lines_of(*[toward(corners[i], corners[j]) for i, j in square])).nodes) == 0
    loose = [toward([9000, 0, 0], [9000, 3000, 0]), toward([9000, 0, 0], [12000, 0, 0])]
    assert len(graph(lines_of(*[toward(corners[i], corners[j]) for i, j in ladder], *loose)).nodes) == 6


def test_graph_of_no_lines_has_no_nodes():
    assert len(graph(Lines(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))).nodes) == 0
