"""Figures of defects: a map of deviations about each, and the deflection curves of bent members."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from processor.defects.result import Result
from processor.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.report.drawing import COLOURS, DASHES, DIVERGING, LEAST_SHOWN_MM, MARKERS, Drawn, label, png

MAPS, CURVES = "defects-maps.png", "defects-curves.png"
ACROSS = 3
MOST_CURVES = 4
MISSING = ("edge-loss", "missing-part")


def of_runs(_: Scene, runs: Sequence[StepRun], __: ErrorReport) -> Drawn:
    """Draw the defects of the answer; nothing where there are none."""
    result: Result = runs[0].result
    drawn: Drawn = {}
    if len(result.picture_defect):
        drawn[MAPS] = _maps(result)
    if len(result.curve_defect):
        drawn[CURVES] = _curves(result)
    return drawn


def _maps(result: Result) -> tuple[str, bytes]:
    count = len(result.picture_defect)
    down = math.ceil(count / ACROSS)
    figure = Figure(figsize=(10.5, 3.4 * down + 0.3), layout="constrained")
    panels = figure.subplots(down, ACROSS, squeeze=False).ravel()
    ends = np.cumsum(result.picture_shape.prod(axis=1))
    for k, axes in enumerate(panels[:count]):
        rows = slice(int(ends[k] - result.picture_shape[k].prod()), int(ends[k]))
        _map(axes, figure, result, k, rows)
    for axes in panels[count:]:
        axes.set_visible(False)
    more = f"; the {count} largest of {len(result.ids)}" if count < len(result.ids) else ""
    return (
        "Deviation from the design about each defect, outward positive (blue), inward negative (orange), mm, on the "
        f"face it lies on. Thin line: the defect. Hatched: nothing seen{more}",
        png(figure),
    )


def _map(axes: Axes, figure: Figure, result: Result, k: int, rows: slice) -> None:
    row = int(result.picture_defect[k])
    shape = tuple(result.picture_shape[k].tolist())
    values = np.asarray(result.picture_mm[rows], float).reshape(shape)
    part = result.picture_part[rows].reshape(shape)
    size = float(result.picture_cell_mm[k])
    x, y = (low + size * np.arange(n + 1) for low, n in zip(result.picture_low[k], shape, strict=True))
    known = np.abs(values[np.isfinite(values)])
    limit = max(float(np.quantile(known, 0.995)) if len(known) else 0.0, LEAST_SHOWN_MM)
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8")
    mesh = axes.pcolormesh(x, y, np.ma.masked_invalid(values.T), cmap=DIVERGING, vmin=-limit, vmax=limit)
    if 0 < part.sum() < part.size:
        middle = [0.5 * (one[1:] + one[:-1]) for one in (x, y)]
        if min(shape) >= 2:
            axes.contour(*middle, part.T.astype(float), levels=[0.5], colors="0.1", linewidths=0.8)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("along, mm", fontsize=8)
    axes.set_ylabel("across, mm", fontsize=8)
    depth = f"{result.depth_max[row]:.2f} ± {result.depth_ci95[row]:.2f} mm"
    axes.set_title(
        f"{result.ids[row]}: {result.classes[row]}, {depth}\n{label(result.components[row], row)}", fontsize=9
    )
    bar = figure.colorbar(mesh, ax=axes, shrink=0.8, extend="both")
    bar.ax.tick_params(labelsize=7)
    bar.set_label("mm", fontsize=8)


def _curves(result: Result) -> tuple[str, bytes]:
    figure = Figure(figsize=(8.5, 4.0), layout="constrained")
    axes = figure.subplots()
    bent = list(dict.fromkeys(result.curve_defect.tolist()))
    for place, k in enumerate(bent[:MOST_CURVES]):
        own = result.curve_defect == k
        at, value, half = result.curve_at_mm[own], result.curve_mm[own], result.curve_ci95[own]
        name = f"{result.ids[k]}: {label(result.components[k], k)}"
        axes.plot(
            at, value, color=COLOURS[place], linestyle=DASHES[place], marker=MARKERS[place], markersize=3, label=name
        )
        if np.isfinite(half).all():
            axes.fill_between(at, value - half, value + half, color=COLOURS[place], alpha=0.25, linewidth=0)
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    axes.set(xlabel="along the component from its middle, mm", ylabel="displacement outward, mm")
    axes.legend(fontsize=8)
    more = f"; the first {MOST_CURVES} of {len(bent)}" if len(bent) > MOST_CURVES else ""
    return f"Deflection curves of bent components, with their 95 % bands where known{more}", png(figure)
