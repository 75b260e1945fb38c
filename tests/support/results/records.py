"""Records compared field by field."""

import dataclasses

import numpy as np


def assert_equal(actual, expected):
    """Records, tuples and arrays are equal to the last bit; NaN equals NaN."""
    assert type(actual) is type(expected)
    if dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            assert_equal(getattr(actual, field.name), getattr(expected, field.name))
    elif isinstance(expected, tuple):
        assert len(actual) == len(expected)
        for one, other in zip(actual, expected, strict=True):
            assert_equal(one, other)
    else:
        if isinstance(expected, np.ndarray):
            assert actual.dtype == expected.dtype
        np.testing.assert_array_equal(actual, expected)
