"""The HTML page of a run: one file, nothing loaded from anywhere."""

from __future__ import annotations

import base64
import collections
import itertools
import json
from typing import Any

import jinja2
import numpy as np

from processor.evaluate import ErrorReport
from processor.model import StepRun
from processor.pipeline import Execution
from processor.report import figures_balls, tables, view
from processor.report.printing import headings, numeric, shown
from processor.steps import preassemble, spheres

TITLES = {"preassemble": "Preassembly", "spheres": "Bolt balls"}
GOOD = "ok"
LEAD = ("what-to-do", "limits")  # tables above the figures
PROVENANCE = ("input", "input_sha256", "seed", "software", "parameters")
MOST_ROWS = 2000  # of a table; keeps the page of a roof of 30,000 balls below 12 MB


def html(execution: Execution, report: ErrorReport, figures: dict[str, tuple[str, bytes]]) -> str:
    """Render the page; every text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("processor", "report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["shown"] = shown
    scene = execution.scene
    points = sum(len(scan.points) for scan in scene.scans)
    live = _live(execution)
    script, digest = view.script() if live else ("", "'none'")
    text: str = environment.get_template("page.html").render(
        title=scene.name,
        kind=scene.kind,
        scans=len(scene.scans),
        points=f"{points:,} points" if points else "points left in the file",
        units=scene.units,
        units_reason=scene.units_reason,
        live=live,
        script=script,
        digest=digest,
        verdicts=_verdicts(execution, report),
        sections=_sections(execution, report, figures),
        provenance=json.dumps({key: execution.provenance[key] for key in PROVENANCE}, indent=2, ensure_ascii=False),
    )
    return text


def _live(execution: Execution) -> str:
    """Return what the page's script draws, as JSON; empty where there is nothing."""
    for run, others in tables.grouped(execution.runs):
        data = view.of_runs(execution.scene, [run, *others]) if run.step == "preassemble" else None
        if data is not None:
            return view.embedded(data)
    return ""


def _verdicts(execution: Execution, report: ErrorReport) -> list[dict[str, str]]:
    found = []
    for run, _ in tables.grouped(execution.runs):
        head, said = SUMMARIES[run.step](run.result)
        tone = _tone(run)
        title = f"{TITLES[run.step]}: {head}"
        found.append({"tone": tone, "head": title, "text": f"Method {run.method}. {said}"})
        found += _further(run)
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


def _tone(run: StepRun) -> str:
    verdicts = getattr(run.result, "verdict", ())
    if run.result.status != GOOD or "fail" in verdicts:
        return "bad"
    return "" if getattr(run.result, "judged", ()) and "indeterminate" in verdicts else "good"


def _preassembled(result: preassemble.Result) -> tuple[str, str]:
    placed = sum(status != "failed" for status in result.component_status)
    verdicts = collections.Counter(result.verdict)
    judged = ", ".join(f"{verdicts[name]} {name}" for name in ("pass", "fail", "indeterminate") if verdicts[name])
    splicing = f"{shown(result.splicing_mean)} mm mean, {shown(result.splicing_max)} mm at most"
    linear = f"{shown(result.linear_mean)} mm mean, {shown(result.linear_max)} mm at most"
    head = f"{result.status}, {placed} of {len(result.components)} parts placed"
    if result.judged:
        head = f"of {len(result.joints)} joints {judged}; assembly {head}"
    unverified = any((one.verified == 0).any() for one in result.judged)
    said = f"Splicing error {splicing}. Linear error {linear}. Joints: {judged or 'none'}."
    return head, said + (" The limits are NOT VERIFIED against the standard's text." if unverified else "")


def _further(run: StepRun) -> list[dict[str, str]]:
    """Say beside the verdict what the adjustment knows of the whole bridge."""
    if run.step != "preassemble" or not run.result.measures:
        return []
    result: preassemble.Result = run.result
    span = f"{shown(result.span_departure)} ± {shown(result.span_ci95)} mm against the design"
    shift = " / ".join(
        f"{shown(value)} ± {shown(half)}"
        for value, half in zip(result.closure[:3].tolist(), result.closure_ci95[:3].tolist(), strict=True)
    )
    known = np.isfinite(result.closure).any()
    closure = f" Closure by the joints alone, along / across / up: {shift} mm." if known else ""
    rows = (
        ("Span", f"{span}.{closure}" if np.isfinite(result.span_departure) else ""),
        ("What limits the accuracy", result.limiting),
        ("Which scan would help", result.advice),
    )
    return [{"tone": "", "head": head, "text": text} for head, text in rows if text]


def _balls(result: spheres.Result) -> tuple[str, str]:
    flags = collections.Counter(result.flag)
    named = ", ".join(f"{flags[name]} {name}" for name in ("low-confidence", "wrong-size", "not-found") if flags[name])
    head = f"{result.status}, {flags[GOOD]} of {len(result.flag)} balls without a flag"
    return head, f"Flagged: {named}." if named else ""


SUMMARIES: dict[str, Any] = {"preassemble": _preassembled, "spheres": _balls}


def _sections(execution: Execution, report: ErrorReport, figures: dict[str, tuple[str, bytes]]) -> list[dict[str, Any]]:
    encoded = [
        {"caption": caption, "data": base64.b64encode(png).decode("ascii"), "file": name}
        for name, (caption, png) in figures.items()
    ]
    sections = []
    for run, others in tables.grouped(execution.runs):
        own = [name for name in figures if figures_balls.is_own(name) == (run.step == "spheres")]
        shown_tables = [one for one in tables.of_step(run, others, report) if one.on_page]
        sections.append(
            {
                "title": TITLES[run.step],
                "message": run.result.message,
                "lead": [_table(one) for one in shown_tables if one.file in LEAD],
                "tables": [_table(one) for one in shown_tables if one.file not in LEAD],
                "live": run.step == "preassemble",
                "figures": [figure for figure in encoded if figure["file"] in own],
            }
        )
    if report.metrics:
        checks = _table(tables.of_checks(report))
        sections.append({"title": "Truth", "message": "", "lead": [], "tables": [checks], "figures": [], "live": False})
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
