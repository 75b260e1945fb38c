"""One night: the cells of a matrix done, written to the history, compared with the nights before, and told.

OUT holds ``cells/NIGHT/KEY/results.json`` of every cell (of the last nights), ``history.sqlite``, of every night
``nights/NIGHT/`` with summary.json, junit.xml, certificate.json, certificate.html and line.txt, these again for the
night done last, and ``nights.html``.

A cell is first moved whole into its folder, then written to the history in one transaction; whatever ends the program
in between, the next start takes up what is there.
"""

from __future__ import annotations

import datetime
import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from processor.model import UsageError
from processor.validation import certificate, changes, junit, software, summary
from processor.validation.cells import Cell, Outcome
from processor.validation.history import History
from processor.validation.matrix import Matrix
from processor.validation.running import Runner
from processor.validation.software import Software
from processor.validation.summary import Summary

LOCK, SCRATCH, CELLS, NIGHTS = ".validation", ".making", "cells", "nights"
HISTORY = "history.sqlite"
KEPT_NIGHTS = 14  # whose results.json of cells stay
SEEN_NIGHTS = changes.MOST_NIGHTS + 10


def number_of(night: str) -> int:
    """Return the number of a night, which its seeds are drawn from. Raises UsageError for what is no date."""
    try:
        return datetime.date.fromisoformat(night).toordinal()
    except ValueError:
        raise UsageError(f"--night {night}: expected a date as 2026-11-30") from None


@contextmanager
def opened(out: Path) -> Iterator[Path]:
    """Take the folder of results for one program; give where scenes may be made. UsageError where it is not free."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; name a folder for the results")
    if out.is_dir() and any(out.iterdir()) and not (out / LOCK).exists():
        raise UsageError(f"{out}: is not empty and holds no earlier nights; name another folder")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UsageError(f"{out}: another validation is at work here; wait for it") from None
        shutil.rmtree(out / SCRATCH, ignore_errors=True)  # of one that was killed
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
    """Do what is not done yet of a night and tell it, its pages in the language ``lang``; ``out`` must be ``opened``.

    ``again`` deletes what other software has done of this night, which is refused otherwise (UsageError). ``progress``
    is told how many of how many cells are done, and of the one that was last.
    """
    cells = matrix.cells(number_of(night))
    present = made_by or software.present()
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
                kept = _kept(out, night, cell, present.code)
                if kept is None:
                    open_cells.append(cell)
                else:
                    history.add(night, cell, kept)
        ready = len(cells) - len(open_cells)
        progress(ready, len(cells), None, None)
        with closing(runner(open_cells)) as coming:
            for cell, outcome in coming:
                if not outcome.failed:
                    _keep(out, night, cell, outcome, present.code)
                history.add(night, cell, outcome)
                ready += 1
                progress(ready, len(cells), cell, outcome)
        told = _tell(matrix, out, night, cells, present, history, lang)
    _forget_old(out)
    return told


def _tell(
    matrix: Matrix, out: Path, night: str, cells: tuple[Cell, ...], present: Software, history: History, lang: str
) -> Summary:
    asked = {cell.key for cell in cells}
    nights = [one for one in history.nights() if one.night <= night]
    rows = history.rows(nights[-SEEN_NIGHTS:][0].night, night)
    found = changes.find(rows, night, history.worse(night), matrix.aim)
    own = tuple(cell for cell in history.cells(night) if cell["cell"] in asked)
    missed = {key: figures for key, figures in history.missed(night).items() if key in asked}
    told = Summary(night, present, own, missed, found)
    same = [one.night for one in nights if one.code == present.code]
    cases = list({entry.case.key: entry.case for entry in matrix.entries}.values())
    certified = certificate.make(night, rows, same, cases, present, matrix)
    files = {
        "summary.json": _json(told.as_object()).encode(),
        "junit.xml": junit.xml(night, own, missed, found),
        "certificate.json": certificate.as_json(certified).encode(),
        "certificate.html": certificate.as_html(certified, lang).encode(),
        "line.txt": f"{told.line}\n".encode(),
    }
    of_night = out / NIGHTS / night
    of_night.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        _write(of_night / name, data)
        _write(out / name, data)
    history.end(night, [(one.name, one.kind, summary.change_object(one)) for one in found.changes], told.line, _now())
    page = summary.nights_html(told, [one for one in history.nights() if one.night <= night], rows, lang)
    _write(out / "nights.html", page.encode())
    return told


# --- the folder of a cell -------------------------------------------------------------------------------------------


def _keep(out: Path, night: str, cell: Cell, outcome: Outcome, code: str) -> None:
    folder = out / CELLS / night / cell.key
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cell.json").unlink(missing_ok=True)
    _write(folder / "results.json", (json.dumps(outcome.results, ensure_ascii=False) + "\n").encode())
    said = {"title": cell.title, "code": code, "seconds": outcome.seconds, "peak_mb": outcome.peak_mb, **cell.spec()}
    _write(folder / "cell.json", _json(said).encode())  # last: where it is, the results are whole and its own


def _kept(out: Path, night: str, cell: Cell, code: str) -> Outcome | None:
    """Return what was kept of a cell that the history has not got, None where it is not whole or of other software."""
    folder = out / CELLS / night / cell.key
    try:
        said = json.loads((folder / "cell.json").read_text("utf-8"))
        if said["code"] != code:
            return None
        results = json.loads((folder / "results.json").read_text("utf-8"))
        return Outcome("", results, float(said["seconds"]), float(said["peak_mb"]))
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _forget_old(out: Path) -> None:
    nights = sorted(folder for folder in (out / CELLS).glob("*") if folder.is_dir())
    for folder in nights[:-KEPT_NIGHTS]:
        shutil.rmtree(folder, ignore_errors=True)


def _write(path: Path, data: bytes) -> None:
    making = path.with_name(f".{path.name}.tmp")
    with making.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(making, path)


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
