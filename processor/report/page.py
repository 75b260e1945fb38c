"""The HTML page of a run: one file that loads nothing."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from typing import Any

import numpy as np

from processor.evaluation.evaluate import ErrorReport
from processor.language.messages import Text, label, messages, text
from processor.model import Scene, Status, StepRun, Verdict, Word, worst
from processor.pipeline import Execution
from processor.report import all_tables, characteristics, headline, templates, title_block
from processor.report.columns import Column
from processor.report.reports_of_steps import characteristics_of, step_report
from processor.report.scripts import page_script
from processor.report.style import CaptionedPngs, Drawn
from processor.report.table import Table, groups, headings, numeric, shown, title
from processor.targets.summary import summary

GOOD = "ok"
LONG_CELL = 24  # characters
LEAD = ("what-to-do", "limits-not-held")  # tables above the figures, below the characteristics
PROVENANCE = ("input", "input_sha256", "seed", "software", "parameters")
BANNER = {
    Verdict.PASS: text("PASS"),
    Verdict.FAIL: text("FAIL"),
    Verdict.INDETERMINATE: text("INDETERMINATE"),
    Verdict.NONE: text("No verdict"),
}
TONES = {Verdict.PASS: "good", Verdict.FAIL: "bad", Verdict.INDETERMINATE: "open", Verdict.NONE: ""}
MOST_ROWS = 2000  # of a table; keeps the page of a roof of 30,000 balls below 12 MB


def html(execution: Execution, report: ErrorReport, figures: Mapping[str, Drawn], lang: str = "en") -> str:
    """Render the page, with the figures of each step, in a language of CODES; every text is escaped."""
    scene = execution.scene
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
        banner=_banner(execution),
        about=_about(scene),
        clipped=None if scene.clips is None else headline.clipped(scene.clips),
        targets=None if scene.targets is None else summary(scene),
        live=page_script.embedded({"words": messages(lang).of_scripts(script), "steps": messages(lang).rendered(live)}),
        script=script,
        digest=digest,
        verdicts=_verdicts(execution, report),
        footnote=headline.to_confirm(execution),
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


def _banner(execution: Execution) -> dict[str, Any]:
    """Return the verdict on everything, in a word, and what it rests on."""
    runs = [run for run, _ in execution.by_step()]
    verdict = worst(run.verdict for run in runs)
    told = characteristics.summary(one for run in runs for one in characteristics_of(execution.scene, run))
    tone = TONES[verdict]
    if verdict not in (Verdict.NONE, Verdict.FAIL) and headline.to_confirm(execution):
        tone = "open"
    return {"tone": tone, "word": BANNER[verdict], "text": text("{sentences:.}", sentences=[told])}


def _verdicts(execution: Execution, report: ErrorReport) -> list[dict[str, Any]]:
    verdicts: list[dict[str, Any]] = []
    for run, _ in execution.by_step():
        report_of = step_report(run.step)
        _, body = report_of.summary(run.result)
        method = text("Method {method}.", method=run.method)
        if body:
            method = text("Method {method}. {text}", method=run.method, text=body)
        verdicts.append({"tone": _tone(run), "head": headline.of_step(run), "text": method})
        verified = getattr(run.result, "verified", True)
        verdicts += [_further(verified, *further) for further in report_of.further_verdicts(run.result)]
    return [*verdicts, _truth(report)]


def _further(verified: bool, head: Any, body: Any, verdict: Verdict = Verdict.NONE) -> dict[str, Any]:
    tone = TONES[verdict] if verified or verdict is Verdict.FAIL else ""
    if verdict is not Verdict.NONE:
        head = text("{head}: {verdict}", head=head, verdict=verdict)
    return {"tone": tone, "head": head, "text": body}


def _truth(report: ErrorReport) -> dict[str, Any]:
    """Summarise the checks against the truth."""
    if not report.metrics:
        return {"tone": "", "head": text("No truth"), "text": text("a real scan: nothing to check against")}
    limited = [metric for metric in report.metrics if metric.limit == metric.limit]
    missed = [metric for metric in limited if not metric.passed]
    if not missed:
        head = text("Comparison with the truth: {limited} of {limited} accuracy limits kept", limited=len(limited))
        body = text("{free} further figures have no limit", free=len(report.metrics) - len(limited))
        return {"tone": "good", "head": head, "text": body}
    head = text(
        "Comparison with the truth: {missed} of {limited} accuracy limits missed",
        missed=len(missed),
        limited=len(limited),
    )
    names = [
        text("{step}: {figure}", step=label(metric.step), figure=all_tables.metric_name(metric)) for metric in missed
    ]
    return {"tone": "bad", "head": head, "text": text("{names}", names=names)}


def _tone(run: StepRun) -> str:
    """Return the colour class of a step's box: a pass against limits that are not verified is neutral."""
    if run.result.status != GOOD or run.verdict is Verdict.FAIL:
        return "bad"
    provisional = run.verdict is Verdict.INDETERMINATE or not getattr(run.result, "verified", True)
    return "" if provisional else "good"


