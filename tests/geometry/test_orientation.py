"""Signs of normals: upwards where that decides, else one sign for each connected surface, in any order of points."""

import numpy as np
import pytest

from processor.geometry import m3c2, nearest_neighbours, normal_orientation
from processor.geometry.m3c2 import oriented
from processor.geometry.normal_orientation import UP
from tests.support.clouds.m3c2_clouds import wavy

ACROSS = 120.0  # normal diameter, mm


def wall(seed, along=(1.0, 0.0), count=4000, size=1000.0, sigma=2.0, lean=0.0):
    """An upright wall through zero along a level direction, that leans by so much."""
    rng = np.random.default_rng(seed)
    u, z = rng.uniform(0.0, size, (2, count))
    a, b = np.array(along) / np.linalg.norm(along)
    off = rng.normal(0.0, sigma, count) - lean * z
    return np.column_stack([u * a - off * b, u * b + off * a, z])


def tube(seed, count=6_000, radius=150.0):
    rng = np.random.default_rng(seed)
    angle, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, 800.0, count)
    r = radius + rng.normal(0.0, 1.0, count)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


def turned(cloud, core=None, scanner=None, across=ACROSS):
    core = cloud if core is None else core
    found = m3c2.normals(nearest_neighbours.of_spacing(cloud), core, across)
    return found, normal_orientation.turned(found, core, across, scanner)


@pytest.mark.parametrize(
    ("normal", "towards", "expected"),
    [
        ([0, 0.6, 0.8], [0, 0, 1], [0, 0.6, 0.8]),
        ([0, 0.6, -0.8], [0, 0, 1], [0, -0.6, 0.8]),
        ([0.6, 0, 0.8], [0, 0, -1], [-0.6, 0, -0.8]),
        ([0.6, 0, -0.8], [0, 1, 0], [-0.6, 0, 0.8]),  # square to the direction: along +z
        ([0.6, -0.8, 0], [0, 0, 1], [-0.6, 0.8, 0]),  # along +y
        ([-1, 0, 0], [0, 1, 0], [1, 0, 0]),  # along +x
    ],
)
def test_a_normal_is_turned_along_its_direction_and_square_to_it_upwards(normal, towards, expected):
    for directions in (towards, [towards]):  # one of all, or one of each
        np.testing.assert_array_equal(oriented(np.array([normal], float), np.array(directions, float)), [expected])


def test_links_between_neighbours_are_lighter_the_more_parallel_their_normals_and_the_more_in_one_plane():
    """A step (0, 3, 4) is 4 along the normal z, and 5 along (0, 0.6, 0.8), which is turned by a cosine of 0.8."""
    places = np.array([[1.0, 2.0, 3.0], [1.0, 5.0, 7.0], [1.0, 62.0, 83.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, -0.6, -0.8], [0.0, 0.0, 1.0]])
    index, far = np.array([[0, 1, 2]]), np.array([[0.0, 5.0, 100.0]])
    cosine, weight = np.empty((1, 3)), np.empty((1, 3), np.uint16)
    rows = np.array([0])
    normal_orientation._links(places, normals, rows, index, far, 50.0, 0, 1, cosine, weight)
    no_link = normal_orientation.NO_LINK  # to itself and to a place beyond the limit of 50
    np.testing.assert_allclose(cosine, [[0.0, -0.8, 0.0]])
    # 1 - 0.8 + (4 + 5) / 2 / 5, in steps.
    assert weight.tolist() == [[no_link, pytest.approx(1.1 * normal_orientation.STEPS, abs=1.0), no_link]]


def test_normals_of_level_surfaces_equal_those_oriented_upwards_bit_for_bit():
    cloud = wavy(5_000, 1)
    found, got = turned(cloud)
    np.testing.assert_array_equal(got.normals, oriented(found.normals, UP))
    assert (got.up, got.upright) == (len(cloud), 0)


