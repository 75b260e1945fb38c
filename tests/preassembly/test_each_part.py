"""Parts on several threads: results, diagnostics and errors as one after the other."""

import threading
import time

import numpy as np
import pytest

from processor import diagnostics
from processor.model import Scan
from processor.preassembly.parts import each_part as parts_in_turn
from processor.preassembly.parts.each_part import each_part


def scans(points=10, count=4):
    return [[Scan(f"part {k}", np.zeros((points, 3)))] for k in range(count)]


def noted(of, monkeypatch, threads):
    monkeypatch.setattr(parts_in_turn, "usable", lambda: threads)
    names = set()

    def function(k):
        names.add(threading.current_thread().name)
        with diagnostics.at(f"part {k}"), diagnostics.placed(np.diag([1.0, 1.0, 1.0, 1.0]), "bridge"):
            diagnostics.note("fit", points=float(k))
            diagnostics.keep("fit", np.full((2, 3), float(k)))
        return k * k

    with diagnostics.recording() as notes, diagnostics.with_clouds(), diagnostics.at("step"):
        found = each_part(function, of)
    return found, notes, names


def test_threads_give_what_one_gives(monkeypatch):
    alone, on_threads = noted(scans(), monkeypatch, 1), noted(scans(), monkeypatch, 3)
    assert alone[0] == on_threads[0] == [0, 1, 4, 9]
    assert alone[1].rows == on_threads[1].rows
    assert [row[1] for row in on_threads[1].rows] == [f"step, part {k}" for k in range(4)]
    for one, other in zip(alone[1].clouds, on_threads[1].clouds, strict=True):
        assert (one.place, one.frame) == (other.place, other.frame)
        np.testing.assert_array_equal(one.points, other.points)
    assert alone[2] == {"MainThread"}
    assert "MainThread" not in on_threads[2]


def test_large_parts_are_worked_on_one_after_the_other(monkeypatch):
    monkeypatch.setattr(parts_in_turn, "POINTS_BESIDE", 39)
    assert noted(scans(points=20), monkeypatch, 4)[2] == {"MainThread"}
    assert "MainThread" not in noted(scans(points=19), monkeypatch, 4)[2]


def test_no_more_parts_at_a_time_than_points_allow(monkeypatch):
    monkeypatch.setattr(parts_in_turn, "POINTS_BESIDE", 39)
    monkeypatch.setattr(parts_in_turn, "usable", lambda: 4)
    beside, most, lock, met = 0, 0, threading.Lock(), threading.Event()

    def function(k):
        nonlocal beside, most
        with lock:
            beside += 1
            most = max(most, beside)
            if beside > 1:
                met.set()
        met.wait(5.0)
        with lock:
            beside -= 1

    each_part(function, scans(points=19, count=6))
    assert most == 2


def test_the_first_error_is_raised_and_no_further_part_begun(monkeypatch):
    monkeypatch.setattr(parts_in_turn, "usable", lambda: 2)
    begun = []

    def function(k):
        begun.append(k)
        if k == 1:
            raise ValueError(f"part {k}")
        time.sleep(0.05)

    with pytest.raises(ValueError, match="part 1"):
        each_part(function, scans(count=100))
    assert len(begun) < 50
