"""Live figures of an assembled bridge: parts, gaps and residuals in space, linear error and trade-off, as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.geometry.m3c2 import Z95
from processor.language.messages import text
from processor.model import KEY_POINTS, Floats, Scene, StepRun
from processor.preassembly.result import Result
from processor.report.charts.surface_view import spacing
from processor.report.preassembly.part_lines import part_lines
from processor.report.style import DIVERGING_STOPS, LEAST_SHOWN_MM, colour_limit
from processor.report.table import shown
from processor.robust_statistics import MAD_TO_SD
from processor.store.json_values import json_ready

MOST_POINTS = 24_000  # of all parts: about 0.6 MB of the page
CELL = 2.5  # times the spacing of points: a cell's median has 0.5 of the noise of a point
MOST_ON_AN_EDGE = 80  # drawn size: a curve is smooth with as many
MOST_CHAINAGES = 3_000  # drawn size: more than a screen has pixels across


def interactive_data(scene: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of an assembled bridge, mm; None where there is no design to draw."""
    if scene.arch is None or not scene.arch.parts:
        return None
    result: Result = runs[0].result
    drawn = _residuals(result)
    medians = np.concatenate([np.empty(0), *(values for _, values, _ in drawn.values())])
    grey = max([LEAST_SHOWN_MM, *(scatter for _, _, scatter in drawn.values())])
    trade = result.trade_off
    view = {
        "title": text("Gaps and residuals in space") if drawn else text("Gaps in space"),
        "arrows": text("gaps as arrows"),
        "values": text("residuals"),
        "method": runs[0].method,
        "keys": KEY_POINTS,
        "stops": DIVERGING_STOPS,
        "parts": [_part(scene, i, drawn, len(medians)) for i in range(len(scene.arch.parts))],
        "joints": [
            {
                "name": shown(name),
                "verdict": result.joints.verdict[j],
                "at": np.round(scene.arch.joint_points[j], 2),
                "gap": np.round(result.joints.gaps[j], 6),
                "ci95": np.round(result.joints.gap_ci95[j], 6),
            }
            for j, name in enumerate(result.joints.name)
        ],
        "limit": max(colour_limit(medians), 2.0 * grey) if drawn else 1.0,
        "grey": grey,
        "linear": [
            _linear(run)
            for k, run in enumerate(runs)
            if not k or np.isfinite(run.result.linear.assembled.deviation).any()
        ],
        "trade": {
            "weight": float("nan") if result.adjustment is None else result.adjustment.weight,
            "lambda": trade.weight,
            "splicing_mean": np.round(trade.splicing_mean, 6),
            "splicing_max": np.round(trade.splicing_max, 6),
            "linear_mean": np.round(trade.linear_mean, 6),
            "linear_max": np.round(trade.linear_max, 6),
        },
    }
    made: dict[str, Any] = json_ready(view)
    return made


def _residuals(result: Result) -> dict[str, tuple[Floats, Floats, float]]:
    """Return for each part with distances from its design its points (n, 3), the medians (n,) of their cells.

    Also the half-width of the 95 % interval of a median by the scatter of the points about it: sqrt(pi / 2 m) sd of m.
    """
    if result.adjustment is None:
        return {}
    residuals, found = result.adjustment.residuals, {}
    for i, name in enumerate(result.components.name):
        rows = (residuals.component == i) & np.isfinite(residuals.distance)
        points, values = residuals.points[rows], residuals.distance[rows]
        if not len(points):
            continue
        cell = np.floor(points / max(CELL * spacing(points), LEAST_SHOWN_MM)).astype(np.int64)
        of = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        order = np.lexsort((values, of))
        count = np.bincount(of)
        first = np.cumsum(count) - count
        medians = 0.5 * (values[order[first + (count - 1) // 2]] + values[order[first + count // 2]])
        share = float((1.0 / count[of]).mean())  # of a point in its median, by which it lies too near
        off = np.abs(values - medians[of])
        off = off[off > 0.0]  # the point that is the median tells nothing
        sd = MAD_TO_SD * float(np.median(off)) / np.sqrt(1.0 - share) if len(off) else 0.0
        half = float(Z95 * sd * np.sqrt(0.5 * np.pi * share))
        found[name] = points, medians[of], half
    return found


def _part(scene: Scene, i: int, drawn: dict[str, tuple[Floats, Floats, float]], points: int) -> dict[str, Any]:
    """Return the lines of a part, and its share of MOST_POINTS of all ``points`` with the medians of their cells."""
    assert scene.arch is not None
    name = scene.arch.parts[i].name
    part = {"name": shown(name), "edges": [np.round(_thinned(edge), 1) for edge in part_lines(scene.arch, i)]}
    if name not in drawn:
        return part | {"points": [], "residual": []}
    rows = slice(None, None, max(1, -(-points // MOST_POINTS)))
    near, medians, _ = drawn[name]
    return part | {"points": np.rint(near[rows]).astype(int).ravel(), "residual": np.round(medians[rows], 3)}


def _thinned(edge: Floats) -> Floats:
    """Return at most MOST_ON_AN_EDGE points of a polyline, both ends among them."""
    if len(edge) <= MOST_ON_AN_EDGE:
        return edge
    chosen: Floats = edge[np.linspace(0, len(edge) - 1, MOST_ON_AN_EDGE).astype(int)]
    return chosen


def _linear(run: StepRun) -> dict[str, Any]:
    linear = run.result.linear
    step = max(1, -(-len(linear.chainage) // MOST_CHAINAGES))
    return {
        "method": run.method,
        "edge": list(linear.edge[::step]),
        "chainage": np.round(linear.chainage[::step], 1),
        "deviation": np.round(linear.assembled.deviation[::step], 6),
        "band": np.round(linear.assembled.ci95[::step], 6),
        "best_fit": np.round(linear.best_fit.deviation[::step], 6),
        "best_fit_band": np.round(linear.best_fit.ci95[::step], 6),
    }
