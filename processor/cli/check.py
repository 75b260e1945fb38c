"""Command ``processor check``: the checks of earlier results, printed again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from processor.cli.common import debug_option
from processor.jobs.exit_codes import DONE, LIMIT_MISSED
from processor.model import InputError, Metric, Statistic
from processor.results.file_names import FORMAT, RESULTS_JSON


@click.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="print one JSON object instead of a table")
@debug_option
@click.pass_context
def check(context: click.Context, output: Path, as_json: bool) -> None:
    """Print the checks of the run in OUT again; exits 4 when a limit was missed."""
    from processor.evaluation.evaluate import ErrorReport
    from processor.report import all_tables
    from processor.report import table as report_table

    results = _read_results(output)
    try:
        metrics = tuple(
            Metric(
                str(c["quantity"]),
                _number(c["value"]),
                Statistic(c["statistic"]),
                unit=str(c["unit"]),
                limit=_number(c["limit"]),
                step=str(c["step"]),
                method=str(c["method"]),
            )
            for c in results["checks"]
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{output / RESULTS_JSON}: a row of checks cannot be read ({error!r}); run processor run again"
        ) from error
    report = ErrorReport(metrics)
    if as_json:
        click.echo(json.dumps({"passed": report.passed, "checks": results["checks"]}, ensure_ascii=False))
    elif metrics:
        click.echo(report_table.plain_text(all_tables.checks_table(report), most=len(metrics)))
    else:
        click.echo("no checks: the input held no truth")
    context.exit(DONE if report.passed else LIMIT_MISSED)


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _read_results(output: Path) -> dict[str, Any]:
    path = output / RESULTS_JSON
    try:
        results: dict[str, Any] = json.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: no readable results ({error}); run processor run again") from error
    if not isinstance(results, dict) or results.get("format") != FORMAT or not isinstance(results.get("checks"), list):
        raise InputError(f"{path}: expected results of processor, found something else")
    return results
