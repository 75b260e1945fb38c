"""Epochs of step ``inspect``: the characteristics of each component."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from processor.epochs.series import Series
from processor.inspection.result import InspectedComponent, Result
from processor.language.messages import label
from processor.model import Reason, Status

BY_DESIGN = False  # actual sizes


def series(results: Sequence[Result | None]) -> Iterator[Series]:
    """Yield each characteristic's actual size; its deviation where the nominal size is not known."""
    tables = [{} if one is None else {part.name: part for part in one.components} for one in results]
    for name in dict.fromkeys(name for table in tables for name in table):
        parts = [table.get(name) for table in tables]
        ids = dict.fromkeys(key for part in parts if part is not None for key in part.characteristics.id)
        for key in ids:
            values = np.array([_value(part, key) for part in parts]).reshape(-1, 4)
            actual = np.where(np.isfinite(values[:, 0]).any(), values[:, 0], values[:, 1])
            unit = next(_unit(part, key) for part in parts if part is not None and key in part.characteristics.id)
            yield Series(
                component=name,
                quantity=label(key),
                value=actual,
                ci95=values[:, 2],
                unit=unit,
                doubtful=values[:, 3] > 0.0,
            )


def remarks(_: Sequence[Result | None]) -> Iterator[Reason]:
    """Say nothing: sizes of a part have nothing in common but the scanner."""
    yield from ()


def _value(part: InspectedComponent | None, key: str) -> tuple[float, float, float, float]:
    """Return actual size, deviation, half-width, and 1 where they are doubtful."""
    if part is None or key not in part.characteristics.id:
        return np.nan, np.nan, np.nan, 0.0
    table, row = part.characteristics, part.characteristics.id.index(key)
    doubtful = float(part.status is not Status.OK)
    return float(table.actual[row]), float(table.deviation[row]), float(table.ci95[row]), doubtful


def _unit(part: InspectedComponent, key: str) -> str:
    return part.characteristics.unit[part.characteristics.id.index(key)]
