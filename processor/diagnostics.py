"""What the parts of a step find on the way: numbers, and clouds on request.

An algorithm says by :func:`note` and :func:`keep` what it has found, by :func:`at` where, and by :func:`placed` in
which frame. Who runs it takes what was said by :func:`taken`; without a taker, and on other threads, nothing is kept.
Nothing that is said changes a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import numpy as np

from processor.model import Diagnostics, Floats


@dataclass(frozen=True)
class KeptCloud:
    """Points (n, 3), mm, of a stage of an algorithm at a place, such as a joint's end, in a frame that is named."""

    stage: str
    place: str
    frame: str
    points: Floats


@dataclass
class Notes:
    """What was said: (stage, place, quantity, value), and clouds."""

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
def with_clouds(wanted: bool = True) -> Iterator[None]:
    """Keep clouds too, in whatever is run within the block."""
    before = _clouds_wanted.set(wanted)
    try:
        yield
    finally:
        _clouds_wanted.reset(before)


@contextmanager
def taken() -> Iterator[Notes]:
    """Give what is said within the block."""
    notes = Notes()
    before = _notes.set(notes)
    try:
        yield notes
    finally:
        _notes.reset(before)


@contextmanager
def at(place: str) -> Iterator[None]:
    """Say that what is said within the block is of a place; places within places are joined."""
    before = _places.set((*_places.get(), place))
    try:
        yield
    finally:
        _places.reset(before)


@contextmanager
def placed(T: Floats, frame: str = "") -> Iterator[None]:
    """Say that points kept within the block are to be moved by T (4, 4) to a frame, named by the outermost block."""
    outer, T_outer = _frame.get()
    before = _frame.set((frame, T) if not outer else (outer, T_outer @ T))
    try:
        yield
    finally:
        _frame.reset(before)


@contextmanager
def silent() -> Iterator[None]:
    """Keep nothing that is said within the block: a repetition of what was said before."""
    before = _notes.set(None)
    try:
        yield
    finally:
        _notes.reset(before)


def note(stage: str, **values: float) -> None:
    """Say numbers that a stage has found; their names are the quantities, with a unit at the end."""
    notes = _notes.get()
    if notes is not None:
        place = ", ".join(_places.get())
        notes.rows += [(stage, place, quantity, float(value)) for quantity, value in values.items()]


def keep(stage: str, points: Floats | Callable[[], Floats]) -> None:
    """Say the points (n, 3) of a stage, mm; they are copied, or made, only where clouds are wanted."""
    notes = _notes.get()
    if notes is not None and _clouds_wanted.get():
        frame, T = _frame.get()
        given = points() if callable(points) else points
        notes.clouds.append(KeptCloud(stage, ", ".join(_places.get()), frame, given @ T[:3, :3].T + T[:3, 3]))


def say_again(notes: Notes) -> None:
    """Say what was said before, by an algorithm whose result is used again."""
    current = _notes.get()
    if current is not None:
        current.rows += notes.rows
        current.clouds += notes.clouds
