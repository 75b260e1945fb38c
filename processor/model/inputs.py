"""Tables that people write in files, declared once: how they are read, what is refused, and their schema.

A table is declared as a frozen dataclass whose fields are its keys; :func:`entry` states of what :class:`Kind` the
values of a key are and what they mean. :func:`read` makes the record of what a file holds; each error names the place,
the key, what was expected and what was found. ``docs/schemas`` is written from the declarations, and
:class:`Parameters` are checked by them however they are made.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Callable, Collection, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from processor.model.errors import InputError, PlainError, UsageError, did_you_mean
from processor.model.fields import Floats

LOG = logging.getLogger("processor.input")
INF = float("inf")
MOST_NAMED = 6  # unknown keys in a warning: more tell nothing further
LARGEST_INTEGER = 2**53  # float64 has every whole number below it
SHOWN = 60  # characters of a value in a message, so that it stays one line
NOTHING = object()  # stands for the value of a key that is missing
NO_FIT = (ValueError, TypeError, OverflowError)

R = TypeVar("R")


class Place:
    """Where a table stands, for messages: its file, or the table of parameters; ``folder`` is that of named files."""

    def __init__(
        self, name: str, error: type[PlainError] = InputError, folder: Path = Path(), separator: str = ": ",
        above: Place | None = None,
    ) -> None:  # fmt: skip
        self.name, self.error, self.folder, self.separator, self.above = name, error, folder, separator, above

    @property
    def where(self) -> str:
        """The names of the tables that lead there; made when a message needs it, as most places have none."""
        return self.name if self.above is None else f"{self.above.where}{self.separator}{self.name}"

    def within(self, key: str) -> Place:
        """Return the place of a key or a table within this one."""
        return Place(key, self.error, self.folder, self.separator, self)

    def refused(self, text: str) -> PlainError:
        """Return the error of the table as a whole."""
        return self.error(f"{self.where}: {text}")

    def refused_key(self, key: str, expected: str, found: str) -> PlainError:
        """Return the error of the value of a key; of parameters by the name that is typed, as in ``stitch.scale``."""
        if self.separator == ".":
            return self.error(f"{self.where}.{key}: expected {expected}, found {found}")
        return self.refused(f"expected {expected} as {key!r}, found {found}")

    def only(self, keys: Collection[str], known: Collection[str], listed: Collection[str] = ()) -> None:
        """Raise the error of the first key that is not known; ``listed`` are those that the message has."""
        for key in keys:
            if key not in known:
                like, names = did_you_mean(key, known), ", ".join(listed or known)
                if self.separator == ".":
                    raise self.error(f"{self.where}.{key}: unknown parameter{like}; known are {names}")
                raise self.refused(f"unknown key {key!r}{like}; known are {names}")


class Kind(NamedTuple):
    """Values of a kind: what is expected of them, how one is converted, and their schema.

    ``convert`` takes the value and the place of its key. It raises an error of the place, or TypeError, ValueError or
    OverflowError where the message is to be the usual one.
    """

    expected: str
    convert: Callable[[Any, Place], Any]
    schema: Mapping[str, Any]
    plain: bool = False  # the place is not looked at: of twenty thousand nodes each key would make one

    def value(self, value: Any, key: str, place: Place) -> Any:
        """Return the value of a key, converted. Raises the error of the place for one of another kind."""
        try:
            if value is NOTHING:
                raise ValueError
            return self.convert(value, place if self.plain else place.within(key))
        except PlainError:
            raise
        except NO_FIT:
            like = did_you_mean(value, self.schema["enum"]) if isinstance(value, str) and "enum" in self.schema else ""
            found = "nothing" if value is NOTHING else shown(value)
            raise place.refused_key(key, self.expected, found + like) from None


def shown(value: Any) -> str:
    """Return a value for a message, or what it is where it is long."""
    if isinstance(value, int) and abs(value) >= 10**SHOWN:  # Python refuses to write out thousands of digits
        return "a number of very many digits"
    if isinstance(value, (str, int, float)):
        return repr(value)[:SHOWN]
    return {list: "a list", dict: "a table", type(None): "null"}.get(type(value), type(value).__name__)


# --- kinds -----------------------------------------------------------------------------------------------------------


def number(
    *, least: float = -INF, most: float = INF, above: float = -INF, below: float = INF,
    whole: bool = False, infinite: bool = False, unknown: bool = False, expected: str = "",
) -> Kind:  # fmt: skip
    """Return numbers in a range, ``whole`` or not; those that may be ``infinite``, or ``unknown`` as NaN, say so."""
    bounds = {"minimum": least, "maximum": most, "exclusiveMinimum": above, "exclusiveMaximum": below}
    bounds = {name: int(bound) if bound == int(bound) else bound for name, bound in bounds.items() if abs(bound) < INF}
    low = f"above {above:g}" if above > -INF else f"of {least:g} or more" if least > -INF else ""
    high = f"below {below:g}" if below < INF else f"at most {most:g}" if most < INF else ""
    of_range = f"from {least:g} to {most:g}" if least > -INF and most < INF else " and ".join(filter(None, (low, high)))
    plain = "a whole number" if whole else "a number" if of_range or infinite else "a finite number"

    def convert(value: Any, _: Place) -> float:
        known = type(value) is int or (type(value) is float and not whole)  # of files all numbers: found at once
        if not known and (isinstance(value, bool) or not isinstance(value, Integral if whole else Real)):
            raise TypeError
        found: float = int(value) if whole else float(value)
        if unknown and found != found:
            return found
        fits = least <= found <= most and (above < found or above == -INF) and (found < below or below == INF)
        if not fits or (abs(found) >= LARGEST_INTEGER if whole else abs(found) == INF and not infinite):
            raise ValueError
        return found

    schema = {"type": "integer" if whole else "number", **bounds}
    return Kind(expected or f"{plain} {of_range}".strip(), convert, schema, True)


def text(*words: str, empty: bool = False, expected: str = "") -> Kind:
    """Return texts, one of ``words`` where these are given, ``empty`` ones only where they may be."""

    def convert(value: Any, _: Place) -> str:
        if not isinstance(value, str) or (value not in words if words else not value and not empty):
            raise ValueError
        return value

    plain: dict[str, Any] = {"type": "string"} if empty else {"type": "string", "minLength": 1}
    schema = {"enum": list(words)} if words else plain
    return Kind(expected or (f"one of {', '.join(words)}" if words else "a text"), convert, schema, True)


def _flag(value: Any, _: Place) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


FLAG = Kind("true or false", _flag, {"type": "boolean"}, True)


def array(*shape: int) -> Kind:
    """Return arrays of finite numbers; -1 in ``shape`` allows any length of an axis."""

    def convert(value: Any, _: Place) -> Floats:
        if np.array(value).dtype.kind in "USb":
            raise TypeError
        found = np.array(value, np.float64)
        fits = found.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, found.shape, strict=True))
        if not fits or not np.isfinite(found).all():
            raise ValueError
        return found

    schema: dict[str, Any] = {"type": "number"}
    for n in reversed(shape):
        schema = {"type": "array", "items": schema, **({} if n < 0 else {"minItems": n, "maxItems": n})}
    return Kind("numbers of shape " + " x ".join("n" if n < 0 else str(n) for n in shape), convert, schema, True)


def listed(item: Kind, expected: str, **schema: Any) -> Kind:
    """Return lists of values of a kind, as tuples."""

    def convert(value: Any, place: Place) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple):
            raise TypeError
        return tuple(item.convert(one, place) for one in value)

    return Kind(expected, convert, {"type": "array", "items": item.schema, **schema})


def table(declared: type) -> Kind:
    """Return tables as declared; ``$table`` in the schema stands for theirs."""
    return Kind("a table", functools.partial(read, declared), {"$table": declared})


def tables(declared: type, **schema: Any) -> Kind:
    """Return lists of tables as declared; of those that ignore unknown keys, one line on them is logged."""

    def convert(value: Any, place: Place) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise TypeError
        if getattr(declared, "IGNORES", False):
            known = keys_of(declared)
            unknown = sorted({key for one in value if isinstance(one, dict) for key in one if key not in known})
            if unknown:
                named, like = ", ".join(map(repr, unknown[:MOST_NAMED])), did_you_mean(unknown[0], known)
                LOG.warning("%s: ignored unknown %s%s", place.where, named, like)
        above = place.above or place
        return tuple(read(declared, one, above.within(f"{place.name} {i}")) for i, one in enumerate(value, 1))

    return Kind("a list", convert, {"type": "array", "items": {"$table": declared}, **schema})


def named_tables(declared: type, **schema: Any) -> Kind:
    """Return tables as declared by their names."""

    def convert(value: Any, place: Place) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise TypeError
        return {name: read(declared, one, place.within(name)) for name, one in value.items()}

    return Kind("a table", convert, {"type": "object", "additionalProperties": {"$table": declared}, **schema})


# --- tables ----------------------------------------------------------------------------------------------------------


def entry(kind: Kind, about: str = "", *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a key; without a ``default`` it must be given.

    What its values mean is the comment beside or above it, else ``about``; documents are written from that.
    """
    return dataclasses.field(default=default, metadata={"kind": kind, "about": about})


