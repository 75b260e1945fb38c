"""Text that a terminal or a spreadsheet shows and does not obey; processor and designgen share it."""

from __future__ import annotations

FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")  # first characters of cells that a spreadsheet would execute


def printable(characters: str) -> str:
    """Replace control characters, as of a file's name, which a terminal or a spreadsheet may obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in characters)


def spreadsheet_text(characters: str) -> str:
    """Return a text without control characters; an apostrophe before it where a spreadsheet would execute it."""
    harmless = printable(characters)
    return "'" + harmless if harmless.startswith(FORMULA) else harmless
