"""Pages in another language: fixed texts looked up, texts with numbers and names in them matched by patterns.

A catalogue is some TOML files beside this one, CODE-PART.toml, in sections, one for each subject. ``[section.words]``
are whole texts, ``[section.sentences]`` texts with places in them, the first that fits is taken. A place is ``{}`` for
anything without "; ", ``{;}`` for anything, ``{#}`` for a number; in the other language they are ``{0}``, ``{1}`` ...
in whatever order.
What stands in a place is translated in turn where it can be. A text that is not known is taken apart at full stops,
semicolons, colons, commas and "and"; what is left of it stays as it is, and so do names from files. A word that means
one thing in a column, say, and another elsewhere is ``column|word`` there.
"""

from __future__ import annotations

import importlib.resources
import re
import sys
from collections.abc import Mapping
from functools import cache
from typing import Any

from processor.language.messages import Text, messages
from processor.model import Word

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CODES = ("en", "zh")
# Files of a catalogue, in the order in which sentences are tried.
PARTS = ("preassemble", "spheres", "stitch", "defects")
SEPARATORS = (" | ", ". ", "; ", ": ", ", ", " and ")
FULL_WIDTH = {" | ": " | ", ". ": "。", "; ": "；", ": ": "：", ", ": "，", " and ": "、"}
PLACES = {
    "{}": "((?:(?!; ).)+?)",
    "{;}": "(.+?)",
    "{#}": r"([-+−]?\d(?:[\d.,]*\d)?(?:e[-+]?\d+)?%?|–|[-+]?(?:nan|inf)%?)",
}
SAID_IN_FIGURES = (
    "title",
    "arrows",
    "values",
    "from",
    "side",
    "verdict",
    "text",
    "regions",
)  # what live figures show that is no name from a file


class Language:
    """A language of the page, by its code."""

    def __init__(self, code: str) -> None:
        self.code = code
        self.words: Mapping[str, str] = {}
        self._patterns: list[tuple[re.Pattern[str], str]] = []
        self._said: dict[str, str] = {}
        if code != "en":
            sections = catalogue(code).values()
            self.words = {key: text for section in sections for key, text in section.get("words", {}).items()}
            sentences = {key: text for section in sections for key, text in section.get("sentences", {}).items()}
            self.words |= {key: text for key, text in messages(code).texts.items() if "{" not in key}
            # A word of a vocabulary may mean something else elsewhere: there the texts come first.
            self.words = {key.split(".")[-1]: text for key, text in messages(code).words.items()} | self.words
            self._patterns = [(_pattern(key), text) for key, text in sentences.items()]

    def say(self, text: Any, within: str = "") -> str:
        """Write a message, or translate a text where it is known; ``within`` distinguishes words of two senses."""
        if isinstance(text, Text) and text.values is None:
            special = self.words.get(f"heading|{text.template}")
            if special is not None or text.template not in messages(self.code).texts:
                text, within = text.template, within or "heading"
        if not isinstance(text, str) or isinstance(text, Word):
            return messages(self.code).text(text)
        if not self.words:
            return text
        if within and (special := self.words.get(f"{within}|{text}")) is not None:
            return special
        if text not in self._said:
            known = self._known(text)
            self._said[text] = self._taken_apart(text) if known is None else known
        return self._said[text]

    def _known(self, text: str) -> str | None:
        if text in self.words:
            return self.words[text]
        for pattern, template in self._patterns:
            found = pattern.fullmatch(text)
            if found:
                return template.format(*(self.say(group) for group in found.groups()))
        return None

    def _taken_apart(self, text: str) -> str:
        if text.endswith("."):
            known = self.say(text[:-1])
            return text if known == text[:-1] else known + "。"
        for separator in SEPARATORS:
            parts = text.split(separator, 1 if separator == ": " else -1)  # what follows a name may hold another
            if len(parts) > 1:
                said = [self.say(part) for part in parts]
                changed = [new != old for new, old in zip(said, parts, strict=True)]
                if all(changed) or (any(changed) and separator != " and "):  # names may be joined by it, too
                    return FULL_WIDTH[separator].join(said)
        return text

    def of_scripts(self, scripts: str) -> dict[str, str]:
        """Return the words that the page's own scripts may say."""
        return {key: text for key, text in self.words.items() if f'"{key}"' in scripts}

    def in_figures(self, data: Any) -> Any:
        """Translate what live figures show: texts, or lists of them, under the keys SAID_IN_FIGURES, at any depth."""
        data = messages(self.code).rendered(data)
        if isinstance(data, dict):
            return {
                key: self._shown(value) if key in SAID_IN_FIGURES else self.in_figures(value)
                for key, value in data.items()
            }
        return [self.in_figures(one) for one in data] if isinstance(data, list) and self.words else data

    def _shown(self, value: Any) -> Any:
        if isinstance(value, str):
            return self.say(value)
        whole = isinstance(value, list) and all(isinstance(one, str) for one in value)
        return [self.say(one) for one in value] if whole else self.in_figures(value)


def catalogue(code: str) -> dict[str, dict[str, dict[str, str]]]:
    """Read a catalogue: words and sentences by section, PART.SECTION."""
    here = importlib.resources.files("processor.language")
    found: dict[str, dict[str, dict[str, str]]] = {}
    for part in PARTS:
        sections = tomllib.loads((here / f"{code}-{part}.toml").read_text("utf-8"))
        found |= {f"{part}.{section}": texts for section, texts in sections.items()}
    return found


def _pattern(key: str) -> re.Pattern[str]:
    parts = re.split(r"(\{[;#]?\})", key)
    stop = "" if key.endswith(".") else r"(?<!\.)"  # a place at the end does not take the text's full stop
    return re.compile("".join(PLACES.get(part) or re.escape(part) for part in parts) + stop, re.DOTALL)


@cache
def language(code: str) -> Language:
    """Return a language by its code, one of CODES; its catalogue is read once."""
    return Language(code)
