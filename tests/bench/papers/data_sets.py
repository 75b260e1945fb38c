"""Data sets of the papers' sizes, and what is measured in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class DataSet:
    """A scene: ``name`` in the tables, recipe of designgen with settings of ``make --set``, and seed."""

    paper: str
    name: str
    recipe: str
    settings: tuple[str, ...]
    seed: int

    @property
    def folder(self) -> str:
        """Name of a folder of its own."""
        plain = "".join(c if c.isalnum() else "-" for c in self.name)
        return f"{self.paper}-{plain}-seed{self.seed}"


@dataclass(frozen=True)
class Measured:
    """What a paper's methods found in a data set: figures by name, and lists of numbers for tables and charts."""

    data_set: DataSet
    figures: Mapping[str, float] = field(default_factory=dict)
    series: Mapping[str, list[Any]] = field(default_factory=dict)
    failed: str = ""
    seconds: float = 0.0


class Found:
    """All that was measured for one paper."""

    def __init__(self, measured: Sequence[Measured]) -> None:
        self.measured = sorted(measured, key=lambda one: (one.data_set.name, one.data_set.seed))

    @property
    def seeds(self) -> int:
        """Number of seeds of which anything was measured."""
        return len({one.data_set.seed for one in self.measured if not one.failed})

    def values(self, data: str, figure: str) -> tuple[float, ...]:
        """Return a figure of a data set over its seeds; NaN where a seed has none."""
        return tuple(one.figures.get(figure, float("nan")) for one in self.of(data))

    def series(self, data: str, name: str) -> list[Any]:
        """Return a list of the first seed that has it; empty without any."""
        return next((one.series[name] for one in self.of(data) if name in one.series), [])

    def of(self, data: str) -> list[Measured]:
        """Return what was measured in a data set, in the order of the seeds."""
        return [one for one in self.measured if one.data_set.name == data]
