"""The records that travel between the parts of the project.

Every record is frozen. Arrays are float64 or int64, checked for their shape and set read-only when the record is
made; an absent array is an empty one. What stands beside the coordinates of each point may be of a smaller type. Lists
of things are kept as columns: ``centres (k, 3)`` beside ``radii (k,)``.
Lengths are in mm, angles in rad. ``T_a_b`` is a 4x4 matrix that maps coordinates in frame b to frame a.

The records are also the HDF5 schema: :mod:`processor.store` walks their fields, so a new record needs no I/O code.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from processor import large_arrays

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
LONGEST_NAME = 256
LONGEST_TEXT = 1 << 20


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
DIRECTION = Meaning(least=-1.0 - 1e-9, most=1.0 + 1e-9)
COUNT = Meaning(least=0.0)
END = Meaning(least=-1.0)  # the id of a node, -1 = none
OPEN = Meaning(infinite=True)  # -inf or inf: without a bound
POSE = Meaning(pose=True)
SCALED_POSE = Meaning(pose=True, scaled=True)
COVARIANCE = Meaning(covariance=True)
NAMES = Meaning(unique=True)
LONG = Meaning(longest=LONGEST_TEXT)
LARGEST_GRID, GRID_CELLS_PER_POINT = 1 << 28, 1024  # cells of a scanner's grid; of the open sky few have returns
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


class Rows(Checked):
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


# --- Vocabularies and constants


NORMAL_95 = 1.959963984540054  # standard deviations of a normal value that hold it in 95 % of cases
KEY_POINTS = ("P1", "P2", "P3", "P4", "P5", "P6", "P7", "P8")
ENDS = ("start", "end")
KINDS = ("arch-bridge", "space-frame", "structure")


class Status(Word):
    """How far a result can be relied on: of a step, or of one of its components or scans."""

    OK = "ok"
    PARTIAL = "partial"  # of a step: some of its parts have no result
    AMBIGUOUS = "ambiguous"  # another solution fits about as well
    WEAK = "weak"  # the data do not determine it well
    FAILED = "failed"


class Verdict(Word):
    """The outcome of a comparison with limits, at 95 % confidence."""

    PASS = "pass"
    FAIL = "fail"
    INDETERMINATE = "indeterminate"
    NONE = "none"  # nothing is limited


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return " (did you mean ...?)" with the names most like one that is not known; nothing where none is like it."""
    by_form = {_plain(one): one for one in known}
    like = [by_form[form] for form in difflib.get_close_matches(_plain(name), by_form, n=2, cutoff=0.6)]
    return f" (did you mean {' or '.join(map(repr, like))}?)" if like else ""


def _plain(name: str) -> str:
    """Return a name without case and separators, as names are mistyped."""
    return "".join(character for character in name[:LONGEST_NAME].lower() if character.isalnum())


LONGEST_WORD, LONGEST_MESSAGE = 1_000, 6_000


class PlainError(ValueError):
    """An error of one message for people; of what came by the megabyte, the message shows the beginning.

    It is a ValueError, as callers of the Python interface expect of wrong arguments: where code catches ValueError
    around what may raise one of these, it lets these pass first.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_shortened(message))


def _shortened(message: str) -> str:
    short = re.sub(rf"\S{{{LONGEST_WORD},}}", lambda word: f"{word[0][: LONGEST_WORD // 5]}...", message)
    cut = len(short) - LONGEST_MESSAGE
    return f"{short[:LONGEST_MESSAGE]}... ({cut} characters more)" if cut > 0 else short


class InputError(PlainError):
    """Input that cannot be used. The message names the file, what was expected, what came and what to do.

    ``path`` is the file or folder that the message begins with, None where it begins otherwise; ``problem`` is the
    message without it.
    """

    def __init__(self, problem: str = "", *, path: Path | str | None = None) -> None:
        super().__init__(problem if path is None else f"{path}: {problem}")
        self.path = None if path is None else Path(path)
        self.problem = _shortened(problem)


WORST_FIRST = (Verdict.FAIL, Verdict.INDETERMINATE, Verdict.PASS)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the worst of verdicts: fail, then indeterminate, then pass; none of none."""
    known = set(verdicts)
    return next((verdict for verdict in WORST_FIRST if verdict in known), Verdict.NONE)


class UsageError(PlainError):
    """A command, recipe or parameter that the program does not understand; the message says what it would take."""


# --- the scene: all that a step may read --------------------------------------------------------------------------


