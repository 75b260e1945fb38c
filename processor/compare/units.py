"""Units of the files of a comparison, as the command line states them."""

from __future__ import annotations

from collections.abc import Sequence

from processor.model import UsageError
from processor.scan_folder.units import FileUnit, file_unit

NEXT = ","


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
    try:
        units = [file_unit(part) for part in parts]
    except UsageError as error:
        raise UsageError(f"--units {text}: {error}") from None
    return {name: units[-1] if name == "compared" else units[0] for name in names}
