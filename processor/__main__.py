"""Entry point of ``processor``: runs the command line and turns errors into one line and an exit code."""

from __future__ import annotations

import logging

from processor.cli.common import log_line, print_error_line
from processor.cli.main import commands
from processor.jobs import program


def main() -> None:
    """Run the command line; the exit codes are those of processor --help."""
    try:
        program.run(commands, lambda line: print_error_line(line, logging.ERROR))
    except SystemExit as end:
        log_line(f"exit code {end.code or 0}")
        raise


if __name__ == "__main__":
    main()