@dataclass(frozen=True)
class Scan(Checked):
    """One scan, or one merged cloud.

    The scan's frame is the one its file uses, in mm. ``points`` are relative to ``origin``: the coordinate in the
    scan's frame is ``origin + points``, so a georeferenced cloud keeps its precision.
    """

    name: str
    points: Floats = column("n", 3, means=PLACE)
    origin: Floats = dataclasses.field(
        default_factory=lambda: np.zeros(3), metadata={"shape": (3,), "dtype": np.float64, "means": PLACE}
    )
    intensity: Floats = column("n")
    # row of Scene.stations a point was seen from, -1 = unknown
    point_station: Labels = column("n", dtype=np.int32, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    # of the scanner's grid: of one height; -1 = not on a grid
    grid_row: Labels = column("n", dtype=np.int32, means=GRID_NUMBER)
    grid_column: Labels = column("n", dtype=np.int32, means=GRID_NUMBER)  # of one direction about the scanner's axis
    component: str = ""  # arch bridge: the part this is a scan of
    station: str = ""
    position: Floats = optional(3, means=PLACE)  # of the scanner, in the scan's frame
    T_project_scan: Floats = optional(
        4, 4, means=PLACE
    )  # absent: the scan is in the project's frame already, or its pose is unknown
    # range noise, one standard deviation; NaN = unknown
    sigma_mm: float = described(float("nan"), means=Meaning(least=0.0, most=1_000.0))
    colour: Codes = column("n", 3, dtype=np.uint8, newer=True)  # red, green, blue

    @property
    def pose(self) -> Floats:
        """T_project_scan (4, 4); the identity for a scan without a pose."""
        return self.T_project_scan if self.T_project_scan.size else np.eye(4)

    def contradictions(self) -> Iterable[Fault]:
        """Yield that a few points claim a grid that fills the memory, noise of no scanner, and a scanner far away."""
        if 0.0 < self.sigma_mm < SMALLEST_MM:
            text = f": expected 0, or {SMALLEST_MM:g} mm or more, found {self.sigma_mm:.3g}"
            yield Fault(("sigma_mm",), text)
        if self.position.size and len(self.points):
            yield from _far(("position",), "", self.position - self.origin, self)
        if len(self.grid_row) and len(self.grid_column):
            rows, columns = (int(large_arrays.extremes(n)[1]) + 1 for n in (self.grid_row, self.grid_column))
            most = LARGEST_GRID + GRID_CELLS_PER_POINT * len(self.grid_row)
            if rows * columns > most:
                text = f": expected a grid of at most {most} cells for its points, found {rows} x {columns}"
                yield Fault(("grid_row",), text)


@dataclass(frozen=True)
class Stations(Checked):
    """Scanner positions in the project's frame, and the poses of the scanners where they are known."""

    ids: tuple[str, ...] = names("k", means=NAMES)
    positions: Floats = column("k", 3, means=PLACE)
    T_project_station: Floats = column("k", 4, 4, means=PLACE)


@dataclass(frozen=True)
class DesignPart(Checked):
    """The nominal geometry of one component, in the bridge's frame (mm)."""

    name: str
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    # From the start to the end of the component; left = +Y; empty = none.
    bottom_edge_left: Floats = column(
        "l", 3, means=PLACE
    )  # from the start to the end of the component; left = +Y; () = none
    bottom_edge_right: Floats = column("r", 3, means=PLACE)
    # of vertices and faces: mesh, or curves: the outer box between joints and bottom edges alone
    source: str = described("mesh", means=Meaning(words=("mesh", "curves")))


@dataclass(frozen=True)
class ArchDesign(Checked):
    """A bridge, or another assembly, of components in assembly order. Bridge frame: X along the span, Z up, mm.

    ``joint_points`` are P1..P8 of each joint: the outer corners bottom-left, bottom-right, top-right, top-left
    (left = +Y), then the middles of the outer bottom, right, top and left edges. Bottom and left are as seen from the
    left part towards the right one. The joints may form any graph.
    """

    parts: tuple[DesignPart, ...] = ()  # in assembly order
    joint_names: tuple[str, ...] = names("j", means=NAMES)
    joint_left: tuple[str, ...] = names("j", means=Meaning(among="parts.name", unlike="joint_right"))
    joint_right: tuple[str, ...] = names("j", means=Meaning(among="parts.name"))
    joint_points: Floats = column("j", 8, 3, means=PLACE)

    def contradictions(self) -> Iterable[Fault]:
        """Yield parts of one name, too many parts, and a bridge larger than any."""
        yield from _many("parts", len(self.parts), MOST_PARTS)
        yield from _many("joint_points", len(self.joint_points), 2 * MOST_PARTS)
        yield from _repeated("parts", tuple(part.name for part in self.parts))
        corners = [part.vertices.min(axis=0) for part in self.parts if len(part.vertices)]
        corners += [part.vertices.max(axis=0) for part in self.parts if len(part.vertices)]
        yield from _wide("joint_points", np.concatenate([np.reshape(corners, (-1, 3)), *self.joint_points]))

    @property
    def joined(self) -> Ints:
        """Rows (j, 2) of the left and the right part of each joint. Raises ValueError for an unknown name."""
        row = [part.name for part in self.parts].index
        pairs = zip(self.joint_left, self.joint_right, strict=True)
        return np.array([(row(left), row(right)) for left, right in pairs], np.int64).reshape(-1, 2)

    @property
    def in_row(self) -> bool:
        """Whether the parts form one row: each is joined to the next one, and there is no other joint."""
        count = np.arange(len(self.parts) - 1)
        return bool(np.array_equal(self.joined, np.stack([count, count + 1], axis=1)))


DESIGN_FRAMES = ("project", "own")  # of a frame's nodes: the project's, which the scans are in, or another one


@dataclass(frozen=True)
class FrameDesign(Checked):
    """A space frame: nodes and the members between them, mm.

    ``coordinates`` is one of DESIGN_FRAMES where the project states it. ``labels`` are the ids as the design has them,
    where these are no whole numbers; then ``ids`` are 1, 2, ... in its order, and nothing outside shows them.
    """

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    centres: Floats = column("k", 3, means=PLACE)
    radii: Floats = column("k", means=SIZE)
    # ids of the two nodes
    member_a: Ints = column("m", dtype=np.int64, means=Meaning(among="ids", unlike="member_b"))
    member_b: Ints = column("m", dtype=np.int64, means=Meaning(among="ids"))
    tube_diameters: Floats = column("m", means=SIZE)
    # 0 = none, else the place in SUPPORTS, from 1
    supports: Codes = column("k", dtype=np.uint8, newer=True, means=Meaning(most=2))
    deflections: Floats = column(
        "k", newer=True, means=Meaning(least=-LARGEST_MM, most=LARGEST_MM)
    )  # computed, downward; NaN = not stated
    coordinates: str | None = newer(means=Meaning(words=DESIGN_FRAMES))
    labels: tuple[str, ...] = names("k", newer=True, means=NAMES)

    @property
    def names(self) -> list[int | str]:
        """The ids of the nodes, as the design has them."""
        return list(self.labels) or self.ids.tolist()

    @property
    def name_of(self) -> dict[int, int | str]:
        """The name of each node, by its number in ``ids``."""
        return dict(zip(self.ids.tolist(), self.names, strict=True))

    def contradictions(self) -> Iterable[Fault]:
        """Yield a frame larger than any, a second member of two nodes, and a tube far wider than its ball."""
        yield from _many("ids", len(self.ids), MOST_NODES)
        yield from _many("member_a", len(self.member_a), MOST_MEMBERS)
        yield from _wide("centres", self.centres)
        ends = np.sort(np.column_stack([self.member_a, self.member_b]), axis=1)
        second = np.ones(len(ends), bool)
        second[np.unique(ends, axis=0, return_index=True)[1]] = False
        if second.any():
            row = int(second.argmax())
            a, b = ends[row].tolist()
            yield Fault(("member_b",), f", row {row}: expected one member of two nodes, found a second of {a} and {b}")
        order = np.argsort(self.ids)
        balls = 2.0 * self.radii[order[np.searchsorted(self.ids, ends, sorter=order)]]
        wide = (self.tube_diameters[:, None] > TUBE_PER_BALL * balls).any(axis=1)
        if wide.any():
            row = int(wide.argmax())
            tube, ball = self.tube_diameters[row], balls[row].min()
            most = f"{TUBE_PER_BALL:g} times the diameter of its ball, {ball:.6g} mm"
            text = f"expected a tube of at most {most}, found {tube:.6g} mm"
            yield Fault(("tube_diameters",), f", row {row}: {text}; give diameters of tubes and radii of balls")


SUPPORTS = ("perimeter", "multi-point")  # of a node: of a frame supported along its edges, or at single points


@dataclass(frozen=True)
class DesignBodies(Checked):
    """The bodies of a structure's mesh by their names in the CAD file: the row (f,) of ``names`` of each facet.

    No two names are equal. ``shared`` of the bodies had a name that others have, ``unnamed`` had none: the design's
    reader numbered them.
    """

    names: tuple[str, ...] = names("b", means=NAMES)
    of_facet: Ints = column("f", dtype=np.int64, means=Meaning(rows_of="names"))
    shared: int = described(0, means=Meaning(least=0))
    unnamed: int = described(0, means=Meaning(least=0))


@dataclass(frozen=True)
class DesignFaults(Checked):
    """What was wrong with a structure's mesh: facets that were ``turned`` outward, and open edges of so many parts.

    ``repeated`` facets were left out, None for none: others have their corners, in the same order or in the other one.
    """

    turned: int = described(0, means=Meaning(least=0))
    open_edges: int = described(0, means=Meaning(least=0))
    open_parts: int = described(0, means=Meaning(least=0))
    repeated: int | None = described(None, newer=True, hashed=True, means=Meaning(least=0))


@dataclass(frozen=True)
class StructureDesign(Checked):
    """One mesh of a whole structure, in the design's frame (mm); ``bodies`` are None where the mesh has no names.

    ``faults`` are None where none were found, or the mesh is not from a file.
    """

    name: str
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    bodies: DesignBodies | None = newer()
    faults: DesignFaults | None = newer()

    def contradictions(self) -> Iterable[Fault]:
        """Yield a structure larger than any, and that bodies are not given for each facet."""
        yield from _wide("vertices", self.vertices)
        given = len(self.faces) if self.bodies is None else len(self.bodies.of_facet)
        if given != len(self.faces):
            text = f": expected a row for each of {len(self.faces)} faces, found {given}"
            yield Fault(("bodies", "of_facet"), text)


# What each step compares with limits, as ``Limit.measure`` names it; of single parts, "part " and a quantity.
MEASURES: Mapping[str, tuple[str, ...]] = {
    "preassemble": (
        "misalignment", "groove_gap", "eccentricity", "span", "unit_length", "inner_arc", "lateral_axis", "elevation",
    ),
    "spheres": (
        "node_place", "ball_size", "support_centre", "support_height", "adjacent_support_height",
        "multi_point_support_height", "deflection", "ceiling",
    ),
    "stitch": ("closure", "control_point", "scan_position"),
    "deviation": ("deviation", "deviation_share"),
    "defects": ("defect_depth", "defect_area"),
    "inspect": (
        "part length", "part width", "part height", "part diagonal", "part diagonal-difference", "part twist",
        "part sweep", "part camber", "part flatness", "part squareness", "part thickness", "part hole-position",
        "part hole-pitch", "part pass-through", "part hole-diameter", "part diameter", "part bow",
    ),
}  # fmt: skip
LIMITED_SIZES = ("length", "height", "thickness", "diameter", "spacing", "depth")


@dataclass(frozen=True)
class Limit(Checked):
    """One row of a standard: what it limits, from ``low`` to ``high`` (NaN = no bound), and where that stands.

    ``low_ratio`` and ``high_ratio`` are multiples of the size named by ``of``; by ``rule`` the smaller of number and
    multiple counts, or their sum. The row is for sizes above ``above_mm`` up to ``up_to_mm``. ``measure`` is what is
    compared with it, one of MEASURES or nothing. ``component`` is a pattern of the names of those that a project gives
    it for, None of all.
    """

    key: str
    what: str = dataclasses.field(metadata={"means": LONG})
    unit: str = "mm"
    low: float = described(float("nan"), means=BOUND)
    high: float = described(float("nan"), means=BOUND)
    low_ratio: float = described(float("nan"), means=BOUND)
    high_ratio: float = described(float("nan"), means=BOUND)
    of: str = described("", means=Meaning(words=("", *LIMITED_SIZES)))
    rule: str = described("", means=Meaning(words=("", "smaller", "sum")))
    above_mm: float = described(float("nan"), means=Meaning(least=0.0))
    up_to_mm: float = described(float("nan"), means=Meaning(least=0.0))
    measure: str = described("", means=Meaning(words=("", *(name for step in MEASURES.values() for name in step))))
    clause: str = described("", means=LONG)
    verified: bool = False  # the number was compared with the published text
    source: str = described("", means=LONG)
    component: str | None = newer()

    def contradictions(self) -> Iterable[Fault]:
        """Yield a lower bound above the upper one."""
        for low, high in (("low", "high"), ("low_ratio", "high_ratio"), ("above_mm", "up_to_mm")):
            if getattr(self, low) > getattr(self, high):
                text = f": expected at most {high}, {getattr(self, high):g}, found {getattr(self, low):g}"
                yield Fault((low,), text)


@dataclass(frozen=True)
class Tolerance(Checked):
    """The limits that results are compared with: those of a standard, of the project, or both (the project's win)."""

    standard: str = ""
    edition: str = described("", means=LONG)
    limits: tuple[Limit, ...] = ()
    # between two ends as assembled, by the design; their gap is compared with it
    root_gap_mm: float = described(0.0, means=PLACE)


@dataclass(frozen=True)
class Control(Checked):
    """Control points: targets whose coordinates are known, and where the scans have them; mm.

    ``positions`` are in the project's frame, that of the design. ``seen`` (m, 3) is where target ``point`` (m,), a row
    of ``ids``, was measured in scan ``scan`` (m,), a row of Scene.scans, in that scan's own frame. Of a cloud of
    several stations ``station`` (m,), a row of Scene.stations, says which one saw it; -1 = the scan's own.
    """

    ids: tuple[str, ...] = names("k", means=NAMES)
    positions: Floats = column("k", 3, means=PLACE)
    sd: Floats = column("k", means=SIZE)  # of each coordinate of a position
    point: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="ids"))
    scan: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="/scans"))
    station: Ints = column("m", dtype=np.int64, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    seen: Floats = column("m", 3, means=PLACE)
    seen_sd: Floats = column("m", means=DEVIATION)  # of each coordinate as seen


class TargetKind(Word):
    """What a target is."""

    CHECKERBOARD = "checkerboard"
    SPHERE = "sphere"


@dataclass(frozen=True)
class TargetSearch(Checked):
    """Targets that scans are searched for, mm: NaN = not for this kind.

    ``checkerboard_mm`` is the side of a square of two by two fields, two of them dark, across from one another.
    """

    checkerboard_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))
    sphere_radius_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))


