"""Command line of ``processor``. What is heavy is imported where it is used, so that help comes at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from processor.cli import batch, compare, init, validate
from processor.cli.common import DONE, IN_PART, LANGUAGES, LIMIT_MISSED, UNITS, named, say
from processor.model import InputError, Metric, Statistic, Status
from processor.version import __version__

if TYPE_CHECKING:
    from processor.api.runs import Results


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="processor")
def commands() -> None:
    """Check steel structures from laser scans.

    Exit codes: 0 done, 1 done in part, 2 wrong usage, 3 bad input, 4 an accuracy limit was missed.
    """


commands.add_command(batch.batch)
commands.add_command(init.init)
commands.add_command(compare.compare)
commands.add_command(validate.validate)


@commands.command()
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of the results")
@click.option("--steps", callback=named, metavar="A,B", help="instead of those of the input's kind")
@click.option("--method", "methods", callback=named, metavar="NAME[,NAME]", help="further ones are run for comparison")
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False), help="TOML file, a table a step")
@click.option("--units", type=click.Choice(UNITS), help="of the scans' coordinates, whatever the format says")
@click.option("--seed", type=click.IntRange(min=0), help="of all randomness  [default: 0, or the parameters']")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="of the page")
@click.option("--json", "as_json", is_flag=True, help="print results.json instead of tables")
@click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")
@click.pass_context
def run(
    context: click.Context,
    input_: Path,
    output: Path,
    steps: tuple[str, ...],
    methods: tuple[str, ...],
    params: Path | None,
    units: str | None,
    seed: int | None,
    lang: str,
    as_json: bool,
) -> None:
    """Process INPUT: a scan folder, a scene file (.h5) or one scan file."""
    from processor.api import runs

    results = runs.run(input_, output, steps, methods, params, units, seed, lang=lang, log=say)
    _show(context, output, results, as_json)


def _show(context: click.Context, output: Path, results: Results, as_json: bool) -> None:
    """Print what was found and set the exit code."""
    from processor.report import all_tables, results_folder
    from processor.report import table as report_table

    if as_json:
        click.echo((output / results_folder.RESULTS).read_text("utf-8"), nl=False)
    else:
        for table in all_tables.all_of(results.execution, results.report):
            if table.on_terminal:
                click.echo(report_table.plain_text(table) + "\n")
        click.echo(f"report: {output / 'report.html'}")
    complete = all(result.status == Status.OK for result in results.steps.values())
    context.exit(LIMIT_MISSED if not results.report.passed else DONE if complete else IN_PART)


@commands.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("input_", metavar="[INPUT]", required=False, type=click.Path(path_type=Path))
@click.option("--units", type=click.Choice(UNITS), help="as given to the run")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="of the page")
@click.option("--json", "as_json", is_flag=True, help="print results.json instead of tables")
@click.pass_context
def report(
    context: click.Context, output: Path, input_: Path | None, units: str | None, lang: str, as_json: bool
) -> None:
    """Check and report again what is in OUT, without running its steps on INPUT anew.

    Without INPUT the file of its name beside OUT is taken, or in the current folder, if its content is the same.
    """
    from processor import pipeline
    from processor.api import runs
    from processor.evaluation.evaluate import evaluate
    from processor.report import results_folder

    results_folder.check_output(output, input_)
    input_ = input_ or pipeline.find_input(output / results_folder.RUNS)
    execution = pipeline.read_execution(output / results_folder.RUNS, input_, units)
    results = runs.write(runs.Results(execution, evaluate(input_, execution)), output, lang)
    _show(context, output, results, as_json)


@commands.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="print one JSON object instead of a table")
@click.pass_context
def check(context: click.Context, output: Path, as_json: bool) -> None:
    """Print the checks of the run in OUT again; exits 4 when a limit was missed."""
    from processor.evaluation.evaluate import ErrorReport
    from processor.report import all_tables
    from processor.report import table as report_table

    found = _read_results(output)
    metrics = tuple(
        Metric(
            c["step"],
            c["quantity"],
            _number(c["value"]),
            Statistic(c["statistic"]),
            unit=c["unit"],
            limit=_number(c["limit"]),
            method=c["method"],
        )
        for c in found["checks"]
    )
    report = ErrorReport(metrics)
    if as_json:
        click.echo(json.dumps({"passed": report.passed, "checks": found["checks"]}, ensure_ascii=False))
    elif metrics:
        click.echo(report_table.plain_text(all_tables.of_checks(report), most=len(metrics)))
    else:
        click.echo("no checks: the input held no truth")
    context.exit(DONE if report.passed else LIMIT_MISSED)


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _read_results(output: Path) -> dict[str, Any]:
    path = output / "results.json"
    try:
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: no readable results ({error}); run processor run again") from error
    if found.get("format") != "processor-results" or not isinstance(found.get("checks"), list):
        raise InputError(f"{path}: expected results of processor, found something else")
    return found
