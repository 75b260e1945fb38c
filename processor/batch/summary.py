"""The summary of a batch: summary.csv, summary.json and index.html, the same bytes for the same inputs.

Times and memory, which differ from run to run, are in timings.csv.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from processor.batch.job import Job
from processor.batch.record import JobStatus, Record
from processor.batch.summary_values import COLUMNS
from processor.language.messages import Text, label, messages, text
from processor.model import InputError, Reason, Status, Verdict
from processor.plain_text import printable
from processor.report import templates
from processor.report.columns import columns
from processor.report.table import csv_of_rows, heading
from processor.results.file_names import REPORT_PAGE
from processor.store.whole_output import replace_text

CSV, JSON, PAGE, TIMINGS = "summary.csv", "summary.json", "index.html", "timings.csv"
FILES = (CSV, JSON, PAGE, TIMINGS)
FORMAT, FORMAT_VERSION = "processor-batch", "1.0"
ENDS = ("report", "log", "input_sha256")  # of a row, after the reason
TONES = {
    JobStatus.DONE: "good",
    JobStatus.IN_PART: "between",
    JobStatus.LIMIT_MISSED: "bad",
    JobStatus.FAILED: "bad",
    Verdict.PASS: "good",
    Verdict.INDETERMINATE: "between",
    Verdict.FAIL: "bad",
}
ERROR = "batch.error"  # code of an error of the command line, whose text is English


@dataclass(frozen=True)
class Summary:
    """The number of inputs of each status, the page that lists them, those that failed, and all verdicts."""

    counts: Mapping[str, int]
    page: Path
    failed: tuple[tuple[str, str], ...]  # name and reason
    verdicts: frozenset[Verdict]


def remove(out: Path) -> None:
    """Remove an earlier summary."""
    for name in FILES:
        (out / name).unlink(missing_ok=True)


def write(out: Path, done: Sequence[tuple[Job, Record]], left_out: Mapping[str, Reason], lang: str = "en") -> Summary:
    """Write the summary of all jobs into ``out``, its page in the language ``lang``.

    Raises InputError if it cannot be written.
    """
    rows = [_row(out, job, ending) for job, ending in done]
    statuses = Counter(ending.status for _, ending in done)
    counts = {str(status): statuses[status] for status in JobStatus}
    left = [
        {"input": readable(name), "reason": _written(why, "en"), "reason_code": why.code}
        for name, why in sorted(left_out.items())
    ]
    header = (
        *columns("input", "status", "verdict"),
        *(column for name, column in COLUMNS.items() if name != "verdict"),
        *columns("reason", *ENDS),
    )
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "units": "mm", "counts": counts}
    content = head | {"inputs": rows, "left_out": left}
    replace_text(out / CSV, csv_of_rows(header, ([row.get(column.name) for column in header] for row in rows)))
    replace_text(out / JSON, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    times = ([readable(r.input), r.status, r.seconds, r.peak_mb, "yes" if r.kept else ""] for _, r in done)
    replace_text(out / TIMINGS, csv_of_rows(columns("input", "status", "seconds", "peak_mb", "kept"), times))
    try:
        page = _html(rows, [ending for _, ending in done], statuses, left_out, lang)
        replace_text(out / PAGE, page)  # last: it is there only if all are
    except InputError:
        remove(out)
        raise
    failed = tuple((row["input"], row["reason"]) for row in rows if row["status"] == JobStatus.FAILED)
    verdicts = frozenset(Verdict(row["verdict"] or "none") for row in rows)
    return Summary(counts, out / PAGE, failed, verdicts)


def _written(why: Reason | None, lang: str) -> str:
    return "" if why is None else readable(messages(lang).text(why))


def readable(text: str) -> str:
    """Return a name on one line, with bytes that are not UTF-8 escaped."""
    return printable(os.fsencode(text).decode("utf-8", "backslashreplace"))


def _row(out: Path, job: Job, ending: Record) -> dict[str, Any]:
    why = ending.reason
    row: dict[str, Any] = {"input": readable(ending.input), "status": ending.status, "verdict": None}
    row |= {"reason": _written(why, "en"), "reason_code": "" if why is None else why.code, **ending.figures}
    row["report"] = "" if ending.status == JobStatus.FAILED else _link(out, job.results_folder / REPORT_PAGE)
    row["log"] = _link(out, job.log) if job.log.is_file() else ""
    return row | {"input_sha256": ending.input_sha256}


def _link(out: Path, path: Path) -> str:
    return quote(os.fsencode(path.relative_to(out)), safe="/")


def _html(
    rows: Sequence[dict[str, Any]],
    records: Sequence[Record],
    statuses: Counter[JobStatus],
    left_out: Mapping[str, Reason],
    lang: str,
) -> str:
    names = [name for name in COLUMNS if name != "verdict" and any(row.get(name) is not None for row in rows)]
    counted = [
        text("{count} {status}", count=statuses[status], status=status) for status in JobStatus if statuses[status]
    ]
    verdicts = [Verdict(row["verdict"] or "none") for row in rows]
    shown = [
        {
            **{name: row[name] for name in ("input", "status", "report", "log")},
            "tone": TONES[row["status"]],
            "verdict": verdict if row["verdict"] else "",
            "verdict_tone": TONES.get(verdict, ""),
            "reason": _written(ending.reason, lang),
            "english": row["reason_code"] == ERROR and lang != "en",
            "cells": [
                {"number": isinstance(cell, int | float), "text": "" if cell is None else messages(lang).text(cell)}
                for cell in (_steps(ending) if name == "steps" else row.get(name) for name in names)
            ],
        }
        for row, ending, verdict in zip(rows, records, verdicts, strict=True)
    ]
    headings = [
        (heading(COLUMNS[name], messages(lang)), any(row["cells"][i]["number"] for row in shown))
        for i, name in enumerate(names)
    ]
    return templates.render(
        "batch",
        "summary.html",
        lang,
        title=text("{count} {count:?input|inputs}", count=len(rows)),
        counted=text("{counts}.", counts=counted),
        columns=headings,
        rows=shown,
        left_out=[(readable(name), _written(why, lang)) for name, why in sorted(left_out.items())],
    )


def _steps(ending: Record) -> list[Text]:
    """List the steps, with the status of those that did not end well."""
    return [
        label(step) if status == Status.OK else text("{step} ({status})", step=label(step), status=Status(status))
        for step, status in ending.steps.items()
    ]
