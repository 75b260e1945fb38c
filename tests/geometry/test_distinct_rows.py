"""Distinct rows are those of np.unique, whatever the range of their numbers."""

import numpy as np
import pytest

from processor.distinct_rows import components, distinct, distinct_points


@pytest.mark.parametrize("span", [3, 40, 10**6, 2**40])
@pytest.mark.parametrize("columns", [1, 2, 4])
def test_distinct_rows_equal_those_of_numpy(span, columns):
    rows = np.random.default_rng(columns).integers(-span, span, (5_000, columns))
    rows = np.vstack([rows, rows[::3]])
    found = distinct(rows)
    expected = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)
    for own, theirs in zip((found.rows, found.first, found.number, found.count), expected, strict=True):
        np.testing.assert_array_equal(own, theirs.reshape(own.shape))


def test_distinct_rows_of_an_empty_array_are_empty():
    found = distinct(np.empty((0, 3), np.int64))
    assert found.rows.shape == (0, 3)
    assert len(found.first) == len(found.number) == len(found.count) == 0


@pytest.mark.parametrize("count", [0, 1, 2_000])
def test_distinct_points_are_those_of_numpy(count):
    points = np.random.default_rng(count).integers(-4, 4, (count, 3)) / 8.0
    found = distinct_points(points)
    expected = np.unique(points, axis=0, return_inverse=True)
    for own, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(own, theirs.reshape(own.shape))


@pytest.mark.parametrize("links", [0, 30, 200])
def test_components_are_those_of_a_walk_numbered_by_their_first_nodes(links):
    rng = np.random.default_rng(links)
    a, b = rng.integers(0, 60, (2, links))
    number = np.arange(60)  # each link gives both of its ends the lower number, until nothing changes
    for _ in range(60):
        for i, j in zip(a, b, strict=True):
            number[i] = number[j] = min(number[i], number[j])
    assert components(60, a, b).tolist() == np.unique(number, return_inverse=True)[1].tolist()
