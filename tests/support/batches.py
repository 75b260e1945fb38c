"""Batches run in this process, their jobs by a program that may fail as planned."""

import contextlib
import functools
import io
import os
import sys
import types
from pathlib import Path
from unittest import mock

import pytest

from processor import __main__
from processor.batch import batch
from processor.jobs import process

ROOT = Path(__file__).resolve().parents[2]
ENV = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
REAL, FAILING = process.GUARDED, (sys.executable, str(ROOT / "tests/support/failing_job.py"))


def run(*arguments, code=0, program=FAILING):
    """Run the command line in this process, the jobs by ``program``."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["processor", "batch", *map(str, arguments)]),
        mock.patch.object(batch, "Settings", functools.partial(batch.Settings, program=program)),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        __main__.main()
    assert end.value.code == code, err.getvalue()
    assert "Traceback" not in err.getvalue()
    return types.SimpleNamespace(stdout=out.getvalue(), stderr=err.getvalue())


def folder(path, plant="", content="1 2 3\n"):
    path.mkdir(parents=True)
    (path / "scan.xyz").write_text(content)
    if plant:
        (path / "plant").write_text(plant)
    return path
