"""results.json: the interface that other people's scripts rely on. Lengths mm, angles rad, NaN as null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import ENDS, KEY_POINTS, Floats, StepRun
from processor.pipeline import Execution
from processor.steps import preassemble, spheres

TRADE_OFF = ("splicing_mean", "splicing_max", "linear_mean", "linear_max")
FORMAT, FORMAT_VERSION = "processor-results", "1.0"


def results_json(execution: Execution, report: ErrorReport) -> dict[str, Any]:
    """Build the object of results.json; further methods of a step stand under ``comparison``."""
    answers: dict[str, Any] = {}
    comparison: dict[str, list[Any]] = {}
    for run in execution.runs:
        if run.step in answers:
            comparison.setdefault(run.step, []).append(step_json(run))
        else:
            answers[run.step] = step_json(run)
    made = execution.provenance
    found: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "input": made["input"],
        "input_sha256": made["input_sha256"],
        "units": {"read_as": execution.scene.units, "reason": execution.scene.units_reason, "written_as": "mm"},
        "seed": made["seed"],
        "software": made["software"],
        "parameters": made["parameters"],
        "steps": answers,
        "comparison": comparison,
        "checks": [
            {
                "step": metric.step,
                "name": metric.name,
                "value": metric.value,
                "limit": metric.limit,
                "unit": metric.unit,
                "passed": metric.passed,
            }
            for metric in report.metrics
        ],
    }
    plain: dict[str, Any] = _plain(found)
    return plain


def step_json(run: StepRun) -> dict[str, Any]:
    """Write one step's result."""
    found: dict[str, Any] = WRITERS[run.step](run.result)
    return found


def _preassemble(result: preassemble.Result) -> dict[str, Any]:
    return {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "components": [
            {
                "name": name,
                "status": result.component_status[i],
                "message": result.component_message[i],
                "T_bridge_scan": result.T_bridge_scan[i],
                "covariance": result.covariance[i],
                "key_points_scan": _ends(result.key_points_scan[i]),
                "key_points_sd": _ends(result.key_points_sd[i]),
            }
            for i, name in enumerate(result.components)
        ],
        "joints": [
            {
                "name": name,
                "left": result.joint_left[j],
                "right": result.joint_right[j],
                "points": {
                    key: {"gap": result.gaps[j, k], "ci95": result.gap_ci95[j, k]} for k, key in enumerate(KEY_POINTS)
                },
                "verdict": result.verdict[j],
            }
            for j, name in enumerate(result.joints)
        ],
        "splicing_error": {"mean": result.splicing_mean, "max": result.splicing_max},
        "linear_error": {
            "mean": result.linear_mean,
            "max": result.linear_max,
            "gauge": result.gauge,
            "stations": result.linear_station,
            "edge": list(result.linear_edge),
            "deviation": result.linear_deviation,
            "foot1_best_fit": {
                "mean": result.best_fit_linear_mean,
                "max": result.best_fit_linear_max,
                "deviation": result.best_fit_linear_deviation,
            },
        },
        "trade_off": [
            {"lambda": weight, **dict(zip(TRADE_OFF, figures, strict=True))}
            for weight, figures in zip(result.trade_lambda, result.trade_figures, strict=True)
        ],
    }


def _ends(points: Floats) -> dict[str, Any]:
    """Name the points (2, 8, 3) of both ends; an end without any is empty."""
    return {
        end: dict(zip(KEY_POINTS, points[i], strict=True)) if np.isfinite(points[i]).any() else {}
        for i, end in enumerate(ENDS)
    }


def _spheres(result: spheres.Result) -> dict[str, Any]:
    return {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "balls": [
            {
                "id": int(result.ids[i]),
                "centre": result.centres[i],
                "radius": result.radii[i],
                "lowest": result.lowest[i],
                "lowest_sd": result.lowest_sd[i],
                "covariance": result.covariance[i],
                "points": int(result.points[i]),
                "visible_fraction": result.visible_fraction[i],
                "rms": result.rms[i],
                "nominal_radius": result.nominal_radii[i],
                "evidence": result.evidence[i],
                "flag": result.flag[i],
                "reason": result.reason[i],
            }
            for i in range(len(result.ids))
        ],
    }


WRITERS: dict[str, Any] = {"preassemble": _preassemble, "spheres": _spheres}


def _plain(value: Any) -> Any:
    """Turn arrays and numpy numbers into lists and numbers, and what is not finite into None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
