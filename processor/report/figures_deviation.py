"""Figures of deviations: a map in plan or elevation, and a histogram beside the level of detection."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from processor.geometry.m3c2 import Distances
from processor.model import Floats
from processor.report.drawing import COLOURS, DIVERGING, HATCHES, png

MOST_DRAWN = 60_000
COLOUR_QUANTILE = 0.98  # of |distance|: what is beyond has the colours of the ends
AXES = "xyz"


def deviation_map(core: Floats, found: Distances, unit: str) -> tuple[str, bytes]:
    """Draw core points (k, 3) coloured by distance, seen along the axis on which they spread least.

    What is beyond its level of detection is a large dot, what is within a small one, so that grey print tells too.
    """
    figure = Figure(figsize=(8.0, 6.5), layout="constrained")
    axes = figure.subplots()
    drawn = np.unique(np.linspace(0, len(core) - 1, min(len(core), MOST_DRAWN)).astype(np.int64))
    distance, known = found.distance[drawn], np.isfinite(found.lod95[drawn])
    spread = np.ptp(core, axis=0) if len(core) else np.zeros(3)
    across, up = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    u, v = core[drawn, across], core[drawn, up]
    limit = max(float(np.quantile(np.abs(distance[known]), COLOUR_QUANTILE)) if known.any() else 0.0, 1e-12)
    beyond = found.significant[drawn]
    axes.scatter(u[~known], v[~known], s=2.0, marker="x", linewidths=0.4, color="0.6", label="no level of detection")
    norm = TwoSlopeNorm(0.0, -limit, limit)
    for which, size, label in ((known & ~beyond, 2.0, "within the level of detection"), (beyond, 9.0, "beyond")):
        order = np.flatnonzero(which)
        order = order[np.argsort(np.abs(distance[order]), kind="stable")]
        axes.scatter(
            u[order], v[order], c=np.clip(distance[order], -limit, limit), s=size, cmap=DIVERGING, norm=norm,
            linewidths=0.0, label=f"{label} ({which.sum()})",
        )  # fmt: skip
    bar = ScalarMappable(norm, DIVERGING)
    figure.colorbar(bar, ax=axes, label=f"compared minus reference along the normal{_in(unit)}", shrink=0.7)
    axes.set(xlabel=f"{AXES[across]}{_in(unit)}", ylabel=f"{AXES[up]}{_in(unit)}")
    axes.ticklabel_format(useOffset=True, style="plain")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3)
    part = "" if len(drawn) == len(core) else f"; {len(drawn):,} of {len(core):,} core points drawn"
    return f"Deviations seen along {AXES[3 - across - up]}; large dots are beyond their level of detection{part}", png(
        figure
    )


def histogram(found: Distances, unit: str) -> tuple[str, bytes]:
    """Draw how distances are spread, those beyond their level of detection hatched, and the median level."""
    figure = Figure(figsize=(8.0, 3.9), layout="constrained")
    axes = figure.subplots()
    known = np.isfinite(found.lod95)
    distance, beyond = found.distance[known], found.significant[known]
    low, high = np.quantile(distance, (0.005, 0.995)) if len(distance) else (-1.0, 1.0)
    middle = float(np.median(found.lod95[known])) if known.any() else 0.0
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
    axes.set(xlabel=f"compared minus reference{_in(unit)}", ylabel="core points")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return "Deviations; the outermost bars hold all beyond", png(figure)


def _in(unit: str) -> str:
    return f", {unit}" if unit else ""