@dataclass(frozen=True)
class Targets(Rows):
    """Targets as found in scans: ``places`` (t, 3) in the frame of scan ``scan`` (t,), a row of Scene.scans; mm.

    ``name`` is that of the control point, "" where none is there. ``sd`` is of each coordinate, with the error that all
    ranges of a view share by the class of scanners, along the direction where it is largest; ``station`` as in
    :class:`Control`. ``fit`` is the share of the intensities' variance that the pattern explains; NaN for spheres.
    """

    name: tuple[str, ...] = names("t")
    kind: tuple[TargetKind, ...] = words("t", TargetKind)
    scan: Ints = column("t", dtype=np.int64, means=Meaning(rows_of="/scans"))
    station: Ints = column("t", dtype=np.int64, means=Meaning(rows_of="/stations.ids", lowest_row=-1))
    places: Floats = column("t", 3, means=PLACE)
    sd: Floats = column("t", means=DEVIATION)
    points: Ints = column("t", dtype=np.int64, means=Meaning(least=0))
    fit: Floats = column("t", means=Meaning(most=1.0))


@dataclass(frozen=True)
class Picks(Checked):
    """Common points that were picked in two scans each, in these scans' frames (mm)."""

    scan_a: tuple[str, ...] = names("q", means=Meaning(among="/scans.name", unlike="scan_b"))
    scan_b: tuple[str, ...] = names("q", means=Meaning(among="/scans.name"))
    points: tuple[str, ...] = names("q")
    in_a: Floats = column("q", 3, means=PLACE)
    in_b: Floats = column("q", 3, means=PLACE)


