"""Figures of a run, drawn by Matplotlib without a screen: PNG bytes by file name.

Lines and bars are told apart by dash, marker or hatch as well as by colour (Okabe and Ito's, safe without colour
vision). The same run gives the same bytes: no dates, and none of the user's own settings.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ft2font import FT2Font
from matplotlib.ticker import NullFormatter

from processor.evaluate import ErrorReport
from processor.model import Floats, Scene, StepRun
from processor.pipeline import Execution
from processor.report.tables import grouped

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
DASHES = ("-", "--", ":", "-.")
HATCHES = ("", "///", "...", "xxx")
MARKERS = ("o", "^", "s", "D")
FLAGS = ("ok", "low-confidence", "wrong-size")
DECADES_APART = 20.0  # ratio between methods from which a linear axis would flatten the better one
LEAST_SHOWN_MM = 1e-3
BEHIND_TEXT = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
LONGEST_LABEL = 24
MOST_LABELS = 30


def of_run(execution: Execution, report: ErrorReport) -> dict[str, tuple[str, bytes]]:
    """Draw all figures of a run: file name -> (caption, PNG)."""
    found: dict[str, tuple[str, bytes]] = {}
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False  # a name from outside may hold dollar signs
        for run, others in grouped(execution.runs):
            runs = [run, *others]
            if run.step == "preassemble":
                found["bridge.png"] = _bridge(execution.scene, run)
                found["linear-error.png"] = _linear_error(execution.scene, runs)
            if run.step == "spheres" and len(run.result.ids) > 1:
                found["plan.png"] = _plan(execution.scene, run)
                if report.true_radii:
                    found["radius-errors.png"] = _radius_errors(runs, report)
    return found


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()


@cache
def _font() -> FT2Font:
    return font_manager.get_font(font_manager.findfont("DejaVu Sans"))


def _label(name: str, place: int) -> str:
    """Return a name as a figure can show it, or its place in the tables where the font lacks its characters."""
    if not all(one.isprintable() and _font().get_char_index(ord(one)) for one in name):
        return f"#{place + 1}"
    return name if len(name) <= LONGEST_LABEL else name[: LONGEST_LABEL - 1] + "…"


# --- bridge --------------------------------------------------------------------------------------------------------


def _bridge(scene: Scene, run: StepRun) -> tuple[str, bytes]:
    """Elevation of the design with the joints, and every gap of every joint."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    elevation, gaps = figure.subplots(2, 1, height_ratios=(1.0, 1.0))
    assert scene.arch is not None
    result = run.result
    for i, part in enumerate(scene.arch.parts):
        x, _, z = part.bottom_edge_left.T / 1000.0
        elevation.plot(x, z, color="0.35" if i % 2 else "0.6", linewidth=3.0)
        middle = (x[len(x) // 2], z[len(z) // 2]) if len(x) else (0.0, 0.0)
        elevation.annotate(
            _label(part.name, i),
            middle,
            xytext=(0, -18),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            bbox=BEHIND_TEXT,
        )
    labels = [_label(name, j) for j, name in enumerate(result.joints)]
    for j, label in enumerate(labels):
        x, _, z = scene.arch.joint_points[j, :2].mean(axis=0) / 1000.0
        size = np.abs(result.gaps[j])
        known = bool(np.isfinite(size).any())
        elevation.plot(x, z, "|" if known else "x", color=COLOURS[1], markersize=14, markeredgewidth=2.0)
        said = f"{label}\n{np.nanmax(size):.2f} mm" if known else f"{label}\nno answer"
        elevation.annotate(
            said, (x, z), xytext=(0, 22), textcoords="offset points", ha="center", fontsize=9, bbox=BEHIND_TEXT
        )
    elevation.set(xlabel="along the span, m", ylabel="height, m", title="design, with the largest |d| of each joint")
    elevation.set_aspect("equal")
    elevation.margins(0.05, 0.4)
    for axis, name in enumerate(("dx, along the span", "dy, across", "dz, up")):
        place = np.arange(len(labels))[:, None] + 0.22 * (axis - 1) + np.linspace(-0.07, 0.07, 8)
        width = result.gap_ci95[:, :, axis]
        gaps.errorbar(
            place.ravel(),
            result.gaps[:, :, axis].ravel(),
            yerr=width.ravel() if np.isfinite(width).any() else None,
            fmt=MARKERS[axis],
            color=COLOURS[axis],
            markersize=4,
            markerfacecolor="none",
            label=name,
        )
    gaps.axhline(0.0, color="0.3", linewidth=0.8)
    gaps.set_xticks(np.arange(len(labels)), labels)
    gaps.set(xlabel="joint, P1 to P8 from left to right", ylabel="gap, mm", title="right part minus left part")
    gaps.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    for axes in (elevation, gaps):
        axes.grid(alpha=0.3)
    return f"Joints of the bridge, method {run.method}", _png(figure)


def _linear_error(scene: Scene, runs: Sequence[StepRun]) -> tuple[str, bytes]:
    """Linear error of all methods along both bottom edges, by both gauges."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    means: list[float] = []
    for axes, (values, title) in zip(
        panels,
        (
            ("linear_deviation", "as assembled"),
            ("best_fit_linear_deviation", "the whole bridge moved so that Foot 1 lies best on its design"),
        ),
        strict=True,
    ):
        for k, run in enumerate(runs):
            deviation: Floats = getattr(run.result, values)
            means += [float(np.median(deviation[np.isfinite(deviation)]))] if np.isfinite(deviation).any() else []
            for edge, width in (("left", 1.6), ("right", 0.8)):
                on = np.array(run.result.linear_edge, dtype=object) == edge
                axes.plot(
                    run.result.linear_station[on] / 1000.0,
                    np.maximum(deviation[on], LEAST_SHOWN_MM),
                    DASHES[k % 4],
                    color=COLOURS[k % 4],
                    linewidth=width,
                    label=f"{run.method}, {edge} edge",
                )
        axes.set(ylabel="linear error, mm", title=title)
        axes.grid(alpha=0.3, which="both")
    if means and max(means) > DECADES_APART * max(min(means), LEAST_SHOWN_MM):
        panels[0].set_yscale("log")
        panels[0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panels[0].yaxis.set_minor_formatter(NullFormatter())
    else:
        panels[0].set_ylim(bottom=0.0)
    for axes in panels:
        _mark_joints(axes, scene, runs[0].result.joints)
    panels[1].set_xlabel("station along the bottom edge, m")
    panels[1].legend(fontsize=8, ncols=max(len(runs), 2), loc="upper center", bbox_to_anchor=(0.5, -0.2))
    return "Linear error: distance of the assembled bottom edges from the design's; dotted lines are joints", _png(
        figure
    )


def _mark_joints(axes: Axes, scene: Scene, joints: Sequence[str]) -> None:
    assert scene.arch is not None
    station = 0.0
    for j, part in enumerate(scene.arch.parts[: len(joints)]):
        station += float(np.linalg.norm(np.diff(part.bottom_edge_left, axis=0), axis=1).sum()) / 1000.0
        axes.axvline(station, color="0.4", linewidth=0.9, linestyle=(0, (1, 2)))
        axes.annotate(
            _label(joints[j], j),
            (station, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, -11),
            textcoords="offset points",
            fontsize=8,
        )


# --- balls ---------------------------------------------------------------------------------------------------------


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
    return f"Plan of the balls, method {run.method}; those to look at bear their ids", _png(figure)


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
    return "Radius errors by method, estimate minus truth; the outermost bars hold all beyond", _png(figure)
