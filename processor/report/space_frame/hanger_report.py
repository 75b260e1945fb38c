"""Hangers of a ceiling: their table, a plan of their lengths, and the points to be staked out."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from processor.language.messages import Message, text
from processor.model import Verdict
from processor.report.columns import MM, columns
from processor.report.style import COLOURS, DIVERGING_STOPS, CaptionedPngs, png
from processor.report.table import Table, csv_of_rows, tabulate
from processor.space_frame.result import Flag, Result

PLAN, STAKE_OUT = "hangers.png", "stakeout.csv"
MOST_NAMED = 30  # drawn size: more lie over each other; the table names all
LENGTHS = LinearSegmentedColormap.from_list("length", DIVERGING_STOPS[2:])  # the half of it from grey to blue
COLUMNS = columns("name", "x_m", "y_m", "z_m", "code")
LOWEST, CEILING = "LOWEST", "CEILING"


def tables(result: Result) -> list[Table]:
    """Return the table of hangers; none without a ceiling."""
    hangers = result.hangers
    if hangers is None:
        return []
    cells = {
        "id": hangers.names,
        "verdict": hangers.verdict,
        "length_mm": hangers.length,
        "ci95_mm": hangers.ci95,
        "x_mm y_mm z_mm": hangers.top,
        "ceiling_z_mm": hangers.bottom[:, 2],
        "flag": result.balls.flag,
    }
    note = text(
        "From each ball's lowest point x, y, z straight down to the ceiling; the input's own frame. Negative: the "
        "ball reaches below the ceiling. Cut to these lengths only after the process hole at the lowest point is "
        "allowed for."
    )
    return [tabulate(text("Hangers"), cells, "hangers", note, units=MM, on_terminal=False)]


def stake_out(result: Result) -> bytes:
    """Write the ends of the hangers of balls without a flag as points for a total station, in metres to 0.1 mm."""
    hangers = result.hangers
    assert hangers is not None
    rows = []
    for i, ball in enumerate(hangers.names):
        if result.balls.flag[i] is Flag.OK and np.isfinite(hangers.length[i]):
            for letter, place, code in (("L", hangers.top[i], LOWEST), ("C", hangers.bottom[i], CEILING)):
                rows.append((f"{letter}{ball}", *np.round(place / 1000.0, 4).tolist(), code))
    return csv_of_rows(COLUMNS, rows).encode("utf-8")


def draw(result: Result) -> CaptionedPngs:
    """Draw a plan of the hangers by their lengths, clashes ringed; nothing without a ceiling."""
    hangers = result.hangers
    known = np.zeros(0, np.bool_) if hangers is None else np.isfinite(hangers.length)
    if hangers is None or not known.any():
        return {}
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    axes = figure.subplots()
    x, y = hangers.top[known, :2].T / 1000.0
    points = axes.scatter(x, y, c=hangers.length[known], s=30.0, cmap=LENGTHS)
    figure.colorbar(points, ax=axes, label="length, mm", shrink=0.8)
    failed = [row for row, verdict in enumerate(hangers.verdict) if verdict is Verdict.FAIL]
    open_ = [row for row, verdict in enumerate(hangers.verdict) if verdict is Verdict.INDETERMINATE]
    for rows, colour, style, label in ((failed, COLOURS[1], "-", "fail"), (open_, "black", ":", "indeterminate")):
        if rows:
            x, y = hangers.top[rows, :2].T / 1000.0
            axes.scatter(
                x, y, s=130.0, facecolors="none", edgecolors=colour, linestyles=style, label=f"{label} ({len(rows)})"
            )
    for row in failed[:MOST_NAMED]:
        label = f"{hangers.names[row]}: {hangers.length[row]:.0f}"
        at = (float(hangers.top[row, 0]) / 1000.0, float(hangers.top[row, 1]) / 1000.0)
        axes.annotate(label, at, xytext=(7, 5), textcoords="offset points", fontsize=8)
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    if failed or open_:
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    caption: Message = text("Plan of the hangers by length; those that fail are ringed, with ball and length in mm")
    return {PLAN: (caption, png(figure))}
