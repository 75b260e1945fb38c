"""Components and stations from the names of files: in English, in Chinese, by numbers."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

DIGITS = {digit: str(i) for i, digit in enumerate("零一二三四五六七八九")}
# Terms with their synonyms as patterns: Chinese, longer words before their parts, and English.
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
    """Return a name in lower case, with Chinese numbers as digits and synonyms replaced by one term."""
    text = _latin_digits(name)
    for word, chinese, english in WORDS:
        text = re.sub(rf"{chinese}|(?<![a-z])(?:{english})(?![a-z])", f" {word} ", text)
    return " ".join(text.split())


def _spaced(name: str) -> str:
    """Return a name with spaces for what stands for them in names of files."""
    return " ".join(re.split(r"[\s_./-]+", name))


def _latin_digits(name: str) -> str:
    """Return a name in lower case, with Chinese numbers up to 99 as digits."""
    text = unicodedata.normalize("NFKC", name).casefold()
    text = re.sub(r"([一二三四五六七八九])?十([一二三四五六七八九])?", _tens, text)
    return "".join(DIGITS.get(c, c) for c in text)


def _tens(match: re.Match[str]) -> str:
    tens, ones = (DIGITS.get(digit or "", "") for digit in match.groups())
    return f"{tens or 1}{ones or 0}"


def components(stem: str, names: Sequence[str]) -> list[str]:
    """Return the components, of those in ``names``, that the stem of a file can refer to.

    In this order: the component's full name; its word and number (``拱肋2``, ``2号拱肋``, ``Rib_02_scan``); its word
    alone. A number alone refers to none: scans are numbered as they were made.
    """
    text = plain(stem)
    exact = [name for name in names if _spaced(plain(name)) == _spaced(text)]
    if exact:
        return exact
    by_number, by_word = [], []
    for name in names:
        term = plain(name)
        digits = re.search(r"\d+$", term)
        word = term[: digits.start() if digits else None].strip(" _-.")
        latin = re.fullmatch(r"[a-z ]+", word)  # such a word must not be part of a longer one
        if not word or not (re.search(rf"(?<![a-z]){word}(?![a-z])", text) if latin else word in text):
            continue
        by_word.append(name)
        number, literal = digits[0].lstrip("0") if digits else "", re.escape(word)
        beside = rf"{literal}{NUMBERED}0*{number}(?!\d)|(?<!\d)0*{number}{NUMBERED}{literal}"
        by_number += [name] if not digits or re.search(beside, text) else []
    return by_number or by_word


def station(stem: str) -> str:
    """Return the station named in the stem of a file, such as S3; "" for none."""
    text = _latin_digits(stem)
    match = re.search(r"(?:^|[\s_\-.])(?:s|st|station|setup|pos|position)[\s_\-.]*0*(\d+)(?!\d)", text)
    match = match or re.search(r"(?:测站|站点|站)[\s_\-.]*0*(\d+)|(?:第)?0*(\d+)[号\s]*(?:测站|站点|站)", text)
    return f"S{next(number for number in match.groups() if number)}" if match else ""


def numbered_backwards(names: Sequence[str]) -> bool:
    """Whether the numbers of names in order fall wherever a word has several, and rise nowhere."""
    of_word = defaultdict(list)
    for name in names:
        match = re.search(r"(\d+)\D*$", plain(name))
        if match:
            of_word[plain(name)[: match.start()].strip(" _-.")].append(int(match[1]))
    steps = [b - a for numbers in of_word.values() for a, b in pairwise(numbers)]
    return bool(steps) and max(steps) < 0
