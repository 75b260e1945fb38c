"""Points beside something nearer to the scanner: a wall behind a post, by formula."""

import numpy as np
import pytest

from processor.adjustment import mixed_pixels
from processor.defects import observations, surface_charts
from processor.geometry import rigid

SCANNER, STEP, WALL, POST = np.array([0.0, -5000.0, 0.0]), 1.6e-3, 0.0, -300.0
HALF = 50.0  # of the post, mm


def scan(noise=0.0, seed=0):
    """Points of rays on a wall at y = 0 and a post before it, and which of them lie on the wall."""
    turn, rise = (x.ravel() for x in np.meshgrid(np.arange(-60, 61) * STEP, np.arange(-40, 41) * STEP))
    ray = np.stack([np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)], axis=1)
    at = SCANNER + ray * ((POST - SCANNER[1]) / ray[:, 1])[:, None]
    on_post = np.abs(at[:, 0]) < HALF
    depth = np.where(on_post, POST, WALL) - SCANNER[1]
    points = SCANNER + ray * (depth / ray[:, 1])[:, None]
    points += np.random.default_rng(seed).normal(0.0, noise, len(points))[:, None] * ray
    return points, ~on_post


def marked(points, wall, every, is_wall=None):
    """The wall is face 0, the post another."""
    is_wall = wall if is_wall is None else is_wall
    return marked_from(SCANNER, points, wall, -points[wall, 1], (every, np.where(is_wall, 0, 1)))


def marked_from(scanner, points, wall, height, every=None):
    """Mark the points of a wall square to y as seen from a scanner, of ``every`` point and its face."""
    normals, face = np.tile([0.0, -1.0, 0.0], (wall.sum(), 1)), np.zeros(wall.sum(), np.int64)
    every = (points, np.where(wall, 0, 1)) if every is None else every
    return mixed_pixels.mark(points[wall], scanner, normals, height, face, every)


def test_points_beside_a_post_are_marked_and_no_others():
    points, wall = scan()
    found = marked(points, wall, points)
    shadow = HALF * 5000.0 / 4700.0  # half of the post's shadow on the wall
    off = np.abs(points[wall, 0]) - shadow
    step_mm = 5000.0 * STEP
    assert found[off < step_mm].all()
    assert not found[off > mixed_pixels.WINDOW_STEPS * step_mm + mixed_pixels.half_beam_width(5000.0) + step_mm].any()


@pytest.mark.parametrize("face", [1, -1])  # of the post: of its own, or none, which the slope of a dent may explain
def test_marks_do_not_depend_on_the_frame(face):
    points, wall = scan()
    every, height, on = np.where(wall, 0, face), -points[wall, 1], np.zeros(wall.sum(), np.int64)
    normals = np.tile([0.0, -1.0, 0.0], (wall.sum(), 1))
    before = mixed_pixels.mark(points[wall], SCANNER, normals, height, on, (points, every))
    turn = rigid.rotation_from_vector(np.array([0.0, 0.0, 0.7]))
    moved, scanner = points @ turn.T + [4e4, -3e4, 2e3], turn @ SCANNER + [4e4, -3e4, 2e3]
    after = mixed_pixels.mark(moved[wall], scanner, normals @ turn.T, height, on, (moved, every))
    assert before.any()
    np.testing.assert_array_equal(after, before)


def test_without_the_post_nothing_is_marked_whatever_the_noise_of_a_point_itself():
    points, wall = scan(noise=0.5)
    assert not marked(points, wall, points[wall], wall[wall]).any()
    pulled = points.copy()  # the error of a point's own range does not decide about it
    pulled[wall] += 0.5 * (points[wall] - SCANNER) / np.linalg.norm(points[wall] - SCANNER, axis=1)[:, None]
    assert np.array_equal(marked(pulled, wall, points), marked(points, wall, points))


@pytest.mark.parametrize("depth", [8.0, -8.0])
def test_a_dent_or_a_bulge_is_not_marked(depth):
    """Points on top of a bulge have neighbours before the face, but none before themselves."""
    points, wall = scan()
    at = points[wall]
    away = np.abs(at[:, 0]) > 200.0
    at = at[away] + np.outer(
        depth * np.exp(-((at[away, 0] - 400.0) ** 2 + at[away, 2] ** 2) / 60.0**2), [0.0, 1.0, 0.0]
    )
    assert not marked(at, np.ones(len(at), bool), at).any()


