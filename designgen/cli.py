"""Command line of ``designgen``. What is heavy is imported where it is used, so that help comes at once."""

from __future__ import annotations

import importlib
import json
import pkgutil
from importlib.metadata import version
from pathlib import Path

import click

from designgen import __version__, designs

FORMATS = ("ply", "las", "laz", "e57", "xyz")


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
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, dir_okay=False), help="scene to write")
@click.option("--seed", type=click.IntRange(min=0), help="instead of the recipe's own")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="e.g. scan.sigma_mm=2; may be repeated")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def make(recipe: str, output: Path, seed: int | None, settings: tuple[str, ...], as_json: bool) -> None:
    """Make the scene of RECIPE (a name or a TOML file) with its truth."""
    from designgen import recipes, scene
    from processor import store

    name, loaded = recipes.load(recipe)
    loaded = recipes.overridden(loaded, settings)
    made, truth = scene.make(name, loaded, seed)
    used = loaded.get("seed", 0) if seed is None else seed
    software = {"designgen": __version__, **{name: version(name) for name in ("cadquery", "numpy", "scipy")}}
    provenance = {"software": software, "recipe": name, "parameters": loaded, "seed": used}
    store.write_scene(output, made, truth, provenance)
    points = sum(len(scan.points) for scan in made.scans)
    if as_json:
        said = {"scene": str(output), "recipe": name, "seed": used, "scans": len(made.scans), "points": points}
        click.echo(json.dumps(said))
    else:
        click.echo(f"{output}: recipe {name}, seed {used}, {len(made.scans)} scan(s), {points:,} points")


@commands.command()
@click.argument("scene", type=click.Path(path_type=Path, dir_okay=False))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path, file_okay=False), help="folder to make")
@click.option("--format", "format_", required=True, type=click.Choice(FORMATS), help="of the scans")
@click.option("--without-truth", is_flag=True, help="leave the truth out")
def export(scene: Path, output: Path, format_: str, without_truth: bool) -> None:
    """Write SCENE as a scan folder: project.toml, design, scans, and the truth in truth.h5."""
    from designgen import scan_folder

    written = scan_folder.export(scene, output, format_, with_truth=not without_truth)
    click.echo(f"{output}: {written} scan(s) as {format_}")
