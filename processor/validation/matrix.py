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
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from processor.jobs.process import PROJECT
from processor.model import InputError, UsageError
from processor.validation.cells import Case, Cell, Origin, fresh_seed
from processor.validation.coverage import Limits
from processor.writers.toml import as_toml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DEFAULT = Path(__file__).with_name("default_matrix.toml")
FOREIGN = PROJECT / "tests" / "bench" / "foreign"  # part of the sources, not of an installed package
TOP_KEYS = {"name", "about", "fixed_seeds", "fresh_seeds", "aim", "coverage", "cell"}
CELL_KEYS = {"name", "recipe", "generator", "steps", "methods", "seeds", "fresh", "set", "params", "full"}
AIMS = ("low", "high")
MOST_SEED = 2**63
MOST_CELLS = 10_000


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
    _check_keys(table, TOP_KEYS, str(path))
    fixed = _seeds(table.get("fixed_seeds", [1]), f"{path}: fixed_seeds")
    fresh = _count(table.get("fresh_seeds", 1), f"{path}: fresh_seeds")
    aim = table.get("aim", {})
    if not isinstance(aim, dict) or not all(isinstance(a, int | float) or a in AIMS for a in aim.values()):
        raise UsageError(f"{path}: aim: expected figures' names with low, high or a number, got {aim!r}")
    cells = table.get("cell")
    if not isinstance(cells, list) or not cells or not all(isinstance(cell, dict) for cell in cells):
        raise UsageError(f"{path}: expected at least one [[cell]]")
    if path == DEFAULT and not FOREIGN.is_dir():
        cells = [cell for cell in cells if "generator" not in cell]
    entries: list[Entry] = []
    for i, cell in enumerate(cells):
        where = f"{path}: cell {i + 1}"
        _check_keys(cell, CELL_KEYS, where)
        entries_of_cell = _entries(cell, path, where, fixed, fresh)
        entries += entries_of_cell if full or not _flag(cell, where) else []
        if sum(len(entry.seeds) + entry.fresh for entry in entries) > MOST_CELLS:
            raise UsageError(f"{where}: more than {MOST_CELLS} cells; set fewer values or seeds")
    if not entries:
        raise UsageError(f"{path}: every cell of it is for --full")
    return Matrix(
        name=str(table.get("name", path.stem)),
        sha256=hashlib.sha256(raw).hexdigest(),
        entries=tuple(entries),
        aim=aim,
        coverage=_limits(table.get("coverage", {}), f"{path}: coverage"),
    )


def _entries(cell: dict[str, Any], path: Path, where: str, fixed: tuple[int, ...], fresh: int) -> list[Entry]:
    from processor import pipeline

    foreign = "generator" in cell
    if foreign and "recipe" in cell:
        raise UsageError(f"{where}: recipe and generator exclude each other")
    recipe = cell.get("generator" if foreign else "recipe")
    if not isinstance(recipe, str) or not recipe:
        expected = "generator = a name or a Python file" if foreign else "recipe = a name or a TOML file"
        raise UsageError(f"{where}: expected {expected}, got {recipe!r}")
    steps, methods = (_names(cell.get(key, []), f"{where}: {key}") for key in ("steps", "methods"))
    if not steps:
        raise UsageError(f"{where}: expected steps = the names of those to run")
    params = cell.get("params", {})
    if not isinstance(params, dict):
        raise UsageError(f"{where}: params: expected a table per step, got {params!r}")
    try:
        pipeline.plan(steps, methods, params, None)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from None
    text, from_file = _generator(recipe, path, where) if foreign else _recipe(recipe, path, where)
    seeds = _seeds(cell["seeds"], f"{where}: seeds") if "seeds" in cell else fixed
    fresh = _count(cell.get("fresh", fresh), f"{where}: fresh")
    stem = Path(recipe).stem if from_file else recipe
    name = cell.get("name", stem)
    if not isinstance(name, str):
        raise UsageError(f"{where}: name: expected a text, got {name!r}")
    return [
        Entry(
            Case(
                name=name,
                recipe=stem,
                recipe_text=text,
                from_file=from_file,
                settings=settings,
                steps=steps,
                methods=methods,
                params=params,
                origin=Origin.FOREIGN if foreign else Origin.OWN,
            ),
            seeds,
            fresh,
        )
        for settings in _combinations(cell.get("set", {}), where)
    ]


