"""Jinja2 templates of the pages: values are escaped, messages are written in the page's language."""

from __future__ import annotations

from pathlib import Path

import jinja2

from processor.language.messages import label, messages, text


def environment(folder: str | Path, lang: str) -> jinja2.Environment:
    """Return the environment of the templates in a folder of this package or of a path, for a language of CODES.

    They extend base.html of the reports. They name their texts by ``text`` and ``label``; filter ``say`` writes a
    message, and all else as it is.
    """
    own = jinja2.FileSystemLoader(folder) if isinstance(folder, Path) else jinja2.PackageLoader("processor", folder)
    loader = jinja2.ChoiceLoader([own, jinja2.PackageLoader("processor", "report")])
    made = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    made.filters["say"] = messages(lang).text
    made.globals |= {"text": text, "label": label}
    return made
