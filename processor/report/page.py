"""The HTML page of a run: one file that loads nothing."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Text, label, messages, text
from processor.model import Scene, Status, StepRun, Verdict, Word
from processor.pipeline import Execution
from processor.report import all_tables, headline, templates, title_block
from processor.report.columns import Column
from processor.report.reports_of_steps import step_report
from processor.report.scripts import page_script
from processor.report.sheet import content
from processor.report.style import Drawn
from processor.report.table import Table, groups, headings, numeric, shown, shown_rows, title
from processor.targets.summary import summary

LONG_CELL = 24  # characters
PROVENANCE = ("input", "input_sha256", "seed", "software", "parameters")
TONES = {Verdict.PASS: "good", Verdict.FAIL: "bad", Verdict.INDETERMINATE: "open", Verdict.NONE: "none"}
MOST_ROWS = 2000  # of a table; keeps the page of a roof of 30,000 balls below 12 MB


def html(
    execution: Execution,
    report: ErrorReport,
    figures: Mapping[str, Drawn],
    lang: str = "en",
    sheet: content.Sheet | None = None,
) -> str:
    """Render the page, with the figures of each step, in a language of CODES; every text is escaped."""
    scene, sheet = execution.scene, sheet or content.of(execution)
    live = {
        run.step: data
        for run, others in execution.by_step()
        if (data := step_report(run.step).interactive_data(scene, [run, *others])) is not None
    }
    script, digest = page_script.script()
    return templates.render(
        "report",
        "page.html",
        lang,
        title=scene.name,
        block=title_block.of(scene, execution.provenance),
        running_foot=title_block.css_string(title_block.foot(execution.provenance)),
        running_head=title_block.css_string(title_block.head(scene)),
        banner={"tone": TONES[sheet.verdict], "word": headline.BANNER[sheet.verdict]},
        sheet=sheet,
        first=[written_table(table, lang) for table in sheet.first],
        lists=[written_table(table, lang) for table in sheet.further],
        about=_about(scene),
        clipped=None if scene.clips is None else headline.clipped(scene.clips),
        targets=None if scene.targets is None else summary(scene),
        live=page_script.embedded({"words": messages(lang).of_scripts(script), "steps": messages(lang).rendered(live)}),
        script=script,
        digest=digest,
        sections=_sections(execution, report, figures, set(live), lang),
        provenance=json.dumps({key: execution.provenance[key] for key in PROVENANCE}, indent=2, ensure_ascii=False),
    )


def _about(scene: Scene) -> Text:
    """State the kind of a scene, its size, and how its coordinates were read."""
    points = sum(len(scan.points) for scan in scene.scans)
    values = {
        "kind": label(scene.kind),
        "scans": len(scene.scans),
        "points": points,
        "units": scene.units,
        "reason": scene.units_reason,
    }
    if points:
        return text(
            "{kind}, {scans} {scans:?scan|scans}, {points:,} points. Coordinates read as {units} ({reason}). "
            "All lengths in mm.",
            **values,
        )
    return text(
        "{kind}, {scans} {scans:?scan|scans}, points left in the file. Coordinates read as {units} ({reason}). "
        "All lengths in mm.",
        **values,
    )


def _sections(
    execution: Execution, report: ErrorReport, figures: Mapping[str, Drawn], live: Container[str], lang: str
) -> list[dict[str, Any]]:
    sections = []
    for run, others in execution.by_step():
        section = _section(run, others, report, lang) | {"live": run.step in live}
        drawn = figures.get(run.step, Drawn({})).figures.values()
        section["figures"] = [{"caption": caption, "data": png} for caption, png in drawn]
        sections.append(section)
    if report.metrics:
        table = written_table(all_tables.checks_table(report), lang)
        empty: dict[str, Any] = {"message": "", "method": "", "figures": [], "live": False, "step": ""}
        sections.append({**empty, "title": _compared(report), "tables": [table]})
    return sections


def _compared(report: ErrorReport) -> Text:
    """Say how many limits of accuracy are kept."""
    limited = [metric for metric in report.metrics if metric.limit == metric.limit]
    missed = sum(not metric.passed for metric in limited)
    if missed:
        return text(
            "Comparison with the truth: {missed} of {limited} accuracy limits missed",
            missed=missed, limited=len(limited),
        )  # fmt: skip
    return text("Comparison with the truth: {limited} of {limited} accuracy limits kept", limited=len(limited))


def _section(run: StepRun, others: list[StepRun], report: ErrorReport, lang: str) -> dict[str, Any]:
    """Return what the appendix says of a step, and its tables that have rows."""
    report_of = step_report(run.step)
    tables = [table for table in all_tables.tables_of_step(run, others, report) if table.on_page and table.rows]
    # Of a step that failed first why
    why: list[Any] = list(report_of.why(run.result)) if run.result.status == Status.FAILED else []
    method = text("Method {method}.", method=run.method)
    if body := report_of.summary(run.result)[1]:
        method = text("Method {method}. {text}", method=run.method, text=body)
    return {
        "title": report_of.title,
        "method": method,
        "message": messages(lang).sentences([*why, *(reason for reason in run.result.reasons if reason not in why)]),
        "tables": [written_table(table, lang) for table in tables],
        "step": run.step,
    }


def _cell(cell: Any, written: str, column: Column, lang: str) -> tuple[str, str]:
    """Return the style of a cell and its text, ``written`` in English; names from the input are not translated."""
    if isinstance(cell, int | float | np.number):
        return "number", written
    if isinstance(cell, Verdict):
        return f"verdict {TONES[cell]}", "" if cell is Verdict.NONE else messages(lang).text(cell)
    if not isinstance(cell, str) or isinstance(cell, Word):
        translated = shown(messages(lang).text(cell))
    else:
        translated = written if column.are_names else shown(messages(lang).text(label(cell)))
    return "long" if len(written) > LONG_CELL else "text", translated


def written_table(table: Table, lang: str) -> dict[str, Any]:
    """Return what the macro ``put`` shows of a table, in a language."""
    note: Any = table.note
    if len(table.rows) > MOST_ROWS:
        note = text(
            "{note} The first {most} of {rows} rows; all are in {file}.csv.",
            note=note,
            most=MOST_ROWS,
            rows=len(table.rows),
            file=table.file,
        )
    catalogue = messages(lang)
    return {
        "title": title(table, catalogue),
        "note": note,
        "groups": groups(table, catalogue),
        "columns": list(zip(headings(table, catalogue), numeric(table), strict=True)),
        "rows": [
            [_cell(*cell, lang) for cell in zip(row, written, table.columns, strict=True)]
            for row, written in zip(table.rows[:MOST_ROWS], shown_rows(table), strict=False)
        ],
    }
