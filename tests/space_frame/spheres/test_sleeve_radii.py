"""Corner radii of sleeves: by the points of an end, by those of its class, by its tube."""

import numpy as np

from processor.space_frame.spheres.sleeve_radii import MemberEnds, estimated

SPHERE = 50.0


def test_a_sleeve_has_the_median_of_its_class_its_larger_one_or_a_share_of_its_tube():
    """Points 60 mm from the centre about each of six axes; the median of a hexagon is 0.901 of its corner radius."""
    directions = np.vstack([np.eye(3), -np.eye(3)])
    tubes = np.array([40.0, 40.0, 40.5, 40.0, 60.0, np.nan])  # 40.5 is of the class of 40
    offs, counts = np.array([18.0, 20.0, 22.0, 30.0, 33.0, 0.0]), np.array([8, 8, 8, 16, 8, 0])
    points = []
    for direction, off, count in zip(directions, offs, counts, strict=True):
        a, b = np.roll(direction, 1), np.roll(direction, 2)
        turn = 2.0 * np.pi * np.arange(count)[:, None] / max(count, 1)
        points.append(60.0 * direction + off * (np.cos(turn) * a + np.sin(turn) * b))
    points = np.concatenate(points)
    ends = MemberEnds(np.array([0, 6]), np.zeros((6, 3)), directions, tubes)
    found = estimated(ends, np.array([0, len(points)]), points, np.array([[0.0, 0.0, 0.0, SPHERE]]), threads=1)
    # The fourth has twice the least number of points; a class of one end keeps 0.7 of its tube; 25 mm without a tube.
    expected = [21.0 / 0.901] * 3 + [30.0 / 0.901, 42.0, 25.0]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
