"""The HTML page of a run: one file, nothing loaded from anywhere."""

from __future__ import annotations

import base64
import collections
import itertools
import json
from typing import Any

import jinja2

from processor.evaluate import ErrorReport
from processor.pipeline import Execution
from processor.report import tables
from processor.report.printing import headings, numeric, shown
from processor.steps import preassemble, spheres

TITLES = {"preassemble": "Preassembly", "spheres": "Bolt balls"}
GOOD = "ok"
PROVENANCE = ("input", "input_sha256", "seed", "software", "parameters")
MOST_ROWS = 2000  # of a table; keeps the page of a roof of 30,000 balls below 12 MB


def html(execution: Execution, report: ErrorReport, figures: dict[str, tuple[str, bytes]]) -> str:
    """Render the page; every text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("processor", "report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["shown"] = shown
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
        provenance=json.dumps({key: execution.provenance[key] for key in PROVENANCE}, indent=2, ensure_ascii=False),
    )
    return text


def _verdicts(execution: Execution, report: ErrorReport) -> list[dict[str, str]]:
    found = []
    for run, _ in tables.grouped(execution.runs):
        head, said = SUMMARIES[run.step](run.result)
        tone = "good" if run.result.status == GOOD else "bad"
        title = f"{TITLES[run.step]}: {run.result.status}, {head}"
        found.append({"tone": tone, "head": title, "text": f"Method {run.method}. {said}"})
    if report.metrics:
        limited = [m for m in report.metrics if m.limit == m.limit]
        missed = [m for m in limited if not m.passed]
        head = (
            f"Truth: {len(missed)} of {len(limited)} limits missed" if missed else f"Truth: {len(limited)} limits kept"
        )
        informed = len(report.metrics) - len(limited)
        said = "; ".join(f"{m.step}: {m.name}" for m in missed) or f"{informed} further figures have no limit"
        found.append({"tone": "bad" if missed else "good", "head": head, "text": said})
    else:
        found.append({"tone": "", "head": "No truth", "text": "a real scan: nothing to check against"})
    return found


def _preassembled(result: preassemble.Result) -> tuple[str, str]:
    placed = sum(status != "failed" for status in result.component_status)
    verdicts = collections.Counter(result.verdict)
    judged = ", ".join(f"{verdicts[name]} {name}" for name in ("pass", "fail", "indeterminate") if verdicts[name])
    splicing = f"{shown(result.splicing_mean)} mm mean, {shown(result.splicing_max)} mm at most"
    linear = f"{shown(result.linear_mean)} mm mean, {shown(result.linear_max)} mm at most"
    head = f"{placed} of {len(result.components)} parts placed"
    return head, f"Splicing error {splicing}. Linear error {linear}. Joints: {judged or 'none'}."


def _balls(result: spheres.Result) -> tuple[str, str]:
    flags = collections.Counter(result.flag)
    named = ", ".join(f"{flags[name]} {name}" for name in ("low-confidence", "wrong-size", "not-found") if flags[name])
    head = f"{flags[GOOD]} of {len(result.flag)} balls without a flag"
    return head, f"Flagged: {named}." if named else ""


SUMMARIES: dict[str, Any] = {"preassemble": _preassembled, "spheres": _balls}


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
                "tables": [_table(one) for one in tables.of_step(run, others, report) if one.on_page],
                "figures": [figure for figure in encoded if figure["file"] in own],
            }
        )
    if report.metrics:
        checks = _table(tables.of_checks(report))
        sections.append({"title": "Truth", "message": "", "tables": [checks], "figures": []})
    return sections


def _table(table: tables.Table) -> dict[str, Any]:
    note = table.note
    if len(table.rows) > MOST_ROWS:
        note = f"{note} The first {MOST_ROWS} of {len(table.rows)} rows; all are in {table.file}.csv.".strip()
    return {
        "title": table.title,
        "note": note,
        "groups": [(name, len(list(members))) for name, members in itertools.groupby(table.groups)],
        "columns": list(zip(headings(table), numeric(table), strict=True)),
        "rows": table.rows[:MOST_ROWS],
    }
