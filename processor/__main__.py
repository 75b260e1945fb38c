"""Entry point of ``processor``: runs the command line and turns errors into one line and an exit code."""

from __future__ import annotations

import logging
import os
import sys
import traceback

import click

from processor.cli.common import log_line, print_error_line
from processor.cli.main import commands
from processor.jobs import garbage_collection
from processor.model import InputError, UsageError

WRONG_USAGE, BAD_INPUT = 2, 3
OUTPUT_CUT = 141  # as a shell reports SIGPIPE


def main() -> None:
    """Run the command line; the exit codes are those of processor --help."""
    garbage_collection.collect_rarely()
    try:
        _main()
    except SystemExit as end:
        log_line(f"exit code {end.code or 0}")
        raise


def _main() -> None:
    try:
        sys.exit(commands(standalone_mode=False))
    except click.exceptions.Exit as end:
        sys.exit(end.exit_code)
    except click.exceptions.Abort:
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(WRONG_USAGE)
    except UsageError as error:
        print_error_line(f"error: {error}", logging.ERROR)
        sys.exit(WRONG_USAGE)
    except BrokenPipeError:
        # Whoever read the output has seen enough. Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(OUTPUT_CUT)
    except Exception as error:
        if "--debug" in sys.argv:
            traceback.print_exc()
        foreseen = isinstance(error, (InputError, OSError))
        line = f"error: {error}" if foreseen else f"error: internal error: {error!r}; --debug shows where"
        print_error_line(line, logging.ERROR)
        sys.exit(BAD_INPUT)


if __name__ == "__main__":
    main()
