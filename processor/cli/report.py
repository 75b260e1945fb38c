"""Command ``processor report``: the report of earlier results, made again."""

from __future__ import annotations

from pathlib import Path

import click

from processor.cli.common import (
    LANGUAGES,
    Shown,
    debug_option,
    form_options,
    forms,
    output_options,
    show_results,
    units_option,
)


@click.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("input_", metavar="[INPUT]", required=False, type=click.Path(path_type=Path))
@units_option("unit of the scans, as given to the run")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the page")
@form_options
@output_options
@debug_option
@click.pass_context
def report(
    context: click.Context, /, output: Path, input_: Path | None, units: str | None, lang: str, **options: bool
) -> None:
    """Check and report again what is in OUT, without running its steps on INPUT anew.

    Without INPUT the file of its name beside OUT is taken, or in the current folder, if its content is the same.
    """
    from processor import pipeline
    from processor.api import runs
    from processor.evaluation.evaluate import evaluate
    from processor.report import write_results
    from processor.results.file_names import RESULTS_H5

    further = forms(options.pop("pdf"), options.pop("xlsx"))
    write_results.check_output(output, input_, RESULTS_H5)
    input_ = input_ or pipeline.find_input(output / RESULTS_H5)
    execution = pipeline.read_execution(output / RESULTS_H5, input_, units)
    results = runs.write(runs.Results(execution, evaluate(input_, execution)), output, lang, further)
    show_results(context, output, results, Shown(**options))
