"""A part among surroundings: placed by its design's surface, and not on the neighbour or on what touches it."""

from unittest import mock

import numpy as np
import pytest
from scipy.spatial import cKDTree

from processor.geometry import mesh_distance, rigid
from processor.registration import located_part, pose_search

SIZE = np.array([5000.0, 1100.0, 800.0])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))  # of a box, by corners
FACES = np.array([[side[0], side[k], side[k + 1]] for side in SIDES for k in (1, 2)])


def box(rng, low, size, step=25.0):
    """Points on the six sides of a box, one on each step in square."""
    low, size, sides = np.array(low, float), np.array(size, float), []
    for k in range(3):
        for end in (0.0, 1.0):
            share = rng.uniform(size=(int(np.prod(np.delete(size, k)) / step**2), 3))
            share[:, k] = end
            sides.append(low + share * size)
    return np.concatenate(sides)


def floor(rng, low, high, step=40.0):
    count = int(np.prod(np.subtract(high, low)) / step**2)
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.zeros(count)])


@pytest.fixture(scope="module")
def design():
    return pose_search.prepared(mesh_distance.of_mesh(CORNERS * SIZE, FACES))


@pytest.mark.parametrize("seed", range(3))
def test_the_part_is_found_on_its_trestles_beside_a_neighbour_of_its_shape(design, seed):
    rng = np.random.default_rng(seed)
    part = box(rng, [0.0, 0.0, 700.0], SIZE)
    neighbour = box(rng, [300.0, 2000.0, 500.0], SIZE, step=60.0)  # farther from the scanner: fewer points
    trestles = [box(rng, [x, -300.0, 0.0], [250.0, 1700.0, 700.0]) for x in (600.0, 4100.0)]
    wall = box(rng, [-3000.0, 5000.0, 0.0], [11000.0, 10.0, 4000.0], step=40.0)
    scene = np.concatenate([part, neighbour, *trestles, wall, floor(rng, [-3000.0, -4000.0], [8000.0, 5000.0])])
    scene += rng.normal(0.0, 1.0, scene.shape)
    T = rigid.transform(rigid.rotation_from_vector(rng.normal(size=3)), rng.uniform(-5e3, 5e3, 3))
    points = rigid.apply(T, scene)

    ((located,),) = located_part.locate(points, [design])  # the neighbour has too few points to be meant
    taken = located_part.at_design(points, located.T, design)
    assert taken[: len(part)].mean() > 0.999
    assert taken[len(part) : len(part) + len(neighbour)].sum() == 0
    placed = rigid.apply(located.T, points[: len(part)])
    off, beyond = design.mesh.distances(placed, 60.0)[1:]
    assert np.median(np.hypot(off, beyond)) < 3.0


def test_of_two_parts_the_one_that_goes_on_where_points_are_is_it(design):
    rng = np.random.default_rng(4)
    shorter = pose_search.prepared(mesh_distance.of_mesh(CORNERS * SIZE * [0.9, 1.0, 1.0], FACES))
    points = np.concatenate([box(rng, [0.0, 0.0, 700.0], SIZE), floor(rng, [-3000.0, -4000.0], [8000.0, 5000.0])])
    located = located_part.locate(points, [shorter, design])
    assert located_part.which(points, [shorter, design], located)[0].numbers == (1,)


def test_a_place_whose_points_are_all_beyond_the_faces_is_none(design):
    """Of a long box a sample of the plane of its bottom is near points of the floor beside it."""
    away = located_part.Located(np.eye(4), 0.5)
    points = np.random.default_rng(6).uniform([-500.0, -500.0, -5.0], [-100.0, -100.0, 5.0], (1000, 3))
    with mock.patch.object(located_part, "_on_body", return_value=away):
        search = located_part._Search(points, cKDTree(points), 50.0)
        assert located_part._located(search, [points], design, pieces=False) == []


def test_nothing_is_located_among_surroundings_alone(design):
    rng = np.random.default_rng(5)
    points = np.concatenate([floor(rng, [-3000.0, -4000.0], [8000.0, 5000.0]), box(rng, [0.0, 0.0, 0.0], [700.0] * 3)])
    located = located_part.locate(points, [design])
    assert located_part.which(points, [design], located) == []
