"""The matrix: a TOML file with the recipes, settings, seeds and methods that are run every night.

Example::

    fixed_seeds = [1, 2]       # of every night, for cells without seeds: their figures change only with the software
    fresh_seeds = 1            # number of further seeds, which are other ones every night

    [[cell]]
    recipe = "frame-small"     # a name of designgen's, or a TOML file beside the matrix
    steps = ["spheres"]
    methods = ["ray", "ransac"]
    seeds = [1, 2, 3]          # fixed ones of this cell; fresh = 2: the number of others
    set."scan.sigma_mm" = [1.0, 2.0]       # all combinations of lists are run; [[2, 2]] is a value that is a list
    set."scan.spacing_mm" = 5.0
    params.spheres.radius_mm = 50.0        # as in a parameter file
    full = true                # only with --full

    [[cell]]
    generator = "arch_bridge"  # a script of tests/bench/foreign, or a .py file beside the matrix, in place of a recipe
    steps = ["preassemble"]
    set.waviness = 0.5

    [coverage]                 # limits of 95 % intervals, %: of all errors of a quantity, and of a single scene
    low = 92
    high = 98
    scene = 85
    least = 50                 # errors; fewer are not judged

    [aim]                      # the better direction of a figure, "low" or "high", or the best value
    "share of the sky" = "high"
"""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processor.jobs.process import PROJECT
from processor.model import InputError, UsageError, inputs
from processor.model.inputs import Kind, Place, entry, hidden, listed, number, tables, text
from processor.plain_text import tomllib
from processor.validation.cells import Case, Cell, Origin, fresh_seed
from processor.validation.coverage import Limits
from processor.writers.toml import as_toml

DEFAULT, SMALLEST = (Path(__file__).with_name(f"{name}_matrix.toml") for name in ("default", "smallest"))
FOREIGN = PROJECT / "tests" / "bench" / "foreign"  # part of the sources, not of an installed package
MOST_SEED = 2**63  # a seed is stored as a 64-bit integer
MOST_CELLS = 10_000  # work: at some seconds each, more than a night


def _aims(value: Any, _: Place) -> Mapping[str, str | float]:
    aims = {**value}
    if not all(isinstance(aim, int | float) or aim in ("low", "high") for aim in aims.values()):
        raise ValueError
    return aims


TABLE = Kind("a table", lambda value, _: {**value}, {"type": "object"})
AIMS = Kind("figures' names with low, high or a number", _aims, {"type": "object"})
NAMES = listed(text(), "a list of names")
SEEDS = listed(number(least=0, most=MOST_SEED - 1, whole=True), "a list of whole numbers from 0")
COUNT = number(least=0, most=MOST_CELLS, whole=True)


@dataclass(frozen=True)
class _CellTable:
    steps: tuple[str, ...] = entry(NAMES._replace(expected="the names of those to run"))
    name: str = entry(text(), default="")
    recipe: str = entry(text(expected="a name or a TOML file"), default="")
    generator: str = entry(text(expected="a name or a Python file"), default="")
    methods: tuple[str, ...] = entry(NAMES, default=())
    seeds: tuple[int, ...] | None = entry(SEEDS, default=None)
    fresh: int | None = entry(COUNT, default=None)
    set: Mapping[str, Any] | None = entry(TABLE, default=None)
    params: Mapping[str, Any] | None = entry(TABLE, default=None)
    full: bool = False
    where: str = hidden("")

    def contradiction(self) -> str:
        if not self.steps:
            return "expected steps = the names of those to run"
        if self.recipe and self.generator:
            return "recipe and generator exclude each other"
        return "" if self.recipe or self.generator else "expected recipe = a name or a TOML file"


@dataclass(frozen=True)
class _MatrixTable:
    cell: tuple[_CellTable, ...] = entry(tables(_CellTable)._replace(expected="at least one [[cell]]"))
    name: str = entry(text(), default="")
    about: str = entry(text(empty=True), default="")
    fixed_seeds: tuple[int, ...] = entry(SEEDS, default=(1,))
    fresh_seeds: int = entry(COUNT, default=1)
    aim: Mapping[str, str | float] | None = entry(AIMS, default=None)
    coverage: Limits = Limits()

    def contradiction(self) -> str:
        return "" if self.cell else "expected at least one [[cell]]"


@dataclass(frozen=True)
class Entry:
    """One ``[[cell]]`` of the file with its settings chosen, and its seeds."""

    case: Case
    seeds: tuple[int, ...]
    fresh: int


