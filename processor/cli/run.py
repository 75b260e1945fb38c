"""Command ``processor run``: one input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from processor.cli.common import (
    LANGUAGES,
    UNITS,
    debug_option,
    fail_on_option,
    print_error_line,
    show_results,
    split_names,
)


@click.command()
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of the results")
@click.option("--steps", callback=split_names, metavar="A,B", help="instead of those of the input's kind")
@click.option(
    "--method", "methods", callback=split_names, metavar="NAME[,NAME]", help="further ones are run for comparison"
)
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False), help="TOML file, a table a step")
@click.option("--units", type=click.Choice(UNITS), help="of the scans' coordinates, whatever the format says")
@click.option("--seed", type=click.IntRange(min=0), help="of all randomness  [default: 0, or the parameters']")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="of the page")
@fail_on_option
@click.option("--json", "as_json", is_flag=True, help="print results.json instead of tables")
@debug_option
@click.pass_context
def run(
    context: click.Context, /, input_: Path, output: Path, fail_on: str | None, as_json: bool, **options: Any
) -> None:
    """Process INPUT: a scan folder, a scene file (.h5) or one scan file."""
    from processor.api import runs

    results = runs.run(
        input_,
        output,
        options["steps"],
        options["methods"],
        options["params"],
        options["units"],
        options["seed"],
        lang=options["lang"],
        log=print_error_line,
    )
    show_results(context, output, results, as_json, fail_on)
