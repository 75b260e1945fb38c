"""Limits of standards, from the files in ``processor/limits``: one file per standard, one row per limit.

Most rows are not verified, and verdicts that depend on them are marked. Limits of a project override the standard.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache
from importlib import resources
from typing import Any

from processor.limits import measurands
from processor.model import Floats, InputError, Limit, Tolerance, did_you_mean

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DEFAULT = "GB 50205-2020"
NAN = float("nan")
NODE_PLACE = measurands.NODE_PLACE
OF_PROJECTS = measurands.of_projects()
NOT_OF_LIMITS = ("class", "needs")  # keys of rows that are no fields of a limit
PART = "part "  # before the quantity of step inspect, in ``Limit.measure`` of what is compared with a single part


@lru_cache(maxsize=1)
def standards() -> Mapping[str, Tolerance]:
    """Return all standards by name; one with classes is both ``NAME`` (its class 1) and ``NAME class N``."""
    tolerances: dict[str, Tolerance] = {}
    for content in files():
        name, rows = content["standard"], content["limit"]
        classes = sorted({row["class"] for row in rows if "class" in row})
        for suffix, number in [("", 1), *((f" class {n}", n) for n in classes)]:
            limits = tuple(_limit(row) for row in rows if row.get("class", number) == number)
            tolerances[name + suffix] = Tolerance(name + suffix, content["edition"], limits)
    return tolerances


def files() -> Iterator[dict[str, Any]]:
    """Yield the content of each file of limits: ``standard``, ``edition`` and the rows ``limit``."""
    folder = resources.files("processor.limits")
    for file in sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name):
        yield tomllib.loads(file.read_text("utf-8"))


def _limit(row: Mapping[str, Any]) -> Limit:
    return Limit(**{key: value for key, value in row.items() if key not in NOT_OF_LIMITS})


def load(standard: str) -> Tolerance:
    """Return the limits of a standard. Raises InputError for an unknown name."""
    known = standards()
    if standard not in known:
        raise InputError(
            f"unknown standard {standard!r}{did_you_mean(standard, known)}; expected one of {', '.join(known)}, "
            "or limits given as numbers"
        )
    return known[standard]


def default_for(given: Tolerance | None) -> Tolerance:
    """Return the limits of a project, those of DEFAULT if it has none."""
    return load(DEFAULT) if given is None else given


def find(tolerance: Tolerance, key: str) -> Limit | None:
    """Return the limit of a key, None without one."""
    return next((limit for limit in tolerance.limits if limit.key == key), None)


def choice(base: Tolerance) -> dict[str, Limit]:
    """Return the limits that a project can set, by key: those of its standard, or else of all, and OF_PROJECTS."""
    limits = base.limits or tuple(limit for of in (load(DEFAULT), *standards().values()) for limit in of.limits)
    first: dict[str, Limit] = {}
    for limit in (*limits, *OF_PROJECTS):
        first.setdefault(limit.key, limit)
    return first


def two_sided(limit: Limit) -> bool:
    """Whether a limit has a lower bound too; then a project gives the least and the greatest value."""
    return not (math.isnan(limit.low) and math.isnan(limit.low_ratio))


def at_least(limit: Limit) -> bool:
    """Whether a limit has a lower bound alone; then a project gives the least value."""
    return two_sided(limit) and math.isnan(limit.high) and math.isnan(limit.high_ratio)


def names_component(limit: Limit, component: str) -> bool:
    """Whether a limit holds for a component of this name: one of all, or whose pattern fits."""
    return limit.component is None or fnmatchcase(component, limit.component)


def override(
    base: Tolerance,
    values: Mapping[str, Floats],
    source: str,
    root_gap_mm: float = 0.0,
    of_components: Mapping[str, Mapping[str, Floats]] | None = None,
) -> Tolerance:
    """Replace limits of a standard by those of a project, or add them.

    ``values`` maps a key to the greatest value (1,), to the least where only that is limited, or to the least and the
    greatest (2,). ``of_components`` has such values by a pattern of the components' names; they come after those of
    all. These limits count as verified. ``source`` names the file that gives them.
    """
    known = choice(base)
    given = {key: _given(known[key], value, source) for key, value in values.items()}
    limits = [given.pop(limit.key, limit) for limit in base.limits]
    own = [
        replace(_given(known[key], value, source), component=pattern)
        for pattern, of_one in (of_components or {}).items()
        for key, value in of_one.items()
    ]
    return replace(base, limits=(*limits, *given.values(), *own), root_gap_mm=root_gap_mm)


def _given(limit: Limit, value: Floats, source: str) -> Limit:
    least_alone = at_least(limit)
    return replace(
        limit,
        low=float(value[0]) if len(value) == 2 or least_alone else NAN,
        high=NAN if least_alone else float(value[-1]),
        low_ratio=NAN,
        high_ratio=NAN,
        rule="",
        clause="",
        verified=True,
        source=source,
    )


def bounds(limit: Limit, sizes_mm: Mapping[str, float]) -> tuple[float, float]:
    """Return the least and the greatest allowed value; -inf and inf without a bound.

    ``sizes_mm`` has the names of ``Limit.of`` as keys. A bound that depends on a size without value is NaN.
    """
    size = sizes_mm.get(limit.of, NAN)
    low = _bound(limit.low, limit.low_ratio, limit.rule, size, max)
    high = _bound(limit.high, limit.high_ratio, limit.rule, size, min)
    return (-math.inf if low is None else low), (math.inf if high is None else high)


def _bound(number: float, ratio: float, rule: str, size_mm: float, tighter: Any) -> float | None:
    if math.isnan(ratio):
        return None if math.isnan(number) else number
    by_size = ratio * size_mm
    if math.isnan(number) or math.isnan(by_size):
        return by_size
    return float(number + by_size if rule == "sum" else tighter(number, by_size))


def applies(limit: Limit, size_mm: float) -> bool:
    """Whether a limit is for objects of this size."""
    return not (size_mm <= limit.above_mm or size_mm > limit.up_to_mm)
