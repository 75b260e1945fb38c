"""Figures of stitched scans: a plan of the scanner positions with the pairs, and the overlap of all pairs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Message, text
from processor.large_arrays import every
from processor.model import Scene, Status, StepRun
from processor.pipeline import Execution
from processor.report.style import COLOURS, CaptionedPngs, png, printable_name
from processor.stitching.result import Result, Scans

PLAN, OVERLAP = "stitch-plan.png", "stitch-overlap.png"
PLAN_POINTS = 4000  # of each scan
MOST_NAMED = 40  # drawn size: more names lie over each other


def draw(execution: Execution, runs: Sequence[StepRun], _: ErrorReport) -> CaptionedPngs:
    """Draw the result of stitching."""
    result: Result = runs[0].result
    drawn: CaptionedPngs = {}
    if len(result.scans) > 1 and np.isfinite(result.scans.position).any():
        drawn[PLAN] = _plan(execution.scene, result)
        if len(result.pairs) and np.isfinite(result.pairs.overlap).any():
            drawn[OVERLAP] = _overlap(result)
    return drawn


def _plan(scene: Scene, result: Result) -> tuple[Message, bytes]:
    figure = Figure(figsize=(7.5, 6.0), layout="constrained")
    axes = figure.subplots()
    scans, pairs = result.scans, result.pairs
    row = {name: i for i, name in enumerate(scans.name)}
    for scan in scene.scans:
        i = row.get(scan.name)
        if i is None or not scans.placed[i] or not len(scan.points):
            continue
        T = scans.T_project_scan[i]
        points = every(scan.points, max(1, len(scan.points) // PLAN_POINTS)) + scan.origin
        points = points @ T[:3, :3].T + T[:3, 3]
        axes.plot(*(1e-3 * points[:, :2].T), ",", color="0.6", zorder=0)
    least = float(np.nanmin(pairs.residual)) if len(pairs) else 0.0
    most = float(np.nanmax(pairs.residual)) if len(pairs) else 1.0
    for k, a in enumerate(pairs.a):
        ends = 1e-3 * scans.position[[row[a], row[pairs.b[k]]]]
        share = (pairs.residual[k] - least) / max(most - least, 1e-12)
        axes.plot(
            ends[:, 0], ends[:, 1],
            color=COLOURS[0] if pairs.used[k] else COLOURS[1], linestyle="-" if pairs.used[k] else "--",
            linewidth=0.6 + 2.0 * float(np.nan_to_num(share)), alpha=0.7, zorder=1,
        )  # fmt: skip
    _draw_positions(axes, scans)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x of the project's frame (m)")
    axes.set_ylabel("y (m)")
    caption = text(
        "Plan of the registered scans. Lines: pairs that share faces, thicker for larger residuals ({least:.2g} to "
        "{most:.2g} mm), dashed if the pair was not used. Crosses: scans with a flag.",
        least=least,
        most=most,
    )
    return caption, png(figure)


def _draw_positions(axes: Axes, scans: Scans) -> None:
    """Draw and name the scanner positions; scans at one position share a label."""
    names: dict[tuple[float, float], list[str]] = {}
    for i, name in enumerate(scans.name):
        if not np.isfinite(scans.position[i]).all():
            continue
        x, y = scans.position[i, :2].tolist()
        names.setdefault((round(x, -2), round(y, -2)), []).append(printable_name(name, i))
        ok = scans.status[i] == Status.OK
        axes.plot(1e-3 * x, 1e-3 * y, "o" if ok else "X", color=COLOURS[2] if ok else COLOURS[1], zorder=2)
    for (x, y), here in list(names.items())[:MOST_NAMED]:
        axes.annotate(", ".join(here), (1e-3 * x, 1e-3 * y), xytext=(5, 5), textcoords="offset points", fontsize=8)


def _overlap(result: Result) -> tuple[Message, bytes]:
    scans, pairs = result.scans, result.pairs
    k = len(scans)
    share, row = np.full((k, k), np.nan), {name: i for i, name in enumerate(scans.name)}
    for i, a in enumerate(pairs.a):
        share[row[a], row[pairs.b[i]]] = share[row[pairs.b[i]], row[a]] = 100.0 * pairs.overlap[i]
    size = min(4.0 + 0.35 * k, 12.0)
    figure = Figure(figsize=(size + 1.0, size), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(share, vmin=0.0, vmax=100.0, cmap="Blues")
    figure.colorbar(image, ax=axes, label="overlap (%)")
    ticks = [printable_name(name, i) for i, name in enumerate(scans.name)]
    if k <= MOST_NAMED:
        axes.set_xticks(range(k), ticks, rotation=90)
        axes.set_yticks(range(k), ticks)
        for i, j in np.argwhere(np.isfinite(share)):
            axes.text(j, i, f"{share[i, j]:.0f}", ha="center", va="center", fontsize=7,
                      color="white" if share[i, j] > 60.0 else "black")  # fmt: skip
    return text("Overlap of scans: share of the surface of both scans that the other one sees too."), png(figure)
