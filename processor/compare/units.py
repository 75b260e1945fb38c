"""Units of the files of a comparison, as the command line states them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from processor.model import UsageError
from processor.scan_folder.units import known_unit

VERTICAL, NEXT = "/", ","


class FileUnit(NamedTuple):
    """Units of a file along x and y, and along z."""

    horizontal: str
    vertical: str


def of_files(text: str, names: Sequence[str]) -> dict[str, FileUnit]:
    """Return the unit of each file of ``names``: reference, compared, and core points, which are as the reference.

    ``text`` is a unit for all, or two with a comma between, of the reference and of the compared cloud; each may have a
    unit of the heights after a slash: ``m/us-ft,m``. Empty without a text. Raises UsageError for any other text.
    """
    if not text:
        return {}
    parts = [part.strip() for part in text.split(NEXT)]
    if len(parts) > 2 or not all(parts):
        raise UsageError(f"--units {text}: expected one unit, or two with a comma between, e.g. m,ft or m/us-ft,m")
    units = [_of_file(part, text) for part in parts]
    return {name: units[-1] if name == "compared" else units[0] for name in names}


def _of_file(part: str, text: str) -> FileUnit:
    horizontal, slash, vertical = part.partition(VERTICAL)
    if slash and not vertical:
        raise UsageError(f"--units {text}: expected a unit of the heights after the slash, e.g. m/us-ft")
    try:
        return FileUnit(known_unit(horizontal), known_unit(vertical or horizontal))
    except UsageError as error:
        raise UsageError(f"--units {text}: {error}") from None