@dataclass(frozen=True)
class Clips(Checked):
    """Boxes that the scans were cut by as they were read: corners in the project's frame, mm, and the points in each.

    ``keep`` marks boxes whose points are the ones kept, the others are left out. ``scan`` is the one meant, "" all.
    """

    scan: tuple[str, ...] = names("c")
    low: Floats = column("c", 3, means=PLACE)
    high: Floats = column("c", 3, means=PLACE)
    keep: Bools = column("c", dtype=np.bool_, means=Meaning())
    inside: Ints = column("c", dtype=np.int64, means=Meaning(least=0))
    read: int = described(0, means=Meaning(least=0))  # points of all scans
    kept: int = described(0, means=Meaning(least=0))


@dataclass(frozen=True)
class Ceiling(Checked):
    """A ceiling that hangs from a space frame, in the project's frame, mm: a ``level``, or a surface of triangles.

    Nothing is to be nearer above it than ``clearance_mm``, no hanger longer than ``longest_mm`` (NaN = any length).
    """

    level: float = described(float("nan"), means=Meaning(least=-LARGEST_MM, most=LARGEST_MM))
    vertices: Floats = column("v", 3, means=PLACE)
    faces: Ints = column("f", 3, dtype=np.int64, means=Meaning(rows_of="vertices"))
    clearance_mm: float = described(0.0, means=Meaning(finite=True, least=0.0, most=LARGEST_MM))
    longest_mm: float = described(float("nan"), means=Meaning(above=0.0, most=LARGEST_MM))

    def contradictions(self) -> Iterable[Fault]:
        """Yield that there is neither a level nor a surface, or both."""
        if bool(np.isnan(self.level)) == (not len(self.faces)):
            yield Fault(("level",), ": expected a level or faces, found neither or both")


