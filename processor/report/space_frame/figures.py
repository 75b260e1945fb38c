"""Figures of balls: errors of radii, and each flagged ball."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, text
from processor.model import Scene, StepRun
from processor.report.space_frame import flagged_ball_figures, hanger_report
from processor.report.style import (
    COLOURS,
    DASHES,
    HATCHES,
    LEAST_SHOWN_MM,
    CaptionedPngs,
    Drawn,
    png,
    translucent,
)
from processor.space_frame.result import Result

RADIUS_ERRORS = "radius-errors.png"


def draw(scene: Scene, runs: Sequence[StepRun], report: ErrorReport, stored: Path | None = None) -> Drawn:
    """Draw balls; ``runs`` are the result and those compared with it, ``stored`` the file that still has the points."""
    first: Result = runs[0].result
    figures: CaptionedPngs = {}
    if len(first.balls) > 1 and report.true_radii:
        figures[RADIUS_ERRORS] = _radius_errors(runs, report)
    figures |= hanger_report.draw(first)
    flagged = flagged_ball_figures.draw(scene, first, stored) if first.has_bounds else Drawn({})
    return Drawn(figures | flagged.figures, flagged.documents)


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
