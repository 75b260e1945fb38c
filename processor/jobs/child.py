"""Child side of a job: limited memory, end with the parent process, jobs served one after another.

:func:`main` with the arguments MEMORY_MB MODULE ARGUMENT... runs a module as ``python -m`` does, or a script where
MODULE ends in ``.py``, within the limit (0: none); its exit code tells a lack of memory, or of room to write, by the
codes of :mod:`processor.jobs.causes`. Standard input is a pipe that stays open as long as the parent
process lives.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import resource
import runpy
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from queue import SimpleQueue

from processor.jobs import causes, garbage_collection

# The parent samples the memory used and kills; the kernel's limit on allocations stops what grows between two samples.
ALLOCATED_PER_USED, ALLOCATED_BEYOND_MB = 2, 1024


class Loss(Enum):
    """Why a job has no result."""

    DIED = "died"  # the process or worker, at every attempt
    STOPPED = "stopped"
    NOT_RUN = "not-run"  # the job raised an exception, e.g. for want of a package
    NOT_RUN_BY_WORKER = "not-run-by-worker"


@dataclass(frozen=True)
class Lost:
    """Instead of a result: why there is none, and the exception on one line."""

    loss: Loss
    error: str = ""


def end_with_parent() -> None:
    """Let this process end when the other end of standard input is closed, as after any death of the parent.

    Its own death leaves no core file.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    with suppress(OSError):
        while os.read(0, 1):
            pass
    _kill()


def _kill() -> None:
    """Kill this process, and its group where it leads one."""
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)


def guard(memory_mb: int) -> None:
    """Limit the memory of this process (0: no limit), and let it end with its parent."""
    if memory_mb:
        limit = (ALLOCATED_PER_USED * memory_mb + ALLOCATED_BEYOND_MB) * 2**20
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    end_with_parent()


def serve() -> None:
    """Do pickled jobs from standard input and write their pickled results to standard output, until the input ends."""
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries may print
    messages: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_receive, args=(messages,), daemon=True).start()
    while True:
        message = messages.get()
        try:
            function, job = pickle.loads(message)
            result = function(job)
        except Exception as error:
            result = Lost(Loss.NOT_RUN, causes.one_line(error))
        pickle.dump(result, results)
        results.flush()


def _receive(messages: SimpleQueue[bytes]) -> None:
    """Queue the messages on standard input; a thread of its own also sees the end of the parent during a job."""
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            messages.put(pickle.load(sys.stdin.buffer))
    _kill()


def main() -> None:
    """Run the module or script of the command line."""
    garbage_collection.collect_rarely()
    if os.environ.get("PYTHONFAULTHANDLER"):  # which an isolated interpreter does not look at
        faulthandler.enable()
    guard(int(sys.argv[1]))
    sys.argv[:] = sys.argv[2:]
    with causes.exiting_by_cause():
        if sys.argv[0].endswith(".py"):
            runpy.run_path(sys.argv[0], run_name="__main__")
        else:
            runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
