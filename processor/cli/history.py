"""Command ``processor history``: several runs of one structure over time."""

from __future__ import annotations

from pathlib import Path

import click

from processor.cli.common import LANGUAGES, Shown, debug_option, default_output, log_line, output_options


@click.command()
@click.argument("root", metavar="ROOT", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="folder of the results  [default: ROOT-history]")
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="of the page")
@output_options
@debug_option
def history(root: Path, output: Path | None, lang: str, **options: bool) -> None:
    """Compare the runs in the folders below ROOT: what changed from epoch to epoch beyond its 95 % interval.

    Each folder holds the results of one run on the same structure. The day of a run is 'scanned' of [report] in its
    project.toml, else that of its scan files, else a day in the folder's name. Joints of bridges, balls of frames,
    surfaces, defects and sizes of parts are compared.
    """
    from processor.epochs import compare, epoch
    from processor.language.messages import messages
    from processor.plain_text import printable
    from processor.report import table
    from processor.report.epochs import lines, tables, write

    shown = Shown(**options)
    output = output or default_output(f"{root.resolve().name}-history", shown.quiet)
    write.check_output(output, root)
    found = compare.compare(epoch.read(root))
    write.write(output, found, lang)
    english = messages("en")
    log_line(english.text(lines.headline(found)))
    if shown.as_json:
        click.echo((output / write.RECORD).read_text("utf-8"), nl=False)
        return
    said = [english.text(line) for line in lines.lines(found, str(output / write.PAGE))]
    for line in said[:1] if shown.quiet else said:
        click.echo(printable(line))
    if shown.verbose:
        for one in tables.tables(found):
            if one.on_terminal:
                click.echo("\n" + table.plain_text(one))
