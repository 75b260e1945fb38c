"""Figures of an assembled bridge: its gaps, its linear error, and what only the adjustment states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from processor.language.messages import Message, text
from processor.model import KEY_POINTS, Floats, Scene, StepRun, Verdict
from processor.preassembly.result import Deviations, EdgeSide, Joints, Result
from processor.report.preassembly import residual_map
from processor.report.preassembly.joint_figures import WITHIN, by_axis, gap_vectors, is_beyond
from processor.report.preassembly.part_lines import part_lines
from processor.report.style import (
    BEHIND_TEXT,
    COLOURS,
    DASHES,
    DECADES_APART,
    LEAST_SHOWN_MM,
    MARKERS,
    CaptionedPngs,
    png,
    printable_name,
    rounded,
)

# Dark enough to be read; a failed joint is told by its word as well.
CALLOUTS = {Verdict.FAIL: "#b34700", Verdict.PASS: "#005a94", Verdict.INDETERMINATE: "black", Verdict.NONE: "black"}
GAP_SHARE = 0.04  # of the bridge's length: how long the largest gap is drawn
SHOWN_LIVE = ("linear-error.png", "trade-off.png")  # the page's charts have the same lines
OF_OTHER_METHODS = ("gaps-by-axis.png",)
# Title, columns of the figures, and name of the line.
TRADED = (("splicing error, mean |d|", 0, 2, "mean"), ("splicing error, largest |d|", 1, 3, "largest"))


def draw(scene: Scene, runs: Sequence[StepRun]) -> CaptionedPngs:
    """Draw the first run's bridge and the linear error of all; what a result does not have is left out."""
    result: Result = runs[0].result
    figures: CaptionedPngs = {"bridge.png": _bridge(scene, runs[0])}
    if any(len(run.result.linear.chainage) for run in runs):
        figures["linear-error.png"] = _linear_error(scene, runs)
    adjustment = result.adjustment
    if adjustment is not None and np.isfinite(adjustment.linear_offset_ci95).any():
        figures["linear-offset.png"] = _linear_offset(scene, runs[0])
    if adjustment is not None and any(np.isfinite(measure.gaps).all() for measure in adjustment.joints.measures):
        figures["gap-vectors.png"] = gap_vectors(result)
    if len(runs) > 1:
        figures["gaps-by-axis.png"] = by_axis(runs)
    if adjustment is not None and np.isfinite(result.trade_off.figures).all(axis=1).any():
        figures["trade-off.png"] = _trade_off(result, adjustment.weight)
    residuals = residual_map.draw(scene, result)
    if residuals is not None:
        figures["residuals.png"] = residuals
    return figures


# --- bridge --------------------------------------------------------------------------------------------------------


