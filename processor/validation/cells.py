"""Cells of a validation: a scene made from a recipe, run with some methods, and the figures of its checks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from processor.model import Metric, Statistic, Word

HASH_DIGITS = 16  # 64 bits: two of a million settings have one with a chance of 3e-8
SEED_DIGITS = 7  # of a fresh seed, in base 16


class Origin(Word):
    """Who makes a scene."""

    OWN = "designgen"
    FOREIGN = "foreign generators"  # scripts that share no code with designgen and the processor


@dataclass(frozen=True)
class Case:
    """A scene without its seed, and what is run on it; ``settings`` are those of ``designgen make --set``."""

    name: str
    recipe: str  # a recipe of designgen or a foreign generator, or the stem of a file
    recipe_text: str
    from_file: bool
    settings: tuple[str, ...]
    steps: tuple[str, ...]
    methods: tuple[str, ...]
    params: Mapping[str, Any] = field(default_factory=dict)
    origin: Origin = Origin.OWN

    @property
    def recipe_sha256(self) -> str:
        """Hash of the recipe's text."""
        return hashlib.sha256(self.recipe_text.encode("utf-8")).hexdigest()

    @property
    def key(self) -> str:
        """Hash of the case without its methods: figures of one method are comparable if it is the same."""
        return _digest([self.recipe, self.recipe_text, self.settings, self.steps, dict(self.params)])


@dataclass(frozen=True)
class Cell:
    """A case with its seed; ``fixed`` seeds are the same every night."""

    case: Case
    seed: int
    fixed: bool

    @property
    def key(self) -> str:
        """Hash of case, methods and seed: with the same software, cells of one key have the same figures."""
        return _digest([self.case.key, self.case.methods, self.seed])

    @property
    def title(self) -> str:
        """Name of the cell in messages and tables."""
        return " ".join([self.case.name, *self.case.settings, f"seed {self.seed}"])

    def spec(self) -> dict[str, Any]:
        """Return what is needed to run this cell, as JSON can hold it."""
        case = self.case
        return {
            "origin": case.origin,
            "recipe": case.recipe,
            "recipe_text": case.recipe_text if case.from_file or case.origin is Origin.FOREIGN else "",
            "settings": list(case.settings),
            "steps": list(case.steps),
            "methods": list(case.methods),
            "params": dict(case.params),
            "seed": self.seed,
        }


@dataclass(frozen=True)
class Outcome:
    """How a cell ended: ``results`` is its results.json, empty if it ``failed``, which is then the reason."""

    failed: str = ""
    results: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    peak_mb: float = 0.0  # of the largest of its processes


def fresh_seed(case: Case, number: int, i: int) -> int:
    """Return seed ``i`` of a case in the night of that number: another one every night, and for every case.

    The figures of two cases are then independent, as the test of changes assumes.
    """
    return int(_digest([case.key, number, i])[:SEED_DIGITS], 16)


def checks_of(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the checks of a results.json, each with the method it is of; names are without the method."""
    main = {step: str(result.get("method", "")) for step, result in results["steps"].items()}
    return [
        {
            **check,
            "method": check["method"] or main.get(check["step"], ""),
            "name": Metric(check["quantity"], 0.0, Statistic(check["statistic"])).name,
        }
        for check in results["checks"]
    ]


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:HASH_DIGITS]
