"""How a record declares its fields, what their values mean, and how they are checked.

Every record is frozen. Arrays are float64 or int64, checked for their shape and set read-only when the record is
made; an absent array is an empty one. What stands beside the coordinates of each point may be of a smaller type. Lists
of things are kept as columns: ``centres (k, 3)`` beside ``radii (k,)``.
Lengths are in mm, angles in rad. ``T_a_b`` is a 4x4 matrix that maps coordinates in frame b to frame a.

The records are also the HDF5 schema: :mod:`processor.store` walks their fields, so a new record needs no I/O code.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from processor.model.columns import Columns
from processor.model.errors import LONGEST_NAME

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
# Labels and grid numbers have small integer types to save memory; coordinates are always float64.
Labels = npt.NDArray[np.int32]
Codes = npt.NDArray[np.uint8]
Shorts = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]


class RecordError(ValueError):
    """A record was given a value that does not fit its field."""


VOCABULARIES: dict[str, type[Word]] = {}  # by name, for files that hold words among other values


class Word(str, Enum):
    """A word of a fixed vocabulary; its value is the word in files. Subclasses list the words."""

    def __init_subclass__(cls) -> None:
        VOCABULARIES[cls.__name__] = cls

    def __str__(self) -> str:
        return str(self.value)


@dataclass(frozen=True)
class Reason:
    """A statement about a result: a code of the catalogue of messages, and the values that its text names.

    ``values`` are numbers, words of a :class:`Word`, names from the input, further reasons, or tuples of these. The
    text is made by :mod:`processor.language`, in English or Chinese; no program reads it again.
    """

    code: str
    values: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def reason(code: str, /, **values: Any) -> Reason:
    """Return a :class:`Reason`; NumPy numbers among the values become Python numbers."""
    return Reason(
        code, {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    )


# --- How a record declares its fields, and how they are checked


LARGEST_MM = 1e11  # a length beyond it, 100,000 km, is none of a structure; float64 has steps of 0.00002 mm there
SMALLEST_MM = 1e-4  # points are stored in steps of it: no size or noise below it is one
WIDEST_MM = 1e7  # 10 km: no structure is larger; what is made of cells or profiles of one would fill the memory
TUBE_PER_BALL = (
    3.0  # diameters: cones taper tubes to their bolts, so a tube of 245 mm may end at a ball of 80 mm, no more
)
FARTHEST_MM = 2e6  # 2 km: no structure is measured from farther; of scans in mm read as metres the scanners are
SAMPLED_POINTS = 1_000  # of a scan, to be compared with its scanner
MOST_NODES, MOST_MEMBERS, MOST_PARTS = 100_000, 400_000, 1_000  # a hundred times those of the largest known
LONGEST_TEXT = 1 << 20  # a WKT or a message of many lines has some thousands; more are no text


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What the values of a field must be beyond type and shape; :mod:`processor.record_checks` checks it at input.

    Numbers: ``finite``, else NaN stands for unknown; from ``least`` to ``most``, beyond ``above``; infinite only where
    they are ``infinite``; ``rows_of`` names what they are row numbers of, from ``lowest_row`` on (-1 = none).
    Matrices: a ``pose`` (NaN where unknown), which may be ``scaled``; a ``covariance``, symmetric, without a negative
    variance. Names and numbers: ``among`` names the values
    that they may have; ``unique``; ``unlike`` names a column that has another value in each row. Texts: one of
    ``words``; at most ``longest`` characters. A reference is a field of the record, or one of the scene after a "/".
    """

    finite: bool = False
    infinite: bool = False
    pose: bool = False
    scaled: bool = False
    covariance: bool = False
    least: float = float("-inf")
    most: float = float("inf")
    above: float = float("-inf")
    rows_of: str = ""
    lowest_row: int = 0
    among: str = ""
    unique: bool = False
    unlike: str = ""
    words: tuple[str, ...] = ()
    longest: int = LONGEST_NAME


