"""Command ``processor papers``: the tables and figures of the source papers."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import click

from processor.cli.common import LANGUAGES, debug_option, split_names
from processor.jobs.exit_codes import DONE, IN_PART
from processor.model import UsageError


@click.command()
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of papers.json and page")
@click.option("--only", callback=split_names, metavar="000,001", help="the papers of these numbers  [default: all]")
@click.option("--seeds", type=click.IntRange(min=1), default=5, show_default=True, help="seeds of every data set")
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="data sets at a time")
@click.option("--keep-steps", is_flag=True, help="keep clouds and numbers of the methods' stages, in OUT/steps")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the page")
@click.option("--json", "as_json", is_flag=True, help="print papers.json instead of one line")
@debug_option
@click.pass_context
def papers(
    context: click.Context,
    /,
    output: Path,
    only: tuple[str, ...],
    seeds: int,
    jobs: int,
    keep_steps: bool,
    lang: str,
    as_json: bool,
) -> None:
    """Repeat the tables and figures of the source papers by their methods, beside ours.

    The data sets are simulated by designgen, which must be installed; what measures them is part of the source and not
    of an installed package. Exit codes: 0 done, 1 some data sets failed.
    """
    from processor.jobs.process import PROJECT

    if not (PROJECT / "tests/bench/papers").is_dir():
        raise UsageError(
            "processor papers: the comparison with the papers is part of the source; in a checkout of it: "
            "pip install --editable '.[designgen]'"
        )
    sys.path.insert(0, str(PROJECT))
    command = importlib.import_module("tests.bench.papers.command")
    found = command.run(output, only, seeds, jobs, lang, keep_steps)
    click.echo(json.dumps(found.content, ensure_ascii=False) if as_json else str(found.line))
    context.exit(IN_PART if found.failed else DONE)
