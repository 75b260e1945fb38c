"""What the commands of ``processor`` share: exit codes, units to choose from, and how a line is said."""

from __future__ import annotations

import click

DONE, IN_PART, LIMIT_MISSED = 0, 1, 4
LANGUAGES = ("en", "zh")
UNITS = ("m", "mm", "cm", "inch", "ft")


def say(line: str) -> None:
    """Write one line on standard error, whatever control characters a name in it holds."""
    click.echo("".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in line), err=True)


def named(_: click.Context, __: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Split an option's names at the commas."""
    return tuple(name.strip() for name in value.split(",") if name.strip()) if value else ()