@pytest.mark.parametrize(
    ("along", "outward"),
    [((1, 0), (0, 1)), ((0, 1), (1, 0)), ((1, 1), (-1, 1)), ((1, -1), (1, 1)), ((1, 2), (2, -1))],
)
def test_normals_of_an_upright_wall_have_one_side_by_convention(along, outward):
    found, got = turned(wall(1, along))
    assert 0.3 < (oriented(found.normals, UP)[:, :2] @ outward > 0.0).mean() < 0.7  # as it was: by chance
    assert (got.normals[:, :2] @ outward > 0.0).all()
    assert (got.convention, got.surfaces) == (4000, 1)


def test_normals_of_a_leaning_wall_point_upwards_on_the_whole():
    _, got = turned(wall(3, lean=0.05))
    assert got.up == 0
    assert (got.normals[:, 1] > 0.0).all()  # the side that looks up, though some of its normals do not
    _, other = turned(wall(3, lean=-0.05))
    assert (other.normals[:, 1] < 0.0).all()
    steep, got = turned(wall(4, lean=0.4))
    np.testing.assert_array_equal(got.normals, oriented(steep.normals, UP))


def test_normals_of_a_wall_point_to_the_side_of_its_floor():
    rng = np.random.default_rng(5)
    for side in (1.0, -1.0):
        x, y = rng.uniform(0.0, 1000.0, (2, 4000))
        floor = np.column_stack([x, side * y, rng.normal(0.0, 1.0, 4000)])
        upright = wall(6, sigma=1.0)
        _, got = turned(np.vstack([floor, upright]))
        high = slice(4000, None)
        above = upright[:, 2] > 100.0
        assert (side * got.normals[high][above, 1] > 0.0).all()
        assert got.neighbours > 2500
        assert got.surfaces <= 2
        assert (got.normals[:4000][np.abs(floor[:, 1]) > 100.0, 2] > 0.9).all()


def test_a_tube_that_stands_alone_looks_outward():
    cloud = tube(7)
    _, got = turned(cloud)
    assert (np.einsum("ni,ni->n", got.normals[:, :2], cloud[:, :2]) > 0.0).all()


def test_normals_of_an_upright_wall_point_to_the_scanner():
    cloud = wall(8)
    scanner = np.broadcast_to([500.0, -4000.0, 500.0], cloud.shape)
    _, got = turned(cloud, scanner=scanner)
    assert (got.normals[:, 1] < 0.0).all()
    assert (got.scanner, got.convention) == (len(cloud), 0)
    half = np.where(cloud[:, :1] < 500.0, scanner, np.nan)  # the rest follows its neighbours
    _, got = turned(cloud, scanner=half)
    assert (got.normals[:, 1] < 0.0).all()
    assert got.scanner > 1500 < got.neighbours


def test_order_and_repeated_points_do_not_change_orientations():
    aside = np.array([600.0, 600.0, 0.0])
    cloud = np.vstack([tube(9, 4000), wall(10, (1, -1), 4000) + aside, wavy(4000, 11) - [0.0, 0.0, 90.0]])
    cloud = np.vstack([cloud, np.repeat(cloud[:300], 15, axis=0)])
    found, first = turned(cloud)
    mixed = np.random.default_rng(12).permutation(len(cloud))
    _, again = turned(cloud[mixed])
    np.testing.assert_array_equal(again.normals, first.normals[mixed])
    np.testing.assert_array_equal(np.abs(first.normals), np.abs(found.normals))


def test_orientation_works_for_few_distant_or_no_core_points():
    cloud = wall(13)
    _, got = turned(cloud, np.array([[100.0 + 80.0 * i, 0.0, 500.0] for i in range(11)]))
    assert (got.normals[:, 1] > 0.9).all()
    for core in (np.array([[500.0, 0.0, 500.0]]), np.array([[500.0, 0.0, 500.0], [1e5, 0.0, 0.0]])):
        _, got = turned(cloud, core)
        assert got.normals[0, 1] > 0.9
    assert np.isnan(got.normals[1]).all()
    assert turned(cloud, np.empty((0, 3)))[1].upright == 0