def _bridge(scene: Scene, run: StepRun) -> tuple[Message, bytes]:
    """Side view and plan with the gaps drawn to a scale of their own, and every gap of every joint."""
    figure = Figure(figsize=(9.0, 10.4), layout="constrained")
    side, plan, gaps = figure.subplots(3, 1, height_ratios=(1.5, 0.7, 1.0))
    assert scene.arch is not None
    joints = run.result.joints
    times = _times(scene, joints)
    for axes, up, ends in ((side, 2, (4, 6)), (plan, 1, (5, 7))):
        for i in range(len(scene.arch.parts)):
            for edge in part_lines(scene.arch, i):
                axes.plot(edge[:, 0] / 1e3, edge[:, up] / 1e3, color="0.35" if i % 2 else "0.6", linewidth=2.0)
        for j in range(len(joints)):
            _joint_drawn(axes, scene.arch.joint_points[j], joints, j, (up, ends, times))
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("along the span, m")
    for i, part in enumerate(scene.arch.parts):
        x, _, z = part_lines(scene.arch, i)[0].T / 1e3
        middle = (x[len(x) // 2], z[len(z) // 2]) if len(x) else (0.0, 0.0)
        _write(side, printable_name(part.name, i), middle, -20)
    labels = [printable_name(name, j) for j, name in enumerate(joints.name)]
    for j, name in enumerate(labels):
        x, _, z = scene.arch.joint_points[j].mean(axis=0) / 1e3
        _write(side, callout(name, joints, j), (x, z), 30, CALLOUTS[joints.verdict[j]])
    drawn = f"gaps drawn {times:,.0f} times their size" if times else "no gap is known"
    side.set(ylabel="height, m", title=f"side view, with the largest gap of each joint; {drawn}")
    plan.set(ylabel="across, left up, m", title=f"plan; {drawn}")
    for axes, below, above in ((side, 0.12, 0.42), (plan, 0.3, 0.3)):  # room for the names
        low, high = axes.dataLim.intervaly
        axes.plot([0.0, 0.0], [low - below * (high - low), high + above * (high - low)], alpha=0.0)
    handles = [
        Patch(facecolor="none", edgecolor="0.2", label="end of the left part"),
        Patch(facecolor="none", edgecolor=COLOURS[1], linestyle="--", label="start of the right part"),
        Line2D([], [], color=WITHIN, marker="o", linestyle="", label="gap within its 95 % region: not drawn"),
    ]
    plan.legend(handles=handles, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.28))
    _all_gaps(gaps, joints, labels)
    for axes in (side, plan, gaps):
        axes.grid(alpha=0.3)
    return text("Joints of the bridge, method {method}", method=run.method), png(figure)


def _times(scene: Scene, joints: Joints) -> float:
    """Return the enlargement of gaps: 1, 2 or 5 times a power of ten.

    The intervals count as well, so that noise is not drawn as a gap.
    """
    assert scene.arch is not None
    sizes = np.concatenate([np.abs(joints.gaps).ravel(), joints.gap_ci95.ravel()])
    largest = float(sizes[np.isfinite(sizes)].max(initial=0.0))
    if not np.isfinite(joints.gaps).any():
        return 0.0
    lines = [line for i in range(len(scene.arch.parts)) for line in part_lines(scene.arch, i)[:1]]
    points = np.concatenate([scene.arch.joint_points.reshape(-1, 3), *lines])
    wanted = GAP_SHARE * float(np.ptp(points[:, 0])) / max(largest, LEAST_SHOWN_MM)
    return rounded(wanted)


def callout(name: str, joints: Joints, j: int) -> str:
    """Write the name of a joint, its largest gap with point and axis, and its verdict, as "J3 P7 dx -7.9 mm FAIL"."""
    size = np.abs(joints.gaps[j])
    if not np.isfinite(size).any():
        return f"{name}\nno gap computed"
    point, axis = np.unravel_index(int(np.nanargmax(size)), size.shape)
    verdict = "" if joints.verdict[j] is Verdict.NONE else f"\n{joints.verdict[j].upper()}"
    return f"{name} {KEY_POINTS[point]} d{'xyz'[axis]} {joints.gaps[j, point, axis]:+.2f} mm{verdict}"


def _joint_drawn(axes: Axes, points: Floats, joints: Joints, j: int, seen: tuple[int, tuple[int, int], float]) -> None:
    """Draw the left part's end as designed and the right part's moved by its gaps, enlarged.

    ``seen`` are the axis up, the two points drawn, and the enlargement. A gap within its 95 % region is a grey dot.
    """
    up, ends, times = seen
    rows = list(ends)
    here = points[rows][:, [0, up]] / 1e3
    axes.plot(here[:, 0], here[:, 1], color="0.2", linewidth=1.6)
    gaps, half = joints.gaps[j, rows][:, [0, up]], joints.gap_ci95[j, rows][:, [0, up]]
    there = here + times * gaps / 1e3
    if not np.isfinite(there).all():
        x, z = here.mean(axis=0)
        axes.plot(x, z, "x", color=COLOURS[1], markersize=10, markeredgewidth=2.0)
        return
    beyond = is_beyond(gaps, half)
    if not beyond.any():
        axes.plot(here[:, 0], here[:, 1], "o", color=WITHIN, markersize=5, zorder=3)
        return
    axes.plot(there[:, 0], there[:, 1], color=COLOURS[1], linewidth=1.6, linestyle=(0, (3, 1.2)))
    for start, end, arrow in zip(here, there, beyond, strict=True):
        if not arrow:
            axes.plot(*start, "o", color=WITHIN, markersize=5, zorder=3)
            continue
        axes.annotate(
            "",
            end,
            start,
            arrowprops={
                "arrowstyle": "->",
                "color": COLOURS[1],
                "lw": 1.0,
                "mutation_scale": 7,
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )


def _write(axes: Axes, text: str, at: tuple[float, float], up: int, colour: str = "black") -> None:
    axes.annotate(
        text, at, xytext=(0, up), textcoords="offset points", ha="center", fontsize=9, bbox=BEHIND_TEXT,
        va="bottom" if up > 0 else "top", color=colour, fontweight="normal" if colour == "black" else "bold",
    )  # fmt: skip


def _all_gaps(axes: Axes, joints: Joints, labels: Sequence[str]) -> None:
    for axis, name in enumerate(("dx, along the span", "dy, across", "dz, up")):
        place = np.arange(len(labels))[:, None] + 0.22 * (axis - 1) + np.linspace(-0.07, 0.07, 8)
        width = joints.gap_ci95[:, :, axis]
        axes.errorbar(
            place.ravel(),
            joints.gaps[:, :, axis].ravel(),
            yerr=width.ravel() if np.isfinite(width).any() else None,
            fmt=MARKERS[axis],
            color=COLOURS[axis],
            markersize=4,
            markerfacecolor="none",
            label=name,
        )
    axes.axhline(0.0, color="0.3", linewidth=0.8)
    axes.set_xticks(np.arange(len(labels)), list(labels))
    intervals = ", with 95 % intervals" if np.isfinite(joints.gap_ci95).any() else ""
    axes.set(xlabel="joint, P1 to P8 from left to right", ylabel="gap, mm", title=f"right part minus left{intervals}")
    axes.legend(fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2))


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


# --- the weight ----------------------------------------------------------------------------------------------------


def figures_of_weight(result: Result, weight: float) -> Floats:
    """Return splicing mean and max, linear mean and max (4,) of the weight that the result was made with."""
    same = np.flatnonzero(np.isclose(result.trade_off.weight, weight))
    if len(same):
        figures: Floats = result.trade_off.figures[same[0]]
        return figures
    return np.array([value for error in result.errors[:2] for value in (error.mean, error.max)])


def _trade_off(result: Result, chosen: float) -> tuple[Message, bytes]:
    """Splicing error against linear error, a point for each weight."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    for axes, (name, x, y, which) in zip(figure.subplots(1, 2), TRADED, strict=True):
        figures = np.maximum(result.trade_off.figures, LEAST_SHOWN_MM)
        axes.plot(figures[:, x], figures[:, y], "o-", color=COLOURS[0], markersize=5, linewidth=1.4)
        at_chosen = np.maximum(figures_of_weight(result, chosen), LEAST_SHOWN_MM)
        marked = f"used in the result, lambda {chosen:g}"
        axes.plot(
            at_chosen[x], at_chosen[y], "s", color=COLOURS[1], markersize=12, fillstyle="none", mew=2.0, label=marked
        )
        finite = np.isfinite(figures).all(axis=1)
        for weight, at in zip(result.trade_off.weight[finite], figures[finite], strict=True):
            axes.annotate(
                f"{weight:g}", (at[x], at[y]), xytext=(8, 6), textcoords="offset points", fontsize=9, bbox=BEHIND_TEXT
            )
        axes.set(xscale="log", yscale="log", xlabel=f"{name}, mm", ylabel=f"linear error, {which}, mm")
        for line in (axes.xaxis, axes.yaxis):
            line.set_major_formatter(lambda value, _: f"{value:g}")
            line.set_minor_formatter(NullFormatter())
            line.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.margins(0.18)
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8, loc="upper right")
    caption = text(
        "What closing the joints costs along the design's curve: the numbers at the points are the weight lambda"
    )
    return caption, png(figure)
