"""The folder of results: made under a temporary name, then moved into place whole."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from processor.evaluation.evaluate import ErrorReport
from processor.model import InputError, UsageError
from processor.pipeline import Execution
from processor.report import all_figures, all_tables, page, results_json
from processor.report import table as report_table
from processor.report.step_report import step_report
from processor.store import store

RESULTS, RUNS = "results.json", "results.h5"
OWN_NAMES = (
    RESULTS,
    RUNS,
    "report.html",
    "figures",
    "job.json",
)  # the last is a batch's, which repeats the job without
OWN_ENDINGS = (".csv", ".dxf", ".pdf")


def check_output(out: Path, source: Path | None, mark: str = RESULTS, names: Collection[str] = OWN_NAMES) -> None:
    """Raise UsageError for a folder with anything but earlier results, as it will be replaced as a whole.

    Earlier results are recognised by the file ``mark`` among files of the ``names`` of results.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; name a folder for the results")
    if source is not None and source.resolve().is_relative_to(out.resolve()):
        raise UsageError(f"{out}: holds the input {source}, which the results would replace; name another folder")
    inside = sorted(path.name for path in out.iterdir()) if out.is_dir() else []
    if inside and mark not in inside:
        raise UsageError(f"{out}: is not empty and holds no earlier results; name another folder")
    others = [name for name in inside if name not in names and not name.endswith(OWN_ENDINGS)]
    if others:
        raise UsageError(f"{out}: holds more than earlier results ({others[0]}); take it out or name another folder")


def write(out: Path, execution: Execution, report: ErrorReport, lang: str = "en") -> None:
    """Write results.h5, results.json, CSV tables, figures, drawings and report.html into ``out``, in place of others.

    Only the page is in the language ``lang``. Raises InputError where they cannot be written, and leaves ``out`` as it
    was.
    """
    with replacing_folder(out) as making:
        store.write_results(making / RUNS, execution.runs, execution.provenance)
        content = results_json.results_json(execution, report)
        write_text(making / RESULTS, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
        for table in all_tables.tables_of_run(execution, report):
            if table.file:
                write_text(making / f"{table.file}.csv", report_table.csv_text(table))
        for run, _ in all_tables.grouped(execution.runs):
            for name, data in step_report(run.step).files(execution, run).items():
                write_bytes(making / name, data)
        drawn = all_figures.draw_figures(execution, report)
        if any(drawn.values()):
            (making / "figures").mkdir()
        for of_step in drawn.values():
            for name, (_, png) in of_step.items():
                write_bytes(making / "figures" / name, png)
        write_text(making / "report.html", page.html(execution, report, drawn, lang))


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """Yield a folder to write into, which replaces ``out`` when all is written and is removed on any error.

    Raises InputError where it cannot be written.
    """
    out = out.absolute()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        making = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        os.chmod(making, 0o755)
        yield making
        _replace(making, out)
    except BaseException as error:
        shutil.rmtree(making, ignore_errors=True)
        if isinstance(error, OSError):
            raise _unwritable(out, error) from error
        if isinstance(error, InputError):  # of a file in the folder that was removed
            raise InputError(str(error).replace(str(making), str(out))) from error
        raise


def _unwritable(out: Path, error: OSError) -> InputError:
    return InputError(f"{out}: cannot be written ({error.strerror or error}); nothing was changed there")


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, onto the disk."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, onto the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _replace(made: Path, out: Path) -> None:
    """Move a folder into the place of another, which is removed only after that."""
    if not out.exists():
        os.replace(made, out)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
    os.replace(out, old / "old")
    try:
        os.replace(made, out)
    except OSError:
        os.replace(old / "old", out)
        os.rmdir(old)
        raise
    shutil.rmtree(old, ignore_errors=True)
