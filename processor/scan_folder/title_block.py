"""The table [report] of project.toml: what stands on the report's title block, and a logo."""

from __future__ import annotations

import datetime
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from processor.model import InputError, TitleBlock
from processor.model.inputs import Kind, Place
from processor.plain_text import printable
from processor.scan_folder.file_values import FILE

KEYS = {  # with what they mean where their names do not say it
    **dict.fromkeys(("company", "project", "drawing", "order"), ""),
    "operator": "who inspected; stands on the line to sign",
    "scanner": "",
    "serial": "of the scanner",
    "scanned": "date of the scan",
    "approved": "who approves; stands on the line to sign",
}
LOGO = "logo"
FORMATS = ("PNG", "JPEG")
MOST_KEYS, LONGEST, LONGEST_KEY = 30, 200, 40  # what the title block on A4 has room for
MOST_BYTES, MOST_PIXELS = 1_000_000, 4_000_000  # the logo is part of the page


def read_title_block(given: Any, place: Place) -> TitleBlock | None:
    """Return the table [report] of a project, its known keys first; None for an empty one.

    Values are texts, numbers and dates; empty texts are left out. Raises InputError for anything else, and for a logo
    that is no PNG or JPEG picture below the folder.
    """
    if not isinstance(given, dict):
        raise TypeError
    if not given:
        return None
    written = {key: _written(key, value, place) for key, value in given.items() if key != LOGO}
    if len(written) > MOST_KEYS:
        raise place.refused(f"expected at most {MOST_KEYS} keys, found {len(written)}; leave some out")
    kept = [key for key in (*KEYS, *(key for key in written if key not in KEYS)) if written.get(key)]
    logo = _logo(FILE.value(given[LOGO], LOGO, place)) if given.get(LOGO) else b""
    return TitleBlock(tuple(kept), tuple(written[key] for key in kept), np.frombuffer(logo, np.uint8))


def _written(key: str, value: Any, place: Place) -> str:
    if len(key) > LONGEST_KEY or not key.strip():
        raise place.refused(f"expected keys of 1 to {LONGEST_KEY} characters, found {key[:60]!r}; shorten it")
    if isinstance(value, datetime.datetime):
        return value.isoformat(" ", "minutes")
    if isinstance(value, datetime.date):
        return value.isoformat()
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        kind = {bool: "true or false", list: "a list", dict: "a table"}.get(type(value), type(value).__name__)
        raise place.refused(f"expected a text, number or date as {key!r}, found {kind}; write it as a text")
    text = printable(" ".join(str(value).split()))
    if len(text) > LONGEST:
        raise place.refused(f"expected at most {LONGEST} characters as {key!r}, found {len(text)}; shorten it")
    return text


def _logo(path: Path) -> bytes:
    advice = f"expected a picture in {' or '.join(FORMATS)}"
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise InputError(f"expected a logo of at most {MOST_BYTES} bytes, found {size}; make it smaller", path=path)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{advice}, it cannot be read ({error.strerror or error})", path=path) from None
    problem = _problem(data)
    if problem:
        raise InputError(f"{advice}, found {problem}; export the logo again as PNG", path=path)
    return data


def _problem(data: bytes) -> str:
    """Say why bytes are no picture that a page may show; nothing if they are one."""
    from PIL import Image

    try:
        with warnings.catch_warnings(), Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            warnings.simplefilter("ignore")
            if picture.width * picture.height > MOST_PIXELS:
                return f"{picture.width} x {picture.height} pixels, more than {MOST_PIXELS} in all"
            picture.load()
    except (OSError, ValueError, SyntaxError, ArithmeticError, MemoryError, Image.DecompressionBombError):
        return "a file that is none, or is damaged"
    return ""


ENTRY = {
    "description": f"a text of at most {LONGEST} characters, a number, or a date of TOML",
    "not": {"type": ["boolean", "array", "object", "null"]},
    "maxLength": LONGEST,
}
TITLE_BLOCK = Kind(
    "a table",
    read_title_block,
    {
        "type": "object",
        "maxProperties": MOST_KEYS + 1,
        "propertyNames": {"minLength": 1, "maxLength": LONGEST_KEY},
        "properties": {
            **{key: {**ENTRY, "description": about} if about else ENTRY for key, about in KEYS.items()},
            LOGO: {"description": "a PNG or JPEG file below the folder, at most 1 MB", "type": "string"},
        },
        "additionalProperties": ENTRY,
    },
)
