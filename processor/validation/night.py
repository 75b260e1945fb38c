"""One night: the cells of a matrix are run, written to the history, compared with earlier nights, and reported.

OUT holds ``cells/NIGHT/KEY/results.json`` of every cell (of the last nights), ``history.sqlite``, ``nights.html``,
``curves.html`` and ``curves.json``, and for every night ``nights/NIGHT/`` with summary.json, junit.xml,
certificate.json, certificate.html and line.txt. Those of the last night are in OUT as well.

A cell is first moved whole into its folder, then written to the history in one transaction. If the program ends in
between, the next run takes it from its folder.
"""

from __future__ import annotations

import datetime
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from processor import pipeline
from processor.jobs.runner import locked
from processor.model import UsageError
from processor.results.file_names import RESULTS_JSON
from processor.store.whole_output import replacing
from processor.validation import certificate, change_detection, coverage, curves, junit, software_identity, summary
from processor.validation.cell_runner import Runner
from processor.validation.cells import Cell, Outcome
from processor.validation.history import History
from processor.validation.matrix import Matrix
from processor.validation.software_identity import Software
from processor.validation.summary import Summary

LOCK, SCRATCH, CELLS, NIGHTS = ".validation", ".making", "cells", "nights"
HISTORY = "history.sqlite"
KEPT_NIGHTS = 14  # whose results.json of cells are kept
SEEN_NIGHTS = change_detection.MOST_NIGHTS + 10  # some nights may lack a case


def number_of(night: str) -> int:
    """Return the number of a night, which its seeds depend on. Raises UsageError for what is no date."""
    try:
        return datetime.date.fromisoformat(night).toordinal()
    except ValueError:
        raise UsageError(f"--night {night}: expected a date as 2026-11-30") from None


