"""Jinja2 templates of the pages: values are escaped, messages are written in the page's language."""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any

import jinja2

from processor.language.messages import NO_NUMBER, label, messages, text


def render(folder: str | Path, name: str, lang: str, /, **values: Any) -> str:
    """Return a page by its template in a folder of this package or of a path, in a language of CODES.

    Templates extend base.html of the reports. They name their texts by ``text`` and ``label``; filter ``say`` writes a
    message, and all else as it is; ``shown`` writes a number with some digits; ``data_uri`` writes an image.
    """
    own = jinja2.FileSystemLoader(folder) if isinstance(folder, Path) else jinja2.PackageLoader("processor", folder)
    loader = jinja2.ChoiceLoader([own, jinja2.PackageLoader("processor", "report")])
    made = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    made.filters |= {"say": messages(lang).text, "shown": _shown, "data_uri": data_uri}
    made.globals |= {"text": text, "label": label}
    return made.get_template(name).render(lang=lang, **values)


def data_uri(image: bytes) -> str:
    """Return a PNG or JPEG image as the address that a page holds it by."""
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode('ascii')}"


def _shown(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}" if math.isfinite(value) else NO_NUMBER
