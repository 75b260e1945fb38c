"""results.json: the interface that other people's scripts rely on. Lengths mm, angles rad, NaN as null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from processor.evaluate import ErrorReport
from processor.model import ENDS, KEY_POINTS, Floats, StepRun
from processor.pipeline import Execution
from processor.report import results_balls
from processor.steps import preassemble

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
    written: dict[str, Any] = plain(found)
    return written


def step_json(run: StepRun) -> dict[str, Any]:
    """Write one step's result."""
    found: dict[str, Any] = WRITERS[run.step](run.result)
    return found


def _preassemble(result: preassemble.Result) -> dict[str, Any]:
    found = {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "components": [
            {
                "name": name,
                "status": result.component_status[i],
                "message": result.component_message[i],
                "scans": result.component_scans[i] if result.component_scans else "",
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
    return found | _adjusted(result) if result.measures else found


def _adjusted(result: preassemble.Result) -> dict[str, Any]:
    """Write what the adjustment alone says; the records of measures, verdicts and proposals as they are."""
    judged = []
    for joint, measures, verdict, proposal in zip(
        result.joints, result.measures, result.judged, result.proposals, strict=True
    ):
        rows = zip(
            measures.name, measures.value, measures.ci95, measures.low, measures.high, measures.unit, strict=True
        )
        limits = zip(
            verdict.key, verdict.what, verdict.value, verdict.ci95, verdict.low, verdict.high, verdict.each,
            verdict.each_probability, verdict.clause, verdict.verified, strict=True,
        )  # fmt: skip
        keys = ("limit", "what", "value", "ci95", "low", "high", "verdict", "probability", "clause")
        judged.append(
            {
                "name": joint,
                "gaps_joint_axes": dict(zip(KEY_POINTS, measures.gaps, strict=True)),
                "measures": {
                    name: {"value": value, "ci95": ci95, "low": low, "high": high, "unit": unit}
                    for name, value, ci95, low, high, unit in rows
                },
                "limits": [{**dict(zip(keys, row[:-1], strict=True)), "verified": bool(row[-1])} for row in limits],
                "probability": verdict.probability,
                "proposal": {
                    "action": proposal.action,
                    "cut": dict(zip(KEY_POINTS, proposal.cut, strict=True)),
                    "build_up": dict(zip(KEY_POINTS, proposal.build_up, strict=True)),
                    "probability": proposal.probability,
                    "probability_as_is": proposal.probability_as_is,
                    "sentence": proposal.sentence,
                },
            }
        )
    ambiguous = [i for i in range(len(result.components)) if np.isfinite(result.T_rival_scan[i]).all()]
    return {
        "lambda": result.weight,
        "joint_measures": judged,
        "span": {"departure": result.span_departure, "ci95": result.span_ci95},
        "closure": {
            "mm": result.closure[:3],
            "mrad": result.closure[3:],
            "ci95_mm": result.closure_ci95[:3],
            "ci95_mrad": result.closure_ci95[3:],
        },
        "linear_offset": {"left_up": result.linear_offset, "ci95": result.linear_offset_ci95},
        "ambiguous": {result.components[i]: {"T_rival_scan": result.T_rival_scan[i]} for i in ambiguous},
        "limiting": result.limiting,
        "advice": result.advice,
        "budget_sd": dict(zip(result.budget_source, result.budget_sd, strict=True)),
    }


def _ends(points: Floats) -> dict[str, Any]:
    """Name the points (2, 8, 3) of both ends; an end without any is empty."""
    return {
        end: dict(zip(KEY_POINTS, points[i], strict=True)) if np.isfinite(points[i]).any() else {}
        for i, end in enumerate(ENDS)
    }


WRITERS: dict[str, Any] = {"preassemble": _preassemble, "spheres": results_balls.written}


def plain(value: Any) -> Any:
    """Turn arrays and numpy numbers into lists and numbers, and what is not finite into None."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
