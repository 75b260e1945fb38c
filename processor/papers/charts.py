"""Charts of the papers' figures in kind: a line or a series of marks a method."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from processor.language.messages import Message
from processor.report import style


@dataclass(frozen=True)
class Chart:
    """A chart: ``lines`` are names with values (n,), drawn over their numbers from 1 on, or over ``places`` (n,)."""

    title: Message
    x: Message
    y: Message
    lines: tuple[tuple[str, list[float]], ...]
    places: tuple[float, ...] = ()
    logarithmic: bool = False


def png(chart: Chart) -> bytes:
    """Draw a chart as PNG; its texts are in English, as those of all figures."""
    with style.default_settings():
        figure = Figure(figsize=(9.0, 3.2), layout="constrained")
        axes = figure.add_subplot()
        for k, (name, values) in enumerate(chart.lines):
            x = chart.places if len(chart.places) == len(values) else np.arange(1, len(values) + 1)
            kind = k % len(style.COLOURS)
            axes.plot(
                x, values, style.MARKERS[kind], color=style.COLOURS[kind], markersize=3.5, label=name,
                linestyle=style.DASHES[kind] if len(values) < 60 else "none", linewidth=1.0,
            )  # fmt: skip
        if chart.logarithmic:
            axes.set_yscale("log")
        axes.set_xlabel(str(chart.x))
        axes.set_ylabel(str(chart.y))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        return style.png(figure)


def data_uri(image: bytes) -> str:
    """Return an image as the address that a page holds it by."""
    return "data:image/png;base64," + base64.b64encode(image).decode("ascii")
