"""How deviations are spread, beside the level of detection."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from processor.geometry.m3c2 import Distances
from processor.language.messages import Message, text
from processor.report.style import COLOURS, HATCHES, png, translucent


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
        facecolor=[translucent(COLOURS[k]) for k in (0, 1)],
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
