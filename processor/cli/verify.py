"""Command ``processor verify``: whether archived files are what was written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import click

from processor.cli.common import debug_option
from processor.jobs.exit_codes import BAD_INPUT, DONE, IN_PART
from processor.model import InputError
from processor.plain_text import printable

WHOLE, UNKNOWN, DAMAGED = "whole", "no-checksums", "damaged"


@dataclass(frozen=True)
class _Found:
    """What is known of a file: its path, one of the three words, and what is damaged."""

    file: str
    state: str
    problems: tuple[str, ...] = ()


@click.command()
@click.argument("path", metavar="PATH", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="print one JSON object instead of lines")
@debug_option
@click.pass_context
def verify(context: click.Context, path: Path, as_json: bool) -> None:
    """Compare files with their checksums: PATH is a file, or a folder whose HDF5 files are all looked at.

    The results.json of a batch is compared with the record beside it. Exit codes: 0 all files are whole, 1 some have no
    checksums (of an earlier version), 3 one is damaged or there is none.
    """
    from processor.scan_folder.files import existing

    existing(path)
    found = []
    for one in _looked_at(path):
        found.append(one)
        if not as_json:
            for problem in one.problems or ("",):
                click.echo(printable(f"{one.state:<13} {one.file}" + (f": {problem}" if problem else "")))
    if not found:
        raise InputError(f"{path}: expected files of processor (.h5) in it, found none")
    counts = {state: sum(one.state == state for one in found) for state in (WHOLE, UNKNOWN, DAMAGED)}
    if as_json:
        click.echo(json.dumps({"files": [asdict(one) for one in found], "counts": counts}, ensure_ascii=False))
    else:
        click.echo(", ".join(f"{count} {state}" for state, count in counts.items() if count))
    context.exit(BAD_INPUT if counts[DAMAGED] else IN_PART if counts[UNKNOWN] else DONE)


def _looked_at(path: Path) -> Iterator[_Found]:
    from processor.batch import record
    from processor.results.file_names import JOB_RECORD, RESULTS_JSON
    from processor.scan_folder import fingerprint
    from processor.store import store

    for name, file, _ in fingerprint.files_of(path):
        shown = name or str(path)
        if file.suffix.lower() == ".h5" or not name:
            sealed, problems = store.damage(file)
            yield _Found(shown, DAMAGED if problems else WHOLE if sealed else UNKNOWN, tuple(problems))
        elif file.name == JOB_RECORD:
            results = file.with_name(RESULTS_JSON)
            known = record.read(file)
            if known is None:
                yield _Found(shown, DAMAGED, ("is no readable record of a batch's job",))
            elif known.results_sha256:
                same = record.sha256_of(results) == known.results_sha256
                why = "" if same else "is not what the batch wrote; run it again"
                yield _Found(
                    str(Path(shown).with_name(RESULTS_JSON)), WHOLE if same else DAMAGED, (why,) if why else ()
                )
