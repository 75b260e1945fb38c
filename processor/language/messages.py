"""Messages in English and Chinese: templates with named values, looked up by code or by their English text.

The catalogue of a language is the TOML files CODE-PART.toml beside this file, in sections:

- ``[reasons]``: the template of each code of a :class:`processor.model.Reason`; all languages have the same codes.
- ``[texts]`` (not English): the template for each English template of a :class:`Text`.
- ``[words]`` (not English): words of vocabularies, ``Class.word`` or, for all classes, ``word``.
- ``[headings]`` (not English): headings of columns and their units, where ``[texts]`` has none or another sense.

Templates have the syntax of :meth:`str.format` with named fields. Fields without a format have three decimals where
they are numbers. ``{n:?scan|scans}`` is the first word for n = 1 and the second otherwise. Values that are messages or
words are translated. Lists are joined by commas, lists of reasons and ``{list:;}`` by semicolons; ``{list:.}`` writes
sentences.
"""

from __future__ import annotations

import importlib.resources
import math
import string
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from processor.model import Reason, Word
from processor.plain_text import printable, tomllib

CODES = ("en", "zh")
LIST = {"en": ", ", "zh": "、"}
SEMICOLON = {"en": "; ", "zh": "；"}
NO_NUMBER = "–"


@dataclass(frozen=True)
class Text:
    """A text of the program's own: its English template, and the values of the template's fields.

    Without values (None) the template is a text without fields, whatever braces it has.
    """

    template: str
    values: Mapping[str, Any] | None = field(default_factory=dict)

    def __str__(self) -> str:
        """Return the text in English."""
        return messages("en").text(self)


def text(template: str, /, **values: Any) -> Text:
    """Return a :class:`Text`."""
    return Text(template, values)


def label(english: str) -> Text:
    """Return a text without fields, which may be a name: translated where a catalogue has exactly this text."""
    return Text(english, None)


Message = Text | Reason | Word


class Messages(string.Formatter):
    """The catalogue of one language."""

    def __init__(self, code: str) -> None:
        self.code = code
        self.reasons: dict[str, str] = {}
        self.texts: dict[str, str] = {}
        self.words: dict[str, str] = {}
        self.headings: dict[str, str] = {}
        for sections in catalogue(code).values():
            self.reasons |= sections.get("reasons", {})
            self.texts |= sections.get("texts", {})
            self.words |= sections.get("words", {})
            self.headings |= sections.get("headings", {})

    def text(self, message: Any) -> str:
        """Write a message, a list of messages, a number, or a name, which stays as it is."""
        if isinstance(message, Text):
            template = self.texts.get(message.template, message.template)
            return template if message.values is None else self.vformat(template, (), message.values)
        if isinstance(message, Reason):
            known = self.reasons.get(message.code)
            return message.code if known is None else self.vformat(known, (), message.values)
        if isinstance(message, Word):
            word = str(message)
            return self.words.get(f"{type(message).__name__}.{word}", self.words.get(word, word))
        if isinstance(message, list | tuple):
            separators = SEMICOLON if any(isinstance(item, Reason) for item in message) else LIST
            return separators[self.code].join(map(self.text, message))
        return self.format_field(message, "")

    def heading(self, english: str) -> str:
        """Write the heading of a column, or its unit."""
        return self.headings.get(english) or self.texts.get(english, english)

    def format_field(self, value: Any, format_spec: str) -> str:
        """Write one value of a template."""
        if format_spec.startswith("?"):
            singular, _, plural = format_spec[1:].partition("|")
            return singular if value == 1 else plural
        if isinstance(value, float) and not math.isfinite(value):
            return NO_NUMBER
        if format_spec == ".":
            return self.sentences(value)
        if format_spec == ";":
            return SEMICOLON[self.code].join(map(self.text, value))
        if isinstance(value, Text | Reason | Word | list | tuple):
            return self.text(value)
        if isinstance(value, float) and not format_spec:
            return f"{value:.3f}"
        # Names come from outside: a terminal may obey their control characters.
        return format(printable(value) if isinstance(value, str) else value, format_spec)

    def sentences(self, messages: Iterable[Message]) -> str:
        """Write messages one after the other, as sentences; names keep their case."""
        stop, space = ("。", "") if self.code == "zh" else (".", " ")
        sentences = []
        for message in messages:
            written = self.text(message)
            if not self._starts_with_name(message):
                written = written[:1].upper() + written[1:]
            sentences.append(written + ("" if written.endswith((stop, "?")) else stop))
        return space.join(sentences)

    def _starts_with_name(self, message: Any) -> bool:
        """Tell whether a message starts with a value that is a name from the input."""
        if isinstance(message, list | tuple):
            return bool(message) and self._starts_with_name(message[0])
        if not isinstance(message, Text | Reason):
            return isinstance(message, str) and not isinstance(message, Word)
        if isinstance(message, Text):
            template = self.texts.get(message.template, message.template)
        else:
            template = self.reasons.get(message.code, message.code)
        literal, name, *_ = next(iter(self.parse(template)), ("", None))
        return not literal and bool(name) and self._starts_with_name((message.values or {}).get(name or ""))

    def of_scripts(self, scripts: str) -> dict[str, str]:
        """Return the texts that the page's own scripts show: those that stand there between quotation marks."""
        return {key: value for key, value in self.texts.items() if f'"{key}"' in scripts}

    def rendered(self, data: Any) -> Any:
        """Write all messages within dictionaries and lists; all else stays as it is."""
        if isinstance(data, Text | Reason | Word):
            return self.text(data)
        if isinstance(data, Mapping):
            return {key: self.rendered(value) for key, value in data.items()}
        return [self.rendered(value) for value in data] if isinstance(data, list | tuple) else data


def catalogue(code: str) -> dict[str, dict[str, dict[str, str]]]:
    """Read the files of a language: by file and section a dictionary of templates."""
    return {path.name: tomllib.loads(path.read_text("utf-8")) for path in _files(code)}


def _files(code: str) -> Iterator[Any]:
    folder = importlib.resources.files("processor.language")
    return iter(
        sorted((file for file in folder.iterdir() if file.name.startswith(f"{code}-")), key=lambda one: one.name)
    )


@cache
def messages(code: str) -> Messages:
    """Return the catalogue of a language, one of CODES; its files are read once."""
    return Messages(code)
