"""Text that a terminal or a spreadsheet shows and does not obey; processor and designgen share it."""

from __future__ import annotations

import re

FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")  # first characters of cells that a spreadsheet would execute


def printable(characters: str) -> str:
    """Replace control characters, as of a file's name, which a terminal or a spreadsheet may obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in characters)


def spreadsheet_text(characters: str) -> str:
    """Return a text without control characters; an apostrophe before it where a spreadsheet would execute it."""
    harmless = printable(characters)
    return "'" + harmless if harmless.startswith(FORMULA) else harmless


def decoded(data: bytes) -> str:
    """Decode bytes as UTF-8, else as GB18030 or Windows-1252, whichever they look like.

    Letters of Western languages beyond ASCII stand alone between others; Chinese ones are pairs of bytes in a row.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        pass
    runs = [len(run) for run in re.findall(rb"[\x80-\xff]+", data)]
    western = 2 * runs.count(1) > len(runs)
    try:
        return data.decode("cp1252" if western else "gb18030")
    except UnicodeDecodeError:
        return data.decode("latin-1" if western else "utf-8", "replace")
