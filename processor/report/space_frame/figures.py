"""Figures of balls: plan with movements, errors of radii, and each flagged ball."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.spatial import cKDTree

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, text
from processor.model import Scene, StepRun
from processor.report.space_frame import flagged_ball_figures, hanger_report
from processor.report.space_frame.nominal_positions import designed_places, nominal_places
from processor.report.style import (
    COLOURS,
    DASHES,
    DIVERGING,
    HATCHES,
    LEAST_SHOWN_MM,
    MARKERS,
    CaptionedPngs,
    Drawn,
    png,
    rounded,
    translucent,
)
from processor.space_frame.result import LOCATED_FLAGS, Flag, Result

MOST_LABELS = 30  # drawn size: more lie over each other; the table names all
ARROW_SHARE = 0.6  # of the way to the next ball: how long all but the longest arrows are drawn
PLAN, RADIUS_ERRORS = "plan.png", "radius-errors.png"


def draw(scene: Scene, runs: Sequence[StepRun], report: ErrorReport, stored: Path | None = None) -> Drawn:
    """Draw balls; ``runs`` are the result and those compared with it, ``stored`` the file that still has the points."""
    first: Result = runs[0].result
    figures: CaptionedPngs = {}
    if len(first.balls) > 1:
        figures[PLAN] = _plan(scene, runs[0])
        if report.true_radii:
            figures[RADIUS_ERRORS] = _radius_errors(runs, report)
    figures |= hanger_report.draw(first)
    flagged = flagged_ball_figures.draw(scene, first, stored) if first.has_bounds else Drawn({})
    return Drawn(figures | flagged.figures, flagged.documents)


# --- plan ----------------------------------------------------------------------------------------------------------


def _plan(scene: Scene, run: StepRun) -> tuple[Message, bytes]:
    """Draw a plan of the balls; one that was not found is at the design's place."""
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    axes = figure.subplots()
    result: Result = run.result
    balls = result.balls
    arrows = _movements(figure, axes, result)
    for k, flag in enumerate(LOCATED_FLAGS):
        on = balls.flagged(flag) & balls.placed
        if on.any():
            axes.scatter(
                balls.centres[on, 0] / 1000.0,
                balls.centres[on, 1] / 1000.0,
                s=36.0,
                marker=MARKERS[k],
                facecolors="none",
                edgecolors=COLOURS[k],
                label=f"{flag} ({on.sum()})",
            )
    where = balls.centres.copy()
    missing = ~balls.placed | balls.flagged(Flag.NOT_FOUND)
    where[missing] = designed_places(scene, result)[missing]
    drawn = missing & np.isfinite(where).all(axis=1)
    if drawn.any():
        label = f"not found, place of the design ({drawn.sum()})"
        x, y = (where[drawn, :2] / 1000.0).T
        axes.scatter(x, y, s=36.0, marker="x", color="black", label=label)
    flagged = np.flatnonzero(~balls.flagged(Flag.OK) & np.isfinite(where).all(axis=1))[:MOST_LABELS]
    for i in flagged.tolist():
        axes.annotate(str(balls.names[i]), where[i, :2] / 1000.0, xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3)
    caption: Message = text("Plan of the balls, method {method}; flagged ones have their ids", method=run.method)
    return caption if arrows is None else text("{plan}; {arrows}", plan=caption, arrows=arrows), png(figure)


def _movements(figure: Figure, axes: Axes, result: Result) -> Message | None:
    """Draw the movements of nodes in plan as arrows and in height as colours; return a caption, None without any."""
    centres, reference = result.balls.centres, result.movement_reference
    vector = centres - nominal_places(result)
    finite = np.isfinite(vector).all(axis=1)
    if reference is None or not finite.any():
        return None
    vector, places = vector[finite], centres[finite, :2] / 1000.0
    neighbour_distance = (
        cKDTree(centres[finite]).query(centres[finite], k=2)[0][:, 1] if finite.sum() > 1 else np.ones(1)
    )
    long = max(float(np.quantile(np.hypot(vector[:, 0], vector[:, 1]), 0.95)), LEAST_SHOWN_MM)
    times = rounded(ARROW_SHARE * float(np.median(neighbour_distance)) / long)
    limit = max(float(np.quantile(np.abs(vector[:, 2]), 0.98)), LEAST_SHOWN_MM)
    up = axes.scatter(
        places[:, 0], places[:, 1], c=np.clip(vector[:, 2], -limit, limit), s=30.0, cmap=DIVERGING,
        norm=TwoSlopeNorm(0.0, -limit, limit),
    )  # fmt: skip
    figure.colorbar(up, ax=axes, label="movement up, mm", shrink=0.7)
    axes.quiver(
        *places.T, *(vector[:, :2].T * times / 1000.0), angles="xy", scale_units="xy", scale=1.0, width=0.0025,
        color="black", zorder=3,
    )  # fmt: skip
    axes.plot([], [], color="black", marker=">", markersize=4.0, label=f"movement in plan, drawn {times:,.0f} times")
    return text(
        "arrows are movements in plan, found minus nominal ({gauge}), drawn {times:,.0f} times their size",
        gauge=reference.gauge,
        times=times,
    )


# --- errors --------------------------------------------------------------------------------------------------------


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> tuple[Message, bytes]:
    """Histogram of the radius errors and cumulative share of their sizes."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    histogram, cumulative = figure.subplots(1, 2)
    errors = [run.result.balls.radii - report.true_radii[run.method] for run in runs]
    errors = [error[np.isfinite(error)] for error in errors]
    everything = np.concatenate(errors)
    low, high = np.quantile(everything, (0.01, 0.99)) if len(everything) else (-1.0, 1.0)
    low, high = min(float(low), -LEAST_SHOWN_MM), max(float(high), LEAST_SHOWN_MM)
    for k, (run, error) in enumerate(zip(runs, errors, strict=True)):
        histogram.hist(
            np.clip(error, low, high), bins=np.linspace(low, high, 31).tolist(), histtype="stepfilled",
            facecolor=translucent(COLOURS[k % 4]), edgecolor=COLOURS[k % 4], hatch=HATCHES[k % 4], label=run.method,
        )  # fmt: skip
        size = np.sort(np.maximum(np.abs(error), LEAST_SHOWN_MM))
        share = np.arange(1, len(size) + 1) / len(run.result.balls)
        cumulative.step(
            size, share, DASHES[k % 4], color=COLOURS[k % 4], where="post", label=f"{run.method} (n = {len(size)})"
        )
    histogram.axvline(0.0, color="0.3", linewidth=0.8)
    histogram.set(xlabel="radius error, mm", ylabel="balls")
    cumulative.set(xlabel="|radius error|, mm", ylabel="share of all balls", ylim=(0.0, 1.02))
    if len(everything):
        cumulative.set_xscale("log")
        cumulative.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        cumulative.xaxis.set_minor_formatter(NullFormatter())
    for axes in (histogram, cumulative):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return text("Radius errors by method, estimate minus truth; the outermost bars contain all beyond"), png(figure)
