"""The picture of a comparison of epochs: the changes of the components that changed most, over the days."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.dates as mdates
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from processor.epochs.change import Component, Finding
from processor.epochs.compare import History
from processor.language.messages import Message, text
from processor.report import style
from processor.report.epochs.tables import ordered

MOST, ACROSS = 12, 3  # drawn size: four rows on the page
CAPTION = text(
    "Change of each component's strongest value since its first epoch, with 95 % intervals of both epochs together; in "
    "orange what changed."
)


def changes(history: History) -> tuple[Message, bytes] | None:
    """Draw the strongest changes, a panel a component; None where nothing is known."""
    shown = [(k, one) for k, one in enumerate(ordered(history)) if one.leading is not None][:MOST]
    if not shown:
        return None
    down = math.ceil(len(shown) / ACROSS)
    figure = Figure(figsize=(11.0, 0.6 + 2.4 * down), layout="constrained")
    panels = figure.subplots(down, min(ACROSS, len(shown)), squeeze=False).ravel()
    for axes, (row, one) in zip(panels, shown, strict=False):
        _panel(axes, history, row, one)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    return CAPTION, style.png(figure)


def _panel(axes: Axes, history: History, row: int, one: Component) -> None:
    assert one.leading is not None
    same = [change for change in one.changes if change.series is one.leading.series]
    dates: Any = mdates  # it has no types
    days = np.array([dates.date2num(epoch.day) for epoch in history.epochs])
    rows = [same[0].first, *(change.last for change in same)]
    values = [0.0, *(change.value for change in same)]
    colour = style.COLOURS[1] if one.finding is Finding.CHANGED else style.COLOURS[0]
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.plot(days[rows], values, "-", color=colour, linewidth=0.8)
    axes.plot(days[rows[:1]], [0.0], "o", color=colour, markersize=4)
    half = [change.ci95 for change in same]
    axes.errorbar(days[rows[1:]], values[1:], half, fmt="o", color=colour, markersize=4, capsize=3)
    axes.set_title(
        f"{style.printable_name(one.name, row)}, {style.drawable(str(one.leading.series.quantity))[:40]}", fontsize=9
    )
    axes.set_ylabel(one.leading.series.unit, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.xaxis.set_major_locator(dates.AutoDateLocator(minticks=2, maxticks=4))
    axes.xaxis.set_major_formatter(dates.DateFormatter("%Y-%m-%d"))
    axes.margins(x=0.12, y=0.15)
