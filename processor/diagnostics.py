"""Diagnostics of the stages of a step: numbers, and clouds on request.

An algorithm records numbers by :func:`note` and points by :func:`keep`; :func:`at` names the place and :func:`placed`
the frame. The caller collects them by :func:`recording`; outside of it, and on other threads, nothing is recorded.
Diagnostics never change a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from processor.model import Diagnostics, Floats

T = TypeVar("T")


@dataclass(frozen=True)
class KeptCloud:
    """Points (n, 3), mm, of a stage of an algorithm at a place, such as a joint's end, in a frame that is named."""

    stage: str
    place: str
    frame: str
    points: Floats


@dataclass
class Notes:
    """The record: rows of (stage, place, quantity, value), and clouds."""

    rows: list[tuple[str, str, str, float]] = field(default_factory=list)
    clouds: list[KeptCloud] = field(default_factory=list)

    def table(self) -> Diagnostics | None:
        """Return the numbers as a record; None without any. What is infinite becomes NaN."""
        if not self.rows:
            return None
        stage, place, quantity, value = zip(*self.rows, strict=True)
        values = np.array(value, np.float64)
        values[~np.isfinite(values)] = np.nan
        return Diagnostics(stage=stage, place=place, quantity=quantity, value=values)


_notes: ContextVar[Notes | None] = ContextVar("notes", default=None)
_places: ContextVar[tuple[str, ...]] = ContextVar("places", default=())
_frame: ContextVar[tuple[str, Floats]] = ContextVar("frame", default=("", np.eye(4)))
_clouds_wanted: ContextVar[bool] = ContextVar("clouds_wanted", default=False)


@contextmanager
def _set(variable: ContextVar[T], value: T) -> Iterator[None]:
    before = variable.set(value)
    try:
        yield
    finally:
        variable.reset(before)


def with_clouds(wanted: bool = True) -> AbstractContextManager[None]:
    """Record clouds, too, within the block."""
    return _set(_clouds_wanted, wanted)


@contextmanager
def recording() -> Iterator[Notes]:
    """Record the diagnostics of the block and yield the record."""
    notes = Notes()
    with _set(_notes, notes):
        yield notes


@contextmanager
def at(place: str) -> Iterator[None]:
    """Name the place of the diagnostics of the block; names of nested blocks are joined."""
    with _set(_places, (*_places.get(), place)):
        yield


@contextmanager
def placed(T_frame: Floats, frame: str = "") -> Iterator[None]:
    """Move points that the block keeps by a pose (4, 4) to a frame, which the outermost block names."""
    outer, T_outer = _frame.get()
    with _set(_frame, (outer, T_outer @ T_frame) if outer else (frame, T_frame)):
        yield


def note(stage: str, **values: float) -> None:
    """Record numbers of a stage; their names are the quantities, with a unit at the end."""
    notes = _notes.get()
    if notes is not None:
        place = ", ".join(_places.get())
        notes.rows += [(stage, place, quantity, float(value)) for quantity, value in values.items()]


def keep(stage: str, points: Floats | Callable[[], Floats]) -> None:
    """Record the points (n, 3) of a stage, mm; they are copied, or computed, only where clouds are wanted."""
    notes = _notes.get()
    if notes is not None and _clouds_wanted.get():
        frame, T = _frame.get()
        given = points() if callable(points) else points
        notes.clouds.append(KeptCloud(stage, ", ".join(_places.get()), frame, given @ T[:3, :3].T + T[:3, 3]))


def replay(notes: Notes) -> None:
    """Record again what an algorithm recorded before whose result is used again."""
    current = _notes.get()
    if current is not None:
        current.rows += notes.rows
        current.clouds += notes.clouds
