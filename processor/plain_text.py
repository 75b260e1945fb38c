"""Text that a terminal or a spreadsheet shows and does not obey; processor and designgen share it."""

from __future__ import annotations


def printable(characters: str) -> str:
    """Replace control characters, as of a file's name, which a terminal or a spreadsheet may obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in characters)
