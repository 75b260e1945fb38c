"""Entry point of ``designgen``: runs the command line and reports errors as one line and an exit code."""

from __future__ import annotations

import sys
import traceback

import click

from designgen.cli import commands
from processor.jobs import garbage_collection
from processor.model import InputError, UsageError
from processor.plain_text import printable

WRONG_USAGE, BAD_INPUT = 2, 3


def main() -> None:
    """Run the command line; exit with 0 when done, 2 on wrong usage, 3 on bad input or an error of the file system."""
    garbage_collection.collect_rarely()
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
        _trace()
        click.echo(printable(f"error: {error}"), err=True)
        sys.exit(WRONG_USAGE)
    except (InputError, OSError) as error:
        _trace()
        click.echo(printable(f"error: {error}"), err=True)
        sys.exit(BAD_INPUT)


def _trace() -> None:
    """Show where the current error arose, with --debug."""
    if "--debug" in sys.argv:
        traceback.print_exc()


if __name__ == "__main__":
    main()
