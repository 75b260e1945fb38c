"""The summary of a batch: summary.csv, summary.json and index.html, the same bytes for the same inputs.

What differs from run to run, times and memory, is in timings.csv.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from processor.batch import record
from processor.batch.figures import COLUMNS
from processor.batch.job import Job
from processor.batch.record import FAILED, Record
from processor.language import language
from processor.model import InputError

CSV, JSON, PAGE, TIMINGS = "summary.csv", "summary.json", "index.html", "timings.csv"
FILES = (CSV, JSON, PAGE, TIMINGS)
FORMAT, FORMAT_VERSION = "processor-batch", "1.0"
STATES = ("done", "in-part", "limit-missed", FAILED)
ENDS = ("report", "log", "input_sha256")  # of a row, after the reason
FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")  # first characters of cells that a spreadsheet would execute
TONES = {"done": "good", "in-part": "between", "limit-missed": "bad", FAILED: "bad"}
VERDICT_TONES = {"pass": "good", "fail": "bad", "indeterminate": "between"}


@dataclass(frozen=True)
class Summary:
    """How many inputs came to each state, the page that lists them, and those that failed."""

    counts: Mapping[str, int]
    page: Path
    failed: tuple[tuple[str, str], ...]  # name and reason


def remove(out: Path) -> None:
    """Remove an earlier summary."""
    for name in FILES:
        (out / name).unlink(missing_ok=True)


def write(out: Path, done: Sequence[tuple[Job, Record]], left_out: Mapping[str, str], lang: str = "en") -> Summary:
    """Write the summary of all jobs into ``out``, its page in the language ``lang``.

    Raises InputError if it cannot be written.
    """
    rows = [_row(out, job, ending) for job, ending in done]
    states = Counter(ending.status for _, ending in done)
    counts = {name: states[name] for name in STATES}
    left = sorted((readable(name), readable(reason)) for name, reason in left_out.items())
    columns = ["input", "status", "verdict", *(name for name in COLUMNS if name != "verdict"), "reason", *ENDS]
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "units": "mm", "counts": counts}
    named = [{"input": name, "reason": reason} for name, reason in left]
    content = head | {"inputs": rows, "left_out": named}
    record.write_text(out / CSV, _csv(columns, ([row.get(name) for name in columns] for row in rows)))
    record.write_text(out / JSON, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    times = ([readable(r.input), r.status, r.seconds, r.peak_mb, "yes" if r.kept else ""] for _, r in done)
    record.write_text(out / TIMINGS, _csv(["input", "status", "seconds", "peak_mb", "kept"], times))
    try:
        record.write_text(out / PAGE, _html(rows, counts, left, lang))  # last: it is there only if all are
    except InputError:
        remove(out)
        raise
    failed = tuple((row["input"], row["reason"]) for row in rows if row["status"] == FAILED)
    return Summary(counts, out / PAGE, failed)


def readable(text: str) -> str:
    """Return a name on one line, with bytes that are not UTF-8 escaped."""
    plain = os.fsencode(text).decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in plain)


def _row(out: Path, job: Job, ending: Record) -> dict[str, Any]:
    with_results = ending.status != FAILED
    row: dict[str, Any] = {"input": readable(ending.input), "status": ending.status}
    row |= {"verdict": None, "reason": readable(ending.reason), **ending.figures}
    row["report"] = _link(out, job.place / "report.html") if with_results else ""
    row["log"] = _link(out, job.log) if job.log.is_file() else ""
    return row | {"input_sha256": ending.input_sha256}


def _link(out: Path, path: Path) -> str:
    return quote(os.fsencode(path.relative_to(out)), safe="/")


def _csv(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows([_cell(cell) for cell in row] for row in rows)
    return text.getvalue()


def _cell(cell: Any) -> Any:
    if isinstance(cell, str):
        return f"'{cell}" if cell.startswith(FORMULA) else cell
    if isinstance(cell, float):
        return repr(round(cell, 6)) if math.isfinite(cell) else ""
    return "" if cell is None else cell


def _html(
    rows: Sequence[dict[str, Any]], counts: Mapping[str, int], left_out: Sequence[tuple[str, str]], lang: str
) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("processor", "batch"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    say = language(lang).say
    environment.filters["say"] = say
    columns = [name for name in COLUMNS if name != "verdict" and any(row.get(name) is not None for row in rows)]
    shown = [
        {
            **{name: row[name] or "" for name in ("input", "status", "verdict", "reason", "report", "log")},
            "tone": TONES[row["status"]],
            "verdict_tone": VERDICT_TONES.get(row["verdict"] or "", ""),
            "cells": [_shown(row.get(name)) for name in columns],
            "english": bool(row["reason"]) and say(row["reason"]) == row["reason"],
        }
        for row in rows
    ]
    text: str = environment.get_template("summary.html").render(
        lang=lang,
        title=f"{len(rows)} inputs",
        counted=", ".join(f"{count} {name}" for name, count in counts.items() if count) + ".",
        columns=[
            (name.replace("_", " "), any(cell["number"] for cell in cells))
            for name, cells in zip(columns, zip(*(row["cells"] for row in shown), strict=True), strict=False)
        ],
        rows=shown,
        left_out=left_out,
    )
    return text


def _shown(cell: Any) -> dict[str, Any]:
    number = isinstance(cell, int | float)
    return {"number": number, "text": "" if cell is None else f"{cell:.3f}" if isinstance(cell, float) else str(cell)}
