"""Names of columns as surveyors and programs write them: which column is x, y or z, and in which unit of length.

East is x, north is y and up is z, whatever the order of the columns. A letter beside a direction does not count: in
``X (North)`` and ``北坐标(X)``, as maps of Gauss-Krueger and of China have it, the column is north, so y.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

UNIT_WORDS = {
    **{unit: unit for unit in ("mm", "cm", "dm", "m", "km", "inch", "ft", "us-ft")},
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters", "毫米"), "mm"),
    **dict.fromkeys(("centimetre", "centimetres", "centimeter", "centimeters", "厘米"), "cm"),
    **dict.fromkeys(("metre", "metres", "meter", "meters", "米"), "m"),
    **dict.fromkeys(("in", "inches"), "inch"),
    **dict.fromkeys(("foot", "feet"), "ft"),
    **dict.fromkeys(("us ft", "usft", "ft us", "ftus", "us feet", "us foot", "us survey feet"), "us-ft"),
    "us survey foot": "us-ft",
}
# Of a word: the axis that it names; E, N and H count as names only together with each other.
LETTERS = {"x": "x", "y": "y", "z": "z"}
DIRECTIONS = {
    "east": "e east easting eastings ost rechtswert rechts est este 东 东向",
    "north": "n north northing northings nord hochwert hoch norte 北 北向",
    "up": "h up height heights elevation elevations elev altitude alt hohe hoehe quota cota altura elevacion altitud "
    "hauteur rl 高 高程 高度 标高 海拔",
}
FILLERS = {"point", "points", "pt", "pos", "position", "cartesian", "wert", "value"}
COORDINATE = r"coord(inate|enada|onnee|inata)?s?|koordinate[n]?|坐标"
NUMBERED = {"0": "x", "1": "y", "2": "z"}  # columns of a vector, as in Points:0
POLAR = {"range", "distance", "rho", "theta", "phi", "azimuth", "zenith", "bearing", "hz", "slope"}
GEOGRAPHIC = {"lon", "long", "longitude", "lat", "latitude", "经度", "纬度"}
OTHERS = {
    *("row", "col", "column", "line", "intensity", "reflectance", "amplitude", "red", "green", "blue", "r", "g", "b"),
    *("nx", "ny", "nz", "id", "classification", "class", "station", "time", "name", "点号", "行", "列", "强度"),
}
_WORDS = {word: axis for axis, words in DIRECTIONS.items() for word in words.split()}


class Meaning(NamedTuple):
    """What a name says: an axis (x, y, z, east, north, up; "" for none) and a unit of length ("" for none)."""

    axis: str
    unit: str


@dataclass(frozen=True)
class Coordinates:
    """The columns of x, y and z, counted from 0, and the unit that each name gives, "" for none."""

    columns: tuple[int, int, int]
    units: tuple[str, str, str]


class AmbiguousNamesError(ValueError):
    """Names that give an axis to more than one column."""


def meaning(name: str) -> Meaning:
    """Return the axis and the unit that a column's name states; no axis where any word of it is unknown."""
    words, unit = _words(name)
    vector = len(words) == 2 and words[0] in ("point", "points", "position") and words[1] in NUMBERED
    if vector:
        return Meaning(NUMBERED[words[1]], unit)
    words = [word for word in words if word not in FILLERS]
    if not all(word in LETTERS or word in _WORDS for word in words):
        return Meaning("", unit)
    directions = {_WORDS[word] for word in words if word in _WORDS}
    letters = {word for word in words if word in LETTERS}
    if directions == {"up"}:
        return Meaning("" if letters - {"z"} else "z" if letters else "up", unit)
    named = directions or letters
    # A map's letter is of the horizontal plane: north may be X, never Z.
    return Meaning(named.pop() if len(named) == 1 and not (directions and "z" in letters) else "", unit)


def coordinates(names: Sequence[str]) -> Coordinates | None:
    """Return the columns of x, y and z by their names: ``x y z``, or east, north and up; None unless all are named.

    Raises AmbiguousNamesError where two columns have the same meaning.
    """
    meanings = [meaning(name) for name in names]
    at = {axis: [i for i, one in enumerate(meanings) if one.axis == axis] for axis in (*LETTERS, *DIRECTIONS)}
    by_letter, by_direction = (at["x"] and at["y"]), (at["east"] and at["north"])
    if by_letter and by_direction:
        if any(len(_words(names[i])[0][0]) > 1 for i in (*at["east"], *at["north"])):
            _refuse(names, [*at["x"], *at["y"], *at["east"], *at["north"]])
        by_direction = []  # columns E and N beside x and y are other quantities
    horizontal = (at["x"], at["y"]) if by_letter else (at["east"], at["north"]) if by_direction else ((), ())
    height = at["z"] if by_letter and at["z"] else [*at["z"], *at["up"]]
    axes = [*horizontal, height]
    if not all(axes):
        return None
    for columns in axes:
        if len(columns) > 1:
            _refuse(names, columns)
    x, y, z = (columns[0] for columns in axes)
    return Coordinates((x, y, z), (meanings[x].unit, meanings[y].unit, meanings[z].unit))


def count_known(names: Iterable[str]) -> int:
    """Return how many of the names are of coordinates, polar or geographic ones, colours or the like."""
    known = POLAR | GEOGRAPHIC | OTHERS
    return sum(bool(meaning(name).axis) or known.issuperset(_words(name)[0]) for name in names)


def other_kind(names: Iterable[str]) -> str:
    """Return "polar" or "geographic" where the names are of such coordinates, else ""."""
    words = {word for name in names for word in _words(name)[0]}
    return "polar" if len(words & POLAR) > 1 else "geographic" if words & GEOGRAPHIC else ""


def _refuse(names: Sequence[str], columns: Sequence[int]) -> None:
    listed = ", ".join(names[i] for i in sorted(columns))
    raise AmbiguousNamesError(f"expected one column each of x, y, z, found more ({listed})")


def _words(name: str) -> tuple[list[str], str]:
    """Return the words of a name in lower case, without accents, and the unit in brackets or at its end."""
    text = unicodedata.normalize("NFKC", name).strip("\"' ")
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text).lower()
    text = "".join(mark for mark in unicodedata.normalize("NFKD", text) if not unicodedata.combining(mark))
    unit = ""
    for bracket in re.findall(r"[(\[{<]([^)\]}>]*)[)\]}>]?", text):
        inside = " ".join(re.findall(r"[^\W\d_]+", bracket))
        if inside in UNIT_WORDS:
            unit, text = UNIT_WORDS[inside], text.replace(bracket, " ")
    words = re.findall(r"[a-z]+|\d+|[^\W\d_a-z]+", re.sub(COORDINATE, " ", text))
    for count in (3, 2, 1):
        if not unit and len(words) > count and " ".join(words[-count:]) in UNIT_WORDS:
            unit, words = UNIT_WORDS[" ".join(words[-count:])], words[:-count]
    return words or [""], unit
