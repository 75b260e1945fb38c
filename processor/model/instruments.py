"""Scanners as instruments: what is known of the errors of a class, or of one instrument that was checked.

One file format for both packages: the classes are in ``scanners.toml`` beside this module, an instrument of one's own
is a file with the keys of one class, see ``docs/instruments.md``. What a file does not give is that of its class.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, make_dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from processor.model.errors import did_you_mean
from processor.model.fields import LONG, NUMBER, Checked, Fault, Floats, Meaning, column, described, names
from processor.model.inputs import NOTHING, Kind, Place, entry, number, read, shown, text
from processor.plain_text import tomllib

ASSUMED = "phase"  # where nobody says what the scanner was


@cache
def classes() -> dict[str, dict[str, Any]]:
    """Return the classes of scanners by their names, as ``scanners.toml`` has them."""
    content: dict[str, dict[str, Any]] = tomllib.loads(
        (resources.files("processor.model") / "scanners.toml").read_text("utf-8")
    )
    return content


def unknown(value: str) -> str:
    """Return what was expected in place of a text that is neither a class nor a file."""
    known = class_names()
    return f"expected one of {', '.join(known)}, or a scanner.toml, found {shown(value)}{did_you_mean(value, known)}"


class Known(NamedTuple):
    """A number of an instrument, with its standard deviation; 0 = of a class, which states none."""

    value: float
    sd: float


def _known(bias: bool, least: float, most: float) -> Kind:
    """Return numbers, or tables of ``value`` and ``sd``.

    Of a ``bias``, which may have either sign, a number alone is its standard deviation about 0.
    """
    one, several = number(least=least, most=most), number(least=-most if bias else least, most=most)
    expected = f"{one.expected}, or {{value = ..., sd = ...}} of such"

    def convert(value: Any, place: Place) -> Known:
        if not isinstance(value, Mapping):
            found = one.convert(value, place)
            return Known(0.0, found) if bias else Known(found, 0.0)
        place.only(value, Known._fields)
        return Known(
            *(kind.value(value.get(key, NOTHING), key, place) for key, kind in (("value", several), ("sd", SD)))
        )

    return Kind(expected, convert, {"anyOf": [one.schema, {"type": "object", "required": list(Known._fields)}]})


SD = number(least=0.0, most=1e4)  # as the widest of TERMS
# Errors that a file may give. The bounds tell units apart: no scanner's set-up is known to a hundredth of a millimetre,
# and none is off by a decimetre or by half a degree.
TERMS: Mapping[str, Kind] = {
    "view_mm": _known(False, 0.01, 100.0),  # error of range that the points of one view share, one standard deviation
    "zero_mm": _known(True, 0.0, 100.0),  # offset of all ranges of the instrument: measured less true
    "scale_ppm": _known(True, 0.0, 1000.0),  # scale of its ranges: measured over true, less 1
    "incidence_mm": _known(False, 0.01, 100.0),  # bias of range at 60 degrees of incidence, one standard deviation
    "horizontal_urad": _known(False, 0.1, 1e4),  # horizontal direction to a target, one standard deviation
    "vertical_urad": _known(False, 0.1, 1e4),
}
BIASES = ("zero_mm", "scale_ppm")


def class_names() -> tuple[str, ...]:
    """Return the classes that say what an instrument's errors are."""
    return tuple(name for name, numbers in classes().items() if set(TERMS) <= set(numbers))


