"""What the commands of ``processor`` share: units, shared options, and output on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from processor.jobs.exit_codes import DONE, FAIL_ON, IN_PART, LIMIT_MISSED, VERDICT, is_refused
from processor.language.messages import printable
from processor.model import Status, UsageError

if TYPE_CHECKING:
    from processor.api.runs import Results

LANGUAGES = ("en", "zh")
UNITS = ("m", "mm", "cm", "inch", "ft")


fail_on_option = click.option(
    "--fail-on", type=click.Choice(tuple(FAIL_ON)), help="exit code 5 where a verdict is so, or worse"
)
debug_option = click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")


def print_error_line(line: str) -> None:
    """Write one line on standard error; control characters, as of a file's name, are replaced."""
    click.echo(printable(line), err=True)


def check_jobs(jobs: int | None, cluster: str | None) -> None:
    """Raise UsageError where both --jobs and --cluster are given."""
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs and --cluster exclude each other: a cluster has as many processes as it has workers")


def split_names(_: click.Context, __: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Split an option's names at the commas."""
    return tuple(name.strip() for name in value.split(",") if name.strip()) if value else ()


def show_results(
    context: click.Context, output: Path, results: Results, as_json: bool, fail_on: str | None = None
) -> None:
    """Print what was found, the headline first, and set the exit code."""
    from processor.report import all_tables, headline
    from processor.report import table as report_table
    from processor.results.names import REPORT_PAGE, RESULTS_JSON

    if as_json:
        click.echo((output / RESULTS_JSON).read_text("utf-8"), nl=False)
    else:
        click.echo(printable(headline.of_run(results.execution)) + "\n")
        for table in all_tables.tables_of_run(results.execution, results.report):
            if table.on_terminal:
                click.echo(report_table.plain_text(table) + "\n")
        click.echo(f"report: {output / REPORT_PAGE}")
    complete = all(result.status == Status.OK for result in results.steps.values())
    if not results.report.passed:
        context.exit(LIMIT_MISSED)
    context.exit(VERDICT if is_refused([results.verdict], fail_on) else DONE if complete else IN_PART)
