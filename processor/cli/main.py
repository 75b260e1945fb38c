"""The program ``processor``: its commands. Heavy modules are imported where they are used, so that help is fast."""

from __future__ import annotations

import click

from processor.cli import (
    batch,
    check,
    compare,
    convert,
    export,
    field_check,
    history,
    init,
    papers,
    report,
    run,
    validate,
    verify,
)
from processor.cli.help_text import Suggesting
from processor.version import __version__


@click.group(cls=Suggesting, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="processor")
def commands() -> None:
    """Check steel structures from laser scans.

    Exit codes: 0 done, 1 done in part, 2 wrong usage, 3 bad input, 4 an accuracy limit was missed, 5 a verdict that
    --fail-on names.
    """


for module in (
    run,
    batch,
    check,
    compare,
    convert,
    export,
    field_check,
    history,
    init,
    report,
    validate,
    papers,
    verify,
):
    commands.add_command(getattr(module, module.__name__.rpartition(".")[2]))
