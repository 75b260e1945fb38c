"""Command line of ``designgen``. Slow imports are inside the functions, so that help appears at once."""

from __future__ import annotations

import importlib
import json
import pkgutil
from pathlib import Path

import click

from designgen import __version__, designs
from designgen.export import FORMATS
from processor.plain_text import printable
from processor.progress import stage

DONE, IN_PART, ALL_FAILED = 0, 1, 2  # exit codes; 2 is also that of wrong usage, after which nothing is made either
json_option = click.option("--json", "as_json", is_flag=True, help="print one JSON object")
debug_option = click.option("--debug", is_flag=True, expose_value=False, help="show where an error arose")


def _print_line(line: str, err: bool = False) -> None:
    """Write one line, which may hold a file's or a body's name, with its control characters replaced."""
    click.echo(printable(line), err=err)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="designgen")
def commands() -> None:
    """Make designs of steel structures, and synthetic laser scans of them with their truth."""


@commands.command("list")
@json_option
@debug_option
def list_(as_json: bool) -> None:
    """List the types of components and the recipes, a line each."""
    from designgen import recipe_files

    names = [module.name for module in pkgutil.iter_modules(designs.__path__)]
    modules = {name: importlib.import_module(f"designgen.designs.{name}") for name in names}
    types = {name: module.ABOUT for name, module in modules.items() if hasattr(module, "ABOUT")}
    named = {name: recipe["about"] for name, recipe in recipe_files.named().items()}
    if as_json:
        click.echo(json.dumps({"component_types": types, "recipes": named}, ensure_ascii=False))
        return
    width = max(map(len, [*types, *named]))
    for heading, lines in (("component types", types), ("recipes", named)):
        click.echo(heading)
        for name, about in lines.items():
            click.echo(f"  {name:<{width}}  {about}")


