"""CAD files read in this process, which has the CAD kernel at hand: a process of its own loads it for seconds.

What is asked and answered stays the same. The processes themselves are tested in test_cad_files and test_cad_designs.
"""

import contextlib
import io
import json
import sys
from types import SimpleNamespace
from unittest import mock

import pytest

from designgen import __main__
from designgen.cad import files as cad_files
from designgen.cad import process as kernel_process
from processor.jobs.causes import Cause
from processor.jobs.process import GUARDED
from processor.scan_folder import cad as scan_folder_cad


def read_here(monkeypatch):
    """Let this process do what ``designgen import`` and the process with the CAD kernel do."""
    monkeypatch.setattr(cad_files, "run", _read)
    monkeypatch.setattr(scan_folder_cad, "process", SimpleNamespace(run=_import, GUARDED=GUARDED))


def _read(_command, *, stdout, pass_fds, **_limits):
    with open(pass_fds[0], "rb", closefd=False) as question:
        job, content = json.loads(question.readline()), question.read()
    kernel_process.answer(job, content, stdout)
    return SimpleNamespace(cause=Cause.EXIT, code=0)


def _import(command, **_limits):
    assert tuple(command[: len(GUARDED)]) == GUARDED
    err = io.StringIO()
    with (
        mock.patch.object(sys, "argv", command[len(GUARDED) + 1 :]),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        __main__.main()
    return SimpleNamespace(cause=Cause.EXIT, code=end.value.code or 0, last_line=["", *err.getvalue().splitlines()][-1])
