"""Command lines in the test's own process, which has loaded what a process of its own would load for seconds."""

import contextlib
import io
import sys
import time
from types import SimpleNamespace
from unittest import mock

import pytest

from designgen import __main__ as designgen_main
from processor import __main__ as processor_main

MAIN = {"processor": processor_main.main, "designgen": designgen_main.main}


def here(program, *arguments, stderr=None):
    """Run a command line of ``program`` and return what subprocess.run would, for text; errors may go to a file."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", [program, *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(stderr or err),
        pytest.raises(SystemExit) as end,
    ):
        MAIN[program]()
    return SimpleNamespace(returncode=end.value.code or 0, stdout=out.getvalue(), stderr=err.getvalue())


def until(condition, seconds=120):
    """Wait for what another process does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)
