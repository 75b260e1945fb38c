"""Command line of ``designgen``. What is heavy is imported where it is used, so that help comes at once."""

from __future__ import annotations

import importlib
import json
import pkgutil
from pathlib import Path

import click

from designgen import __version__, designs
from processor.progress import stage

DONE, IN_PART, ALL_FAILED = 0, 1, 2
FORMATS = ("ply", "las", "laz", "e57", "ptx", "pcd", "xyz")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="designgen")
def commands() -> None:
    """Make steel designs and synthetic scans of them, with the truth beside them."""


@commands.command("list")
def list_() -> None:
    """List component types and recipes, a line each."""
    from designgen import recipes

    click.echo("component types")
    for module in pkgutil.iter_modules(designs.__path__):
        about = getattr(importlib.import_module(f"designgen.designs.{module.name}"), "ABOUT", "")
        if about:
            click.echo(f"  {module.name:<14} {about}")
    click.echo("recipes")
    for name, recipe in recipes.named().items():
        click.echo(f"  {name:<14} {recipe['about']}")


@commands.command()
@click.argument("recipe")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="scene to write; of many, the folder"
)
@click.option("--seed", type=click.IntRange(min=0), help="instead of the recipe's own; of many scenes, the first")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="e.g. scan.sigma_mm=2; may be repeated")
@click.option("--count", type=click.IntRange(min=1), help="make a folder of scenes: so many seeds, one after another")
@click.option(
    "--vary", multiple=True, metavar="KEY=V1,V2,...", help="... and every combination of values; may be repeated"
)
@click.option("--jobs", type=click.IntRange(min=1), help="processes that make the folder's scenes  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Dask scheduler whose workers make them, e.g. tcp://10.0.0.1:8786")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@click.pass_context
def make(
    context: click.Context,
    recipe: str,
    output: Path,
    seed: int | None,
    settings: tuple[str, ...],
    count: int | None,
    vary: tuple[str, ...],
    jobs: int | None,
    cluster: str | None,
    as_json: bool,
) -> None:
    """Make the scene of RECIPE (a name or a TOML file) with its truth.

    With --count or --vary many, in a folder with an index.csv. Run again, what is there and whole is kept.
    Exit codes: 0 done, 1 some scenes failed (the index says why), 2 all failed, or wrong usage, 3 bad input.
    """
    from designgen import batch, recipes

    name, loaded = recipes.load(recipe)
    loaded = recipes.overridden(loaded, settings)
    many = count is not None or bool(vary)
    batch.check_usage(output, settings, vary, many=many, jobs=jobs, cluster=cluster)
    if many:
        varied = batch.parse_varied(vary)
        planned = batch.plan(output, name, loaded, varied, seed, count or 1)
        said = batch.make_many(output, planned, list(varied), jobs or 1, cluster)
        for failure in said["failed"]:
            click.echo(f"{failure['file']}: failed: {failure['reason']}", err=True)
        click.echo(
            json.dumps(said) if as_json else "{index}: {done} of {scenes} scene(s), {made} made now".format(**said)
        )
        context.exit(DONE if not said["failed"] else IN_PART if said["done"] else ALL_FAILED)
    with stage(f"making {name}"):
        used, scans, points = batch.make_scene(output, name, loaded, seed)
    if as_json:
        click.echo(json.dumps({"scene": str(output), "recipe": name, "seed": used, "scans": scans, "points": points}))
    else:
        click.echo(f"{output}: recipe {name}, seed {used}, {scans} scan(s), {points:,} points")


@commands.command()
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="folder to make")
@click.option("--format", "format_", required=True, type=click.Choice(FORMATS), help="of the scans")
@click.option("--without-truth", is_flag=True, help="leave the truth out")
@click.option("--spherical", is_flag=True, help="E57 with ranges and angles, as scanners write it")
@click.option("--step", is_flag=True, help="write the design's solids as STEP, too")
@click.option("--without-meshes", is_flag=True, help="leave the meshes of an arch bridge's parts out of its design")
def export(
    scene: Path, output: Path, format_: str, without_truth: bool, spherical: bool, step: bool, without_meshes: bool
) -> None:
    """Write SCENE as a scan folder: project.toml, design, scans, and the truth in truth.h5."""
    from designgen.export import folder

    if spherical and format_ != "e57":
        raise click.UsageError("--spherical is for --format e57")
    with stage(f"writing {output.name}"):
        written = folder.export(
            scene,
            output,
            format_,
            with_truth=not without_truth,
            spherical=spherical,
            step=step,
            with_meshes=not without_meshes,
        )
    for name in written.left_out:
        click.echo(f"{output}: scan {name!r} is left out: it saw next to nothing", err=True)
    click.echo(f"{output}: {written.scans} scan(s) as {format_}")


@commands.command("import")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="folder to make")
@click.option("--units", default="", help="of the file's numbers, whatever the file says: mm, m, inch, ...")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@click.pass_context
def import_(context: click.Context, file: Path, output: Path, units: str, as_json: bool) -> None:
    """Turn a STEP or IFC FILE into meshes in mm, one a body, with their sizes in import.json.

    Exit codes: 0 done, 1 some bodies could not be taken (they are listed), 2 wrong usage, 3 bad input.
    """
    from designgen.cad import files

    said = files.import_file(file, output, units)
    if as_json:
        click.echo(json.dumps(said, ensure_ascii=False))
    else:
        click.echo("\n".join(files.summary(said)))
    for problem in said["problems"]:
        click.echo(f"{file}: {problem}", err=True)
    context.exit(IN_PART if said["problems"] else DONE)