@pytest.mark.parametrize(("rows", "at_once"), [(101, 0), (100_000, 0), (101, 100_000)])
def test_points_in_blocks_are_marked_as_at_once(rows, at_once, monkeypatch):
    """Of two scanners and an unknown one, whose points are mixed; those of the post are none of its wall's block."""
    monkeypatch.setattr(mixed_pixels, "AT_ONCE", at_once)
    monkeypatch.setattr(mixed_pixels, "BAND_POINTS", 300)
    monkeypatch.setattr(mixed_pixels.large_arrays, "BLOCK_ROWS", 997)
    points, wall = scan(noise=0.5)
    one = marked(points, wall, points)
    assert one.any()
    assert not one.all()
    scanners = np.array([SCANNER, np.full(3, np.nan), SCANNER + np.array([0.0, -2000.0, 300.0])])
    seen = np.vstack([points, points, points + scanners[2] - SCANNER])
    number, on = np.repeat([0, 1, 2], len(points)), np.tile(wall, 3)
    height = np.tile(-points[:, 1], 3)
    order = np.random.default_rng(0).permutation(len(seen))
    order = order[np.argsort(on[order] + 2 * (number[order] == 1), kind="stable")]  # posts first

    class Passes:
        def __iter__(self):
            for start in range(0, len(order), rows):
                part = order[start : start + rows]
                facet = np.where(on[part], 0, -1)
                yield mixed_pixels.Block(seen[part], number[part], np.where(on[part], 0, 1), facet, height[part])

    found = np.zeros(len(seen), bool)
    found[order[on[order]]] = mixed_pixels.mark_passes(Passes(), scanners, np.array([[0.0, -1.0, 0.0]]))
    expected = np.zeros((3, len(points)), bool)
    expected[0, wall] = one
    expected[2, wall] = marked_from(scanners[2], seen[number == 2], wall, -points[wall, 1])
    np.testing.assert_array_equal(found.reshape(3, -1), expected)


def test_a_few_points_are_no_scan():
    points, wall = scan()
    assert not marked(points[:3], wall[:3], points[:3]).any()


def square(low, high):
    """A closed box as vertices and faces."""
    x = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)], float)
    faces = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
             [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]  # fmt: skip
    return x, np.array(faces, np.int64)


def test_a_beam_past_the_edge_of_a_plate_is_no_dent_of_its_far_side():
    vertices, faces = square((0.0, 0.0, 0.0), (200.0, 12.0, 400.0))
    surface = surface_charts.of_mesh(vertices, faces, 20.0)
    grid = observations.mesh_distance.facet_grid(surface.vertices, surface.faces, surface.normals, 60.0)
    scanner = np.array([[2000.0, -600.0, 200.0]])
    front = int(np.flatnonzero(surface.normals[:, 1] < -0.9)[0])
    through = np.array([[100.0, 10.0, 200.0], [197.0, 10.0, 200.0]])  # the second line of sight enters by the edge
    passed = observations._passed_by(
        surface, grid, np.full(2, front), through, np.full(2, -10.0), np.repeat(scanner, 2, axis=0)
    )
    assert passed.tolist() == [False, True]


def test_points_beside_a_rail_before_a_wall_at_grazing_incidence_are_marked():
    """A rail stands 80 mm before the wall: of its neighbours on the wall, the rail lies within the slope of a dent."""
    scanner, step = np.array([-20_000.0, -4_600.0, 0.0]), 1.0e-3
    turn, rise = (x.ravel() for x in np.meshgrid(np.arange(0.15, 0.45, step), np.arange(-10, 11) * step))
    ray = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], axis=1)
    on_wall = scanner + ray * (-scanner[1] / ray[:, 1])[:, None]
    on_rail = scanner + ray * ((-80.0 - scanner[1]) / ray[:, 1])[:, None]
    is_rail = (np.abs(on_rail[:, 0]) < 30.0)[:, None]
    points, wall = np.where(is_rail, on_rail, on_wall), ~is_rail[:, 0]
    found = marked_from(scanner, points, wall, -points[wall, 1])
    turned = np.arctan2(ray[:, 1], ray[:, 0])
    beside = np.abs(turned[wall] - turned[~wall].min() + step) < 0.3 * step  # past the rail's far end
    assert beside.sum() == 21
    assert found[beside].all()
