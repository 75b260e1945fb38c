"""The folder of ``processor history``: history.json, CSV tables, a picture and a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from processor import pipeline
from processor.epochs.change import Change, Component
from processor.epochs.compare import History
from processor.language.messages import Message, messages, text
from processor.report import page, templates, title_block, write_results
from processor.report.epochs import figures, lines, tables
from processor.report.style import default_settings
from processor.report.table import csv_text
from processor.results.fields_to_json import reason_json
from processor.store.json_values import json_ready
from processor.store.whole_output import whole_folder

RECORD, PAGE, FIGURE = "history.json", "report.html", "history.png"
OWN_NAMES = (RECORD, PAGE, FIGURE)
FORMAT, FORMAT_VERSION = "processor-history", "1.0"


def check_output(out: Path, root: Path) -> None:
    """Raise UsageError for a folder that holds the runs, or anything but an earlier comparison."""
    write_results.check_output(out, root, RECORD, OWN_NAMES)


def as_json(history: History) -> dict[str, Any]:
    """Build the object of history.json; units as stated, a value that is not known is null."""
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": history.name,
        "headline": messages("en").text(lines.headline(history)),
        "epochs": [
            {
                "day": one.day.isoformat(),
                "day_from": one.day_from,
                "folder": one.folder,
                "input": one.input,
                "input_sha256": one.input_sha256,
                **{name: one.facts.get(name) for name in ("scanner", "serial", "temperature_C", "design")},
            }
            for one in history.epochs
        ],
        "components": [_component(history, one) for one in tables.ordered(history)],
        "remarks": [reason_json(one) for one in history.remarks],
        "software": pipeline.software(),
    }
    written: dict[str, Any] = json_ready(content)
    return written


def _component(history: History, one: Component) -> dict[str, Any]:
    by_series: dict[int, list[Change]] = {}
    for change in one.changes:
        by_series.setdefault(id(change.series), []).append(change)
    return {
        "name": one.name,
        "step": one.step,
        "kind": one.kind,
        "follows": list(one.follows),
        "finding": one.finding,
        "since": tables.day(history, one.since) or None,
        "values": [
            {
                "quantity": messages("en").text(changes[0].series.quantity),
                "unit": changes[0].series.unit,
                "value": changes[0].series.value,
                "ci95": changes[0].series.ci95,
                "changes": [
                    {
                        "from": tables.day(history, change.first),
                        "to": tables.day(history, change.last),
                        "change": change.value,
                        "ci95": change.ci95,
                        "ci95_widened": change.widened,
                        "beyond": change.beyond,
                        "beyond_widened": change.surely,
                        "doubtful": change.doubtful,
                    }
                    for change in changes
                ],
            }
            for changes in by_series.values()
        ],
    }


def write(out: Path, history: History, lang: str = "en") -> dict[str, Any]:
    """Write the folder in place of an earlier one, its page in ``lang``; returns the object of history.json."""
    record = as_json(history)
    with default_settings():
        drawn = figures.changes(history)
    with whole_folder(out, replaces=True) as making:
        for table in tables.tables(history):
            (making / f"{table.file}.csv").write_text(csv_text(table), "utf-8")
        (making / RECORD).write_text(json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False) + "\n", "utf-8")
        if drawn is not None:
            (making / FIGURE).write_bytes(drawn[1])
        (making / PAGE).write_text(_page(history, drawn, lang), "utf-8")
    return record


def _page(history: History, drawn: tuple[Message, bytes] | None, lang: str) -> str:
    first, others = tables.of_page(history)
    first_day, last_day = tables.day(history, 0), tables.day(history, -1)
    return templates.render(
        "report",
        "history.html",
        lang,
        name=history.name,
        banner=text("{counts}", counts=lines.counts(history)),
        about=text("{epochs} epochs, {first} to {last}", epochs=len(history.epochs), first=first_day, last=last_day),
        remarks=history.remarks,
        figure=None if drawn is None else {"caption": drawn[0], "data": drawn[1], "twin": False},
        first=[page.written_table(table, lang) for table in first],
        others=[page.written_table(table, lang) for table in others],
        running_head=title_block.css_string(history.name),
        running_foot=title_block.css_string(f"processor {pipeline.software().get('processor', '')}"),
    )
