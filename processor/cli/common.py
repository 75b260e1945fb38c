"""What the commands of ``processor`` share: units, shared options, and output on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

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


def output_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --verbose, --quiet and --json, of which one at most is given."""
    for option in (
        click.option("--json", "as_json", is_flag=True, help="print results.json instead of lines"),
        click.option("-q", "--quiet", is_flag=True, help="print the headline alone, and no progress"),
        click.option("-v", "--verbose", is_flag=True, help="print the tables as well"),
    ):
        command = option(command)
    return command


@dataclass(frozen=True)
class Shown:
    """How much is printed, by --json, --verbose and --quiet."""

    as_json: bool = False
    verbose: bool = False
    quiet: bool = False

    def __post_init__(self) -> None:
        if self.as_json + self.verbose + self.quiet > 1:
            raise UsageError("--json, --verbose and --quiet exclude each other; give one of them")


def show_results(
    context: click.Context, output: Path, results: Results, shown: Shown, fail_on: str | None = None
) -> None:
    """Print what was found, the headline first, and set the exit code; why a step failed is for standard error."""
    from processor.report import headline, terminal
    from processor.results.names import REPORT_PAGE, RESULTS_JSON

    page = str(output / REPORT_PAGE)
    if shown.as_json:
        click.echo((output / RESULTS_JSON).read_text("utf-8"), nl=False)
    elif shown.quiet:
        click.echo(printable(headline.of_run(results.execution)))
    else:
        write = terminal.verbose if shown.verbose else terminal.lines
        for line in write(results.execution, results.report, page):
            click.echo(line)
    for line in terminal.failures(results.execution):
        print_error_line(f"error: {line}")
    complete = all(result.status == Status.OK for result in results.steps.values())
    failed = any(result.status == Status.FAILED for result in results.steps.values())
    if failed:
        context.exit(IN_PART)
    if not results.report.passed:
        context.exit(LIMIT_MISSED)
    context.exit(VERDICT if is_refused([results.verdict], fail_on) else DONE if complete else IN_PART)