@dataclass(frozen=True)
class TitleBlock(Checked):
    """What the project writes on its report: names and texts in their order, and a logo (bytes of a PNG or JPEG)."""

    keys: tuple[str, ...] = names("k")
    values: tuple[str, ...] = names("k")
    logo: Codes = column("bytes", dtype=np.uint8, means=Meaning())


def _units_as_stated(text: str) -> tuple[Reason, ...]:
    """Return the source of a unit that a scene file of before version 1.5 states as a text."""
    return (reason("units.as-stated", text=text),) if text else ()


@dataclass(frozen=True)
class Scene(Checked):
    """What was scanned, and what it was meant to be. Steps read this and nothing else."""

    name: str
    kind: str = dataclasses.field(metadata={"means": Meaning(words=KINDS)})
    scans: tuple[Scan, ...] = ()
    arch: ArchDesign | None = None
    frame: FrameDesign | None = None
    stations: Stations | None = None
    # of the steel while it was scanned
    temperature_C: float = described(float("nan"), means=Meaning(least=-100.0, most=500.0))
    units: str = "mm"  # of the input's coordinates, and why they were read so
    units_reason: tuple[Reason, ...] = reasons(of_text=_units_as_stated, hashed_as_text=True)
    structure: StructureDesign | None = None
    tolerance: Tolerance | None = None  # None: the input does not state it
    control: Control | None = newer()
    picks: Picks | None = newer()
    title_block: TitleBlock | None = newer(hashed=False)
    clips: Clips | None = newer()
    ceiling: Ceiling | None = newer()
    target_search: TargetSearch | None = newer()
    targets: Targets | None = newer(hashed=False)  # those of Scene.control are hashed
    target_remarks: tuple[Reason, ...] = reasons(newer=True, hashed=False)  # on the search for targets
    # days of the scans by their files, YYYY-MM-DD, in order; no step reads them
    scanned: tuple[str, ...] = names("days", newer=True, hashed=False)

    def contradictions(self) -> Iterable[Fault]:
        """Yield scans of one name or station, scanners far away, and parts that the design does not have."""
        yield from _repeated("scans", tuple(scan.name for scan in self.scans))
        seen: set[tuple[str, str]] = set()
        for i, scan in enumerate(self.scans):
            if scan.station and (scan.component, scan.station) in seen:
                text = f": expected another station for each scan, found {scan.station!r} a second time"
                yield Fault(("scans", f"{i:04d}", "station"), text)
            seen.add((scan.component, scan.station))
            for row, position in self._stations_of(scan):
                place = (position - scan.pose[:3, 3]) @ scan.pose[:3, :3] - scan.origin
                far = list(_far(("stations", "positions"), f", row {row}", place, scan))
                if far:  # one names the mistake: a wrong unit concerns every row
                    yield far[0]
                    break
        parts = {part.name for part in self.arch.parts} if self.arch else set()
        for i, scan in enumerate(self.scans):
            if parts and scan.component and scan.component not in parts:
                text = f": expected a part of the design, found {scan.component!r}"
                yield Fault(("scans", f"{i:04d}", "component"), text)

    def _stations_of(self, scan: Scan) -> list[tuple[int, Floats]]:
        """Return the stations that a scan's points name, or all if it is the only scan: rows and positions (3,)."""
        if self.stations is None or not len(scan.points):
            return []
        positions = dict(enumerate(self.stations.positions))
        if len(scan.point_station):
            named = np.unique(_sample(scan.point_station)).tolist()
            return [(row, positions[row]) for row in named if row in positions]
        return list(positions.items()) if len(self.scans) == 1 else []