PLACE = Meaning(finite=True, least=-LARGEST_MM, most=LARGEST_MM)
SIZE = Meaning(finite=True, above=SMALLEST_MM, most=LARGEST_MM)
DEVIATION = Meaning(finite=True, least=0.0, most=LARGEST_MM)  # one standard deviation
BOUND = Meaning()  # NaN = none; never infinite
# Of results and truths; NaN where unknown.
NUMBER = Meaning()  # of any sign
COORDINATE = Meaning(least=-LARGEST_MM, most=LARGEST_MM)
RADIUS = Meaning(above=0.0, most=LARGEST_MM)
AMOUNT = Meaning(least=0.0)  # a standard deviation, half-width, distance, area
RATIO = Meaning(least=0.0, infinite=True)  # infinite over nothing
SHARE = Meaning(least=0.0, most=1.0 + 1e-9)  # a quotient of sums may be rounded up
DIRECTION = Meaning(least=-1.0 - 1e-9, most=1.0 + 1e-9)  # a component of a unit vector may be rounded up
COUNT = Meaning(least=0.0)
END = Meaning(least=-1.0)  # the id of a node, -1 = none
OPEN = Meaning(infinite=True)  # -inf or inf: without a bound
POSE = Meaning(pose=True)
SCALED_POSE = Meaning(pose=True, scaled=True)
COVARIANCE = Meaning(covariance=True)
NAMES = Meaning(unique=True)
LONG = Meaning(longest=LONGEST_TEXT)
LARGEST_GRID, GRID_CELLS_PER_POINT = 1 << 28, 1024  # cells of a scanner's grid; of the open sky few have returns
# -1: none; rows and columns up to 16 million, a tenth of a second of arc.
GRID_NUMBER = Meaning(least=-1, most=(1 << 24) - 1)


def column(*shape: int | str, dtype: type = np.float64, **shown: Any) -> Any:
    """Declare an array field.

    ``shape`` holds a number for a fixed axis and a name for a free one; axes of one name have one length within the
    record. Without a value the array is empty. ``shown`` is the metadata of :func:`described`.
    """
    return dataclasses.field(
        default_factory=lambda: np.empty([0 if isinstance(n, str) else n for n in shape] if shape else 0, dtype),
        metadata={"shape": shape, "dtype": dtype, **shown},
    )


def optional(*shape: int, dtype: type = np.float64, **shown: Any) -> Any:
    """Declare an array field of fixed shape that may be absent (then it has size 0)."""
    return dataclasses.field(
        default_factory=lambda: np.empty(0, dtype), metadata={"shape": shape, "dtype": dtype, "optional": True, **shown}
    )


def names(axis: str, **shown: Any) -> Any:
    """Declare a tuple of strings, as long as the axis of that name in the record's arrays."""
    return dataclasses.field(default=(), metadata={"axis": axis, **shown})


def name_lists(axis: str, **shown: Any) -> Any:
    """Declare a tuple of lists of strings, as long as the axis of that name in the record's arrays."""
    return dataclasses.field(default=(), metadata={"axis": axis, "lists": True, **shown})


def words(axis: str, vocabulary: type[Word], **shown: Any) -> Any:
    """Declare a tuple of words of a vocabulary, as long as the axis of that name in the record's arrays."""
    return dataclasses.field(default=(), metadata={"axis": axis, "words": vocabulary, **shown})


def reasons(axis: str = "", **shown: Any) -> Any:
    """Declare a tuple of reasons; with an axis a tuple of reasons for each row along it.

    ``of_text`` turns the text that earlier files hold in their place into reasons. ``hashed_as_text``: the hash of a
    scene is taken from their English text, as it was when the field held that text.
    """
    return dataclasses.field(default=(), metadata={"reasons": axis, **shown})


def described(default: Any = dataclasses.MISSING, **shown: Any) -> Any:
    """Declare a field of a single value with the metadata that files and reports show of it.

    ``words``: the vocabulary of a single word.
    ``unit``: of its numbers. ``heading``: its English name in tables; the field's name without one. ``json``: its key
    in results.json, "a.b" for a key b within a, "" where it is not written; the field's name without one. A star in
    the key stands for the names in ``keys``, which the items of an array (of a column: of its rows) are for. A tuple
    of keys: the value is written under each. ``axes``:
    names along several axes, written as nested objects. ``by``: the column of a nested table by which its rows are
    named in an object. ``sentence``: the key of the English text of reasons. ``optional``: not written where it is
    empty. ``where``: a column is written in rows where the column of this name is finite. ``joined``: HDF5 holds the
    records of a tuple as one table.
    """
    return dataclasses.field(default=default, metadata=shown)


