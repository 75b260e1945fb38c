"""Live figures of an assembled bridge: parts, gaps and residuals in space, linear error and trade-off, as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.language.messages import text
from processor.model import KEY_POINTS, Floats, Scene, StepRun
from processor.preassembly.result import Result
from processor.report.preassembly import residual_map
from processor.report.preassembly.part_lines import part_lines
from processor.report.preassembly.residual_map import PartMap
from processor.report.style import DIVERGING_STOPS
from processor.report.table import shown
from processor.store.json_values import json_ready

MOST_POINTS = 24_000  # of all parts: about 0.6 MB of the page
MOST_ON_AN_EDGE = 80  # drawn size: a curve is smooth with as many
MOST_CHAINAGES = 3_000  # drawn size: more than a screen has pixels across


def interactive_data(scene: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of an assembled bridge, mm; None where there is no design to draw."""
    if scene.arch is None or not scene.arch.parts:
        return None
    result: Result = runs[0].result
    drawn = residual_map.maps(scene, result)
    points = sum(len(one.points) for one in drawn)
    of_name = {one.name: one for one in drawn}
    band = residual_map.scatter_band(drawn)
    trade = result.trade_off
    view = {
        "title": text("Gaps and residuals in space") if drawn else text("Gaps in space"),
        "arrows": text("gaps as arrows"),
        "values": text("residuals"),
        "method": runs[0].method,
        "keys": KEY_POINTS,
        "stops": DIVERGING_STOPS,
        "parts": [_part(scene, i, of_name, points) for i in range(len(scene.arch.parts))],
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
        "limit": residual_map.colour_steps(drawn, band)[2][-1] if drawn else 1.0,
        "grey": band.high,
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


def _part(scene: Scene, i: int, drawn: dict[str, PartMap], points: int) -> dict[str, Any]:
    """Return the lines of a part, and its share of MOST_POINTS of all ``points`` with the medians of their cells."""
    assert scene.arch is not None
    name = scene.arch.parts[i].name
    part = {"name": shown(name), "edges": [np.round(_thinned(edge), 1) for edge in part_lines(scene.arch, i)]}
    if name not in drawn:
        return part | {"points": [], "residual": []}
    rows = slice(None, None, max(1, -(-points // MOST_POINTS)))
    return part | {
        "points": np.rint(drawn[name].points[rows]).astype(int).ravel(),
        "residual": np.round(drawn[name].of_points[rows], 3),
    }


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
