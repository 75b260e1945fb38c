"""Command ``processor compare``: M3C2 between two clouds, without a design."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from processor.cli.common import LANGUAGES, cluster_option, debug_option, default_output, print_error_line

LENGTH = click.FloatRange(min=0.0, min_open=True)
FILE = click.Path(path_type=Path)
RADIUS = ("rad", "scale")  # in the names of options of other software, which takes radii


class _Diameters(click.Command):
    """A command that explains, where an option for a radius is given, that its options are diameters."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if any(part in error.option_name.lower() for part in RADIUS):
                raise click.UsageError(
                    f"No such option: {error.option_name}. Expected a diameter, twice the radius: "
                    "--projection-diameter of the cylinder, --normal-diameter of the sphere for normals.",
                    ctx,
                ) from error
            raise


@click.command(cls=_Diameters)
@click.argument("reference", type=FILE)
@click.argument("compared", type=FILE)
@click.option("-o", "--output", type=FILE, help="folder of the results  [default: REFERENCE-COMPARED-comparison]")
@click.option("--core", type=FILE, help="cloud of core points  [default: every point of REFERENCE]")
@click.option("--normal-diameter", type=LENGTH, help="diameter of the sphere in which a normal is fitted")
@click.option("--projection-diameter", type=LENGTH, help="diameter of the cylinder along the normal")
@click.option("--max-depth", type=LENGTH, help="reach of the cylinder to either side of the core point")
@click.option(
    "--registration-error", type=click.FloatRange(min=0.0), default=0.0, help="length that is added to the LOD95"
)
@click.option("--normals", type=FILE, help="nx, ny, nz of every core point, PLY or text, instead of fitted ones")
@click.option(
    "--units", metavar="U[/V][,U[/V]]", help="unit of all files, or of each; V: unit of heights, e.g. m/us-ft,m"
)
@cluster_option
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the page")
@click.option("--json", "as_json", is_flag=True, help="print compare.json")
@debug_option
def compare(reference: Path, compared: Path, output: Path | None, lang: str, as_json: bool, **options: Any) -> None:
    """Distances from cloud REFERENCE to cloud COMPARED along normals, with levels of detection (M3C2).

    All lengths are in the unit of the clouds, with --units in that of REFERENCE; those not given are derived from the
    clouds' density.
    """
    from processor import large_arrays
    from processor.compare import compare as comparing
    from processor.jobs import tile_cluster
    from processor.language.messages import messages
    from processor.plain_text import printable
    from processor.report import cloud_comparison
    from processor.scan_folder.files import missing
    from processor.store import whole_output

    for path in (reference, compared):
        if not path.exists():
            raise missing(path)
    output = output or default_output(f"{reference.stem}-{compared.stem}-comparison")
    cloud_comparison.check_output(output, (reference, compared, options["core"], options["normals"]))
    address = options.pop("cluster")
    given = {name: value for name, value in options.items() if value is not None}
    with large_arrays.in_files(whole_output.existing_parent(output)):
        with tile_cluster.on_cluster(address, print_error_line):
            result = comparing.compare(comparing.Request(reference, compared, **given), print_error_line)
        record = cloud_comparison.write(output, result, lang)
    if as_json:
        click.echo(json.dumps(record, ensure_ascii=False))
        return
    for line in cloud_comparison.lines(result):
        click.echo(printable(messages("en").text(line)))
    click.echo(f"report: {output / cloud_comparison.PAGE}")
