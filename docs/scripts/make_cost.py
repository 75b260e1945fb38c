"""Write tables and chart of docs/cost.md: ``python -m docs.scripts.make_cost out/bench-cost.json``, of any files.

The files are those of ``python -m tests.bench.cost``; several are parts of one bench, each with its own ``--only``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

PAGE = Path(__file__).parents[1] / "cost.md"
PICTURE = PAGE.parent / "pictures/cost.png"
START, END = (
    "<!-- below: written by docs/scripts/make_cost.py -->",
    "<!-- above: written by docs/scripts/make_cost.py -->",
)
COLUMNS = 5
SECONDS, MEMORY = "#1f5fa8", "#c8641b"
LEAST_SHARE = 0.02  # of the smallest scene's MB, that are counted of a run at least


def main(paths: list[str]) -> None:
    """Replace what stands between the marks, and the picture."""
    content = joined([json.loads(Path(path).read_text("utf-8")) for path in paths])
    above, _, rest = PAGE.read_text("utf-8").partition(START)
    below = rest.partition(END)[2]
    PAGE.write_text(above + "\n".join([START, "", *tables(content), "", END]) + below, "utf-8")
    chart(content).savefig(PICTURE, dpi=100)


def joined(contents: list[dict[str, Any]]) -> dict[str, Any]:
    """Several files as one."""
    whole: dict[str, Any] = {"machine": contents[0]["machine"], "start": {}, "series": [], "peers": {}}
    for content in contents:
        whole["start"] |= content["start"]
        whole["series"] += content["series"]
        whole["peers"] |= content["peers"]
    return whole


def beyond(values: Any, base: float) -> Any:
    """Return what MB are beyond those of the smallest scene; never less than a share of these."""
    return np.maximum(np.asarray(values, float) - base, LEAST_SHARE * base)


def tables(content: dict[str, Any]) -> list[str]:
    """Return the lines: the machine, the smallest scenes, the series, and the peers where there are any."""
    machine = dict(content["machine"])
    lines = [f"Machine: {machine.pop('cores')} cores, {', '.join(f'{k} {v}' for k, v in machine.items())}.", ""]
    lines += ["| smallest scene of | " + " | ".join(content["start"]) + " |", "|---|" + "---|" * len(content["start"])]
    for key, name in (("points", "points"), ("step", "step, processor s"), ("cpu", "run, processor s"), ("mb", "MB")):
        lines.append(f"| {name} | " + " | ".join(figure(one[key]) for one in content["start"].values()) + " |")
    heads = (
        "step", "against", "held", "size", "points", "step, processor s", "run, processor s", "MB",
        "exponent of the step's s", "of MB", "bytes a point",
    )  # fmt: skip
    lines += ["", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    lines += [series_row(one) for one in content["series"]]
    if content["peers"]:
        lines += peers(content["peers"])
    return lines


def series_row(series: dict[str, Any]) -> str:
    """One row: the values of all sizes with slashes between."""
    keys = ("size", "points", "step", "cpu", "mb")
    columns = ["/".join(figure(row[key]) for row in series["rows"]) for key in keys]
    if series["over"] == "points":
        columns[1] = ""
    bytes_ = series["bytes a point"]
    cells = (
        series["step"], series["over"], series["held"], *columns, f"{series['exponent']:.2f}",
        f"{series['memory exponent']:.2f}", "" if bytes_ is None else figure(bytes_),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def peers(found: dict[str, Any]) -> list[str]:
    """Tables of the tasks beside peers, and who is not installed."""
    count = found["outliers"][0]["points"]
    lines = ["", f"Outlier removal of {figure(count)} points, medians:", ""]
    lines += ["| | processor s | s | ratio | marks as ours |", "|---|---|---|---|---|"]
    for row in found["outliers"]:
        lines.append(peer_row(row, f"{row['agree']:.2%}"))
    first = found["registration"][0]
    lines += ["", f"A scanned part of {figure(first['points'])} points in {first['poses']} random poses, medians:", ""]
    lines += ["| | processor s | s | ratio | right | rms error, mm |", "|---|---|---|---|---|---|"]
    for row in found["registration"]:
        lines.append(peer_row(row, f"{row['found']} of {row['poses']}", f"{row['error']:.2f}"))
    missing = found["missing"]
    return [*lines, "", f"Not installed in that run: {', '.join(missing)}."] if missing else lines


def peer_row(row: dict[str, Any], *further: str) -> str:
    """One row of a task: name, seconds, ratio, and what else is known."""
    cells = (row["name"], figure(row["cpu"]), figure(row["wall"]), f"{row['ratio']:.2f}", *further)
    return "| " + " | ".join(cells) + " |"


def figure(value: float) -> str:
    """Write a number with two or three digits: 12, 3.4, 250k, 1.6M."""
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if value >= unit and (unit > 1e3 or value >= 1e4):
            return f"{value / unit:.3g}{name}" if value / unit < 100 else f"{value / unit:.0f}{name}"
    return f"{value:.0f}" if value >= 100.0 or value == int(value) else f"{value:.2g}"


def chart(content: dict[str, Any]) -> Figure:
    """Draw each series, with lines of fit: processor seconds of the step, MB beyond those of its smallest scene."""
    rows = -(-len(content["series"]) // COLUMNS)
    figure_ = Figure(figsize=(12.5, 2.75 * rows), layout="constrained")
    panels = figure_.subplots(rows, COLUMNS, squeeze=False).ravel()
    for axes, series in zip(panels, content["series"], strict=False):
        start = content["start"][series["step"]]
        sizes = np.array([row["size"] for row in series["rows"]])
        for key, colour, slope in (("step", SECONDS, "exponent"), ("mb", MEMORY, "memory exponent")):
            values = np.array([row[key] for row in series["rows"]])
            if key == "mb":
                values = beyond(values, start["mb"])
            name = f"{'s' if key == 'step' else 'MB'} ∝ size^{series[slope]:.2f}"
            axes.loglog(sizes, values, "o" if key == "step" else "s", color=colour, markersize=5)
            line = np.exp(np.log(values).mean() + series[slope] * (np.log(sizes) - np.log(sizes).mean()))
            axes.loglog(sizes, line, "-" if key == "step" else "--", color=colour, linewidth=1.2, label=name)
        axes.set_title(f"{series['step']} by {series['over']}", fontsize=10)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * 4.0)
        axes.set_xticks(sizes, [figure(size) for size in sizes], fontsize=8)
        axes.minorticks_off()
        axes.tick_params(axis="y", labelsize=8)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, loc="upper left", frameon=False)
    for axes in panels[len(content["series"]) :]:
        axes.set_visible(False)
    return figure_


if __name__ == "__main__":
    main(sys.argv[1:])
