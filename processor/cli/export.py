"""Command ``processor export``: clouds out of a run's results and its input."""

from __future__ import annotations

import json
from pathlib import Path

import click

from processor.cli.common import debug_option, print_error_line, units_option
from processor.clouds import CONTENTS, FORMATS


@click.command()
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path))
@click.argument("input_", metavar="[INPUT]", required=False, type=click.Path(path_type=Path))
@click.option("-o", "--output", "folder", required=True, type=click.Path(path_type=Path), help="new folder")
@click.option("--what", required=True, type=click.Choice(CONTENTS), help="content of the clouds")
@click.option("--format", "format_", required=True, type=click.Choice(FORMATS), help="format of the clouds")
@click.option(
    "--spacing-mm",
    type=click.FloatRange(min=0.0, min_open=True),
    help="least distance of two points; others are left out",
)
@units_option("unit of the scans, as given to the run")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@debug_option
def export(
    output: Path,
    input_: Path | None,
    folder: Path,
    what: str,
    format_: str,
    spacing_mm: float | None,
    units: str | None,
    as_json: bool,
) -> None:
    """Write point clouds of the run in OUT as a new folder.

    \b
    registered  each scan with its pose, and a project.toml that processor run takes
    merged      all scans as one cloud in the project's frame
    assembled   the parts of a bridge in the bridge's frame
    clean       each scan without outliers, and without points that are not of the design
    deviation   core points with deviation_mm, lod95_mm and component

    Without INPUT the file of its name beside OUT is taken, or in the current folder, if its content is the same.
    """  # noqa: D301
    from processor.clouds.export import export as write
    from processor.language.messages import messages
    from processor.progress import stage

    with stage(f"writing {folder.name}"):
        done = write(output, folder, what, format_, spacing_mm or 0.0, input_, units)
    for remark in done.remarks:
        print_error_line(messages("en").text(remark))
    if as_json:
        content = {"folder": str(folder), "what": what, "format": format_, "files": done.files}
        click.echo(json.dumps(content, ensure_ascii=False))
        return
    for name, count in done.files.items():
        click.echo(f"{folder / name}: {count:,} points")
