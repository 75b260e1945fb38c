"""The report of a night: one line, an object for programs, and the page of all nights."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from processor.language import language
from processor.validation import changes
from processor.validation.cells import Figure
from processor.validation.changes import ALARMS, CHANGED, IMPROVEMENT, Change, Found
from processor.validation.history import Name, Night, Row
from processor.validation.software import Software

FORMAT, FORMAT_VERSION = "processor-validation", "1.0"
MOST_NAMED = 2  # changes that the line names
SPARK_NIGHTS, SPARK_WIDTH, SPARK_HEIGHT = 60, 120, 22
TEST = (
    "Fixed seeds: the same scenes every night, whose figures move only when the software does; where they moved, "
    "paired one-sided t tests over the scenes against a margin of 2 % (1 point for shares), by the differences' own "
    "scatter and by that from seed to seed, the smaller p doubled. Seeds of the night: an exact stratified rank "
    f"test (normal scores) against {changes.LEAST_NIGHTS} to {changes.MOST_NIGHTS} earlier nights. Holm's correction "
    "over all tests of a night: on a night when nothing got worse, the chance of any alarm is at most "
    f"{100.0 * changes.ALARM_RATE:g} %; the same for improvements."
)


@dataclass(frozen=True)
class Summary:
    """Cells of a night, figures beyond their limits by cell (``missed``), and changes (``found``)."""

    night: str
    software: Software
    cells: tuple[Mapping[str, Any], ...]
    missed: Mapping[str, Sequence[Figure]]
    found: Found

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """The cells without results."""
        return [cell for cell in self.cells if cell["failed"]]

    @property
    def passed(self) -> bool:
        """Whether no limit was missed and nothing got worse."""
        return not self.missed and not self.found.of(*ALARMS)

    @property
    def line(self) -> str:
        """The night on one line, for a chat channel."""
        misses = sum(map(len, self.missed.values()))
        verdict = "ok" if self.passed and not self.failed else "NOT OK"
        parts = [f"{self.night} {verdict}", self._version()]
        parts.append(f"{_count(len(self.cells) - len(self.failed), 'cell')}, {_count(self.found.figures, 'figure')}")
        parts += [f"{_count(len(self.failed), 'cell')} failed"] if self.failed else []
        parts.append(f"{_count(misses, 'limit')} missed" if misses else "limits kept")
        for kinds, word in ((ALARMS, "worse"), ((IMPROVEMENT,), "better")):
            changed = self.found.of(*kinds)
            if changed:
                more = f"; {len(changed) - MOST_NAMED} more" if len(changed) > MOST_NAMED else ""
                parts.append(f"{len(changed)} {word}: {'; '.join(map(_named, changed[:MOST_NAMED]))}{more}")
        neither = len(self.found.of(CHANGED))
        parts += [f"{neither} moved, neither worse nor better"] if neither else []
        if self.found.first:
            parts.append("nothing to compare with yet")
        elif not self.found.changes:
            parts.append("nothing changed")
        parts += [f"scenes of {self.found.moved_scenes} cells are others"] if self.found.moved_scenes else []
        return " | ".join(parts)

    def _version(self) -> str:
        commit = self.software.commit
        short = commit[:8] + ("+" if commit.endswith("+") else "")
        return " ".join([self.software.versions.get("steel-scan-check", ""), short]).strip() or "no version"

    def as_object(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "night": self.night,
            "passed": self.passed,
            "line": self.line,
            "commit": self.software.commit,
            "code": self.software.code,
            "software": self.software.versions,
            "cells": [dict(cell) for cell in self.cells],
            "missed": [
                {"cell": cell, "step": f.step, "method": f.method, "name": f.name, "value": _finite(f.value)}
                | {"limit": f.limit, "unit": f.unit}
                for cell, figures in self.missed.items()
                for f in figures
            ],
            "changes": [change_object(change) for change in self.found.of(*ALARMS, IMPROVEMENT, CHANGED)],
            "test": {
                "about": TEST,
                "alarm_rate": changes.ALARM_RATE,
                "figures": self.found.figures,
                "paired": self.found.paired,
                "fresh": self.found.fresh,
            },
        }


def change_object(change: Change) -> dict[str, Any]:
    """Return a change as an object; its size is a ``ratio`` or a ``difference``, positive or above 1 if worse."""
    step, method, name = change.name
    size = {"ratio": _finite(math.exp(change.size))} if change.is_ratio else {"difference": _finite(change.size)}
    return {
        "step": step,
        "method": method,
        "name": name,
        "kind": change.kind,
        "said": change.said,
        "test": change.test,
        "p": change.p,
        "cases": change.cases,
        "unit": change.unit,
        **size,
    }


def _named(change: Change) -> str:
    step, method, name = change.name
    return f"{step} ({method}) {name} {change.said}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- the page of all nights -----------------------------------------------------------------------------------------


def nights_html(summary: Summary, nights: Sequence[Night], rows: Sequence[Row], lang: str = "en") -> str:
    """Return the page in a language: the nights, the latest first, and every figure over the nights."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["say"] = language(lang).say
    shown = [night.night for night in nights][-SPARK_NIGHTS:]
    course: dict[Name, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    units: dict[Name, str] = {}
    for row in rows:
        course[row.name][row.night].append(row.value)
        units[row.name] = row.unit
    change_of = {change.name: change for change in summary.found.changes}
    figures = []
    for name in sorted(course):
        if summary.night not in course[name]:
            continue
        levels = [_middle(course[name].get(night, [])) for night in shown]
        change = change_of.get(name)
        figures.append(
            {
                "name": name,
                "unit": units[name],
                "value": f"{levels[-1]:.3g}" if math.isfinite(levels[-1]) else "–",
                "spark": _spark(levels),
                "kind": change.kind if change else "",
                "said": change.said if change else "",
            }
        )
    text: str = environment.get_template("nights.html").render(
        lang=lang,
        summary=summary,
        nights=list(reversed(nights)),
        figures=figures,
        test=TEST,
        width=SPARK_WIDTH,
        height=SPARK_HEIGHT,
    )
    return text + "\n"


def _middle(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def _spark(levels: Sequence[float]) -> list[str]:
    """Return the points of polylines through the levels, one for every run of nights that have a level."""
    finite = [level for level in levels if math.isfinite(level)]
    if not finite:
        return []
    low, high = min(finite), max(finite)
    scale = (SPARK_HEIGHT - 4) / (high - low) if high > low else 0.0
    step = (SPARK_WIDTH - 4) / max(1, len(levels) - 1)
    runs: list[list[str]] = [[]]
    for i, level in enumerate(levels):
        if math.isfinite(level):
            y = SPARK_HEIGHT - 2 - scale * (level - low) if scale else SPARK_HEIGHT / 2
            runs[-1].append(f"{2 + i * step:.1f},{y:.1f}")
        elif runs[-1]:
            runs.append([])
    return [" ".join([*run, run[-1]]) for run in runs if run]  # the last point twice: a single one would not be drawn
