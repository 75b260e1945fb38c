"""The points of a part among ground, trestles and walls: which points of made-up scenes are found to be the part's."""

import numpy as np
import pytest

from processor.registration import main_body

SIZE = np.array([6000.0, 1200.0, 900.0])


def rectangle(rng, low, high, step=30.0):
    """Points on an axis-aligned rectangle (one size is zero), one on each step in square."""
    low, high = np.array(low, float), np.array(high, float)
    area = np.prod(np.delete(high - low, np.argmin(high - low)))
    return rng.uniform(low, high, (int(area / step**2), 3)) + rng.normal(0.0, 1.0, (int(area / step**2), 3))


def box(rng, low, high):
    low, high = np.array(low, float), np.array(high, float)
    sides = []
    for k in range(3):
        for at in (low, high):
            a, b = low.copy(), high.copy()
            a[k] = b[k] = at[k]
            sides.append(rectangle(rng, a, b))
    return np.concatenate(sides)


def part(rng):
    return box(rng, [0.0, 0.0, 600.0], SIZE + np.array([0.0, 0.0, 600.0]))


def ground(rng, margin=1000.0):
    return rectangle(rng, [-margin, -margin, 0.0], [SIZE[0] + margin, SIZE[1] + margin, 0.0])


def wall(rng):
    return rectangle(rng, [-2000.0, 3000.0, 0.0], [9000.0, 3000.0, 4000.0])


def crate(rng):
    return box(rng, [2000.0, 2000.0, 0.0], [3200.0, 2800.0, 800.0])


def trestle(rng):
    return box(rng, [1000.0, -100.0, 0.0], [1200.0, 1300.0, 600.0])


ALL_BUT_EDGES = 0.999  # the ground's edges of one voxel's width, and points of three sd of noise


def found(rng, *others):
    """Shares of the part's points and of the others that are taken for the part's."""
    of_part, rest = part(rng), np.concatenate([other(rng) for other in others])
    points = np.concatenate([of_part, rest])
    order = rng.permutation(len(points))
    taken = np.empty(len(points), bool)
    taken[order] = main_body.of_sizes(points[order], [SIZE, 0.5 * SIZE])
    return taken[: len(of_part)].mean(), taken[len(of_part) :].mean()


@pytest.mark.parametrize("others", [(crate,), (ground, wall, crate)])
def test_a_part_among_things_that_do_not_touch_it_is_found(others):
    of_part, of_others = found(np.random.default_rng(1), *others)
    assert of_part > ALL_BUT_EDGES
    assert of_others < 1.0 - ALL_BUT_EDGES


def test_objects_touching_a_part_are_kept_with_it():
    rng = np.random.default_rng(2)
    of_part, of_others = found(rng, ground, trestle)
    assert of_part > ALL_BUT_EDGES
    assert 0.0 < of_others < len(trestle(rng)) / (len(trestle(rng)) + len(ground(rng)))


def test_main_body_is_found_in_any_pose():
    rng = np.random.default_rng(3)
    own, below = part(rng), ground(rng)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    taken = main_body.of_sizes(np.concatenate([own, below]) @ turn.T + 1e5, [SIZE])
    assert taken[: len(own)].mean() > ALL_BUT_EDGES
    assert taken[len(own) :].mean() < 1.0 - ALL_BUT_EDGES


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_no_points_are_dropped_from_a_part_or_a_piece_alone(share):
    points = part(np.random.default_rng(4))
    assert main_body.of_sizes(points[points[:, 0] <= share * SIZE[0]], [SIZE]) is None


def test_no_points_are_dropped_from_clouds_without_another_body():
    rng = np.random.default_rng(5)
    for points in (
        np.concatenate([part(rng), rng.uniform(-1000.0, 7000.0, (300, 3))]),  # stray ones
        rng.uniform(0.0, 1e5, (50, 3)),
        np.zeros((10, 3)),
        1000.0 * part(rng),  # far larger than the part
    ):
        assert main_body.of_sizes(points, [SIZE]) is None
