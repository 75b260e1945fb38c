"""What the page's own scripts draw: parts, gaps and residuals in space, linear error and trade-off, as JSON."""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.model import KEY_POINTS, Floats, Scene, StepRun
from processor.preassembly import step as preassembly_step
from processor.report.preassembly.results import TRADE_OFF
from processor.report.results_json import plain
from processor.report.style import DIVERGING_STOPS, colour_limit
from processor.report.table import shown

MOST_POINTS = 24_000  # of all parts: about 0.6 MB of the page
MOST_ON_AN_EDGE = 80
MOST_STATIONS = 3_000
SCRIPTS = ("view.js", "chart.js", "start.js")


def of_runs(scene: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of an assembled bridge, mm; None where there is no design to draw."""
    if scene.arch is None or not scene.arch.parts:
        return None
    result: preassembly_step.Result = runs[0].result
    found = {
        "title": "Gaps and residuals in space" if len(result.residual) else "Gaps in space",
        "arrows": "gaps as arrows",
        "values": "residuals",
        "method": runs[0].method,
        "keys": KEY_POINTS,
        "stops": DIVERGING_STOPS,
        "parts": [_part(scene, result, i) for i in range(len(scene.arch.parts))],
        "joints": [
            {
                "name": shown(name),
                "verdict": result.verdict[j],
                "at": np.round(scene.arch.joint_points[j], 2),
                "gap": np.round(result.gaps[j], 6),
                "ci95": np.round(result.gap_ci95[j], 6),
            }
            for j, name in enumerate(result.joints)
        ],
        "limit": colour_limit(result.residual) if np.isfinite(result.residual).any() else 1.0,
        "linear": [
            _linear(run) for k, run in enumerate(runs) if not k or np.isfinite(run.result.linear_deviation).any()
        ],
        "trade": {
            "weight": result.weight,
            "lambda": result.trade_lambda,
            **dict(zip(TRADE_OFF, np.round(result.trade_figures, 6).T, strict=True)),
        },
    }
    made: dict[str, Any] = plain(found)
    return made


def embedded(data: dict[str, Any]) -> str:
    """Write JSON that can stand within a script element: no character of it can end the element or open another."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def script() -> tuple[str, str]:
    """Return the page's script and its SHA-256 as a content security policy writes it."""
    folder = importlib.resources.files("processor.report")
    text = "".join((folder / name).read_text("utf-8") for name in SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return text, f"'sha256-{digest}'"


def _part(scene: Scene, result: preassembly_step.Result, i: int) -> dict[str, Any]:
    assert scene.arch is not None
    part = scene.arch.parts[i]
    own = np.flatnonzero(_component(result, part.name))
    step = max(1, -(-len(result.residual) // MOST_POINTS))
    own = own[::step]
    return {
        "name": shown(part.name),
        "edges": [np.round(_thinned(edge), 1) for edge in (part.bottom_edge_left, part.bottom_edge_right)],
        "points": np.rint(result.residual_points[own]).astype(int).ravel(),
        "residual": np.round(result.residual[own], 3),
    }


def _component(result: preassembly_step.Result, name: str) -> Any:
    """Mark (p,) the residuals of a part."""
    if not len(result.residual) or name not in result.components:
        return np.zeros(len(result.residual), bool)
    return (result.residual_component == result.components.index(name)) & np.isfinite(result.residual)


def _thinned(edge: Floats) -> Floats:
    """Return at most MOST_ON_AN_EDGE points of a polyline, both ends among them."""
    if len(edge) <= MOST_ON_AN_EDGE:
        return edge
    chosen: Floats = edge[np.linspace(0, len(edge) - 1, MOST_ON_AN_EDGE).astype(int)]
    return chosen


def _linear(run: StepRun) -> dict[str, Any]:
    result: preassembly_step.Result = run.result
    step = max(1, -(-len(result.linear_station) // MOST_STATIONS))
    return {
        "method": run.method,
        "edge": list(result.linear_edge[::step]),
        "station": np.round(result.linear_station[::step], 1),
        "deviation": np.round(result.linear_deviation[::step], 6),
        "band": np.round(result.linear_ci95[::step], 6),
        "best_fit": np.round(result.best_fit_linear_deviation[::step], 6),
        "best_fit_band": np.round(result.best_fit_linear_ci95[::step], 6),
    }
