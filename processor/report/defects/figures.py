"""Figures of defects: a map of deviations about each, and the deflection curves of bent members."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from processor.defects.result import Result
from processor.evaluation.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.report.style import (
    COLOURS,
    DASHES,
    DIVERGING,
    LEAST_SHOWN_MM,
    MARKERS,
    Drawn,
    label,
    pdf,
    png,
    write_beside,
)

MAPS, CURVES = "defects-maps.png", "defects-curves.png"
ACROSS = 3
MOST_CURVES = 4
MOST_MAPS = 12
DOCUMENT = "defects.pdf"
LINE = 0.07  # of a panel's height
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


def files(result: Result) -> dict[str, bytes]:
    """Draw a page for each defect: its map, what was measured of it, and its deflection curve where it has one."""
    count = len(result.picture_defect)
    return {DOCUMENT: pdf(_page(result, k) for k in range(count))} if count else {}


def _page(result: Result, k: int) -> Figure:
    row = int(result.picture_defect[k])
    curve = bool((result.curve_defect == row).any())
    figure = Figure(figsize=(10.5, 8.2 if curve else 5.0), layout="constrained")
    grid = figure.add_gridspec(2 if curve else 1, 2, width_ratios=[1.6, 1.0])
    _map(figure.add_subplot(grid[0, 0]), figure, result, k)
    write_beside(figure.add_subplot(grid[0, 1]), _numbers(result, row), LINE, 9.0)
    if curve:
        _curves_of(figure.add_subplot(grid[1, :]), result, [row])
    return figure


def _maps(result: Result) -> tuple[str, bytes]:
    count = min(len(result.picture_defect), MOST_MAPS)
    down = math.ceil(count / ACROSS)
    figure = Figure(figsize=(10.5, 3.4 * down + 0.3), layout="constrained")
    panels = figure.subplots(down, ACROSS, squeeze=False).ravel()
    for k, axes in enumerate(panels[:count]):
        _map(axes, figure, result, k)
    for axes in panels[count:]:
        axes.set_visible(False)
    more = f"; the {count} largest of {len(result.ids)}; {DOCUMENT} has a page each" if count < len(result.ids) else ""
    return (
        "Deviation from the design about each defect, outward positive (blue), inward negative (orange), mm, on the "
        f"face it lies on. Thin line: the defect. Hatched: nothing seen{more}",
        png(figure),
    )


def _map(axes: Axes, figure: Figure, result: Result, k: int) -> None:
    row = int(result.picture_defect[k])
    size_of = result.picture_shape.prod(axis=1)
    rows = slice(int(size_of[:k].sum()), int(size_of[: k + 1].sum()))
    shape = tuple(result.picture_shape[k].tolist())
    values = np.asarray(result.picture_mm[rows], float).reshape(shape)
    part = result.picture_part[rows].reshape(shape)
    size = float(result.picture_cell_mm[k])
    x, y = (low + size * np.arange(n + 1) for low, n in zip(result.picture_low[k], shape, strict=True))
    known = np.abs(values[np.isfinite(values)])
    limit = max(float(np.quantile(known, 0.995)) if len(known) else 0.0, LEAST_SHOWN_MM)
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8")
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_invalid(values.T), cmap=DIVERGING, vmin=-limit, vmax=limit, rasterized=True
    )
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


def _numbers(result: Result, row: int) -> list[tuple[str, str]]:
    """Return what was measured of a defect, in words and as text."""
    length, width = result.extent[row].tolist()
    rows = [
        ("class", f"{result.classes[row]}, {result.confidence[row]:.2f}"),
        ("otherwise", result.second[row]),
        ("component", label(result.components[row], row)),
        ("area", f"{result.area_mm2[row]:.0f} mm2"),
        ("length, width", f"{length:.0f}, {width:.0f} mm"),
        ("depth, greatest", f"{result.depth_max[row]:.2f} ± {result.depth_ci95[row]:.2f} mm"),
        ("depth, mean", f"{result.depth_mean[row]:.2f} mm"),
        ("volume", f"{result.volume_mm3[row]:.0f} ± {result.volume_ci95[row]:.0f} mm3"),
        ("from the face's border", f"{result.edge_mm[row]:.0f} mm"),
        ("curvature", f"{result.curvature_per_m[row]:.2f} 1/m"),
        ("by chance on 100 m2", f"{result.chance[row]:.1g}" + (", doubtful" if result.doubtful[row] else "")),
        ("LOD95 of its depth", f"{result.lod95[row]:.2f} mm"),
        *((f"centre {axis}", f"{at:.1f} mm") for axis, at in zip("xyz", result.centres[row].tolist(), strict=True)),
    ]
    return rows + [(line, "") for line in textwrap.wrap(result.remarks[row], 52)[:4]]


def _curves(result: Result) -> tuple[str, bytes]:
    figure = Figure(figsize=(8.5, 4.0), layout="constrained")
    bent = list(dict.fromkeys(result.curve_defect.tolist()))
    _curves_of(figure.subplots(), result, bent[:MOST_CURVES])
    more = f"; the first {MOST_CURVES} of {len(bent)}" if len(bent) > MOST_CURVES else ""
    return f"Deflection curves of bent components, with their 95 % bands where known{more}", png(figure)


def _curves_of(axes: Axes, result: Result, bent: Sequence[int]) -> None:
    for place, k in enumerate(bent):
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
