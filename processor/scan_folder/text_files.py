"""Small text files of a scan folder."""

from __future__ import annotations

import csv
from pathlib import Path

from processor.model import InputError
from processor.plain_text import decoded
from processor.readers.file_checks import errors_name_the_file


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8 or GB18030. Raises InputError if it cannot be read."""
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", path=path) from None


def csv_rows(path: Path, separator: str = ",") -> list[tuple[int, list[str]]]:
    """Return the rows of a CSV file that are not blank, each with the number of its line, counted from 1."""
    text = read_text(path)
    with errors_name_the_file(path, "CSV"):
        reader = csv.reader(text.splitlines(), delimiter=separator)
        return [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