def _sample(rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return rows[:: max(1, len(rows) // SAMPLED_POINTS)]


def _far(path: tuple[str, ...], row: str, position: Floats, scan: Scan) -> Iterator[Fault]:
    """Yield that a scanner's position, relative to the scan's origin, is far from all points of the scan."""
    away = float(np.linalg.norm(_sample(scan.points) - position, axis=1).min())
    if away > FARTHEST_MM:
        text = f"expected a scanner at most {FARTHEST_MM / 1e6:g} km from the points of scan {scan.name!r}"
        yield Fault(path, f"{row}: {text}, found {away / 1e6:.4g} km; is its unit that of the scans?")


def _wide(field: str, points: Floats) -> Iterator[Fault]:
    """Yield that points (n, 3) of a design extend farther than any structure."""
    if not len(points):
        return
    extent = float((points.max(axis=0) - points.min(axis=0)).max())
    if extent > WIDEST_MM:
        row = int(np.abs(points - np.median(points, axis=0)).max(axis=1).argmax())
        text = f"expected a design of at most {WIDEST_MM / 1e6:g} km across, found {extent / 1e6:.4g} km"
        yield Fault((field,), f", row {row}: {text}; correct the place or the unit")


def _many(field: str, count: int, most: int) -> Iterator[Fault]:
    if count > most:
        yield Fault((field,), f": expected at most {most}, found {count}")


def _repeated(field: str, names: tuple[str, ...]) -> Iterator[Fault]:
    for i, name in enumerate(names):
        if name in names[:i]:
            text = f": expected another name for each, found {name!r} a second time"
            yield Fault((field, f"{i:04d}", "name"), text)
            return


# --- the truth: evaluation alone reads it --------------------------------------------------------------------------


@dataclass(frozen=True)
class PointLabels(Checked):
    """What each point of a scan really is: ``part`` a row of ``part_names``, ``source`` a row of SOURCES.

    Scans by rays also name the surface, and give the range measured less the true one and the cosine of incidence.
    """

    scan: str
    part_names: tuple[str, ...] = ()
    part: Labels = column("n", dtype=np.int32, means=Meaning(least=-1))  # -1 = none
    source: Codes = column("n", dtype=np.uint8, means=Meaning(most=2.0))
    surface_names: tuple[str, ...] = ()
    surface: Labels = column("n", dtype=np.int32, means=Meaning(least=-1))  # -1 = none
    range_error_mm: Shorts = column("n", dtype=np.float32, means=COORDINATE)
    incidence_cos: Shorts = column("n", dtype=np.float32, means=NUMBER)
    defect: Labels = column(
        "n", dtype=np.int32, newer=True, means=Meaning(least=-1)
    )  # id of the defect that displaced the surface, -1 = none


SOURCES = ("surface", "mixed", "outlier")  # the footprint on one surface; on several, or past an edge; a stray return


@dataclass(frozen=True)
class ArchTruth(Checked):
    """The true pose and key points of each component. Axis of length 2: start, end; NaN where an end has none.

    ``edges_bridge`` are points from the start to the end along the bottom edges, left and right; NaN without any.
    A component that is left or right part of several joints has the key points of each in a row of ``branch_*``.
    """

    names: tuple[str, ...] = names("c")
    T_bridge_scan: Floats = column("c", 4, 4, means=POSE)
    key_points_scan: Floats = column("c", 2, 8, 3, means=COORDINATE)
    key_points_bridge: Floats = column("c", 2, 8, 3, means=COORDINATE)
    edges_bridge: Floats = column("c", 2, "e", 3, means=COORDINATE)
    branch_component: Ints = column("b", dtype=np.int64, newer=True, means=Meaning(rows_of="names"))  # row of names
    branch_joint: Ints = column("b", dtype=np.int64, newer=True, means=COUNT)  # row of the design's joints
    branch_scan: Floats = column("b", 8, 3, newer=True, means=COORDINATE)
    branch_bridge: Floats = column("b", 8, 3, newer=True, means=COORDINATE)


@dataclass(frozen=True)
class FrameTruth(Checked):
    """The true balls, in the frame of the scan: as built, not as designed.

    ``lowest`` is the lowest point of the sphere, its centre minus its radius: where a ball has its process hole, the
    hole cuts that point away.
    """

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    centres: Floats = column("k", 3, means=COORDINATE)
    radii: Floats = column("k", means=RADIUS)
    lowest: Floats = column("k", 3, means=COORDINATE)


@dataclass(frozen=True)
class StationTruth(Checked):
    """Where the scanners really stood, and the systematic errors each had; both axes of ``tilt`` in rad."""

    ids: tuple[str, ...] = names("k")
    T_project_station: Floats = column("k", 4, 4, means=POSE)
    zero_offset_mm: Floats = column("k", means=COORDINATE)
    scale_ppm: Floats = column("k", means=NUMBER)
    tilt: Floats = column("k", 2, means=NUMBER)


@dataclass(frozen=True)
class AsBuilt(Checked):
    """What was built or happened otherwise than designed: a row per number, e.g. ("bow, up", "rib1", 3.2, "mm")."""

    what: tuple[str, ...] = names("i")
    where: tuple[str, ...] = names("i")
    value: Floats = column("i", means=NUMBER)
    unit: tuple[str, ...] = names("i")


@dataclass(frozen=True)
class BodyTruth(Checked):
    """The bodies of a structure by name, how each moved as a whole, and the row (m,) of the body of each true point.

    ``shift`` is that of the middle of a body's box in the design, ``turn`` the rotation vector about it; NaN for a
    body that is missing. Bends and dents are none of either.
    """

    names: tuple[str, ...] = names("b")
    of_point: Labels = column("m", dtype=np.int32, means=Meaning(rows_of="names", lowest_row=-1))
    shift: Floats = column("b", 3, means=COORDINATE)  # mm
    turn: Floats = column("b", 3, means=NUMBER)  # rad

    @property
    def moved(self) -> Bools:
        """Whether each body (b,) moved as a whole."""
        known = np.isfinite(self.shift).all(axis=1)
        changed: Bools = known & ((self.shift != 0.0).any(axis=1) | (self.turn != 0.0).any(axis=1))
        return changed


@dataclass(frozen=True)
class StructureTruth(Checked):
    """Points of the design's surface with their outward normals, and where the structure really has them (mm).

    ``bodies`` are None where the structure is no model of named bodies.
    """

    points: Floats = column("m", 3, means=COORDINATE)
    normals: Floats = column("m", 3, means=DIRECTION)
    displacement: Floats = column("m", 3, means=COORDINATE)
    bodies: BodyTruth | None = newer()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.bodies is not None and len(self.bodies.of_point) != len(self.points):
            raise RecordError(
                f"StructureTruth.bodies: expected a row for each of {len(self.points)} points, "
                f"found {len(self.bodies.of_point)}"
            )


@dataclass(frozen=True)
class DefectTruth(Checked):
    """The defects of a structure, in the design's frame; a depth inward is positive."""

    ids: Ints = column("k", dtype=np.int64, means=NAMES)
    classes: tuple[str, ...] = names("k")
    components: tuple[str, ...] = names("k")
    centres: Floats = column("k", 3, means=COORDINATE)
    area_mm2: Floats = column("k", means=AMOUNT)
    depth_max_mm: Floats = column("k", means=COORDINATE)
    volume_mm3: Floats = column("k", means=NUMBER)


@dataclass(frozen=True)
class PoseTruth(Checked):
    """Where the design lies in a scene whose scans are in another frame than the design.

    ``covariance``, turn about the design frame's axes and shift: of the motion that errors of the scan's stations look
    like, which no method can distinguish from a movement of the whole.
    """

    T_design_project: Floats = column(4, 4, means=POSE)
    covariance: Floats = optional(6, 6, newer=True, means=COVARIANCE)


@dataclass(frozen=True)
class TargetTruth(Checked):
    """Targets as placed, in the project's frame: centres of patterns and of spheres."""

    ids: tuple[str, ...] = names("k")
    kinds: tuple[str, ...] = names("k")
    positions: Floats = column("k", 3, means=COORDINATE)


@dataclass(frozen=True)
class Truth(Checked):
    """What the generator knows and no step may see."""

    labels: tuple[PointLabels, ...] = ()
    arch: ArchTruth | None = None
    frame: FrameTruth | None = None
    spacing_mm: float = described(float("nan"), means=AMOUNT)
    sigma_mm: float = described(float("nan"), means=AMOUNT)
    structure: StructureTruth | None = None
    defects: DefectTruth | None = None
    stations: StationTruth | None = None
    as_built: AsBuilt | None = None
    pose: PoseTruth | None = newer()  # without it the scans are in the design's frame
    targets: TargetTruth | None = newer()


# --- checks ---------------------------------------------------------------------------------------------------------


class Statistic(Word):
    """What a metric takes of a quantity; the word is its part of the metric's name."""

    VALUE = "value"
    COUNT = "count"
    SHARE = "share"
    MEDIAN = "median"
    MEAN = "mean"
    RMS = "rms"
    P95 = "95th percentile"
    MAX = "max"
    BIAS = "bias"
    SD = "standard deviation"
    ERROR_95 = "95 % error"
    NUMBER = "number"  # of errors that the other statistics are made from
    EFFICIENCY = "efficiency"  # least possible standard deviation by the real one
    COVERAGE = "coverage"  # share of errors within their 95 % intervals
    PULL_RMS = "rms of error by standard deviation"


class Better(Word):
    """Which way a metric is better."""

    LOW = "low"
    HIGH = "high"
    ZERO = "zero"
    ONE = "one"
    NOMINAL_95 = "95"


BETTER = {
    Statistic.BIAS: Better.ZERO,
    Statistic.NUMBER: Better.HIGH,
    Statistic.EFFICIENCY: Better.HIGH,
    Statistic.COVERAGE: Better.NOMINAL_95,
    Statistic.PULL_RMS: Better.ONE,
}  # of all other statistics low, where the metric does not state otherwise
METRIC_NAMES = {
    Statistic.VALUE: "{quantity}",
    Statistic.COUNT: "{quantity}",
    Statistic.SHARE: "{quantity}",
    Statistic.COVERAGE: "{quantity} within their 95 % intervals",
}


@dataclass(frozen=True)
class Metric:
    """One figure compared with the truth. Without a limit (NaN) it informs and always passes.

    ``quantity`` is an English name, of which a catalogue has the translation; ``method`` names the step's method where
    the run was made for comparison.
    """

    step: str
    quantity: str
    value: float
    statistic: Statistic = Statistic.VALUE
    unit: str = ""
    limit: float = float("nan")
    better: Better | None = None  # None: as BETTER has it for the statistic
    method: str = ""

    def __post_init__(self) -> None:
        if self.better is None:
            object.__setattr__(self, "better", BETTER.get(self.statistic, Better.LOW))

    @property
    def name(self) -> str:
        """The name of the figure in files: quantity and statistic, after the method of a comparison."""
        name = METRIC_NAMES.get(self.statistic, "{quantity}, {statistic}")
        name = name.format(quantity=self.quantity, statistic=self.statistic)
        return f"{self.method}: {name}" if self.method else name

    @property
    def passed(self) -> bool:
        """Whether the value keeps within the limit; a value that is not a number never does."""
        return bool(np.isnan(self.limit) or self.value <= self.limit)


@dataclass(frozen=True)
class Diagnostics(Checked):
    """Numbers that the parts of a step found on the way, one a row; NaN where there is none.

    ``place`` is where, such as the end of a part; a unit stands at the end of a quantity, else it is a number or share.
    """

    stage: tuple[str, ...] = names("k")
    place: tuple[str, ...] = names("k", means=LONG)
    quantity: tuple[str, ...] = names("k")
    value: Floats = column("k", means=OPEN)


@dataclass(frozen=True)
class StepRun:
    """One step as it was run: the parameters as JSON text, the step's own Result record, and diagnostics, if any."""

    step: str
    method: str
    params: str = dataclasses.field(metadata={"means": LONG})
    result: Any
    diagnostics: Diagnostics | None = newer()

    @property
    def verdict(self) -> Verdict:
        """The worst verdict in the result; none where the step compares nothing with limits."""
        verdict: Verdict = getattr(self.result, "overall", Verdict.NONE)
        return verdict
