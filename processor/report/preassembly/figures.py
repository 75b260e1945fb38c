"""Figures of an assembled bridge: its gaps, its linear error, and what only the adjustment states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from processor.language.messages import Message, text
from processor.model import Scene, StepRun
from processor.preassembly.result import Deviations, EdgeSide, Result
from processor.report.preassembly.joint_figures import gap_vectors
from processor.report.style import COLOURS, DASHES, DECADES_APART, LEAST_SHOWN_MM, CaptionedPngs, png, printable_name


def draw(scene: Scene, runs: Sequence[StepRun]) -> CaptionedPngs:
    """Draw the linear error of all runs, and the gaps of the first; what a result does not have is left out."""
    result: Result = runs[0].result
    figures: CaptionedPngs = {}
    if any(len(run.result.linear.chainage) for run in runs):
        figures["linear-error.png"] = _linear_error(scene, runs)
    adjustment = result.adjustment
    if adjustment is not None and np.isfinite(adjustment.linear_offset_ci95).any():
        figures["linear-offset.png"] = _linear_offset(scene, runs[0])
    if adjustment is not None and any(np.isfinite(measure.gaps).all() for measure in adjustment.joints.measures):
        figures["gap-vectors.png"] = gap_vectors(result)
    return figures


# --- linear error --------------------------------------------------------------------------------------------------


def _linear_error(scene: Scene, runs: Sequence[StepRun]) -> tuple[Message, bytes]:
    """Linear error of all methods that have a result along both bottom edges, by both gauges."""
    styled = [(k, run) for k, run in enumerate(runs) if np.isfinite(run.result.linear.assembled.deviation).any()]
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True, sharey=True)
    means: list[float] = []
    for axes, best_fit, title in zip(
        panels,
        (False, True),
        ("as assembled", "the whole bridge moved so that Foot 1 lies best on its design"),
        strict=True,
    ):
        for k, run in styled:
            deviations: Deviations = run.result.linear.best_fit if best_fit else run.result.linear.assembled
            finite = deviations.deviation[np.isfinite(deviations.deviation)]
            means += [float(np.median(finite))] if len(finite) else []
            _draw_deviations(axes, run, deviations, k)
        axes.set(ylabel="linear error, mm", title=title)
        axes.grid(alpha=0.3, which="both")
    if means and max(means) > DECADES_APART * max(min(means), LEAST_SHOWN_MM):
        panels[0].set_yscale("log")
        panels[0].set_ylim(bottom=max(LEAST_SHOWN_MM, 0.05 * min(means)))
        panels[0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panels[0].yaxis.set_minor_formatter(NullFormatter())
    else:
        panels[0].set_ylim(bottom=0.0)
    for axes in panels:
        _mark_joints(axes, scene, runs[0].result.joints.name)
    panels[1].set_xlabel("chainage along the bottom edge, m")
    if styled:
        panels[1].legend(fontsize=8, ncols=max(len(styled), 2), loc="upper center", bbox_to_anchor=(0.5, -0.2))
    return _linear_caption(runs, [run for _, run in styled]), png(figure)


def _draw_deviations(axes: Axes, run: StepRun, deviations: Deviations, k: int) -> None:
    """Draw the deviations of both edges by the k-th method, with their band or the method's own error."""
    linear = run.result.linear
    colour = COLOURS[k % 4]
    for edge, width in ((EdgeSide.LEFT, 1.6), (EdgeSide.RIGHT, 0.8)):
        on = np.array(linear.edge, dtype=object) == edge
        chainage_m, deviation = linear.chainage[on] / 1000.0, deviations.deviation[on]
        axes.plot(
            chainage_m,
            np.maximum(deviation, LEAST_SHOWN_MM),
            DASHES[k % 4],
            color=colour,
            linewidth=width,
            label=f"{run.method}, {edge} edge",
        )
        if not np.isfinite(deviations.ci95).any():
            continue
        band = deviations.ci95[on]
        low, high = (np.maximum(deviation + sign * band, LEAST_SHOWN_MM) for sign in (-1.0, 1.0))
        axes.fill_between(chainage_m, low, high, color=colour, alpha=0.2, linewidth=0.0)


def _linear_caption(runs: Sequence[StepRun], drawn: Sequence[StepRun]) -> Message:
    """State what the curves and bands are, and which methods have none."""
    has_band = {run.method: bool(np.isfinite(run.result.linear.assembled.ci95).any()) for run in drawn}
    shaded = any(has_band.values())
    bare = [method for method, known in has_band.items() if not known]
    missing = [run.method for run in runs if run.method not in has_band]
    caption = [
        text("Linear error: distance of the assembled bottom edges from the design's"),
        text("dotted lines are joints"),
    ]
    if shaded:
        caption.append(text("the shaded band holds 95 % or more"))
    if shaded and bare:
        caption.append(text("without a band, because they state no uncertainty: {methods}", methods=bare))
    if missing:
        caption.append(text("without a result, so not drawn: {methods}", methods=missing))
    return text("{parts:;}", parts=caption)


def _linear_offset(scene: Scene, run: StepRun) -> tuple[Message, bytes]:
    """Offset of the bottom edges from the design's, to the left and up, with its band."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    linear, adjustment = run.result.linear, run.result.adjustment
    for axis, (axes, title) in enumerate(zip(panels, ("to the left", "up"), strict=True)):
        for k, edge in enumerate(EdgeSide):
            on = np.array(linear.edge, dtype=object) == edge
            chainage_m = linear.chainage[on] / 1e3
            offset, width = adjustment.linear_offset[on, axis], adjustment.linear_offset_ci95[on, axis]
            axes.fill_between(chainage_m, offset - width, offset + width, color=COLOURS[k], alpha=0.22, linewidth=0.0)
            axes.plot(chainage_m, offset, DASHES[k], color=COLOURS[k], linewidth=1.4, label=f"{edge} edge, 95 % band")
        axes.axhline(0.0, color="0.3", linewidth=0.8)
        axes.set(ylabel="offset, mm", title=f"{title}, as assembled")
        axes.grid(alpha=0.3)
        _mark_joints(axes, scene, run.result.joints.name)
    panels[1].set_xlabel("chainage along the bottom edge, m")
    panels[1].legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.22))
    caption = text(
        "Offset of the bottom edges from the design's, method {method}; dotted lines are joints", method=run.method
    )
    return caption, png(figure)


def _mark_joints(axes: Axes, scene: Scene, joints: Sequence[str]) -> None:
    assert scene.arch is not None
    chainage_m = 0.0
    for j, part in enumerate(scene.arch.parts[: len(joints)] if scene.arch.in_row else ()):
        chainage_m += float(np.linalg.norm(np.diff(part.bottom_edge_left, axis=0), axis=1).sum()) / 1000.0
        axes.axvline(chainage_m, color="0.4", linewidth=0.9, linestyle=(0, (1, 2)))
        axes.annotate(
            printable_name(joints[j], j),
            (chainage_m, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, -11),
            textcoords="offset points",
            fontsize=8,
        )