@contextmanager
def locked_output(out: Path) -> Iterator[Path]:
    """Lock the folder of results and give the folder for scenes in it. Raises UsageError if it is not free."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; name a folder for the results")
    if out.is_dir() and any(out.iterdir()) and not (out / LOCK).exists():
        raise UsageError(f"{out}: is not empty and holds no earlier nights; name another folder")
    out.mkdir(parents=True, exist_ok=True)
    with locked(out / LOCK, f"{out}: another validation is at work here; wait for it"):
        shutil.rmtree(out / SCRATCH, ignore_errors=True)  # of a run that was killed
        (out / SCRATCH).mkdir()
        try:
            yield out / SCRATCH
        finally:
            shutil.rmtree(out / SCRATCH, ignore_errors=True)


def run(
    matrix: Matrix,
    out: Path,
    night: str,
    runner: Runner,
    history_file: Path | None = None,
    again: bool = False,
    made_by: Software | None = None,
    progress: Callable[[int, int, Cell | None, Outcome | None], None] = lambda *_: None,
    lang: str = "en",
) -> Summary:
    """Run the cells of a night that are not done, and report it in the language ``lang``.

    ``out`` must be locked by :func:`locked_output`.

    ``again`` deletes cells of this night that other software has done; without it, they raise UsageError. ``progress``
    is called with the numbers of cells done and of all, and the last cell with its outcome.
    """
    cells = matrix.cells(number_of(night))
    present = made_by or software_identity.present()
    with closing(History(history_file or out / HISTORY)) as history:
        begun_by = history.begun_by(night)
        if begun_by not in (None, present.code):
            if not again:
                raise UsageError(
                    f"night {night} was begun by other software (sources {begun_by}, now {present.code});"
                    " --again does all of it again, --night names another"
                )
            history.forget(night)
        history.begin(night, present, matrix.name, matrix.sha256, _now())
        done = history.done(night)
        open_cells = []
        for cell in cells:
            if cell.key not in done:
                earlier = _earlier(out, night, cell, present.code)
                if earlier is None:
                    open_cells.append(cell)
                else:
                    history.add(night, cell, earlier)
        ready = len(cells) - len(open_cells)
        progress(ready, len(cells), None, None)
        with closing(runner(open_cells)) as coming:
            for cell, outcome in coming:
                if not outcome.failed:
                    _keep(out, night, cell, outcome, present.code)
                history.add(night, cell, outcome)
                ready += 1
                progress(ready, len(cells), cell, outcome)
        report = _report(matrix, out, night, cells, present, history, lang)
    # Only the last nights keep their cells
    nights = sorted(folder for folder in (out / CELLS).glob("*") if folder.is_dir())
    for folder in nights[:-KEPT_NIGHTS]:
        shutil.rmtree(folder, ignore_errors=True)
    return report


def _report(
    matrix: Matrix, out: Path, night: str, cells: tuple[Cell, ...], present: Software, history: History, lang: str
) -> Summary:
    wanted = {cell.key for cell in cells}
    nights = [each for each in history.nights() if each["night"] <= night]
    rows = history.rows(nights[-SEEN_NIGHTS:][0]["night"], night)
    detected = change_detection.find(rows, night, history.worse(night), matrix.aim)
    done = tuple(cell for cell in history.cells(night) if cell["cell"] in wanted)
    missed = [figure for figure in history.missed(night) if figure["cell"] in wanted]
    same = [each["night"] for each in nights if each["code"] == present.code]
    judged = {(name, module.Params().method) for name, module in pipeline.step_modules().items()}
    cases = {entry.case.key for entry in matrix.entries}
    intervals = coverage.pooled([row for row in rows if row.case in cases], same, judged, matrix.coverage)
    report = Summary(
        night=night, software=present, cells=done, missed=missed, detected=detected, coverage=tuple(intervals)
    )
    certified = certificate.make(night, rows, same, present, matrix, intervals)
    files = {
        "summary.json": _json(report.as_object()).encode(),
        "junit.xml": junit.xml(report),
        "certificate.json": certificate.as_json(certified).encode(),
        "certificate.html": certificate.as_html(certified, lang).encode(),
        "line.txt": f"{report.line}\n".encode(),
    }
    of_night = out / NIGHTS / night
    of_night.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        _write(of_night / name, data)
        _write(out / name, data)
    changed = [(change.name, change.kind, summary.change_object(change)) for change in detected.changes]
    history.end(night, changed, report.line, _now())
    drawn = curves.of_history(rows, same, history.settings(nights[-SEEN_NIGHTS:][0]["night"], night))
    _write(out / "curves.json", _json(curves.as_object(drawn, night)).encode())
    _write(out / "curves.html", curves.html(drawn, night, lang).encode())
    page = summary.nights_html(report, [each for each in history.nights() if each["night"] <= night], rows, lang)
    _write(out / "nights.html", page.encode())
    return report


# --- the folder of a cell -------------------------------------------------------------------------------------------


def _keep(out: Path, night: str, cell: Cell, outcome: Outcome, code: str) -> None:
    folder = out / CELLS / night / cell.key
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cell.json").unlink(missing_ok=True)
    _write(folder / RESULTS_JSON, (json.dumps(outcome.results, ensure_ascii=False) + "\n").encode())
    content = {"title": cell.title, "code": code, "seconds": outcome.seconds, "peak_mb": outcome.peak_mb}
    _write(folder / "cell.json", _json(content | cell.spec()).encode())  # last: it is there only with whole results


def _earlier(out: Path, night: str, cell: Cell, code: str) -> Outcome | None:
    """Return the kept outcome of a cell that is not in the history; None if it is not whole or of other software."""
    folder = out / CELLS / night / cell.key
    try:
        content = json.loads((folder / "cell.json").read_text("utf-8"))
        if content["code"] != code:
            return None
        results = json.loads((folder / RESULTS_JSON).read_text("utf-8"))
        return Outcome("", results, float(content["seconds"]), float(content["peak_mb"]))
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
