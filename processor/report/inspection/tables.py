"""Tables of inspected components."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from processor.evaluation.evaluate import ErrorReport
from processor.inspection.result import Characteristics, InspectedComponent, Result
from processor.language.messages import text
from processor.model import StepRun
from processor.report.columns import MM, columns
from processor.report.table import Table

__all__ = ["Characteristics", "step_tables"]

NOTE = text(
    "Deviation: actual less nominal. ci95 is the half-width of its 95 % interval. Twist is the rotation of the end "
    "section against the start section times the height; squareness is the tilt of an end face against the part's "
    "chord, times the width or height. Sweep (positive to the left) and camber (upward) are the greatest departures of "
    "the axis from the design's, measured from the chord between the part's own ends. Lower and upper bound the "
    "deviation; verdicts follow ISO 14253-1."
)


def step_tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of the first run: all characteristics, and the axis of each component."""
    result: Result = runs[0].result
    if not result.components:
        return []
    header = columns("component", "characteristic", "quantity", "nominal", "actual", "deviation", "ci95",
               "lower", "upper", "unit", "verdict", "clause", "remark")  # fmt: skip
    rows = tuple(row for component in result.components for row in _rows(component))
    tables = [Table(text("Characteristics of components"), header, rows, "inspect", NOTE, on_terminal=False)]
    if any(len(component.axis) for component in result.components):
        tables.append(_axes(result))
    return tables


def _rows(component: InspectedComponent) -> Iterator[tuple[Any, ...]]:
    for row in component.characteristics.items():
        yield (component.name, *(one for name, one in row.items() if name not in ("limit", "verified")))


def _axes(result: Result) -> Table:
    rows = tuple(
        (component.name, *row)
        for component in result.components
        for row in zip(
            *(column.tolist() for column in (
                component.axis.chainage, component.axis.sideways, component.axis.sideways_ci95, component.axis.up,
                component.axis.up_ci95,
            )), strict=True,
        )
    )  # fmt: skip
    header = columns("component", "chainage_mm", "sideways_mm", "sideways_ci95_mm", "up_mm", "up_ci95_mm")
    title = text("Axes of components against the design's")
    return Table(title, header, rows, "inspect-axes", units=MM, on_page=False, on_terminal=False)
