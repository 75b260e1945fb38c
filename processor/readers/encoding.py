"""Text of unknown encoding: content and names of files."""

from __future__ import annotations

import os


def decoded(data: bytes) -> str:
    """Decode bytes as UTF-8, or else as GB18030, or else as UTF-8 with replacement characters."""
    for encoding in ("utf-8-sig", "gb18030"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("utf-8", "replace")


def file_name_as_text(name: str) -> str:
    """Return the name of a file as text, decoded as GB18030 where it is not UTF-8."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return decoded(os.fsencode(name))
    return name
