"""Command ``processor init``: a first project.toml for a folder of scans, and its design.json."""

from __future__ import annotations

import json
from pathlib import Path

import click

from processor.cli.common import LANGUAGES, UNITS, debug_option
from processor.model import UsageError
from processor.plain_text import printable

PICTURE = "design.png"


@click.command()
@click.argument("folder", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="replace the project.toml that is there")
@click.option("--design-units", type=click.Choice(UNITS), help="unit of a design that states none  [default: guessed]")
@click.option(
    "--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of comments and lines"
)
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
@debug_option
def init(folder: Path, force: bool, design_units: str | None, lang: str, as_json: bool) -> None:
    """Write FOLDER/project.toml as its files suggest: kind, units, design, and which scan is which component.

    Without a design.json it is written, too, where meshes or CAD files show one: the parts of an arch bridge in order
    with their joints and bottom edges, or the nodes and members of a space frame. One that is there is never changed.

    Components are recognised by their names and by their shapes against the design. What is uncertain is printed and
    marked in the file, and in a picture of a design that was found, design.png: check it before the first run.
    """
    from processor.language.messages import messages, text
    from processor.scan_folder import files, guess
    from processor.store.whole_output import replacing

    path = folder / files.PROJECT
    if path.exists() and not force:
        raise UsageError(f"{path}: is there already; --force replaces it")
    project = guess.guess(folder, design_units or "")
    table = guess.to_toml(project, lang)
    guess.write_design(folder, project, lang)
    if project.made is not None and project.made.design is not None:
        from processor.report.charts import design_picture

        with replacing(folder / PICTURE) as temporary:
            temporary.write_bytes(design_picture.draw(project.made.design, project.made.unsure))
    with replacing(path) as temporary:
        temporary.write_text(table, "utf-8")
    if as_json:
        click.echo(json.dumps(guess.as_json(project), ensure_ascii=False))
        return
    write = messages(lang).text
    if project.made:
        made, content = str(folder / project.design), guess.summary(project)
        line = text("{file}: {content}; shown in {picture}", file=made, content=content, picture=PICTURE)
        click.echo(printable(write(line)))
    scans = len(project.scans)
    line = text("{file}: kind {kind}, {files} file(s) of scans", file=str(path), kind=project.kind, files=scans)
    click.echo(printable(write(line)))
    for doubt in project.doubts:
        click.echo(printable(f"? {write(doubt)}"))
