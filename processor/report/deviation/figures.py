"""Figures of deviations: a map in plan or elevation, and a histogram beside the level of detection."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from processor.geometry.m3c2 import Distances
from processor.language.messages import Message, text
from processor.model import Floats, Ints
from processor.report.style import COLOURS, DIVERGING, HATCHES, png

MOST_DRAWN = 60_000
COLOUR_QUANTILE = 0.98  # of |distance|: what is beyond has the colours of the ends
AXES = "xyz"
WITHIN_SIZE, BEYOND_SIZE = 2.0, 9.0  # of dots, points squared
LEGEND_COLOUR = "#404040"
BOTH_SIDES = 0.1  # share of core points that look away from which they get a panel of their own


def deviation_map(core: Floats, normals: Floats, distances: Distances, label: str, unit: str) -> tuple[Message, bytes]:
    """Draw core points (k, 3) with normals (k, 3) by distance, seen along the axis on which they spread least.

    Large dots exceed their level of detection, small ones do not, so the map is readable in grey. A structure with
    faces to both sides gets one panel for each side. ``label`` says what a distance is.
    """
    drawn = np.unique(np.linspace(0, len(core) - 1, min(len(core), MOST_DRAWN)).astype(np.int64))
    spread = np.ptp(core, axis=0) if len(core) else np.zeros(3)
    across, up = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    along = 3 - across - up
    from_behind = normals[drawn, along] < 0.0
    has_lod = np.isfinite(distances.lod95[drawn])
    size = np.abs(distances.distance[drawn][has_lod])
    limit = max(float(np.quantile(size, COLOUR_QUANTILE)) if has_lod.any() else 0.0, 1e-12)
    norm = TwoSlopeNorm(0.0, -limit, limit)
    sides = (
        [(drawn[~from_behind], "+"), (drawn[from_behind], "-")] if from_behind.mean() > BOTH_SIDES else [(drawn, "")]
    )
    wide = spread[across] > spread[up]
    figure = Figure(figsize=(8.0, 4.8 * len(sides) + 1.0) if wide else (7.0 * len(sides), 6.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(*((len(sides), 1) if wide else (1, len(sides)))))
    for axes, (rows, side) in zip(panels, sides, strict=True):
        _panel(axes, core[rows][:, [across, up]], rows, distances, norm)
        axes.set(xlabel=f"{AXES[across]}{_in(unit)}", ylabel=f"{AXES[up]}{_in(unit)}")
        if side:
            axes.set_title(f"surface facing {side}{AXES[along]}", fontsize=10)
    bar = ScalarMappable(norm, DIVERGING)
    figure.colorbar(bar, ax=panels.tolist(), label=f"{label}{_in(unit)}", shrink=0.7)
    part = "" if len(drawn) == len(core) else "; {drawn:,} of {all:,} core points drawn"
    template = "Deviations seen along {axis}; large dots are beyond their level of detection" + part
    return text(template, axis=AXES[along], drawn=len(drawn), all=len(core)), png(figure)


def _panel(axes: Axes, places: Floats, rows: Ints, distances: Distances, norm: TwoSlopeNorm) -> None:
    distance, has_lod = distances.distance[rows], np.isfinite(distances.lod95[rows])
    beyond = distances.significant[rows]
    u, v = places.T
    axes.scatter(u[~has_lod], v[~has_lod], s=2.0, marker="x", linewidths=0.4, color="0.6")
    for which, size in ((has_lod & ~beyond, WITHIN_SIZE), (beyond, BEYOND_SIZE)):
        order = np.flatnonzero(which)
        order = order[np.argsort(np.abs(distance[order]), kind="stable")]
        shown = np.clip(distance[order], norm.vmin, norm.vmax)
        axes.scatter(u[order], v[order], c=shown, s=size, cmap=DIVERGING, norm=norm, linewidths=0.0)
    axes.ticklabel_format(useOffset=True, style="plain")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    counts = int((~has_lod).sum()), int((has_lod & ~beyond).sum()), int(beyond.sum())
    axes.legend(handles=_legend(*counts), fontsize=7, loc="upper right")


def _legend(unknown: int, within: int, beyond: int) -> list[Line2D]:
    """Make marks large and dark enough to be seen: those drawn are too small, and pale in the middle of the colours."""
    marks = (
        ("x", 4.0, f"no level of detection ({unknown})"),
        ("o", 2.5, f"within the level of detection ({within})"),
        ("o", 2.5 * (BEYOND_SIZE / WITHIN_SIZE) ** 0.5, f"beyond ({beyond})"),
    )
    return [
        Line2D([], [], linestyle="", marker=mark, markersize=size, color=LEGEND_COLOUR, label=label)
        for mark, size, label in marks
    ]


def histogram(distances: Distances, label: str, unit: str) -> tuple[Message, bytes]:
    """Draw how distances are spread, those beyond their level of detection hatched, and the median level."""
    figure = Figure(figsize=(8.0, 3.9), layout="constrained")
    axes = figure.subplots()
    has_lod = np.isfinite(distances.lod95)
    distance, beyond = distances.distance[has_lod], distances.significant[has_lod]
    low, high = np.quantile(distance, (0.005, 0.995)) if len(distance) else (-1.0, 1.0)
    middle = float(np.median(distances.lod95[has_lod])) if has_lod.any() else 0.0
    low, high = min(float(low), -1.2 * middle, -1e-12), max(float(high), 1.2 * middle, 1e-12)
    axes.hist(
        [np.clip(distance[~beyond], low, high), np.clip(distance[beyond], low, high)],
        bins=np.linspace(low, high, 61).tolist(),
        histtype="stepfilled",
        stacked=True,
        label=[f"within the level of detection ({(~beyond).sum()})", f"beyond ({beyond.sum()})"],
        facecolor=[(*mpl.colors.to_rgb(COLOURS[k]), 0.35) for k in (0, 1)],
        edgecolor=COLOURS[:2],
        hatch=HATCHES[:2],
    )
    for side in (-middle, middle):
        axes.axvline(side, color="black", linestyle="--", label="median level of detection, 95 %" if side > 0 else None)
    axes.set(xlabel=f"{label}{_in(unit)}", ylabel="core points")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return text("Deviations; the outermost bars hold all beyond"), png(figure)


def _in(unit: str) -> str:
    return f", {unit}" if unit else ""
