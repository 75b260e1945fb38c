"""results.json, the interface for other programs. Lengths in mm, angles in rad, NaN as null."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.model import StepRun
from processor.pipeline import Execution
from processor.report.step_report import step_report

FORMAT, FORMAT_VERSION = "processor-results", "1.0"


def results_json(execution: Execution, report: ErrorReport) -> dict[str, Any]:
    """Build the object of results.json; further methods of a step are under ``comparison``."""
    answers: dict[str, Any] = {}
    comparison: dict[str, list[Any]] = {}
    for run in execution.runs:
        if run.step in answers:
            comparison.setdefault(run.step, []).append(step_json(run))
        else:
            answers[run.step] = step_json(run)
    made = execution.provenance
    content: dict[str, Any] = {
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
                "method": metric.method,
                "quantity": metric.quantity,
                "statistic": metric.statistic,
                "value": metric.value,
                "limit": metric.limit,
                "unit": metric.unit,
                "better": metric.better,
                "passed": metric.passed,
            }
            for metric in report.metrics
        ],
    }
    written: dict[str, Any] = plain(content)
    return written


def step_json(run: StepRun) -> dict[str, Any]:
    """Write one step's result."""
    return step_report(run.step).written(run.result)


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
