"""Which component of a design a file's name means: in English, in Chinese, by numbers."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

DIGITS = {one: str(i) for i, one in enumerate("零一二三四五六七八九")}
# What one thing is called, in Chinese, longer words before those they hold, and in English.
WORDS = (
    ("foot", "拱脚|拱座|拱足|起拱段", "springing|springer|skewback|footing|feet|foot"),
    ("rib", "拱肋|拱段|肋段|肋", "ribs?|arch[ _-]?segment|segment|seg"),
    ("crown", "拱顶|合龙段|合拢段", "crown|keystone|closure"),
    ("girder", "主梁|纵梁|箱梁", "girder"),
    ("beam", "横梁|梁", "beam"),
    ("column", "立柱|柱", "column|pillar"),
)
NUMBERED = r"[\s_\-.#号段节第no]*"  # between a word and its number


def plain(name: str) -> str:
    """Return a name in small letters, Chinese numbers as digits, and words for one thing as one word."""
    text = unicodedata.normalize("NFKC", name).casefold()
    text = re.sub(r"([一二三四五六七八九])?十([一二三四五六七八九])?", _tens, text)
    text = "".join(DIGITS.get(one, one) for one in text)
    for word, chinese, english in WORDS:
        text = re.sub(rf"{chinese}|(?<![a-z])(?:{english})(?![a-z])", f" {word} ", text)
    return " ".join(text.split())


def _tens(match: re.Match[str]) -> str:
    tens, ones = (DIGITS.get(one or "", "") for one in match.groups())
    return f"{tens or 1}{ones or 0}"


def meant(stem: str, components: Sequence[str]) -> list[str]:
    """Return the components that a file's stem may mean; none where the name says nothing.

    A name of its own counts first, then word and number (``拱肋2``, ``2号拱肋``, ``Rib_02_scan``), then the word alone,
    then, where there is nothing but a number, the place in the order.
    """
    text = plain(stem)
    exact = [one for one in components if plain(one) == text]
    if exact:
        return exact
    numbered, worded = [], []
    for one in components:
        said = plain(one)
        digits = re.search(r"\d+$", said)
        word = said[: digits.start() if digits else None].strip(" _-.")
        if not word or not _holds(text, word):
            continue
        numbered += [one] if digits is None or _numbers(text, word, digits[0].lstrip("0")) else []
        worded.append(one)
    if numbered or worded:
        return numbered or worded
    numbers = re.findall(r"\d+", text)
    if len(numbers) == 1 and not re.search(r"[^\W\d_]", re.sub(r"scan|part|no|号|段|节|第|扫描|构件", "", text)):
        place = int(numbers[0])
        return [components[place - 1]] if 1 <= place <= len(components) else []
    return []


def _holds(text: str, word: str) -> bool:
    """Whether a word is in a text: one of Latin letters on its own, not within another."""
    latin = re.fullmatch(r"[a-z ]+", word) is not None
    return bool(re.search(rf"(?<![a-z]){word}(?![a-z])", text)) if latin else word in text


def _numbers(text: str, word: str, number: str) -> bool:
    """Whether a word stands beside a number in a text."""
    after = rf"{re.escape(word)}{NUMBERED}0*{number}(?!\d)"
    before = rf"(?<!\d)0*{number}{NUMBERED}{re.escape(word)}"
    return bool(re.search(after, text) or re.search(before, text))


def station(stem: str) -> str:
    """Return the station that a file's stem names, e.g. S3; empty where it names none."""
    text = unicodedata.normalize("NFKC", stem).casefold()
    text = "".join(DIGITS.get(one, one) for one in text)
    found = re.search(r"(?:^|[\s_\-.])(?:s|st|station|setup|pos|position)[\s_\-.]*0*(\d+)(?!\d)", text)
    found = found or re.search(r"(?:测站|站点|站)[\s_\-.]*0*(\d+)|(?:第)?0*(\d+)[号\s]*(?:测站|站点|站)", text)
    return f"S{next(one for one in found.groups() if one)}" if found else ""
