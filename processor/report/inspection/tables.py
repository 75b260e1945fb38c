"""Tables of inspected components."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.inspection.result import Characteristics, Result
from processor.language.messages import text
from processor.model import StepRun
from processor.report.characteristics import RISKS
from processor.report.columns import MM
from processor.report.table import Table, tabulate

NOTE = text(
    "Deviation: actual less nominal. ci95 is the half-width of its 95 % interval. Twist is the rotation of the end "
    "section against the start section times the height; squareness is the tilt of an end face against the part's "
    "chord, times the width or height. Sweep (positive to the left) and camber (upward) are the greatest departures of "
    "the axis from the design's, measured from the chord between the part's own ends. Lower and upper bound the "
    "deviation; verdicts follow ISO 14253-1 unless the "
    "project states another decision rule. The risks are the probabilities that it is wrong to accept and to reject."
)


def step_tables(runs: Sequence[StepRun], _: ErrorReport) -> list[Table]:
    """Tables of the first run: all characteristics, and the axis of each component."""
    result: Result = runs[0].result
    if not result.components:
        return []
    every = Characteristics.concat([component.characteristics for component in result.components])
    cells: dict[str, Any] = {
        "component": [component.name for component in result.components for _ in component.characteristics.id],
        "characteristic": every.id,
        "quantity": every.quantity,
        **{name: getattr(every, name) for name in ("nominal", "actual", "deviation", "ci95", "lower", "upper", "unit")},
        "verdict": every.verdict,
        **{name: getattr(every, name) for name in RISKS if len(getattr(every, name))},
        "clause": every.clause,
        "remark": every.reasons,
    }
    tables = [tabulate(text("Characteristics of components"), cells, "inspect", NOTE, on_terminal=False)]
    axes = {component.name: component.axis for component in result.components if len(component.axis)}
    if axes:
        cells = {"component": [name for name, axis in axes.items() for _ in axis.chainage]}
        for name in ("chainage", "sideways", "sideways_ci95", "up", "up_ci95"):
            cells[f"{name}_mm"] = np.concatenate([getattr(axis, name) for axis in axes.values()])
        title = text("Axes of components against the design's")
        tables.append(tabulate(title, cells, "inspect-axes", units=MM, on_page=False, on_terminal=False))
    return tables
