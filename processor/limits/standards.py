"""Limits of standards, from the files in ``processor/limits``: one file per standard, one row per limit.

Most rows are not verified, and verdicts that depend on them are marked. Limits of a project override the standard.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import resources
from typing import Any

from processor import record_checks
from processor.model import InputError, Limit, Tolerance, did_you_mean
from processor.plain_text import tomllib

DEFAULT = "GB 50205-2020"
NAN = float("nan")
NOT_OF_LIMITS = ("class", "needs")  # keys of rows that are no fields of a limit


@lru_cache(maxsize=1)
def standards() -> Mapping[str, Tolerance]:
    """Return all standards by name; one with classes is both ``NAME`` (its class 1) and ``NAME class N``.

    Raises InputError for a file that states what no limit can be, such as a measure that no step gives.
    """
    tolerances: dict[str, Tolerance] = {}
    for content in files():
        name, rows = content["standard"], content["limit"]
        classes = sorted({row["class"] for row in rows if "class" in row})
        for suffix, number in [("", 1), *((f" class {n}", n) for n in classes)]:
            limits = tuple(_limit(row) for row in rows if row.get("class", number) == number)
            tolerance = Tolerance(name + suffix, content["edition"], limits)
            tolerances[name + suffix] = record_checks.check(tolerance, f"limits of {name}")
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
