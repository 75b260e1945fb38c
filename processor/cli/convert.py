"""Command ``processor convert``: a scan folder or a scan file as one scene file."""

from __future__ import annotations

import json
from pathlib import Path

import click

from processor.cli.common import debug_option, units_option


@click.command()
@click.argument("input_", metavar="INPUT", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="scene file (.h5)")
@units_option("unit of the scans, whatever the file states")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@debug_option
def convert(input_: Path, output: Path, units: str | None, as_json: bool) -> None:
    """Write INPUT, a scan folder or one scan file, as a scene file that `processor run` takes.

    For what is run often, and for clouds that are larger than memory: points are read block by block, and lie beside
    OUTPUT meanwhile. Coordinates are rounded to 0.0001 mm, beyond an extent of 400 m to 0.001 mm.
    """
    from processor.api import conversion
    from processor.plain_text import printable

    done = conversion.convert(input_, output, units)
    total = sum(done.points.values())
    if as_json:
        content = {
            "scene": str(done.path),
            "scans": [{"name": name, "points": points} for name, points in done.points.items()],
            "units": done.units,
            "units_reason": done.units_reason,
            "truth": done.with_truth,
        }
        click.echo(json.dumps(content, ensure_ascii=False))
        return
    scans = f"{len(done.points)} scan{'' if len(done.points) == 1 else 's'}"
    click.echo(printable(f"{done.path}: {scans}, {total:,} points, read as {done.units} ({done.units_reason})"))