def _sections(
    execution: Execution, report: ErrorReport, figures: Mapping[str, Drawn], live: Container[str], lang: str
) -> list[dict[str, Any]]:
    sections = [_section(execution, run, others, report, lang) for run, others in execution.by_step()]
    for section in sections:
        section["live"] = section["step"] in live
        drawn = figures.get(section["step"], Drawn({}))
        section["figures"] = _pictures(section["step"], drawn.figures, section["live"])
    if report.metrics:
        table = written_table(all_tables.checks_table(report), lang)
        empty: dict[str, Any] = {"message": "", "lead": [], "further": [], "figures": [], "live": False, "step": ""}
        sections.append({**empty, "title": text("Truth"), "tables": [table]})
    return sections


def _section(
    execution: Execution, run: StepRun, others: list[StepRun], report: ErrorReport, lang: str
) -> dict[str, Any]:
    """Return the tables of a step: what is compared with limits, what to look at first, the others, and more."""
    report_of = step_report(run.step)
    tables = [table for table in all_tables.tables_of_step(run, others, report) if table.on_page]
    if run.result.status == Status.FAILED:
        tables = [table for table in tables if table.rows]
    held = [] if report_of.own_table else characteristics_of(execution.scene, run)
    lead = [characteristics.table(held, report_of.characteristics_note)] if held else []
    lead += [table for table in tables if table.file in LEAD]
    further = [table for table in tables if table.file not in LEAD and table.folded]
    # Of a step that failed first why
    why: list[Any] = list(step_report(run.step).why(run.result)) if run.result.status == Status.FAILED else []
    return {
        "title": report_of.title,
        "message": messages(lang).sentences([*why, *(reason for reason in run.result.reasons if reason not in why)]),
        "lead": [written_table(table, lang) for table in lead],
        "tables": [written_table(table, lang) for table in tables if table.file not in LEAD and not table.folded],
        "further": [written_table(table, lang) for table in further],
        "further_titles": list(dict.fromkeys(title(table, messages(lang)) for table in further)),
        "step": run.step,
    }


def _pictures(step: str, drawn: CaptionedPngs, live: bool) -> list[dict[str, Any]]:
    """Return the pictures of a step; ``twin`` marks those that are interactive views on the screen."""
    report_of = step_report(step)
    twins = report_of.live_figures if live else ()
    return [
        {
            "caption": caption,
            "data": png,
            "twin": name in twins,
            "further": name in report_of.further_figures,
        }
        for name, (caption, png) in drawn.items()
    ]


def _cell(cell: Any, column: Column, lang: str) -> tuple[str, str]:
    """Return the style of a cell and its text; names from the input are not translated."""
    if isinstance(cell, int | float | np.number):
        return "number", shown(cell)
    if isinstance(cell, Verdict):
        return f"verdict {TONES[cell]}", messages(lang).text(cell)
    if not isinstance(cell, str) or isinstance(cell, Word):
        written = shown(messages(lang).text(cell))
    else:
        written = shown(cell) if column.are_names else shown(messages(lang).text(label(cell)))
    return "long" if len(shown(cell)) > LONG_CELL else "text", written


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
            [_cell(cell, column, lang) for cell, column in zip(row, table.columns, strict=True)]
            for row in table.rows[:MOST_ROWS]
        ],
    }