@dataclass(frozen=True)
class Matrix:
    """What is run every night. ``aim``: by figure the better direction, low or high, or the best value."""

    name: str
    sha256: str
    entries: tuple[Entry, ...]
    aim: Mapping[str, str | float]
    coverage: Limits = Limits()

    def cells(self, number: int) -> tuple[Cell, ...]:
        """Return the cells of the night of that number, fixed seeds first, each key once."""
        cells = [Cell(entry.case, seed, True) for entry in self.entries for seed in entry.seeds]
        cells += [
            Cell(entry.case, fresh_seed(entry.case, number, i), False)
            for entry in self.entries
            for i in range(entry.fresh)
        ]
        unique: dict[str, Cell] = {}
        for cell in cells:
            unique.setdefault(cell.key, cell)
        return tuple(unique.values())


def read(path: Path, full: bool) -> Matrix:
    """Read a matrix, with ``full`` also the cells marked so; the default one without foreign scenes outside a checkout.

    Raises InputError for a file that cannot be read, UsageError for unknown keys and wrong values.
    """
    try:
        raw = path.read_bytes()
        table: dict[str, Any] = tomllib.loads(raw.decode("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: expected a matrix in TOML, could not read it ({error})") from error
    declared = inputs.read(_MatrixTable, table, Place(str(path), UsageError))
    entries: list[Entry] = []
    for cell in declared.cell:
        if path == DEFAULT and cell.generator and not FOREIGN.is_dir():
            continue
        entries_of_cell = _entries(cell, path, declared)
        entries += entries_of_cell if full or not cell.full else []
        if sum(len(entry.seeds) + entry.fresh for entry in entries) > MOST_CELLS:
            raise UsageError(f"{cell.where}: more than {MOST_CELLS} cells; set fewer values or seeds")
    if not entries:
        raise UsageError(f"{path}: every cell of it is for --full")
    return Matrix(
        name=declared.name or path.stem,
        sha256=hashlib.sha256(raw).hexdigest(),
        entries=tuple(entries),
        aim=declared.aim or {},
        coverage=declared.coverage,
    )


def _entries(cell: _CellTable, path: Path, defaults: _MatrixTable) -> list[Entry]:
    """Return the entries of a cell, one a combination of its settings."""
    from processor import pipeline

    params = cell.params or {}
    try:
        pipeline.plan(cell.steps, cell.methods, params, None)
    except UsageError as error:
        raise UsageError(f"{cell.where}: {error}") from None
    foreign = bool(cell.generator)
    recipe = cell.generator or cell.recipe
    recipe_text, from_file = _source(recipe, foreign, path, cell.where)
    stem = Path(recipe).stem if from_file else recipe
    return [
        Entry(
            Case(
                name=cell.name or stem,
                recipe=stem,
                recipe_text=recipe_text,
                from_file=from_file,
                settings=settings,
                steps=cell.steps,
                methods=cell.methods,
                params=params,
                origin=Origin.FOREIGN if foreign else Origin.OWN,
            ),
            tuple(dict.fromkeys(defaults.fixed_seeds if cell.seeds is None else cell.seeds)),
            defaults.fresh_seeds if cell.fresh is None else cell.fresh,
        )
        for settings in _combinations(cell.set or {}, cell.where)
    ]


def _combinations(table: Mapping[str, Any], where: str) -> list[tuple[str, ...]]:
    flat = _flat(table)
    lists = [value if isinstance(value, list) else [value] for value in flat.values()]
    if not all(lists):
        raise UsageError(f"{where}: set: a list of values is empty")
    return [
        tuple(f"{key}={as_toml(value)}" for key, value in zip(flat, chosen, strict=True))
        for chosen in itertools.product(*lists)
    ]


def _flat(table: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{above}{key}.") if isinstance(value, dict) else {f"{above}{key}": value}
    return flat


def _source(name: str, foreign: bool, path: Path, where: str) -> tuple[str, bool]:
    """Return the text of a recipe or of a foreign generator, and whether it is a file of the user."""
    what, suffix, known = (
        ("generator", ".py", "those of a name are part of the sources; or give a .py file beside the matrix")
        if foreign
        else ("recipe", ".toml", "designgen list names them")
    )
    from_file = name.endswith(suffix)
    if from_file:
        file = path.parent / name
    elif foreign:
        file = FOREIGN / f"{name}.py"
    else:
        designgen = importlib.util.find_spec("designgen")  # it is not imported
        if designgen is None or not designgen.submodule_search_locations:
            raise UsageError(f"{where}: scenes are made by designgen, which is not installed")
        file = Path(designgen.submodule_search_locations[0]) / "recipes" / f"{name}.toml"
    try:
        return file.read_text("utf-8"), from_file
    except (OSError, UnicodeDecodeError) as error:
        hint = "" if from_file else f" ({known})"
        raise UsageError(f"{where}: no {what} {name!r}{hint}: {error}") from error
