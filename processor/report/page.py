"""The HTML page of a run: one file, nothing loaded from anywhere."""

from __future__ import annotations

import base64
import json
from typing import Any

import jinja2

from processor.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report import tables

TITLES = {"preassemble": "Preassembly", "spheres": "Bolt balls"}
GOOD = "ok"
CSV_ONLY = ("linear",)  # a row a station: the figure shows it


def html(execution: Execution, report: ErrorReport, figures: dict[str, tuple[str, bytes]]) -> str:
    """Render the page; every text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("processor", "report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["shown"] = tables.shown
    scene = execution.scene
    text: str = environment.get_template("page.html").render(
        title=scene.name,
        kind=scene.kind,
        scans=len(scene.scans),
        points=f"{sum(len(scan.points) for scan in scene.scans):,}",
        units=scene.units,
        units_reason=scene.units_reason,
        verdicts=_verdicts(execution, report),
        sections=_sections(execution, report, figures),
        provenance=json.dumps(execution.provenance, indent=2, ensure_ascii=False),
    )
    return text


def _verdicts(execution: Execution, report: ErrorReport) -> list[dict[str, str]]:
    found = []
    for run, _ in tables.grouped(execution.runs):
        result = run.result
        said = f"method {run.method}"
        if run.step == "preassemble":
            said += f"; splicing error {result.splicing_mean:.2f} mm mean, {result.splicing_max:.2f} mm at most"
        else:
            fine = sum(flag == GOOD for flag in result.flag)
            said += f"; {fine} of {len(result.flag)} balls without a flag"
        tone = "good" if result.status == GOOD else "bad"
        found.append({"tone": tone, "head": f"{TITLES[run.step]}: {result.status}", "text": said})
    if report.metrics:
        limited = [m for m in report.metrics if m.limit == m.limit]
        missed = [m for m in limited if not m.passed]
        head = (
            f"Truth: {len(missed)} of {len(limited)} limits missed" if missed else f"Truth: {len(limited)} limits kept"
        )
        informed = len(report.metrics) - len(limited)
        found.append({"tone": "bad" if missed else "good", "head": head, "text": f"{informed} further figures inform"})
    else:
        found.append({"tone": "", "head": "No truth", "text": "a real scan: nothing to check against"})
    return found


def _sections(execution: Execution, report: ErrorReport, figures: dict[str, tuple[str, bytes]]) -> list[dict[str, Any]]:
    encoded = [
        {"caption": caption, "data": base64.b64encode(png).decode("ascii"), "file": name}
        for name, (caption, png) in figures.items()
    ]
    sections = []
    for run, others in tables.grouped(execution.runs):
        own = ("bridge.png", "linear-error.png") if run.step == "preassemble" else ("plan.png", "radius-errors.png")
        sections.append(
            {
                "title": TITLES[run.step],
                "message": run.result.message,
                "tables": [t for t in tables.of_step(run, others, report) if t.file not in CSV_ONLY],
                "figures": [figure for figure in encoded if figure["file"] in own],
            }
        )
    if report.metrics:
        sections.append({"title": "Truth", "message": "", "tables": [tables.of_checks(report)], "figures": []})
    return sections
