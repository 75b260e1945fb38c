"""What the commands of ``processor`` share: units, shared options, and output on the terminal."""

from __future__ import annotations

import logging
import shlex
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from processor.jobs.exit_codes import DONE, FAIL_ON, IN_PART, LIMIT_MISSED, VERDICT, is_refused
from processor.model import InputError, Status, UsageError
from processor.plain_text import printable

if TYPE_CHECKING:
    from processor.api.runs import Results

LANGUAGES = ("en", "zh")
UNITS = ("m", "mm", "cm", "dm", "km", "inch", "ft", "us-ft")


def _known_units(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    parts = (value or UNITS[0]).split("/")
    if len(parts) > 2 or not set(parts) <= set(UNITS):
        raise click.BadParameter(f"{value!r} is none of {', '.join(UNITS)}, or two of them as m/us-ft", ctx, param)
    return value


def units_option(about: str) -> Callable[[Any], Any]:
    """Return the option ``--units``: a unit of coordinates, or that of x and y, a slash and that of the heights."""
    return click.option("--units", metavar="U[/V]", callback=_known_units, help=f"{about}; V: unit of heights")


fail_on_option = click.option(
    "--fail-on", type=click.Choice(tuple(FAIL_ON)), help="exit code 5 where a verdict is so, or worse"
)
LOG = logging.getLogger("processor")
LOG_FORMAT, LOG_TIME = "%(asctime)sZ %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S"


def print_error_line(line: str, level: int = logging.INFO) -> None:
    """Write one line on standard error, and to the log file; control characters, as of a file's name, are replaced."""
    click.echo(printable(line), err=True)
    log_line(line, level)


def default_output(name: str, quiet: bool = False) -> Path:
    """Return a folder of the current one for results where -o names none, and print it."""
    if not quiet:
        print_error_line(f"results go to {name}, as -o names no folder")
    return Path(name)


def log_line(line: str, level: int = logging.INFO) -> None:
    """Write one line to the log file alone, if there is one."""
    LOG.log(level, "%s", printable(line))


class _OnTerminal(logging.Handler):
    """Writes the message of a record on standard error, as it is at that time."""

    def emit(self, record: logging.LogRecord) -> None:
        click.echo(printable(record.getMessage()), err=True)


def _log_to(_: click.Context, __: click.Parameter, path: Path | None) -> None:
    """Append to a log file from now on; InputError where it cannot be written."""
    for earlier in LOG.handlers[:]:
        LOG.removeHandler(earlier)
        earlier.close()
    LOG.propagate = False
    of_input = logging.getLogger("processor.input")
    if not any(isinstance(one, _OnTerminal) for one in of_input.handlers):
        of_input.addHandler(_OnTerminal())
    if path is None:
        LOG.addHandler(logging.NullHandler())
        return
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--log-file {path}: cannot be written ({error.strerror or error})") from error
    formatter = logging.Formatter(LOG_FORMAT, LOG_TIME)
    formatter.converter = time.gmtime
    handler.setFormatter(formatter)
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    LOG.info("%s", printable(shlex.join(sys.argv[1:])))


def debug_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --log-file and --debug, which every command has."""
    log_file = click.option(
        "--log-file",
        type=click.Path(path_type=Path, dir_okay=False),
        callback=_log_to,
        expose_value=False,
        help="append progress, errors and the exit code, with times (UTC) and levels",
    )
    debug = click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")
    return log_file(debug(command))


def cluster_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --cluster, whose workers compute the tiles of one scene."""
    return click.option(
        "--cluster", metavar="ADDRESS", help="Dask scheduler whose workers share the work, e.g. tcp://10.0.0.1:8786"
    )(command)


def check_jobs(jobs: int | None, cluster: str | None) -> None:
    """Raise UsageError where both --jobs and --cluster are given."""
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs and --cluster exclude each other: a cluster has as many processes as it has workers")


def split_names(_: click.Context, __: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Split an option's names at the commas."""
    return tuple(name.strip() for name in value.split(",") if name.strip()) if value else ()


def form_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add --pdf and --xlsx, further forms of the report."""
    for name, help_text in (("xlsx", "write report.xlsx, too (extra xlsx)"), ("pdf", "write report.pdf, too")):
        command = click.option(f"--{name}", is_flag=True, help=help_text)(command)
    return command


def forms(pdf: bool, xlsx: bool) -> tuple[str, ...]:
    """Return the further forms of the report that are wanted. Raises UsageError for one that cannot be written."""
    if xlsx:
        from processor.report import workbook

        workbook.check()
    return tuple(name for name, wanted in (("pdf", pdf), ("xlsx", xlsx)) if wanted)


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
    from processor.results.file_names import REPORT_PAGE, RESULTS_JSON

    page = str(output / REPORT_PAGE)
    log_line(headline.of_run(results.execution))
    if shown.as_json:
        click.echo((output / RESULTS_JSON).read_text("utf-8"), nl=False)
    elif shown.quiet:
        click.echo(printable(headline.of_run(results.execution)))
    else:
        write = terminal.verbose if shown.verbose else terminal.lines
        for line in write(results.execution, results.report, page):
            click.echo(line)
    for line in terminal.failures(results.execution):
        print_error_line(f"error: {line}", logging.ERROR)
    complete = all(result.status == Status.OK for result in results.steps.values())
    failed = any(result.status == Status.FAILED for result in results.steps.values())
    if failed:
        context.exit(IN_PART)
    if not results.report.passed:
        context.exit(LIMIT_MISSED)
    context.exit(VERDICT if is_refused([results.verdict], fail_on) else DONE if complete else IN_PART)
