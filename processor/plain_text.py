"""Text of unknown encoding, text that a terminal or a spreadsheet shows and does not obey, and the reader of TOML.

processor and designgen share it.
"""

from __future__ import annotations

import re
import sys

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["decoded", "printable", "spreadsheet_text", "tomllib"]

FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")  # first characters of cells that a spreadsheet would execute


def printable(characters: str) -> str:
    """Replace control characters, as of a file's name, which a terminal or a spreadsheet may obey."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in characters)


def spreadsheet_text(characters: str) -> str:
    """Return a text without control characters; an apostrophe before it where a spreadsheet would execute it."""
    harmless = printable(characters)
    return "'" + harmless if harmless.startswith(FORMULA) else harmless


def decoded(data: bytes) -> str:
    """Decode bytes as UTF-8, or else as GB18030 or Latin-1 (as of Windows), by the look of the bytes beyond ASCII."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        pass
    # Chinese characters of everyday use (GB 2312) are two bytes beyond ASCII each, and no small Latin letter stands
    # beside them: a run of an odd number of bytes is of a European word, and so is one of letters alone between small
    # letters. Both are valid GB18030.
    runs = re.findall(rb"([a-z]?)([\x80-\xff]+)(?=([a-z]?))", data)
    latin = sum(len(run) % 2 == 1 or bool(before and after and min(run) >= 0xC0) for before, run, after in runs)
    if 2 * latin <= len(runs):
        try:
            return data.decode("gb18030")
        except UnicodeDecodeError:
            pass
    try:
        return data.decode("cp1252")
    except UnicodeDecodeError:
        return data.decode("utf-8", "replace")