def per_point_fields(record: type) -> tuple[str, ...]:
    """Return the names of the fields of a scan or its labels that have one row per point."""
    fields = dataclasses.fields(record)
    return tuple(field.name for field in fields if field.metadata.get("shape", ("",))[0] == "n")


def newer(hashed: bool = True, **shown: Any) -> Any:
    """Declare a record or a text that came to the schema later: absent, it changes no scene's hash.

    A column with ``newer`` in its metadata is of this kind too: where it is empty it is not stored. Not ``hashed``, it
    never changes the hash: no step reads it, so results stay those of the scene whatever it says.
    """
    return dataclasses.field(default=None, metadata={"newer": True, "hashed": hashed, **shown})


class Fault(NamedTuple):
    """What is impossible in a record: the field within it, and the text to follow its name.

    ``path`` are the names of the fields and the numbers of the records that lead to the field. The text has the row,
    what was expected and what was found: ", row 3: expected ..., found ...", or without a row ": expected ...".
    """

    path: tuple[str, ...]
    text: str


@functools.cache
def _declared(record: type) -> tuple[tuple[str, str, Mapping[str, Any]], ...]:
    """Return name, place in messages and metadata of the fields of a record that are checked when it is made."""
    return tuple(
        (field.name, f"{record.__name__}.{field.name}", field.metadata)
        for field in dataclasses.fields(record)
        if not field.metadata.keys().isdisjoint(("words", "axis", "reasons", "shape"))
    )


class Checked:
    """Checks the declared fields of a frozen dataclass when it is made; holds no data and no behaviour."""

    def __post_init__(self) -> None:
        lengths: dict[str, tuple[int, str]] = {}
        for name, where, metadata in _declared(type(self)):  # type: ignore[arg-type]  # classes can be keys
            value = getattr(self, name)
            if "words" in metadata and "axis" not in metadata:
                object.__setattr__(self, name, _word(metadata["words"], value, where))
            elif "axis" in metadata:
                kind = metadata.get("words", str)
                lists = metadata.get("lists", False)
                value = tuple(tuple(map(str, item)) if lists else _word(kind, item, where) for item in value)
                if value or not metadata.get("newer"):
                    _same_length(lengths, metadata["axis"], len(value), where)
                object.__setattr__(self, name, value)
            elif "reasons" in metadata:
                value = tuple(tuple(row) if metadata["reasons"] else row for row in value)
                if metadata["reasons"]:
                    _same_length(lengths, metadata["reasons"], len(value), where)
                object.__setattr__(self, name, value)
            else:
                object.__setattr__(self, name, _checked_array(value, metadata, where, lengths))

    def contradictions(self) -> Iterable[Fault]:
        """Yield what its fields, each possible, contradict."""
        return ()


class Rows(Columns, Checked):
    """A table stored as columns of one length, a row per item; results.json has a list of its rows."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return max((len(getattr(self, field.name)) for field in dataclasses.fields(self)), default=0)  # type: ignore[arg-type]


def _word(kind: type[str], item: Any, where: str) -> str:
    try:
        return kind(item)
    except ValueError:
        raise RecordError(f"{where}: {item!r} is no {kind.__name__}") from None


def _checked_array(
    value: Any, metadata: Any, where: str, lengths: dict[str, tuple[int, str]]
) -> npt.NDArray[np.generic]:
    shape = metadata["shape"]
    array: npt.NDArray[np.generic] = np.ascontiguousarray(value, dtype=metadata["dtype"])
    absent = array.size == 0
    if absent and metadata.get("optional"):
        array = np.empty(0, metadata["dtype"])
    else:
        if absent:
            array = array.reshape([0 if isinstance(n, str) else n for n in shape])
        fits = array.ndim == len(shape) and all(
            isinstance(want, str) or got == want for got, want in zip(array.shape, shape, strict=True)
        )
        if not fits:
            raise RecordError(f"{where}: expected an array of shape {shape}, got {array.shape}")
        if not absent:
            for got, want in zip(array.shape, shape, strict=True):
                if isinstance(want, str):
                    _same_length(lengths, want, got, where)
    array = array.view()
    array.flags.writeable = False
    return array


def _same_length(lengths: dict[str, tuple[int, str]], axis: str, length: int, where: str) -> None:
    known, first = lengths.setdefault(axis, (length, where))
    if known != length:
        raise RecordError(f"{where}: length {length} along '{axis}', but {first} has {known}")
