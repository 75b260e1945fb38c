"""Names of files of unknown encoding."""

from __future__ import annotations

import os

from processor.plain_text import decoded


def file_name_as_text(name: str) -> str:
    """Return the name of a file as text, decoded as GB18030 where it is not UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return decoded(os.fsencode(name))
    return name
