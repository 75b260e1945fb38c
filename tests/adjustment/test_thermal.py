"""Thermal expansion, by hand: 10 m of steel 25 K above the reference are 3 mm longer."""

import math

import pytest

from processor.adjustment import thermal


def test_steel_is_longer_by_its_temperature_and_as_designed_where_that_is_unknown():
    assert 10_000.0 * (thermal.expansion(45.0) - 1.0) == pytest.approx(3.0)
    assert thermal.expansion(math.nan) == 1.0
