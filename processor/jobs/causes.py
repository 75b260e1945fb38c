"""What ends a process, as data: a child process passes the cause to its parent as an exit code."""

from __future__ import annotations

import errno
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum


class Cause(Enum):
    """What ended a process."""

    EXIT = "exit"
    SIGNAL = "signal"
    TIME = "time"
    MEMORY = "memory"
    OUTPUT = "output"  # nothing more can be written, whatever the input
    STOPPED = "stopped"


# Exit codes of guarded processes; no program of this project ends with one of these otherwise.
EXIT_CODES = {Cause.MEMORY: 86, Cause.OUTPUT: 87}
UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def cause_of(error: BaseException | None) -> Cause | None:
    """Return the cause by the type of an exception, or of one that led to it; None for any other.

    An exception raised ``from None`` stands for itself. An InputError that a lack of memory led to states a fault of
    the input: a damaged file may declare any size.
    """
    of_input = False
    while error is not None:
        # Where the module of InputError is not loaded there is none, and none is loaded here
        model = sys.modules.get("processor.model")
        of_input = of_input or (model is not None and isinstance(error, model.InputError))
        lacks = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        if lacks and not of_input:
            return Cause.MEMORY
        if isinstance(error, OSError) and error.errno in UNWRITABLE:
            return Cause.OUTPUT
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None


def one_line(error: BaseException) -> str:
    """Return type and message of an exception on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def signal_name(number: int) -> str:
    """Return the name of a signal, as SIGSEGV; of one without a name "signal 40"."""
    return signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"


@contextmanager
def exiting_by_cause() -> Iterator[None]:
    """End this process with the exit code of its cause, where an exception ends it or made it exit with an error."""
    try:
        yield
    except (Exception, SystemExit) as error:
        cause = None if isinstance(error, SystemExit) and not error.code else cause_of(error)
        if cause is None:
            raise
        if not isinstance(error, SystemExit):
            traceback.print_exc()
        raise SystemExit(EXIT_CODES[cause]) from error
