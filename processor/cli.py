"""Command line of ``processor``. What is heavy is imported where it is used, so that help comes at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from processor import __version__
from processor.model import InputError, Metric

if TYPE_CHECKING:
    from processor.evaluate import ErrorReport
    from processor.pipeline import Execution

DONE, IN_PART, LIMIT_MISSED = 0, 1, 4
UNITS = ("m", "mm", "cm", "inch", "ft")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="processor")
def commands() -> None:
    """Check steel structures from laser scans.

    Exit codes: 0 done, 1 done in part, 2 wrong usage, 3 bad input, 4 an accuracy limit was missed.
    """


def say(line: str) -> None:
    """Write one line on standard error, whatever control characters a name in it holds."""
    click.echo("".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in line), err=True)


def _named(_: click.Context, __: click.Parameter, value: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in value.split(",") if name.strip()) if value else ()


@commands.command()
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of the results")
@click.option("--steps", callback=_named, metavar="A,B", help="instead of those of the input's kind")
@click.option("--method", "methods", callback=_named, metavar="NAME[,NAME]", help="further ones are run for comparison")
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False), help="TOML file, a table a step")
@click.option("--units", type=click.Choice(UNITS), help="of the scans' coordinates, whatever the format says")
@click.option("--seed", type=click.IntRange(min=0), help="of all randomness  [default: 0, or the parameters']")
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
    as_json: bool,
) -> None:
    """Process INPUT: a scan folder, a scene file (.h5) or one scan file."""
    from processor import pipeline
    from processor.evaluate import evaluate
    from processor.report import writing

    if not input_.exists():
        raise InputError(f"{input_}: there is no such file or folder")
    writing.check_output(output, input_)
    parameters = pipeline.read_params(params)
    if steps:
        pipeline.plan(steps, methods, parameters, seed)  # what is wrong with the names is said before long reading
    piecewise = pipeline.is_large(input_)
    scene = pipeline.read(input_, units, piecewise)
    jobs = pipeline.plan(steps or pipeline.steps_for(scene), methods, parameters, seed)
    if piecewise and not pipeline.streams(jobs):
        piecewise = False
        scene = pipeline.read(input_, units)
    say(f"{input_.name}: read as {scene.units} ({scene.units_reason})")
    execution = pipeline.execute(input_, scene, jobs, say, piecewise)
    report = evaluate(input_, execution)
    writing.write(output, execution, report)
    _show(context, output, execution, report, as_json)


def _show(context: click.Context, output: Path, execution: Execution, report: ErrorReport, as_json: bool) -> None:
    """Print what was found and set the exit code."""
    from processor.report import printing, tables, writing

    if as_json:
        click.echo((output / writing.RESULTS).read_text("utf-8"), nl=False)
    else:
        for table in tables.all_of(execution, report):
            if table.on_terminal:
                click.echo(printing.plain_text(table) + "\n")
        click.echo(f"report: {output / 'report.html'}")
    complete = all(one.result.status == "ok" for one, _ in tables.grouped(execution.runs))
    context.exit(LIMIT_MISSED if not report.passed else DONE if complete else IN_PART)


LENGTH = click.FloatRange(min=0.0, min_open=True)
FILE = click.Path(path_type=Path)


@commands.command()
@click.argument("reference", type=FILE)
@click.argument("compared", type=FILE)
@click.option("-o", "--output", required=True, type=FILE, help="folder of the results")
@click.option("--core", type=FILE, help="cloud of core points  [default: every point of REFERENCE]")
@click.option("--normal-diameter", type=LENGTH, help="of the sphere that a normal is fitted in")
@click.option("--projection-diameter", type=LENGTH, help="of the cylinder along the normal")
@click.option("--max-depth", type=LENGTH, help="of the cylinder, to either side of the core point")
@click.option("--registration-error", type=click.FloatRange(min=0.0), default=0.0, help="a length, part of the LOD95")
@click.option("--normals", type=FILE, help="nx, ny, nz of every core point, PLY or text, instead of fitted ones")
@click.option("--json", "as_json", is_flag=True, help="print compare.json")
@click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")
def compare(
    reference: Path,
    compared: Path,
    output: Path,
    core: Path | None,
    normal_diameter: float | None,
    projection_diameter: float | None,
    max_depth: float | None,
    registration_error: float,
    normals: Path | None,
    as_json: bool,
) -> None:
    """Distances from cloud REFERENCE to cloud COMPARED along normals, with levels of detection (M3C2).

    All lengths are in the clouds' own unit; what is not given is made from their density.
    """
    from processor import compare as comparing
    from processor.report import comparison

    comparison.check_output(output, (reference, compared, core, normals))
    request = comparing.Request(
        reference, compared, core, normals, normal_diameter or 0.0, projection_diameter or 0.0, max_depth or 0.0,
        registration_error,
    )  # fmt: skip
    record = comparison.write(output, comparing.compare(request, say))
    if as_json:
        click.echo(json.dumps(record, ensure_ascii=False))
        return
    for line in comparison.lines(record):
        click.echo(line)
    click.echo(f"report: {output / comparison.PAGE}")


@commands.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option("--units", type=click.Choice(UNITS), help="as given to the run")
@click.option("--json", "as_json", is_flag=True, help="print results.json instead of tables")
@click.pass_context
def report(context: click.Context, output: Path, input_: Path, units: str | None, as_json: bool) -> None:
    """Check and report again what is in OUT, without running its steps on INPUT anew."""
    from processor import pipeline
    from processor.evaluate import evaluate
    from processor.report import writing

    writing.check_output(output, input_)
    execution = pipeline.read_execution(output / writing.RUNS, input_, units)
    found = evaluate(input_, execution)
    writing.write(output, execution, found)
    _show(context, output, execution, found, as_json)


@commands.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="print one JSON object instead of a table")
@click.pass_context
def check(context: click.Context, output: Path, as_json: bool) -> None:
    """Print the checks of the run in OUT again; exits 4 when a limit was missed."""
    from processor.evaluate import ErrorReport
    from processor.report import printing, tables

    found = _read_results(output)
    metrics = tuple(
        Metric(c["step"], c["name"], _number(c["value"]), _number(c["limit"]), c["unit"]) for c in found["checks"]
    )
    report = ErrorReport(metrics)
    if as_json:
        click.echo(json.dumps({"passed": report.passed, "checks": found["checks"]}, ensure_ascii=False))
    elif metrics:
        click.echo(printing.plain_text(tables.of_checks(report), most=len(metrics)))
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