def hidden(default: Any) -> Any:
    """Declare a field that is no key. One named ``where`` receives the place of the table."""
    return dataclasses.field(default=default, metadata={"kind": None})


@functools.cache
def keys_of(declared: Any) -> dict[str, tuple[Kind, dataclasses.Field[Any]]]:
    """Return the kind and the field of each key of a table. Plain fields are of the kind of their defaults."""
    keys = {}
    for field in dataclasses.fields(declared):
        kind = field.metadata.get("kind", field)
        if kind is field:
            missing = field.default_factory is dataclasses.MISSING
            kind = _of_default(field.default if missing else field.default_factory())
        if kind is not None:
            keys[field.name] = (kind, field)
    return keys


def _of_default(value: Any) -> Kind:
    """Return the kind of a plain field; of a list, which may be one value, that of its first item, else numbers."""
    if isinstance(value, tuple):
        item = _of_default(value[0] if value else 0.0)

        def convert(given: Any, place: Place) -> tuple[Any, ...]:
            return tuple(item.convert(one, place) for one in (given if isinstance(given, list | tuple) else [given]))

        return Kind(f"{item.expected}, or a list of such", convert, {})
    if dataclasses.is_dataclass(value):
        return table(type(value))
    if isinstance(value, float):
        return number(unknown=value != value)
    return {bool: FLAG, str: text(empty=True), int: number(whole=True)}[type(value)]


