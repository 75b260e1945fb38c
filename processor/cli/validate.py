"""Command ``processor validate``: a matrix of simulated scenes, night by night."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click

from processor.cli.common import LANGUAGES, check_jobs, debug_option
from processor.jobs.exit_codes import DONE, GOT_WORSE, IN_PART, LIMIT_MISSED


@click.command()
@click.argument("matrix", metavar="[MATRIX.toml]", required=False, type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of all nights")
@click.option("--jobs", type=click.IntRange(min=1), help="cells at a time  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Dask scheduler whose workers do them, e.g. tcp://10.0.0.1:8786")
@click.option("--full", is_flag=True, help="the cells that are marked full as well")
@click.option("--smallest", is_flag=True, help="a matrix of two minutes, every step on the smallest scenes")
@click.option("--history", type=click.Path(path_type=Path, dir_okay=False), help="[default: history.sqlite in OUT]")
@click.option("--night", metavar="YYYY-MM-DD", help="whose seeds are used  [default: today, UTC]")
@click.option("--again", is_flag=True, help="do all of a night again that other software began")
@click.option("--accept", is_flag=True, help="do nothing but accept what got worse in the night as the new level")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the pages")
@click.option("--json", "as_json", is_flag=True, help="print summary.json instead of one line")
@debug_option
@click.pass_context
def validate(context: click.Context, /, matrix: Path | None, **options: Any) -> None:
    """Make, run and check a matrix of scenes, and report what changed since the nights before.

    Without MATRIX.toml the default one, which covers every step. Run again, it goes on where it was.
    Exit codes: 0 done, 1 some cells failed, 4 a limit was missed, 6 a figure got worse and all limits are kept.
    """
    from processor.validation import command
    from processor.validation import matrix as matrices

    chosen = SimpleNamespace(**options)
    check_jobs(chosen.jobs, chosen.cluster)
    if chosen.smallest and (matrix is not None or chosen.full):
        raise click.UsageError("--smallest is a matrix of its own: leave out MATRIX.toml and --full")
    if chosen.accept:
        click.echo(command.accept(chosen.output, chosen.history, chosen.night))
        return
    summary = command.run(
        matrices.SMALLEST if chosen.smallest else matrix,
        chosen.output,
        chosen.jobs or 1,
        chosen.cluster,
        full=chosen.full,
        history=chosen.history,
        night=chosen.night,
        again=chosen.again,
        lang=chosen.lang,
    )
    click.echo(json.dumps(summary.as_object(), ensure_ascii=False) if chosen.as_json else str(summary.line))
    context.exit(
        LIMIT_MISSED
        if not summary.keeps_limits
        else GOT_WORSE
        if not summary.passed
        else IN_PART
        if summary.failed
        else DONE
    )
