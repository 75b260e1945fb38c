"""Command ``processor run``: one input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from processor.cli.common import (
    LANGUAGES,
    Shown,
    cluster_option,
    debug_option,
    default_output,
    fail_on_option,
    form_options,
    forms,
    log_line,
    output_options,
    print_error_line,
    show_results,
    split_names,
    units_option,
)
from processor.cli.help_text import RunCommand
from processor.cli.limited_run import limited_run
from processor.model import UsageError
from processor.results.file_names import RESULTS_JSON


@click.command(cls=RunCommand)
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="folder of results  [default: INPUT-results, created here]"
)
@click.option("--steps", callback=split_names, metavar="A,B", help="instead of those of the input's kind")
@click.option(
    "--method", "methods", callback=split_names, metavar="NAME[,NAME]", help="further ones are run for comparison"
)
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False), help="TOML file, one table per step")
@units_option("unit of the scans, whatever the file states")
@click.option("--seed", type=click.IntRange(min=0), help="seed of all randomness  [default: 0, or the parameters']")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the page")
@click.option("--timeout-s", type=click.FloatRange(min=0, min_open=True), help="end the run after so long")
@click.option("--memory-mb", type=click.IntRange(min=64), help="end the run if it takes more")
@cluster_option
@click.option("--keep-steps", is_flag=True, help="clouds of the stages of the papers' methods as PLY in OUT/steps")
@click.option("--so-far", type=click.Path(path_type=Path), hidden=True)
@click.option("--methods-from", type=click.Path(path_type=Path), hidden=True, help="where a method's module lies")
@form_options
@fail_on_option
@output_options
@debug_option
@click.pass_context
def run(context: click.Context, /, input_: Path, output: Path | None, fail_on: str | None, **options: Any) -> None:
    """Process INPUT: a scan folder, a scene file (.h5) or one scan file.

    A run that a limit ends leaves OUT as it was, and the steps that were done in OUT.part; it exits with 3.
    """
    from processor import user_methods
    from processor.scan_folder.files import missing

    shown = Shown(options["as_json"], options["verbose"], options["quiet"])
    if not input_.exists():
        raise missing(input_)
    further = forms(options["pdf"], options["xlsx"])
    output = output or default_output(_default_name(input_), shown.quiet)
    user_methods.folder = options.pop("methods_from")
    limits = options.pop("timeout_s"), options.pop("memory_mb")
    if any(limit is not None for limit in limits):
        context.exit(limited_run(input_, output, *limits, _arguments({**options, "fail_on": fail_on})))
    from processor import diagnostics, progress
    from processor.api import runs  # in two seconds, which the process that waits for a limited run spares

    with diagnostics.with_clouds(options["keep_steps"]), progress.in_lines(not shown.quiet):
        results = runs.compute(
            input_,
            output,
            options["steps"],
            options["methods"],
            options["params"],
            options["units"],
            options["seed"],
            log=log_line if shown.quiet else print_error_line,
            so_far=options["so_far"],
            cluster=options["cluster"],
        )
    runs.write(results, output, options["lang"], further)
    show_results(context, output, results, shown, fail_on)


def _default_name(input_: Path) -> str:
    """Return the name of the folder of results of an input.

    Raises UsageError where it holds results of an input of another name.
    """
    name = input_.resolve().name
    output = f"{Path(name).stem if input_.is_file() else name}-results"
    try:
        made_of = str(json.loads(Path(output, RESULTS_JSON).read_text("utf-8")).get("input", name))
    except (OSError, ValueError, AttributeError):
        return output
    if made_of != name:
        raise UsageError(f"{output}: holds results of {made_of!r}, not of {name!r}; name a folder with -o")
    return output


def _arguments(options: dict[str, Any]) -> list[str]:
    """Return options as they are given on a command line."""
    arguments = []
    for name, value in options.items():
        option = {"methods": "--method", "as_json": "--json"}.get(name, f"--{name.replace('_', '-')}")
        if value is True:
            arguments.append(option)
        elif value not in (None, False, ()):
            text = str(value.absolute() if isinstance(value, Path) else value)
            arguments += [option, ",".join(value) if isinstance(value, tuple) else text]
    return arguments
