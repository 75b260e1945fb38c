"""Point feature histograms against the definition written out pair by pair, and their invariances."""

import math

import numpy as np
import pytest

from processor.defects import baseline
from processor.geometry import rigid
from processor.registration import pfh


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a, b):
    return sum(p * q for p, q in zip(a, b, strict=True))


def histogram_by_definition(points, normals, query, radius, bins):
    """Rusu's definition, one pair after the other, in plain Python."""
    near = [k for k in range(len(points)) if math.dist(points[k], points[query]) <= radius]
    counts, pairs = [0] * bins**3, 0
    for first in range(len(near)):
        for second in range(first + 1, len(near)):
            s, t = near[first], near[second]
            line = [q - p for p, q in zip(points[s], points[t], strict=True)]
            D = math.sqrt(dot(line, line))
            # The source is the point whose normal makes the smaller angle with the line between the two.
            if math.acos(min(1.0, abs(dot(normals[s], line)) / D)) > math.acos(
                min(1.0, abs(dot(normals[t], line)) / D)
            ):
                s, t, line = t, s, [-c for c in line]
            u = normals[s]
            v = cross(u, [c / D for c in line])
            norm = math.sqrt(dot(v, v))
            v = [c / norm for c in v]
            w = cross(u, v)
            alpha, beta = dot(v, normals[t]), dot(u, line) / D
            theta = math.atan2(dot(w, normals[t]), dot(u, normals[t]))
            cells = [
                min(bins - 1, int(bins * (alpha + 1.0) / 2.0)),
                min(bins - 1, int(bins * (beta + 1.0) / 2.0)),
                min(bins - 1, int(bins * (theta + math.pi) / (2.0 * math.pi))),
            ]
            counts[cells[0] + bins * cells[1] + bins * bins * cells[2]] += 1
            pairs += 1
    return [c / pairs for c in counts]


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 100.0, (60, 3))
    normals = rng.normal(size=(60, 3))
    return points, normals / np.linalg.norm(normals, axis=1)[:, None]


@pytest.mark.parametrize("bins", [5, 3])
def test_histograms_equal_the_definition_bin_by_bin(cloud, bins):
    points, normals = cloud
    found = pfh.histograms(points, normals, 45.0, bins)
    assert found.shape == (60, bins**3)
    for query in range(60):
        expected = histogram_by_definition(points.tolist(), normals.tolist(), query, 45.0, bins)
        np.testing.assert_allclose(found[query], expected, atol=1e-12)  # shares, float64


@pytest.mark.parametrize("normals", [lambda points: pfh.normals(points, 25.0), baseline._normals])
@pytest.mark.parametrize("centre", [[0.0, 0, 0], [5e5, -3e5, 100.0]])
def test_normals_of_a_sphere_point_outward(normals, centre):
    on = np.random.default_rng(4).normal(size=(1500, 3))
    on /= np.linalg.norm(on, axis=1)[:, None]
    assert np.einsum("ni,ni->n", normals(100.0 * on + centre), on).min() > 0.95  # within 18 degrees: none is inward


def test_coarse_alignment_on_a_shape_with_corners():
    rng = np.random.default_rng(3)
    shape = np.vstack(
        [
            rng.uniform(0.0, 1.0, (80, 3)) * s + o
            for s, o in [((900, 10, 10), (0, 0, 0)), ((10, 500, 300), (900, 0, 0)), ((200, 300, 10), (300, 100, 400))]
        ]
    )
    T = rigid.transform(rigid.rotation_from_vector(np.array([1.0, 0.5, -2.0])), np.array([100.0, -200.0, 300.0]))
    moved = rigid.apply(T, shape)
    described = [pfh.histograms(c, pfh.normals(c, 200.0), 200.0) for c in (shape, moved)]
    found = pfh.coarse_alignment(shape, moved, *described, tolerance_mm=20.0, iterations=3000, rng=rng)
    assert np.linalg.norm(rigid.apply(found, shape) - moved, axis=1).max() < 40.0  # twice the tolerance asked for


def test_a_pose_near_a_first_one_is_that_of_all_pairs_that_agree_with_it():
    """Thirty pairs that cannot be mistaken, half a mm apart: their least-squares pose, not that of the best three."""
    rng = np.random.default_rng(4)
    T = rigid.transform(rigid.rotation_from_vector(np.array([0.3, -0.2, 0.1])), np.array([10.0, -20.0, 30.0]))
    source = rng.uniform(-500.0, 500.0, (30, 3))
    target = rigid.apply(T, source) + rng.normal(0.0, 0.5, source.shape)
    prior = pfh.Prior(T, 1.0, 20.0)
    described = (np.eye(30), np.eye(30))
    found = pfh.coarse_alignment(source, target, *described, tolerance_mm=5.0, iterations=50, rng=rng, prior=prior)
    np.testing.assert_allclose(found, rigid.fit(source, target), atol=1e-9)  # float64


def test_a_point_alone_has_an_empty_histogram():
    assert pfh.histograms(np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), 1.0).sum() == 0.0
