"""results.json, the interface for other programs. Lengths in mm, angles in rad, NaN as null."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import messages
from processor.model import Scene, StepRun, instruments, worst
from processor.pipeline import Execution
from processor.results.fields_to_json import as_object, reason_json
from processor.results.file_names import FORMAT, FORMAT_VERSION
from processor.store.json_values import json_ready

ROW_DEPTH = 4  # results, steps, a step, a table: containers about its rows


def results_json(execution: Execution, report: ErrorReport, headline: str = "") -> dict[str, Any]:
    """Build the object of results.json; further methods of a step are under ``comparison``."""
    by_step = execution.by_step()
    made = execution.provenance
    content: dict[str, Any] = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "verdict": worst(run.verdict for run, _ in by_step),
        "headline": headline,
        "input": made["input"],
        "input_sha256": made["input_sha256"],
        "units": _units(execution.scene),
        **_clips(execution.scene),
        "instruments": _instruments(execution.scene),
        **({"scanned": made["epoch"]["scanned"]} if made.get("epoch", {}).get("scanned") else {}),
        "seed": made["seed"],
        "software": made["software"],
        "parameters": made["parameters"],
        "steps": {run.step: step_json(run) for run, _ in by_step},
        "comparison": {run.step: [step_json(other) for other in others] for run, others in by_step if others},
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
    written: dict[str, Any] = json_ready(content)
    return written


def text_of(content: Mapping[str, Any]) -> str:
    """Return results.json as text: members of a step on lines of their own, and each row of a table on one line."""
    return _lines(content, 0) + "\n"


def _lines(value: Any, depth: int) -> str:
    """Write a value of ``depth`` containers around it. The json module takes ten times as long for indented text."""
    rows = isinstance(value, list) and any(isinstance(item, dict) for item in value)
    if depth == ROW_DEPTH or not value or not (rows or isinstance(value, dict)):
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    margin = " " * depth
    if rows:
        return f"[\n{margin} " + f",\n{margin} ".join(_lines(item, depth + 1) for item in value) + f"\n{margin}]"
    items = [f"{json.dumps(key, ensure_ascii=False)}: {_lines(item, depth + 1)}" for key, item in value.items()]
    return f"{{\n{margin} " + f",\n{margin} ".join(items) + f"\n{margin}}}"


def _units(scene: Scene) -> dict[str, Any]:
    """Write how the coordinates were read, and why: in English, and as codes with values."""
    return {
        "read_as": scene.units,
        "reason": messages("en").text(scene.units_reason),
        "reasons": [reason_json(one) for one in scene.units_reason],
        "written_as": "mm",
    }


def _instruments(scene: Scene) -> list[dict[str, Any]]:
    """Write the scanners whose errors the intervals hold; one that nobody states has the class that is assumed."""
    return [
        {
            "name": one.name,
            "class": one.scanner_class,
            "stated": bool(scene.instruments),
            "serial": one.serial or None,
            "checked": one.checked or None,
            "source": one.source,
            "scans": list(one.scans) or None,
            "terms": {name: known._asdict() for name, known in one.known.items()},
        }
        for one in scene.instruments or [instruments.of_class()]
    ]


def _clips(scene: Scene) -> dict[str, Any]:
    """Write what the scans were cut by, mm, project's frame; nothing where they were not."""
    clips = scene.clips
    if clips is None:
        return {}
    rows = zip(clips.low, clips.high, clips.keep.tolist(), clips.scan, clips.inside.tolist(), strict=True)
    boxes = [
        {"box": [low, high], "keep": keep, "scan": scan or None, "points": inside}
        for low, high, keep, scan, inside in rows
    ]
    return {"clip": {"points_read": clips.read, "points_clipped": clips.read - clips.kept, "boxes": boxes}}


def step_json(run: StepRun) -> dict[str, Any]:
    """Write the result of one step, with its verdict: the worst of those in it."""
    return as_object(run.result) | {"verdict": run.verdict}
