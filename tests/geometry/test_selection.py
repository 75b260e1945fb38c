"""Selection and the median compared with those of NumPy."""

import numpy as np
from numba import njit

from processor.geometry.selection import least_first, median


def test_the_least_come_first():
    rng = np.random.default_rng(1)
    for count in (1, 2, 3, 8, 41):
        for values in (rng.normal(size=count + 3), rng.integers(0, 3, count + 3) * 1.0, np.full(count + 3, 2.0)):
            expected = np.sort(values[:count])
            for k in range(count):
                found = values.copy()
                least_first.py_func(found, count, k)
                assert found[k] == expected[k]
                np.testing.assert_array_equal(np.sort(found[:k]), expected[:k])
                np.testing.assert_array_equal(np.sort(found[:count]), expected)
                np.testing.assert_array_equal(found[count:], values[count:])


@njit
def called(values, count):
    return median(values, count)  # Python cannot call it


def test_median_is_numpys():
    rng = np.random.default_rng(2)
    for count in (1, 2, 3, 8, 41):
        for values in (rng.normal(size=count + 3), rng.integers(0, 3, count + 3) * 1.0):
            assert called(values.copy(), count) == np.median(values[:count])
