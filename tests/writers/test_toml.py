"""Written TOML is read back unchanged by tomllib."""

import datetime
import math
import sys

import pytest

from processor.writers import toml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.mark.parametrize(
    "value",
    [
        'quotes " and \\ and \x7f and \x1b and\nlines',
        "拱脚 1",
        1,
        -2.5e-7,
        math.inf,
        True,
        [1, 2.5, "three"],
        datetime.date(2026, 11, 24),
        datetime.datetime(2026, 11, 24, 8, 30),
        datetime.time(8, 30),
        {"a b": [1], "c": {"d": "e"}},
    ],
)
def test_a_value_is_read_back_as_it_was(value):
    assert tomllib.loads(f"x = {toml.as_toml(value)}")["x"] == value


def test_a_document_with_tables_is_read_back_as_it_was():
    table = {"after": {"deep": {"x": 1}, "y": "\x7f"}, "before": [1, 2], "nan": 0.0, "odd key\x7f": 3}
    assert tomllib.loads(toml.document(table)) == table


def test_nan_is_read_back_as_nan():
    assert math.isnan(tomllib.loads(f"x = {toml.as_toml(math.nan)}")["x"])
