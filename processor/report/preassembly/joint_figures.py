"""Figure of the gaps at every joint: the section with arrows across it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Polygon

from processor.language.messages import Message, text
from processor.model import KEY_POINTS, NORMAL_95, Floats
from processor.preassembly.chain.joint_measures import RAYLEIGH_95, Measures
from processor.preassembly.result import Result
from processor.report.style import BEHIND_TEXT, COLOURS, LEAST_SHOWN_MM, png, printable_name, rounded

MOST_JOINTS = 24  # drawn size: of more the page would be longer than anybody reads; tables have all
ARROW_SHARE = 0.3  # of the section: how long the longest arrow is drawn
# A thin line with a small head, which covers neither the start nor the end
ARROW = {"arrowstyle": "-|>", "color": COLOURS[0], "lw": 1.4, "mutation_scale": 7, "shrinkA": 0, "shrinkB": 0}
# Where the numbers of P1..P8 stand: outward of the section, left of the bridge is left on the page.
OUTWARD = ((-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0))
ALIGNED = {-1: ("right", "top"), 0: ("center", "center"), 1: ("left", "bottom")}


WITHIN = "0.45"  # colour of the dot that stands for a gap within its interval


def gap_vectors(result: Result) -> tuple[Message, bytes]:
    """Draw every joint, up to MOST_JOINTS of them, all arrows to one scale; a joint without gaps gets a note."""
    measures = () if result.adjustment is None else result.adjustment.joints.measures
    shown = range(len(measures))[:MOST_JOINTS]
    complete = [j for j in shown if np.isfinite(measures[j].gaps).all()]
    across = min(2, len(shown))
    down = math.ceil(len(shown) / across)
    figure = Figure(figsize=(4.6 * across, 4.3 * down + 0.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(down, across, squeeze=False).ravel())
    times = _times([measures[j] for j in complete])
    for axes, j in zip(panels, shown, strict=False):
        if j in complete:
            _section(axes, measures[j], times)
        else:
            axes.set(xticks=[], yticks=[])
            axes.text(0.5, 0.5, "no gaps computed", ha="center", transform=axes.transAxes, fontsize=9)
        axes.set_title(f"{printable_name(result.joints.name[j], j)}: {result.joints.verdict[j].upper()}", fontsize=11)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    handles = [
        Line2D([], [], color=COLOURS[0], marker=">", label=f"gap across, drawn {times:,.0f} times its size"),
        Line2D([], [], color=COLOURS[1], label="95 % region of the gap across"),
        Line2D([], [], color=WITHIN, marker="o", linestyle="", label="gap across within its 95 % region"),
        Line2D([], [], color="black", marker="o", fillstyle="none", linestyle="", label="dx +: open along the bridge"),
        Line2D([], [], color="black", marker="s", linestyle="", label="dx −: overlap"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9)
    caption = [
        text("Gaps at the joints, right part minus left, in the joint's axes, seen along the bridge"),
        text("numbers are dx with its 95 % interval, mm"),
    ]
    if len(shown) < len(measures):
        caption.append(text("the first {shown} of {count} joints", shown=len(shown), count=len(measures)))
    return text("{parts:;}", parts=caption), png(figure)


def _times(measures: Sequence[Measures]) -> float:
    """By how much arrows are enlarged; the intervals count as well, so that noise is not drawn as a gap."""
    longest, size = LEAST_SHOWN_MM, 0.0
    for measure in measures:
        reach = RAYLEIGH_95 * np.sqrt(np.maximum(np.diag(measure.covariance), 0.0)).reshape(8, 3)[:, 1:].max()
        longest = max(longest, float(np.linalg.norm(measure.gaps[:, 1:], axis=1).max()), float(reach))
        size = max(size, float(np.ptp(measure.points[:, 1:], axis=0).min()))
    return rounded(ARROW_SHARE * size / longest)


def _section(axes: Axes, measures: Measures, times: float) -> None:
    at, gaps = measures.points[:, 1:], measures.gaps
    axes.add_patch(Polygon(at[:4], closed=True, facecolor="0.96", edgecolor="0.45", linewidth=1.2))
    half = NORMAL_95 * np.sqrt(np.maximum(np.diag(measures.covariance)[::3], 0.0))
    for k in range(8):
        tip = at[k] + times * gaps[k, 1:]
        block = measures.covariance[3 * k + 1 : 3 * k + 3, 3 * k + 1 : 3 * k + 3]
        axes.add_patch(_ellipse(tip, block * times**2))
        # Whether a gap across (2,) is within the 95 % region of its covariance (2, 2) about none
        gap = gaps[k, 1:]
        if bool(gap @ np.linalg.pinv(block) @ gap <= RAYLEIGH_95**2):
            axes.plot(*at[k], "o", color=WITHIN, markersize=8, zorder=2)
        else:
            start, end = ((float(point[0]), float(point[1])) for point in (at[k], tip))
            axes.annotate("", end, start, arrowprops=ARROW)
        is_open = gaps[k, 0] >= 0.0
        axes.plot(*at[k], "o" if is_open else "s", color="black", markersize=5, fillstyle="none" if is_open else "full")
        side, up = OUTWARD[k]
        # Left of the bridge is +y and stands on the left: the axis is turned round below.
        axes.annotate(
            f"{KEY_POINTS[k]}\n{round(gaps[k, 0], 2) + 0.0:+.2f}\n± {half[k]:.2f}",
            (at[k, 0], at[k, 1]),
            xytext=(30 * side, 26 * up),
            textcoords="offset points",
            ha=ALIGNED[side][0],
            va=ALIGNED[up][1],
            fontsize=8,
            bbox=BEHIND_TEXT,
            zorder=1.5,
        )
    size = np.ptp(at, axis=0)
    low, high = at.min(axis=0) - 0.72 * size.max(), at.max(axis=0) + 0.72 * size.max()
    axes.set(xlim=(high[0], low[0]), ylim=(at[:, 1].min() - 0.47 * size.max(), at[:, 1].max() + 0.47 * size.max()))
    axes.set_aspect("equal")
    axes.set(xlabel="to the left, mm", ylabel="up, mm")
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25)


def _ellipse(at: Floats, covariance: Floats) -> Ellipse:
    """Return the region that holds 95 % of a normal distribution in the plane."""
    scale, axes = np.linalg.eigh(covariance)
    length = 2.0 * RAYLEIGH_95 * np.sqrt(np.maximum(scale, 0.0))
    turn = math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return Ellipse(
        (float(at[0]), float(at[1])), float(length[1]), float(length[0]), angle=turn,
        facecolor="none", edgecolor=COLOURS[1], linewidth=1.1, zorder=4,
    )  # fmt: skip