class Parameters:
    """Base of records of parameters: what is declared of them holds for those that programs make as well.

    ``table`` is their name in a file of parameters, such as ``preassemble.adjust``.
    """

    PLACE: ClassVar[Place]

    def __init_subclass__(cls, table: str) -> None:
        cls.PLACE = Place(table, UsageError, separator=".")

    def __post_init__(self) -> None:
        for name, (kind, field) in keys_of(type(self)).items():  # type: ignore[arg-type]  # classes can be keys
            if "kind" in field.metadata:
                kind.value(getattr(self, name), name, self.PLACE)


def read(declared: type[R], value: Any, place: Place) -> R:
    """Return the record of a table as a file has it. Raises the error of the place for what is not as declared.

    A method ``contradiction`` of the record returns what the values, each possible, contradict.
    """
    if not isinstance(value, Mapping):
        raise place.refused(f"expected a table of names and values, found {shown(value)}")
    keys = keys_of(declared)  # type: ignore[arg-type]
    if not getattr(declared, "IGNORES", False):
        place.only(value, keys, getattr(declared, "LISTED", ()))
    values = {
        name: kind.value(value.get(name, NOTHING), name, place)
        for name, (kind, field) in keys.items()
        if name in value or (field.default is dataclasses.MISSING is field.default_factory)
    }
    if "where" not in keys and hasattr(declared, "where"):
        values["where"] = place.where
    made = declared(**values)
    contradiction = getattr(made, "contradiction", str)()
    if contradiction:
        raise place.refused(contradiction)
    return made
