"""Batches run in this process, their jobs by a program that may fail as planned, or here as well."""

import contextlib
import functools
import io
import os
import sys
import threading
import types
from pathlib import Path
from unittest import mock

import pytest

from processor import __main__
from processor.batch import batch, job
from processor.jobs import causes, process
from tests.support.processes import commands

ROOT = Path(__file__).resolve().parents[3]
ENV = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
REAL, FAILING = process.GUARDED, (sys.executable, str(ROOT / "tests/support/processes/failing_job.py"))


def run(*arguments, code=0, program=FAILING, stderr=None):
    """Run the command line in this process, the jobs by ``program``; None: one after another in this process, too."""
    here = mock.patch.object(job.process, "run", run_here) if program is None else contextlib.nullcontext()
    settings = functools.partial(batch.Settings, program=program or REAL)
    with here, mock.patch.object(batch, "Settings", settings):
        return called("batch", arguments, code, stderr)


def run_one(*arguments, code=0):
    """Run ``processor run`` in this process."""
    return called("run", arguments, code)


def called(name, arguments, code, stderr=None):
    """Run a command of processor in this process, whose threads may run others by :func:`run_here`."""
    out, err = _TextOfThread(), _TextOfThread()
    with (
        mock.patch.object(sys, "argv", ["processor", name, *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(stderr or err),
        pytest.raises(SystemExit) as end,
    ):
        __main__.main()
    assert (end.value.code or 0) == code, err.getvalue()
    assert "Traceback" not in err.getvalue()
    return types.SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue())


class _TextOfThread(io.StringIO):
    """What is written to it, but by threads that have put another ``text`` in its place for what they write."""

    def __init__(self):
        super().__init__()
        self.of_thread = threading.local()

    def write(self, text):
        other = getattr(self.of_thread, "text", None)
        return super().write(text) if other is None else other.write(text)


_ONE_AT_A_TIME = threading.Lock()  # the command line is of the whole process


_run_there = process.run


def run_here(command, *, log=None, **limits):
    """What :func:`processor.jobs.process.run` makes of a guarded command, without a process; for :func:`called`."""
    if command[: len(REAL)] != REAL:  # that of another program
        return _run_there(command, log=log, **limits)
    memory_mb, module, *arguments = command[len(REAL) :]
    assert memory_mb.isdigit()
    sys.stdout.of_thread.text, err = io.StringIO(), io.StringIO()
    sys.stderr.of_thread.text = err
    with (
        _ONE_AT_A_TIME,
        mock.patch.object(sys, "argv", [module, *arguments]),
        pytest.raises(SystemExit) as end,
    ):
        commands.MAIN[module]()
    if log is not None:
        with log.open("a", encoding="utf-8") as file:
            file.write(err.getvalue())
    last = ["", *filter(str.strip, err.getvalue().splitlines())][-1]
    code = end.value.code or 0
    return process.Ended(causes.Cause.EXIT, code, last_line=last, seconds=0.0, peak_mb=0.0, max_rss_mb=0.0)


def folder(path, plant="", content="1 2 3\n"):
    path.mkdir(parents=True)
    (path / "scan.xyz").write_text(content)
    if plant:
        (path / "plant").write_text(plant)
    return path
