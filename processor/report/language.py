"""The page in another language: fixed texts looked up, texts with numbers and names in them matched by patterns.

A catalogue is a TOML file beside this one: ``[words]`` are whole texts, ``[sentences]`` texts with ``{}`` where
something stands, in the other language ``{0}``, ``{1}`` ... in whatever order. What stands there is translated in turn
where it can be. A text that is not known is taken apart at full stops, semicolons and commas; what is left of it stays
as it is, and so do names from files.
"""

from __future__ import annotations

import importlib.resources
import re
import sys
from collections.abc import Mapping
from functools import cache

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

CODES = ("en", "zh")
SEPARATORS = (". ", "; ", ": ", ", ")
FULL_WIDTH = {". ": "。", "; ": "；", ": ": "：", ", ": "，"}


class Language:
    """A language of the page, by its code."""

    def __init__(self, code: str) -> None:
        self.code = code
        self.words: Mapping[str, str] = {}
        self._patterns: list[tuple[re.Pattern[str], str]] = []
        self._said: dict[str, str] = {}
        if code != "en":
            found = tomllib.loads((importlib.resources.files("processor.report") / f"{code}.toml").read_text("utf-8"))
            self.words = found["words"]
            self._patterns = [(_pattern(key), text) for key, text in found["sentences"].items()]

    def say(self, text: str) -> str:
        """Translate a text; as it is where it is not known."""
        if not self.words:
            return text
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
            parts = text.split(separator)
            if len(parts) > 1:
                said = [self.say(part) for part in parts]
                if said != parts:
                    return FULL_WIDTH[separator].join(said)
        return text

    def of_scripts(self, scripts: str) -> dict[str, str]:
        """Return the words that the page's own scripts may say."""
        return {key: text for key, text in self.words.items() if key in scripts}


def _pattern(key: str) -> re.Pattern[str]:
    return re.compile("((?:(?!; ).)+?)".join(re.escape(part) for part in key.split("{}")), re.DOTALL)


@cache
def language(code: str) -> Language:
    """Return a language by its code, one of CODES; its catalogue is read once."""
    return Language(code)
