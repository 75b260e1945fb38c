"""Command ``processor batch``: many inputs below one folder."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import click

from processor.cli.common import (
    LANGUAGES,
    check_jobs,
    debug_option,
    fail_on_option,
    print_error_line,
    split_names,
    units_option,
)
from processor.jobs.exit_codes import DONE, IN_PART, LIMIT_MISSED, VERDICT, is_refused

if TYPE_CHECKING:
    from processor.batch.batch import Settings
    from processor.batch.record import Record


@click.command()
@click.argument("root", metavar="ROOT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of all results")
@click.option("--jobs", type=click.IntRange(min=1), help="inputs processed at a time  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Dask scheduler whose workers do it, e.g. tcp://10.0.0.1:8786")
@click.option(
    "--timeout-s",
    type=click.FloatRange(min=0, min_open=True),
    default=3600.0,
    show_default=True,
    help="limit of each input",
)
@click.option(
    "--memory-mb", type=click.IntRange(min=64), help="limit of each job  [default: its share of 80 % of the machine]"
)
@click.option("--retry", is_flag=True, help="try again what failed, though nothing has changed")
@click.option("--steps", callback=split_names, metavar="A,B", help="steps, as in `processor run`")
@click.option("--method", "methods", callback=split_names, metavar="NAME[,NAME]", help="as in `processor run`")
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False), help="a TOML file of parameters")
@units_option("unit of the scans; scene files contain theirs")
@click.option("--seed", type=click.IntRange(min=0), help="seed of all randomness")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of all pages")
@fail_on_option
@click.option("--json", "as_json", is_flag=True, help="print a JSON line for each input, then one for all")
@debug_option
@click.pass_context
def batch(context: click.Context, /, root: Path, **options: Any) -> None:
    """Process every scan folder, scene file and scan file below ROOT, each in a process of its own.

    Run again, it goes on where it was: what is done is kept while input, parameters and software are the same. Writes
    a folder of results for each input, index.html, summary.csv and summary.json. Exit codes: 1 where an input failed
    (it is listed), 4 where none did and an accuracy limit was missed, 5 where a verdict is as --fail-on names.
    """
    from processor.batch import batch as batch_run
    from processor.jobs.runner import StoppedError

    chosen = SimpleNamespace(**options)
    try:
        summary = batch_run.run(
            _settings(root, chosen), print_error_line, lambda record: _report_input(record, chosen.as_json)
        )
    except StoppedError:
        context.exit(IN_PART)
    counts = {name: count for name, count in summary.counts.items() if count}
    if chosen.as_json:
        click.echo(json.dumps({"event": "summary", "counts": summary.counts, "page": str(summary.page)}))
    else:
        click.echo(f"{summary.page}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
    if summary.failed:
        context.exit(IN_PART)
    if "limit-missed" in counts:
        context.exit(LIMIT_MISSED)
    refused = is_refused(summary.verdicts, chosen.fail_on)
    context.exit(VERDICT if refused else IN_PART if "in-part" in counts else DONE)


def _settings(root: Path, options: SimpleNamespace) -> Settings:
    """Check the options and turn them into the settings of a batch."""
    from processor import pipeline
    from processor.batch import batch as batch_run

    check_jobs(options.jobs, options.cluster)
    parameters = pipeline.read_params(options.params)
    if options.steps or options.methods or parameters:  # wrong names are reported once, not by every input
        pipeline.plan(options.steps or tuple(pipeline.step_modules()), options.methods, parameters, options.seed)
    seed = "" if options.seed is None else str(options.seed)
    arguments = {"--steps": ",".join(options.steps), "--method": ",".join(options.methods), "--seed": seed}
    arguments["--lang"] = options.lang
    return batch_run.Settings(
        root=root,
        out=options.output,
        run_options=tuple(text for name, value in arguments.items() if value for text in (name, value)),
        params_toml=options.params.read_bytes() if options.params else b"",
        identity_parameters={
            "steps": options.steps,
            "methods": options.methods,
            "seed": options.seed,
            "lang": options.lang,
            "params": json.loads(json.dumps(parameters, default=str)),
        },
        units=options.units,
        at_a_time=options.jobs or 1,
        cluster=options.cluster,
        timeout_s=options.timeout_s,
        memory_mb=options.memory_mb,
        retry=options.retry,
        lang=options.lang,
    )


def _report_input(record: Record, as_json: bool) -> None:
    from processor.batch.record import as_object
    from processor.language.messages import messages

    if as_json:
        click.echo(json.dumps({"event": "input", **as_object(record)}))
    elif record.reason is not None:
        print_error_line(f"{record.input}: failed: {messages('en').text(record.reason)}", logging.WARNING)
