"""Figures of a run, drawn by Matplotlib without a screen: PNG bytes by file name."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from processor.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.pipeline import Execution
from processor.report.tables import grouped

# Told apart by dash, marker and hatch as well as by colour (Okabe and Ito's, safe without colour vision).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
DASHES = ("-", "--", ":", "-.")
HATCHES = ("", "//", "..", "xx")
GAP_SCALE_SHARE = 0.05  # the longest gap vector is drawn as this share of the span


def of_run(execution: Execution, report: ErrorReport) -> dict[str, tuple[str, bytes]]:
    """Draw all figures of a run: file name -> (caption, PNG)."""
    found: dict[str, tuple[str, bytes]] = {}
    for run, others in grouped(execution.runs):
        runs = [run, *others]
        if run.step == "preassemble":
            found["bridge.png"] = _bridge(execution.scene, run)
            found["linear-error.png"] = _linear_error(runs)
        if run.step == "spheres" and len(run.result.ids) > 1:
            found["plan.png"] = _plan(run)
            if report.true_balls is not None:
                found["radius-errors.png"] = _radius_errors(runs, report)
    return found


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    plt.close(figure)
    return out.getvalue()


def _bridge(scene: Scene, run: StepRun) -> tuple[str, bytes]:
    """Elevation of the design's bottom edges with the mean gap of each joint, to a scale of its own."""
    figure, axes = plt.subplots(figsize=(9.0, 3.6), layout="constrained")
    assert scene.arch is not None
    for i, part in enumerate(scene.arch.parts):
        x, _, z = part.bottom_edge_left.T / 1000.0
        axes.plot(x, z, color="0.35" if i % 2 else "0.6", linewidth=3.0)
        axes.annotate(
            part.name, (x[len(x) // 2], z[len(z) // 2]), xytext=(0, -14), textcoords="offset points", ha="center"
        )
    gaps = np.nanmean(np.where(np.isfinite(run.result.gaps), run.result.gaps, 0.0), axis=1)
    longest = float(np.linalg.norm(gaps, axis=1).max(initial=0.0))
    span = float(np.ptp(np.concatenate([part.bottom_edge_left[:, 0] for part in scene.arch.parts]))) / 1000.0
    scale = GAP_SCALE_SHARE * span / longest if longest > 0.0 else 0.0
    for name, corners, gap in zip(run.result.joints, scene.arch.joint_points, gaps, strict=True):
        x, _, z = corners[:4].mean(axis=0) / 1000.0
        axes.annotate(
            "",
            (x + scale * gap[0], z + scale * gap[2]),
            (x, z),
            arrowprops={"arrowstyle": "->", "color": COLOURS[1], "lw": 2},
        )
        axes.annotate(
            f"{name}: {np.linalg.norm(gap):.2f} mm", (x, z), xytext=(0, 12), textcoords="offset points", ha="center"
        )
    axes.set(xlabel="along the span, m", ylabel="height, m")
    axes.set_aspect("equal")
    axes.margins(0.06, 0.25)
    axes.grid(alpha=0.3)
    return (
        f"Bridge, method {run.method}: mean gap vector of each joint, right part minus left part, not to scale",
        _png(figure),
    )


def _linear_error(runs: Sequence[StepRun]) -> tuple[str, bytes]:
    figure, axes = plt.subplots(figsize=(9.0, 4.0), layout="constrained")
    for k, run in enumerate(runs):
        result = run.result
        left = np.array(result.linear_edge) == "left"
        axes.plot(
            result.linear_station[left] / 1000.0,
            np.maximum(result.linear_deviation[left], 1e-3),
            DASHES[k % 4],
            color=COLOURS[k % 4],
            label=f"{run.method}, as assembled",
        )
        axes.plot(
            result.linear_station[left] / 1000.0,
            np.maximum(result.best_fit_linear_deviation[left], 1e-3),
            DASHES[k % 4],
            color=COLOURS[k % 4],
            alpha=0.4,
            linewidth=1.0,
            label=f"{run.method}, Foot 1 best-fit",
        )
    axes.set_yscale("log")
    axes.set(xlabel="station along the left bottom edge, m", ylabel="linear error, mm")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2)
    return "Linear error: distance of the assembled bottom edge from the design's", _png(figure)


def _plan(run: StepRun) -> tuple[str, bytes]:
    figure, axes = plt.subplots(figsize=(7.0, 6.0), layout="constrained")
    result = run.result
    flags = np.array(result.flag)
    for k, flag in enumerate(("ok", "low-confidence", "wrong-size")):
        chosen = flags == flag
        axes.scatter(
            result.centres[chosen, 0] / 1000.0,
            result.centres[chosen, 1] / 1000.0,
            s=result.radii[chosen],
            marker=("o", "^", "s")[k],
            facecolors="none",
            edgecolors=COLOURS[k],
            label=f"{flag} ({chosen.sum()})",
        )
    axes.set(xlabel="x, m", ylabel="y, m")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3)
    missing = int((flags == "not-found").sum())
    return f"Plan of the balls, method {run.method}" + (f"; {missing} not found" if missing else ""), _png(figure)


def _radius_errors(runs: Sequence[StepRun], report: ErrorReport) -> tuple[str, bytes]:
    """Histogram and cumulative share of |radius error|."""
    assert report.true_balls is not None
    row = {int(i): k for k, i in enumerate(report.true_balls.ids)}
    figure, (histogram, cumulative) = plt.subplots(1, 2, figsize=(9.0, 3.8), layout="constrained")
    errors = []
    for run in runs:
        known = [k for k, i in enumerate(run.result.ids.tolist()) if i in row and np.isfinite(run.result.radii[k])]
        true = report.true_balls.radii[[row[int(run.result.ids[k])] for k in known]]
        errors.append(run.result.radii[known] - true)
    everything = np.concatenate(errors) if errors else np.zeros(0)
    edge = float(np.quantile(np.abs(everything), 0.98)) if len(everything) else 1.0
    bins = np.linspace(-edge, edge, 31)
    for k, (run, error) in enumerate(zip(runs, errors, strict=True)):
        histogram.hist(
            np.clip(error, -edge, edge),
            bins=bins.tolist(),
            alpha=0.55,
            color=COLOURS[k % 4],
            hatch=HATCHES[k % 4],
            label=run.method,
        )
        share = np.arange(1, len(error) + 1) / max(len(error), 1)
        cumulative.plot(np.sort(np.abs(error)), share, DASHES[k % 4], color=COLOURS[k % 4], label=run.method)
    histogram.set(xlabel="radius error, mm", ylabel="balls")
    cumulative.set(xlabel="|radius error|, mm", ylabel="share of balls", ylim=(0.0, 1.02))
    cumulative.set_xscale("log")
    for axes in (histogram, cumulative):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return "Radius errors by method; the outermost bars hold all beyond", _png(figure)
