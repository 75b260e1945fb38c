"""Figures of stitched scans: a plan of stations with pairs, and the overlap of all with all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from processor.evaluation.evaluate import ErrorReport
from processor.model import Scene, StepRun
from processor.pipeline import Execution
from processor.report.style import COLOURS, Drawn, label, png
from processor.stitching.result import Result

PLAN, OVERLAP = "stitch-plan.png", "stitch-overlap.png"
PLAN_POINTS = 4000  # of each scan
MOST_NAMED = 40


def of_runs(execution: Execution, runs: Sequence[StepRun], _: ErrorReport) -> Drawn:
    """Draw the answer of stitching."""
    result: Result = runs[0].result
    found: Drawn = {}
    if len(result.scans) > 1 and np.isfinite(result.position).any():
        found[PLAN] = _plan(execution.scene, result)
        if len(result.pair_a) and np.isfinite(result.overlap).any():
            found[OVERLAP] = _overlap(result)
    return found


def _plan(scene: Scene, result: Result) -> tuple[str, bytes]:
    figure = Figure(figsize=(7.5, 6.0), layout="constrained")
    axes = figure.subplots()
    row = {name: i for i, name in enumerate(result.scans)}
    for scan in scene.scans:
        i = row.get(scan.name)
        if i is None or not np.isfinite(result.T_project_scan[i]).all() or not len(scan.points):
            continue
        T = result.T_project_scan[i]
        points = scan.points[:: max(1, len(scan.points) // PLAN_POINTS)] + scan.origin
        points = points @ T[:3, :3].T + T[:3, 3]
        axes.plot(*(1e-3 * points[:, :2].T), ",", color="0.6", zorder=0)
    least = float(np.nanmin(result.residual)) if len(result.residual) else 0.0
    most = float(np.nanmax(result.residual)) if len(result.residual) else 1.0
    for k, a in enumerate(result.pair_a):
        ends = 1e-3 * result.position[[row[a], row[result.pair_b[k]]]]
        share = (result.residual[k] - least) / max(most - least, 1e-12)
        axes.plot(
            ends[:, 0], ends[:, 1],
            color=COLOURS[0] if result.used[k] else COLOURS[1], linestyle="-" if result.used[k] else "--",
            linewidth=0.6 + 2.0 * float(np.nan_to_num(share)), alpha=0.7, zorder=1,
        )  # fmt: skip
    names: dict[tuple[float, float], list[str]] = {}
    for i, name in enumerate(result.scans):
        if np.isfinite(result.position[i]).all():
            at = (round(float(result.position[i, 0]), -2), round(float(result.position[i, 1]), -2))
            names.setdefault(at, []).append(label(name, i))
            good = result.scan_status[i] == "ok"
            axes.plot(
                *(1e-3 * result.position[i, :2]),
                "o" if good else "X",
                color=COLOURS[2] if good else COLOURS[1],
                zorder=2,
            )
    for (x, y), here in list(names.items())[:MOST_NAMED]:
        axes.annotate(", ".join(here), (1e-3 * x, 1e-3 * y), xytext=(5, 5), textcoords="offset points", fontsize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x of the project's frame (m)")
    axes.set_ylabel("y (m)")
    caption = (
        "Plan of the scans put together. Lines: pairs that share faces, thicker where these fit less well "
        f"({least:.2g} to {most:.2g} mm), dashed where a pair was not used. Crosses: scans with a flag."
    )
    return caption, png(figure)


def _overlap(result: Result) -> tuple[str, bytes]:
    k = len(result.scans)
    share, row = np.full((k, k), np.nan), {name: i for i, name in enumerate(result.scans)}
    for i, a in enumerate(result.pair_a):
        share[row[a], row[result.pair_b[i]]] = share[row[result.pair_b[i]], row[a]] = 100.0 * result.overlap[i]
    size = min(4.0 + 0.35 * k, 12.0)
    figure = Figure(figsize=(size + 1.0, size), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(share, vmin=0.0, vmax=100.0, cmap="Blues")
    figure.colorbar(image, ax=axes, label="overlap (%)")
    ticks = [label(name, i) for i, name in enumerate(result.scans)]
    if k <= MOST_NAMED:
        axes.set_xticks(range(k), ticks, rotation=90)
        axes.set_yticks(range(k), ticks)
        for i, j in np.argwhere(np.isfinite(share)):
            axes.text(j, i, f"{share[i, j]:.0f}", ha="center", va="center", fontsize=7,
                      color="white" if share[i, j] > 60.0 else "black")  # fmt: skip
    return "Overlap of scans: share of both scans' faces that the other one sees too.", png(figure)
