"""Commands of ``processor`` about folders: many of them as a batch, and a first project.toml for one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from processor.cli.common import DONE, IN_PART, LANGUAGES, LIMIT_MISSED, UNITS, named, say
from processor.model import UsageError

if TYPE_CHECKING:
    from processor.batch.record import Record


@click.command()
@click.argument("root", metavar="ROOT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="folder of all results")
@click.option("--jobs", type=click.IntRange(min=1), help="inputs processed at a time  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Dask scheduler whose workers do it, e.g. tcp://10.0.0.1:8786")
@click.option("--timeout-s", type=click.FloatRange(min=0, min_open=True), default=3600.0, show_default=True)
@click.option("--memory-mb", type=click.IntRange(min=64), help="of a job  [default: its share of 80 % of the machine]")
@click.option("--retry", is_flag=True, help="try again what failed, though nothing has changed")
@click.option("--steps", callback=named, metavar="A,B", help="as of run; so are the options below")
@click.option("--method", "methods", callback=named, metavar="NAME[,NAME]")
@click.option("--params", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--units", type=click.Choice(UNITS), help="of scans; scene files know theirs")
@click.option("--seed", type=click.IntRange(min=0))
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="of all pages")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object a line for each input, then one for all")
@click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")
@click.pass_context
def batch(
    context: click.Context,
    root: Path,
    output: Path,
    jobs: int | None,
    cluster: str | None,
    timeout_s: float,
    memory_mb: int | None,
    retry: bool,
    steps: tuple[str, ...],
    methods: tuple[str, ...],
    params: Path | None,
    units: str | None,
    seed: int | None,
    lang: str,
    as_json: bool,
) -> None:
    """Process every scan folder, scene file and scan file below ROOT, each in a process of its own.

    Run again, it goes on where it was: what is done is kept while input, parameters and software are the same. Writes
    a folder of results for each input, index.html, summary.csv and summary.json. Exit codes: 1 where an input failed
    (it is listed), 4 where none did and an accuracy limit was missed.
    """
    from processor import pipeline
    from processor.batch import batch as whole
    from processor.jobs.runner import StoppedError

    if jobs is not None and cluster is not None:
        raise UsageError("--jobs and --cluster exclude each other: a cluster does as many at a time as it has workers")
    parameters = pipeline.read_params(params)
    if steps or methods or parameters:  # what is wrong with them is said once, not by every input
        pipeline.plan(steps or tuple(pipeline.step_modules()), methods, parameters, seed)
    given = {"--steps": ",".join(steps), "--method": ",".join(methods), "--seed": "" if seed is None else str(seed)}
    given["--lang"] = lang
    settings = whole.Settings(
        root,
        output,
        tuple(text for name, value in given.items() if value for text in (name, value)),
        params.read_bytes() if params else b"",
        {
            "steps": steps,
            "methods": methods,
            "seed": seed,
            "lang": lang,
            "params": json.loads(json.dumps(parameters, default=str)),
        },
        units,
        jobs or 1,
        cluster,
        timeout_s,
        memory_mb,
        retry,
        lang=lang,
    )

    def ended(one: Record) -> None:
        if as_json:
            click.echo(json.dumps({"event": "input", **dataclasses.asdict(one)}))
        elif one.status == "failed":
            say(f"{one.input}: failed: {one.reason}")

    try:
        found = whole.run(settings, say, ended)
    except StoppedError:
        context.exit(IN_PART)
    counts = {name: count for name, count in found.counts.items() if count}
    if as_json:
        click.echo(json.dumps({"event": "summary", "counts": found.counts, "page": str(found.page)}))
    else:
        click.echo(f"{found.page}: {', '.join(f'{count} {name}' for name, count in counts.items())}")
    context.exit(
        IN_PART
        if found.failed
        else LIMIT_MISSED
        if "limit-missed" in counts
        else IN_PART
        if "in-part" in counts
        else DONE
    )


@click.command()
@click.argument("folder", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="replace the project.toml that is there")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")
def init(folder: Path, force: bool, as_json: bool) -> None:
    """Write FOLDER/project.toml as its files suggest: kind, units, design, and which scan is which component.

    Components are told by their names and by their shape against the design. What was unsure is said, and marked in
    the file: look at it before the first run.
    """
    from processor.scan_folder import guess
    from processor.store import store

    path = folder / guess.PROJECT
    if path.exists() and not force:
        raise UsageError(f"{path}: is there already; --force replaces it")
    found = guess.guess(folder)
    text = guess.written(found)
    with store.replacing(path) as temporary:
        temporary.write_text(text, "utf-8")
    if as_json:
        click.echo(json.dumps(guess.as_json(found), ensure_ascii=False))
        return
    click.echo(f"{path}: kind {found.kind}, {len(found.scans)} file(s) of scans")
    for one in found.unsure:
        click.echo(f"? {one}")