@commands.command()
@click.argument("recipe")
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="scene file; folder for several scenes"
)
@click.option("--seed", type=click.IntRange(min=0), help="first seed  [default: the recipe's]")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="change the recipe, e.g. scan.sigma_mm=2; repeatable"
)
@click.option("--count", type=click.IntRange(min=1), help="make scenes for this number of consecutive seeds")
@click.option(
    "--vary", multiple=True, metavar="KEY=V1,V2,...", help="make scenes for every combination of values; repeatable"
)
@click.option("--jobs", type=click.IntRange(min=1), help="number of processes for several scenes  [default: 1]")
@click.option("--cluster", metavar="ADDRESS", help="Dask scheduler for several scenes, e.g. tcp://10.0.0.1:8786")
@json_option
@debug_option
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

    With --count or --vary, make several scenes in a folder with index.csv and a card of the set (card.md, card.json).
    A second run keeps complete scenes.
    Exit codes: 0 done, 1 some scenes failed (reasons are in the index), 2 all failed or wrong usage, 3 bad input.
    """
    from designgen import batch, recipe_files

    name, loaded = recipe_files.load(recipe)
    loaded = recipe_files.overridden(loaded, settings)
    many = count is not None or bool(vary)
    batch.check_usage(output, settings, vary, many=many, jobs=jobs, cluster=cluster)
    if many:
        varied = batch.parse_varied(vary)
        planned = batch.plan(output, name, loaded, varied, seed, count or 1)
        report = batch.make_many(output, planned, loaded, varied, jobs or 1, cluster)
        for failure in report["failed"]:
            _print_line(f"{failure['file']}: failed: {failure['reason']}", err=True)
        text = "{index}: {done} of {scenes} scene(s), {made} made now".format(**report)
        click.echo(json.dumps(report) if as_json else printable(text))
        context.exit(DONE if not report["failed"] else IN_PART if report["done"] else ALL_FAILED)
    with stage(f"making {name}"):
        used, scans, points = batch.make_scene(output, name, loaded, seed)
    if as_json:
        click.echo(json.dumps({"scene": str(output), "recipe": name, "seed": used, "scans": scans, "points": points}))
    else:
        _print_line(f"{output}: recipe {name}, seed {used}, {scans} scan(s), {points:,} points")


@commands.command()
@click.argument("model", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, dir_okay=False), help="scene file")
@click.option(
    "--stations", default="6", metavar="N|FILE.json", help="number of stations, or their places  [default: 6]"
)
@click.option("--scanner", default="phase", help="class of scanner, or a scanner.toml  [default: phase]")
@click.option("--units", default="", help="unit of the model's numbers, instead of that in the file: mm, m, inch, ...")
@click.option("--seed", type=click.IntRange(min=0), default=0, help="of all random numbers  [default: 0]")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="change a setting, e.g. scan.step_mrad=1; repeatable"
)
@json_option
@debug_option
def scan(
    model: Path,
    output: Path,
    stations: str,
    scanner: str,
    units: str,
    seed: int,
    settings: tuple[str, ...],
    as_json: bool,
) -> None:
    """Scan MODEL (STEP, IFC, PLY, STL, OBJ, or a Python file) from stations around it: a scene with its truth.

    A Python file is run as a program and leaves a CadQuery object in ``result``. Without a file of places, stations are
    placed so that most of the surface is seen. Exit codes: 0 done, 2 wrong usage, 3 bad input.
    """
    from designgen import batch
    from designgen.scenes import model as models

    recipe = models.recipe_of(str(model), stations, scanner, units, settings)
    with stage(f"scanning {model.name}"):
        used, scans, points = batch.make_scene(output, model.stem, recipe, seed)
    if as_json:
        click.echo(
            json.dumps({"scene": str(output), "model": str(model), "seed": used, "scans": scans, "points": points})
        )
    else:
        _print_line(f"{output}: model {model.name}, seed {used}, {scans} scan(s), {points:,} points")


@commands.command()
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="new folder")
@click.option("--format", "format_", required=True, type=click.Choice(FORMATS), help="format of the scans")
@click.option("--without-truth", is_flag=True, help="do not write the truth")
@click.option("--spherical", is_flag=True, help="E57 with ranges and angles instead of x, y, z")
@click.option("--step", is_flag=True, help="also write the solids as STEP, as designed and as built")
@click.option("--without-meshes", is_flag=True, help="design of an arch bridge without meshes of its parts")
@json_option
@debug_option
def export(
    scene: Path,
    output: Path,
    format_: str,
    without_truth: bool,
    spherical: bool,
    step: bool,
    without_meshes: bool,
    as_json: bool,
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
        _print_line(f"{output}: scan {name!r} is left out: it has almost no points", err=True)
    if as_json:
        content = {"folder": str(output), "format": format_, "scans": written.scans, "left_out": list(written.left_out)}
        click.echo(json.dumps(content, ensure_ascii=False))
        return
    _print_line(f"{output}: {written.scans} scan(s) as {format_}")


@commands.command("import")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="new folder")
@click.option("--units", default="", help="unit of the numbers, instead of that in the file: mm, m, inch, ...")
@click.option("--default-units", default="", metavar="UNIT", help="unit of the numbers where the file states none")
@click.option("--named", type=click.Path(path_type=Path), help="what errors call FILE, the original of a copy")
@json_option
@debug_option
@click.pass_context
def import_(
    context: click.Context,
    file: Path,
    output: Path,
    units: str,
    default_units: str,
    named: Path | None,
    as_json: bool,
) -> None:
    """Convert a STEP or IFC FILE to meshes in mm, one for each body, with their sizes in import.json.

    Exit codes: 0 done, 1 some bodies could not be read (they are listed), 2 wrong usage, 3 bad input.
    """
    from designgen.cad import files

    report = files.import_file(file, output, units, default_units, named)
    if as_json:
        click.echo(json.dumps(report, ensure_ascii=False))
    else:
        for line in files.summary(report):
            _print_line(line)
    for line in (*report["problems"], *report["notes"]):
        _print_line(f"{file}: {line}", err=True)
    context.exit(IN_PART if report["problems"] else DONE)
