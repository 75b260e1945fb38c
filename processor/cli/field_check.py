"""Command ``processor field-check``: the scanner tested by targets before the work."""

from __future__ import annotations

import json
from pathlib import Path

import click

from processor.cli.common import LANGUAGES, debug_option, default_output, fail_on_option, units_option
from processor.jobs.exit_codes import DONE, VERDICT, is_refused


@click.command(name="field-check")
@click.argument("folder", metavar="FOLDER", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="folder of the results  [default: FOLDER-check]")
@units_option("of scans whose files state none")
@fail_on_option
@click.option("--lang", type=click.Choice(LANGUAGES), default="en", show_default=True, help="language of the page")
@click.option("--json", "as_json", is_flag=True, help="print results.json instead of lines")
@debug_option
@click.pass_context
def field_check(
    context: click.Context, folder: Path, output: Path | None, units: str | None, fail_on: str | None, lang: str,
    as_json: bool,
) -> None:  # fmt: skip
    """Test a scanner by scans of targets from several places, and write scanner.toml for projects.

    FOLDER holds scans of the same targets, each in the scanner's own frame: four or more targets, from two places or
    more, better each scan from a place of its own. Its project.toml gives the targets' size ([targets]), the class to
    test against (scanner), and [report] scanner, serial and scanned. Control points with coordinates give the scale.
    """
    from processor.field_check.check import check
    from processor.language.messages import messages
    from processor.plain_text import printable
    from processor.report import field_check as report
    from processor.results.file_names import REPORT_PAGE
    from processor.scan_folder.files import existing
    from processor.scan_folder.folder import read_input

    existing(folder)
    output = output or default_output(f"{folder.resolve().name}-check", as_json)
    report.check_output(output, folder)
    found = check(read_input(folder, units))
    record = report.write(output, found, lang)
    if as_json:
        click.echo(json.dumps(record, ensure_ascii=False))
    else:
        for line in report.lines(found):
            click.echo(printable(messages("en").text(line)))
        click.echo(f"report: {output / REPORT_PAGE}, for projects: {output / report.SCANNER}")
    context.exit(VERDICT if is_refused([found.verdict], fail_on) else DONE)
