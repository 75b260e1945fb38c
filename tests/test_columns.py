"""Tables stored as columns."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from processor.model import Columns, Floats, Rows, column, names


@dataclass(frozen=True)
class Places(Rows):
    """Names, places and a column that may be absent."""

    name: tuple[str, ...] = names("k")
    place: Floats = column("k", 3)
    sd: Floats = column("k")


@dataclass(frozen=True)
class Seen(Columns):
    """Distances, and one noise of all."""

    distance: Floats
    scanner: Floats | None
    noise: float


TABLE = Places(("a", "b", "c"), np.arange(9.0).reshape(3, 3))


@pytest.mark.parametrize("rows", [slice(0, 3, 2), np.array([0, 2]), np.array([True, False, True])])
def test_rows_are_taken_by_slice_number_or_flag(rows):
    few = TABLE.take(rows)
    assert few.name == ("a", "c")
    assert few.place.tolist() == [[0.0, 1.0, 2.0], [6.0, 7.0, 8.0]]
    assert len(few.sd) == 0
    assert Seen(np.arange(3.0), None, 0.5).take(rows).distance.tolist() == [0.0, 2.0]


def test_values_of_the_whole_table_stay():
    joined = Seen.concat([Seen(np.array([1.0]), None, 0.5), Seen(np.array([2.0, 3.0]), None, 0.7)])
    assert (joined.distance.tolist(), joined.scanner, joined.noise) == ([1.0, 2.0, 3.0], None, 0.5)


def test_tables_are_joined_in_their_order():
    both = Places.concat([TABLE.take(slice(1, 2)), TABLE])
    assert both.name == ("b", "a", "b", "c")
    assert both.place[0].tolist() == [3.0, 4.0, 5.0]
    assert len(Places.concat([])) == 0


def test_a_table_of_objects_has_their_attributes_and_given_columns():
    items = [SimpleNamespace(name="a", place=np.zeros(3)), SimpleNamespace(name="b", place=np.ones(3))]
    table = Places.from_items(items, sd=[0.1, 0.2])
    assert (table.name, table.place.tolist(), table.sd.tolist()) == (("a", "b"), [[0.0] * 3, [1.0] * 3], [0.1, 0.2])
    assert Places.from_items([]).place.shape == (0, 3)
