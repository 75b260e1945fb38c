"""Thermal expansion, by hand: 10 m of steel 25 K above the reference are 3 mm longer."""

import math

import pytest

from processor.adjustment import thermal


def test_ten_metres_of_steel_25_kelvin_warmer_are_3_mm_longer():
    assert 10_000.0 * (thermal.expansion(45.0) - 1.0) == pytest.approx(3.0)


def test_expansion_at_an_unknown_temperature_is_one():
    assert thermal.expansion(math.nan) == 1.0
