"""What the programs of the command line share: a signal stops them as Ctrl-C does, an error is one line and a code."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

import click

from processor.jobs import address_space, garbage_collection
from processor.jobs.causes import Cause, cause_of, one_line
from processor.jobs.exit_codes import BAD_INPUT, WRONG_USAGE
from processor.model import InputError, UsageError

SIGNALLED = 128  # and the signal's number, as a shell reports it
STOPPING = (signal.SIGTERM, signal.SIGHUP)

LIBRARY_BYTES = 1 << 28  # more than the largest library, LLVM, takes: one that cannot be loaded raises what it likes


def run(commands: click.Command, print_line: Callable[[str], None]) -> NoReturn:
    """Run the command line and exit: 0 done, 2 wrong usage, 3 bad input or an error of the system.

    ``print_line`` writes a line on standard error. A command exits with a code of its own through its context.
    """
    garbage_collection.collect_rarely()
    with _stopped_as_by_keyboard() as received:
        try:
            sys.exit(commands(standalone_mode=False))
        except click.exceptions.Exit as end:
            sys.exit(end.exit_code)
        except (click.exceptions.Abort, KeyboardInterrupt):
            number = received[0] if received else signal.SIGINT
            print_line(f"stopped by {signal.Signals(number).name}")
            sys.exit(SIGNALLED + number)
        except click.ClickException as error:
            error.show()
            sys.exit(WRONG_USAGE)
        except BrokenPipeError:
            # Whoever read the output has seen enough. Python would complain once more when it flushes at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(SIGNALLED + signal.SIGPIPE)
        except Exception as error:
            if "--debug" in sys.argv:
                traceback.print_exc()
            print_line(f"error: {_line(error)}")
            sys.exit(WRONG_USAGE if isinstance(error, UsageError) else BAD_INPUT)


def _line(error: Exception) -> str:
    if isinstance(error, UsageError | InputError):
        return str(error)
    if cause_of(error) is Cause.MEMORY or address_space.room() < LIBRARY_BYTES:
        why = f" ({one_line(error)})"
        return f"not enough memory{why}; free some, or raise the limit of this process (ulimit -v)"
    return str(error) if isinstance(error, OSError) else f"internal error: {error!r}; --debug shows where"


@contextmanager
def _stopped_as_by_keyboard() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt where a signal comes that would end the process at once, and yield those that came.

    What is being written is then removed as after Ctrl-C. A signal that is ignored, as by nohup, stays ignored.
    """
    received: list[int] = []

    def interrupt(number: int, _: FrameType | None) -> None:
        received.append(number)
        raise KeyboardInterrupt

    handled = []
    if threading.current_thread() is threading.main_thread():
        handled = [number for number in STOPPING if signal.getsignal(number) is signal.SIG_DFL]
    for number in handled:
        signal.signal(number, interrupt)
    try:
        yield received
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)
