"""Small text files of a scan folder."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from processor.model import InputError
from processor.plain_text import decoded, tomllib
from processor.readers.file_checks import errors_name_the_file

TEXT_BYTES = 32 * 2**20  # a design of 100,000 nodes has a third of it; JSON of empty lists takes 25 times as much
TOML_BYTES = 4 * 2**20  # 100,000 control points of forty bytes; a project file has some thousands
MOST_KEYS = 32  # of a dotted key of TOML: each part becomes a table, and the reader takes their square in memory
STRINGS_AND_REMARKS = re.compile(r'"""[\s\S]*?"""|"(?:[^"\\\n]|\\.)*"|#[^\n]*|' + r"'''[\s\S]*?'''|'[^'\n]*'")


def read_toml(path: Path) -> Any:
    """Return the values of a TOML file. Raises InputError if it is none, or nested or large beyond any use."""
    text = read_text(path, TOML_BYTES)
    bare = STRINGS_AND_REMARKS.sub("s", text)
    deepest = max((part.count(".") for part in re.split(r"[=\n\[\]{},]", bare)), default=0)
    if deepest >= MOST_KEYS:
        raise InputError(f"expected keys of at most {MOST_KEYS} parts, found one of {deepest + 1}", path=path)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"not readable TOML: {error}", path=path) from None


def read_text(path: Path, most: int = TEXT_BYTES) -> str:
    """Return the text of a file in UTF-8 or GB18030. Raises InputError if it cannot be read, or has too many bytes."""
    try:
        if path.stat().st_size > most:
            raise InputError(
                f"expected at most {most} bytes, found {path.stat().st_size}; is it the right file?", path=path
            )
        return decoded(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", path=path) from None


def csv_table(path: Path, columns: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return the place of each row of a CSV file, for messages, and its cells by these columns, in any order.

    Raises InputError for other columns, and for a row of more or fewer cells.
    """
    rows = csv_rows(path)
    header = [name.strip().lower() for name in rows[0][1]] if rows else []
    if sorted(header) != sorted(columns):
        raise InputError(f"expected columns {','.join(columns)}, found {','.join(header)[:80]!r}", path=path)
    table = []
    for line, row in rows[1:]:
        where = f"{path}: line {line}"
        if len(row) != len(header):
            raise InputError(f"{where}: expected {len(header)} cells, found {len(row)}: {','.join(row)[:80]!r}")
        table.append((where, dict(zip(header, map(str.strip, row), strict=True))))
    return table


def csv_rows(path: Path, separator: str = ",") -> list[tuple[int, list[str]]]:
    """Return the rows of a CSV file that are not blank, each with the number of its line, counted from 1."""
    text = read_text(path)
    with errors_name_the_file(path, "CSV"):
        reader = csv.reader(text.splitlines(), delimiter=separator)
        return [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
