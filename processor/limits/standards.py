"""Limits of standards, from the files in ``processor/limits``: one file a standard, a row a limit.

Most rows are not verified: a verdict that hangs on one says so. What a project gives itself wins over the standard.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from typing import Any

from processor.model import Floats, InputError, Limit, Tolerance

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DEFAULT = "GB 50205-2020"
NAN = float("nan")
NODE_PLACE = "node_place_mm"
# What no standard here limits, and a project may.
OF_PROJECTS = (Limit(NODE_PLACE, "distance of a space frame's node from its nominal place"),)


@lru_cache(maxsize=1)
def standards() -> Mapping[str, Tolerance]:
    """All standards by name; one with classes stands there as ``NAME`` (its class 1) and as ``NAME class N``."""
    folder = resources.files("processor.limits")
    found: dict[str, Tolerance] = {}
    for file in sorted((f for f in folder.iterdir() if f.name.endswith(".toml")), key=lambda f: f.name):
        content = tomllib.loads(file.read_text("utf-8"))
        name, rows = content["standard"], content["limit"]
        classes = sorted({row["class"] for row in rows if "class" in row})
        for suffix, number in [("", 1), *((f" class {n}", n) for n in classes)]:
            limits = tuple(_limit(row) for row in rows if row.get("class", number) == number)
            found[name + suffix] = Tolerance(name + suffix, content["edition"], limits)
    return found


def _limit(row: Mapping[str, Any]) -> Limit:
    return Limit(**{key: value for key, value in row.items() if key != "class"})


def load(standard: str) -> Tolerance:
    """Limits of a standard. Raises InputError for a name that there is no file for."""
    known = standards()
    if standard not in known:
        raise InputError(
            f"unknown standard {standard!r}; there are {', '.join(known)}; limits can also be given as numbers"
        )
    return known[standard]


def default_for(given: Tolerance | None) -> Tolerance:
    """Return the limits that a project gives, or those of DEFAULT where it says nothing."""
    return load(DEFAULT) if given is None else given


def find(tolerance: Tolerance, key: str) -> Limit | None:
    """Return the limit of that key, None where there is none."""
    return next((limit for limit in tolerance.limits if limit.key == key), None)


def choice(base: Tolerance) -> dict[str, Limit]:
    """Limits that a project can set by key: those of its standard, and without a standard those of any.

    Beside them stand OF_PROJECTS.
    """
    limits = base.limits or tuple(limit for one in (load(DEFAULT), *standards().values()) for limit in one.limits)
    limits = (*limits, *OF_PROJECTS)
    found: dict[str, Limit] = {}
    for limit in limits:
        found.setdefault(limit.key, limit)
    return found


def two_sided(limit: Limit) -> bool:
    """Whether the limit bounds from below as well; then a project gives the least and the greatest."""
    return not (math.isnan(limit.low) and math.isnan(limit.low_ratio))


def with_own(base: Tolerance, own: Mapping[str, Floats], source: str, root_gap_mm: float = 0.0) -> Tolerance:
    """Put a project's own limits in the place of the standard's, or beside them.

    ``own`` holds by key (1,) the greatest, or (2,) the least and the greatest. They count as verified: nobody but the
    project can say otherwise. ``source`` is where they were given.
    """
    known = choice(base)
    given = {}
    for key, value in own.items():
        given[key] = replace(
            known[key],
            low=float(value[0]) if len(value) == 2 else NAN,
            high=float(value[-1]),
            low_ratio=NAN,
            high_ratio=NAN,
            rule="",
            clause="",
            verified=True,
            source=source,
        )
    kept = [given.pop(limit.key, limit) for limit in base.limits]
    return replace(base, limits=(*kept, *given.values()), root_gap_mm=root_gap_mm)


def bounds(limit: Limit, sizes_mm: Mapping[str, float]) -> tuple[float, float]:
    """Least and greatest allowed value; -inf and inf where the row has no such bound.

    ``sizes_mm`` are by the names of ``Limit.of``. NaN for a bound that hangs on a size not among them.
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
    """Whether a row is for things of this size."""
    return not (size_mm <= limit.above_mm or size_mm > limit.up_to_mm)
