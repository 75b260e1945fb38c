"""What tests share on the disk is made once, and anew after a change of what made it."""

import numpy as np

from tests.support import made as cache
from tests.support.made import made

calls = []


def numbers(count, start):
    calls.append(count)
    return np.arange(start, start + count, dtype=float)


def test_a_thing_is_made_once_for_its_arguments_and_sources(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "FOLDER", tmp_path)
    calls.clear()
    first, again = made(numbers, 3, 0.5), made(numbers, 3, 0.5)
    np.testing.assert_array_equal(first, [0.5, 1.5, 2.5])
    first[0] = 7.0  # of this caller alone
    np.testing.assert_array_equal(again, [0.5, 1.5, 2.5])
    assert calls == [3]
    np.testing.assert_array_equal(made(numbers, 2, 0.5), [0.5, 1.5])
    assert calls == [3, 2]
    monkeypatch.setattr(cache, "_sources", lambda module: "changed")
    made(numbers, 2, 0.5)
    assert calls == [3, 2, 2]


def test_sources_are_those_of_all_that_a_module_imports():
    names = {path.name for path in cache._files("designgen.scanning.raycast")}
    assert "ray_kernels.py" in names
    assert "judging.py" not in names