def _combinations(table: Any, where: str) -> list[tuple[str, ...]]:
    if not isinstance(table, dict):
        raise UsageError(f"{where}: set: expected keys with values or lists of values, got {table!r}")
    flat = _flat(table)
    lists = [value if isinstance(value, list) else [value] for value in flat.values()]
    if not all(lists):
        raise UsageError(f"{where}: set: a list of values is empty")
    return [
        tuple(f"{key}={as_toml(value)}" for key, value in zip(flat, chosen, strict=True))
        for chosen in itertools.product(*lists)
    ]


def _flat(table: dict[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{above}{key}.") if isinstance(value, dict) else {f"{above}{key}": value}
    return flat


def _generator(name: str, path: Path, where: str) -> tuple[str, bool]:
    """Return the script of a foreign generator, and whether it is a file of the user."""
    from_file = name.endswith(".py")
    file = path.parent / name if from_file else FOREIGN / f"{name}.py"
    try:
        return file.read_text("utf-8"), from_file
    except (OSError, UnicodeDecodeError) as error:
        known = "" if from_file else " (those of a name are part of the sources; or give a .py file beside the matrix)"
        raise UsageError(f"{where}: no generator {name!r}{known}: {error}") from error


def _installed(where: str) -> Path:
    """Return the folder of designgen, which is not imported."""
    spec = importlib.util.find_spec("designgen")
    if spec is None or not spec.submodule_search_locations:
        raise UsageError(f"{where}: scenes are made by designgen, which is not installed")
    return Path(spec.submodule_search_locations[0])


def _recipe(recipe: str, path: Path, where: str) -> tuple[str, bool]:
    """Return the recipe's text, and whether it is a file of the user."""
    from_file = recipe.endswith(".toml")
    file = path.parent / recipe if from_file else _installed(where) / "recipes" / f"{recipe}.toml"
    try:
        return file.read_text("utf-8"), from_file
    except (OSError, UnicodeDecodeError) as error:
        known = "" if from_file else " (designgen list names them)"
        raise UsageError(f"{where}: no recipe {recipe!r}{known}: {error}") from error


def _check_keys(table: dict[str, Any], keys: set[str], where: str) -> None:
    unknown = sorted(set(table) - keys)
    if unknown:
        raise UsageError(f"{where}: unknown key {unknown[0]!r}; there are {', '.join(sorted(keys))}")


def _flag(cell: dict[str, Any], where: str) -> bool:
    full = cell.get("full", False)
    if not isinstance(full, bool):
        raise UsageError(f"{where}: full: expected true or false, got {full!r}")
    return full


def _names(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise UsageError(f"{where}: expected a list of names, got {value!r}")
    return tuple(value)


def _seeds(value: Any, where: str) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(type(seed) is int and 0 <= seed < MOST_SEED for seed in value):
        raise UsageError(f"{where}: expected a list of whole numbers from 0, got {value!r}")
    return tuple(dict.fromkeys(value))


def _limits(value: Any, where: str) -> Limits:
    if not isinstance(value, dict) or not all(isinstance(n, int | float) for n in value.values()):
        raise UsageError(f"{where}: expected numbers low, high, scene and least, got {value!r}")
    _check_keys(value, {"low", "high", "scene", "least"}, where)
    return Limits(**value)


def _count(value: Any, where: str) -> int:
    if type(value) is not int or not 0 <= value <= MOST_CELLS:
        raise UsageError(f"{where}: expected a number from 0 to {MOST_CELLS}, got {value!r}")
    return value
