"""Entry point of ``designgen``: runs the command line and reports errors as one line and an exit code."""

from __future__ import annotations

import click

from designgen.cli import commands
from processor.jobs import program
from processor.plain_text import printable


def main() -> None:
    """Run the command line; exit with 0 when done, 2 on wrong usage, 3 on bad input or an error of the system."""
    program.run(commands, lambda line: click.echo(printable(line), err=True))


if __name__ == "__main__":
    main()
