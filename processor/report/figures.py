"""Figures of a run, drawn by Matplotlib without a screen: PNG bytes by file name."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from processor.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.pipeline import Execution
from processor.report import figures_preassembly
from processor.report.drawing import COLOURS, DASHES, HATCHES, LEAST_SHOWN_MM, MARKERS, Drawn, png
from processor.report.tables import grouped

FLAGS = ("ok", "low-confidence", "wrong-size")
MOST_LABELS = 30


def of_run(execution: Execution, report: ErrorReport) -> Drawn:
    """Draw all figures of a run: file name -> (caption, PNG)."""
    found: Drawn = {}
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False  # a name from outside may hold dollar signs
        for run, others in grouped(execution.runs):
            runs = [run, *others]
            if run.step == "preassemble":
                found |= figures_preassembly.of_runs(execution.scene, runs)
            if run.step == "spheres" and len(run.result.ids) > 1:
                found["plan.png"] = _plan(execution.scene, run)
                if report.true_radii:
                    found["radius-errors.png"] = _radius_errors(runs, report)
    return found


def _plan(scene: Scene, run: StepRun) -> tuple[str, bytes]:
    """Plan of the balls; one that was not found stands where the design has it."""
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    axes = figure.subplots()
    result = run.result
    flags = np.array(result.flag, dtype=object)
    for k, flag in enumerate(FLAGS):
        on = flags == flag
        if on.any():
            axes.scatter(
                result.centres[on, 0] / 1000.0,
                result.centres[on, 1] / 1000.0,
                s=36.0,
                marker=MARKERS[k],
                facecolors="none",
                edgecolors=COLOURS[k],
                label=f"{flag} ({on.sum()})",
            )
    where = result.centres.copy()
    missing = ~np.isfinite(where).all(axis=1)
    if scene.frame is not None:
        designed = dict(zip(scene.frame.ids.tolist(), scene.frame.centres, strict=True))
        for i in np.flatnonzero(missing).tolist():
            where[i] = designed.get(int(result.ids[i]), where[i])
    if missing.any():
        label = f"not found, place of the design ({missing.sum()})"
        x, y = (where[missing, :2] / 1000.0).T
        axes.scatter(x, y, s=36.0, marker="x", color="black", label=label)
    to_see = np.flatnonzero((flags != "ok") & np.isfinite(where).all(axis=1))[:MOST_LABELS]
    for i in to_see.tolist():
        axes.annotate(str(result.ids[i]), where[i, :2] / 1000.0, xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=4)
    return f"Plan of the balls, method {run.method}; those to look at bear their ids", png(figure)


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> tuple[str, bytes]:
    """Histogram of the radius errors and cumulative share of their sizes."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    histogram, cumulative = figure.subplots(1, 2)
    errors = [run.result.radii - report.true_radii[run.method] for run in runs]
    errors = [error[np.isfinite(error)] for error in errors]
    everything = np.concatenate(errors)
    low, high = np.quantile(everything, (0.01, 0.99)) if len(everything) else (-1.0, 1.0)
    low, high = min(float(low), -LEAST_SHOWN_MM), max(float(high), LEAST_SHOWN_MM)
    for k, (run, error) in enumerate(zip(runs, errors, strict=True)):
        histogram.hist(
            np.clip(error, low, high),
            bins=np.linspace(low, high, 31).tolist(),
            histtype="stepfilled",
            facecolor=(*mpl.colors.to_rgb(COLOURS[k % 4]), 0.35),
            edgecolor=COLOURS[k % 4],
            hatch=HATCHES[k % 4],
            label=run.method,
        )
        size = np.sort(np.maximum(np.abs(error), LEAST_SHOWN_MM))
        share = np.arange(1, len(size) + 1) / len(run.result.ids)
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
    return "Radius errors by method, estimate minus truth; the outermost bars hold all beyond", png(figure)
