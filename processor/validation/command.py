"""The command ``processor validate``."""

from __future__ import annotations

import datetime
import sys
from contextlib import closing
from pathlib import Path

from tqdm import tqdm

from processor.model import InputError, UsageError
from processor.plain_text import printable
from processor.store.whole_output import check_folder
from processor.validation import cell_runner
from processor.validation import matrix as matrices
from processor.validation import night as nights
from processor.validation.cells import Cell, Outcome
from processor.validation.history import History
from processor.validation.summary import Summary


def run(
    matrix: Path | None,
    out: Path,
    jobs: int,
    cluster: str | None,
    full: bool,
    history: Path | None,
    night: str | None,
    again: bool,
    lang: str = "en",
) -> Summary:
    """Run a night; failed cells are reported on standard error, with a progress bar if that is a terminal."""
    night = _night(night)
    check_folder(out / nights.HISTORY)
    wanted = matrices.read(matrix or matrices.DEFAULT, full)
    with (
        nights.locked_output(out) as scratch,
        cell_runner.cell_runner(cluster, jobs, scratch, lambda line: print(line, file=sys.stderr)) as runner,
        tqdm(total=0, unit="cell", disable=not sys.stderr.isatty()) as bar,
    ):

        def progress(ready: int, total: int, cell: Cell | None, outcome: Outcome | None) -> None:
            bar.total, bar.n = total, ready
            bar.refresh()
            if cell is not None and outcome is not None and outcome.failed:
                with bar.external_write_mode(sys.stderr):
                    print(f"{cell.title}: failed: {printable(outcome.failed)}", file=sys.stderr)

        return nights.run(wanted, out, night, runner, history, again, progress=progress, lang=lang)


def accept(out: Path, history: Path | None, night: str | None) -> str:
    """Accept what got worse in a night, by default the last; returns the message."""
    path = history or out / nights.HISTORY
    if not path.exists():
        raise InputError(f"{path}: there is no such history; name it with --history")
    with closing(History(path)) as opened:
        known = [each["night"] for each in opened.nights()]
        if night is not None and _night(night) not in known:
            raise UsageError(f"--night {night}: the history has no such night")
        if not known:
            raise InputError(f"{path}: holds no nights yet")
        chosen = night or known[-1]
        return f"{chosen}: {opened.accept(chosen)} figure(s) accepted as they are now"


def _night(night: str | None) -> str:
    night = night or datetime.datetime.now(datetime.timezone.utc).date().isoformat()
    nights.number_of(night)
    return night