@dataclass(frozen=True)
class Instrument(Checked):
    """The scanner of some scans: its class and errors, and by what check these are known.

    Each of TERMS has a ``value`` and its ``sd``. ``checked`` is the day of the check, YYYY-MM-DD; "" = the errors are
    those that are assumed of the class. ``scans`` names the scans that it measured; () = all others.
    """

    name: str = ""
    scanner_class: str = ASSUMED
    serial: str = ""
    checked: str = ""
    source: str = described("", means=LONG)
    terms: tuple[str, ...] = names("t", means=Meaning(words=tuple(TERMS), unique=True))
    value: Floats = column("t", means=NUMBER)
    sd: Floats = column("t", means=Meaning(finite=True, least=0.0))
    scans: tuple[str, ...] = names("s", means=Meaning(among="/scans.name"))

    @property
    def known(self) -> dict[str, Known]:
        """The errors by their names."""
        rows = zip(self.terms, self.value.tolist(), self.sd.tolist(), strict=True)
        return {term: Known(value, sd) for term, value, sd in rows}

    def contradictions(self) -> Iterable[Fault]:
        """Yield that the class is not known, or an error is missing."""
        if self.scanner_class not in class_names():
            yield Fault(
                ("scanner_class",), f": expected one of {', '.join(class_names())}, found {self.scanner_class!r}"
            )
        if missing := set(TERMS) - set(self.terms):
            yield Fault(("terms",), f": expected {', '.join(sorted(missing))}, too")


def of_class(name: str = ASSUMED) -> Instrument:
    """Return what is assumed of an instrument of a class."""
    numbers = classes()[name]
    place = Place("scanners.toml").within(name)
    known = {term: kind.value(numbers[term], term, place) for term, kind in TERMS.items()}
    return made(known, name=name, scanner_class=name, source=numbers["source"])


def made(known: Mapping[str, Known], **about: Any) -> Instrument:
    """Return the instrument of errors by their names; ``about`` are its other fields."""
    return Instrument(
        terms=tuple(known),
        value=np.array([one.value for one in known.values()]),
        sd=np.array([one.sd for one in known.values()]),
        **about,
    )


def _day(value: Any, place: Place) -> str:
    if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
        return value.isoformat()
    return datetime.date.fromisoformat(value).isoformat()


@dataclass(frozen=True)
class _About:
    """What a file of one scanner says beside its numbers."""

    scanner_class: str = entry(text(*class_names()))  # of what the file does not give
    about: str = entry(text(), default="")  # its name, as of its maker
    serial: str = entry(text(), default="")
    checked: str = entry(Kind("a day, YYYY-MM-DD", _day, {"type": "string"}), default="")
    source: str = entry(text(), default="")  # of the numbers: by what check, of whom
    verified: bool = False  # all numbers were compared with an instrument

    def contradiction(self) -> str:
        """Return that a check names no instrument, or nobody says what it was, or what it found."""
        if not self.checked:
            return ""
        missing = [key for key in ("about", "serial", "source") if not getattr(self, key)]
        found = f"expected {', '.join(missing)} of an instrument that was checked, found nothing"
        return found if missing else ""


def _of_simulation(key: str, value: Any) -> tuple[str, type, Any]:
    """Return the field of a number that the simulation alone reads."""
    if isinstance(value, str):
        return key, str, entry(text("phase", "pulse"), default="")
    signed = key in ("signal_power", "bias_signal_mm")
    return key, float, entry(number() if signed else number(least=0.0), default=math.nan)


ScannerFile = make_dataclass(
    "ScannerFile",
    [
        *((term, Known, entry(kind, default=None)) for term, kind in TERMS.items()),
        *(
            _of_simulation(key, value)
            for key, value in classes()[ASSUMED].items()
            if key not in (*TERMS, *_About.__dataclass_fields__)
        ),
    ],
    bases=(_About,),
    frozen=True,
)


def from_file(content: Any, place: Place) -> Instrument:
    """Return the instrument of a file as read, what it does not give by its class. Raises the error of the place."""
    given: Any = read(ScannerFile, content, place)
    known = of_class(given.scanner_class).known | {
        term: found for term in TERMS if (found := getattr(given, term)) is not None
    }
    return made(
        known,
        name=given.about or given.scanner_class,
        scanner_class=given.scanner_class,
        serial=given.serial,
        checked=given.checked,
        source=given.source,
    )


def simulated(content: Any, place: Place) -> dict[str, Any]:
    """Return the numbers of a file as read that the simulation takes, what it does not give by its class."""
    made_of, given = from_file(content, place), dict(content)
    if "view_mm" in given:
        given["offset_mm"] = made_of.known["view_mm"].value
    given["scale_ppm"] = math.hypot(*made_of.known["scale_ppm"])
    return classes()[made_of.scanner_class] | given
