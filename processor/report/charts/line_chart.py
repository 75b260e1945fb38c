"""Charts of lines or series of marks, and maps; their texts are in English, as those of all figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from processor.language.messages import Message
from processor.report import style

MOST_JOINED = 60  # values of a line that are joined


@dataclass(frozen=True)
class Chart:
    """A chart: ``lines`` are names with values (n,), drawn over their numbers from 1 on, or over ``places`` (n,).

    ``over`` has places (n,) for each line instead. A map has them in ``plan``, at the scale of the values. ``level`` is
    a value that is drawn as a line across, NaN = none.
    """

    title: Message
    x: Message
    y: Message
    lines: tuple[tuple[str, list[float]], ...]
    places: tuple[float, ...] = ()
    logarithmic: bool = False
    logarithmic_x: bool = False
    plan: tuple[list[float], ...] = ()
    over: tuple[list[float], ...] = ()
    level: float = float("nan")


def png(chart: Chart) -> bytes:
    """Draw a chart as PNG; its texts are in English, as those of all figures."""
    with style.default_settings():
        figure = Figure(figsize=(9.0, 6.0 if chart.plan else 3.2), layout="constrained")
        axes = figure.add_subplot()
        for k, (name, values) in enumerate(chart.lines):
            x: Sequence[float] = chart.places if len(chart.places) == len(values) else range(1, len(values) + 1)
            x = (chart.plan or chart.over)[k] if chart.plan or chart.over else x
            kind, turn = k % len(style.COLOURS), k // len(style.COLOURS)
            line = "none" if chart.plan or len(values) >= MOST_JOINED else style.DASHES[(kind + turn) % 4]
            marker, size = ("o", 0.8) if chart.plan else (style.MARKERS[(kind + turn) % 4], 3.5)
            axes.plot(
                x, values, marker, color=style.COLOURS[kind], markersize=size, label=name, linestyle=line, linewidth=1.0
            )
        if chart.plan:
            axes.set_aspect("equal")
        if math.isfinite(chart.level):
            axes.axhline(chart.level, color="#5b6672", linewidth=0.8)
        if chart.logarithmic:
            axes.set_yscale("log")
        if chart.logarithmic_x:
            axes.set_xscale("log")
        axes.set_xlabel(str(chart.x))
        axes.set_ylabel(str(chart.y))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return style.png(figure)
