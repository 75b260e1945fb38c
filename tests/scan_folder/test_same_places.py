"""Vertices that a mesh repeats, joined by position."""

import numpy as np
import pytest
import trimesh

from processor.geometry.nearest_neighbours import same_places
from processor.scan_folder.shapes.body import welded


def test_points_within_the_distance_have_one_number_and_others_have_their_own():
    points = np.array([[0.0, 0, 0], [5.0, 0, 0], [5e-5, 0, 0], [0.0, 0, 0], [5.0, 2e-4, 0]])
    place = same_places(points, 1e-4)
    assert place[0] == place[2] == place[3]
    assert len({place[0], place[1], place[4]}) == 3
    assert len(same_places(np.empty((0, 3)), 1e-4)) == 0


@pytest.mark.parametrize("offset", [0.0, 5e-5, 1234.56785])
def test_a_body_is_closed_wherever_its_vertices_lie_on_a_grid(offset):
    """Each facet of a box has corners of its own, off by rounding: astride the step of any grid they are one."""
    mesh = trimesh.creation.box([100.0, 60.0, 40.0])
    corners = mesh.vertices[mesh.faces].reshape(-1, 3) + offset
    corners += np.random.default_rng(1).uniform(-1e-9, 1e-9, corners.shape)
    body = welded("box", corners, np.arange(len(corners)).reshape(-1, 3))
    assert len(body.vertices) == 8
    assert body.open_edges == 0
