"""The report of a night: one line, an object for programs, and the page of all nights."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from processor.language.messages import NO_NUMBER, Text, label, text
from processor.model import Statistic
from processor.report import templates
from processor.report.all_tables import figure_name
from processor.robust_statistics import finite_median
from processor.validation import change_detection
from processor.validation import coverage as intervals
from processor.validation.cells import Origin
from processor.validation.change_detection import ALARMS, Change, ChangeKind, Detected, Direction
from processor.validation.coverage import Coverage
from processor.validation.history import Name, Row
from processor.validation.software_identity import Software

FORMAT, FORMAT_VERSION = "processor-validation", "1.0"
MOST_NAMED = 2  # changes that the line names
SPARK_NIGHTS, SPARK_WIDTH, SPARK_HEIGHT = 60, 120, 22  # two months, at 2 pixels a night, of a table's row
# Numbers are of processor.validation.change_detection and processor.validation.loss.
TEST = text(
    "Fixed seeds give the same scenes every night, so their figures change only with the software. Changed figures "
    "are tested by paired one-sided t tests over the scenes, with a margin of 2 % (1 point for shares). The scatter"
    " is that of the differences or that from seed to seed: the smaller p counts, doubled. Figures of the seeds of "
    "the night are compared with {least} to {most} earlier nights by an exact stratified rank test (normal scores)."
    " Holm's correction covers all tests of a night: if nothing got worse, the chance of any alarm is at most "
    "{rate:g} %. The same holds for improvements.",
    least=change_detection.LEAST_NIGHTS,
    most=change_detection.MOST_NIGHTS,
    rate=100.0 * change_detection.ALARM_RATE,
)


@dataclass(frozen=True)
class Summary:
    """Cells of a night, figures beyond their limits (``missed``), changes (``detected``), and coverage."""

    night: str
    software: Software
    cells: tuple[Mapping[str, Any], ...]
    missed: Sequence[Mapping[str, Any]]
    detected: Detected
    coverage: tuple[Coverage, ...] = ()

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """The cells without results."""
        return [cell for cell in self.cells if cell["failed"]]

    @property
    def keeps_limits(self) -> bool:
        """Whether no limit was missed and all intervals hold what they state."""
        return not self.missed and not self.wrong_intervals

    @property
    def passed(self) -> bool:
        """Whether no limit was missed and nothing got worse."""
        return self.keeps_limits and not self.detected.of(*ALARMS)

    @property
    def wrong_intervals(self) -> list[Coverage]:
        """The quantities whose 95 % intervals hold too little or too much."""
        return intervals.missed(self.coverage)

    @property
    def line(self) -> Text:
        """The night on one line, for a chat channel."""
        misses = len(self.missed)
        failed, detected = len(self.failed), self.detected
        verdict = text("ok") if self.passed and not failed else text("NOT OK")
        if self.keeps_limits and not self.passed:
            verdict = text("WORSE")
        parts = [text("{night} {verdict}", night=self.night, verdict=verdict), self._version()]
        counts = {"cells": len(self.cells) - failed, "figures": detected.figures}
        parts.append(text("{cells} {cells:?cell|cells}, {figures} {figures:?figure|figures}", **counts))
        parts += [text("{cells} {cells:?cell|cells} failed", cells=failed)] if failed else []
        parts.append(text("{count} {count:?limit|limits} missed", count=misses) if misses else text("limits kept"))
        for origin in Origin:
            wrong = [one for one in self.wrong_intervals if one.origin == origin]
            if wrong:
                parts.append(text("intervals of {count} quantities do not hold, scenes of {origin}: {first} {holds}",
                                  count=len(wrong), origin=origin, first=wrong[0].quantity,
                                  holds=wrong[0].holds))  # fmt: skip
        parts += [
            text("{count} {direction}: {changes}", count=len(changed), direction=direction, changes=_listed(changed))
            for kinds, direction in ((ALARMS, Direction.WORSE), ((ChangeKind.IMPROVEMENT,), Direction.BETTER))
            if (changed := detected.of(*kinds))
        ]
        neither = len(detected.of(ChangeKind.CHANGED))
        parts += [text("{count} changed, neither worse nor better", count=neither)] if neither else []
        if detected.first:
            parts.append(text("nothing to compare with yet"))
        elif not detected.changes:
            parts.append(text("nothing changed"))
        if detected.moved_scenes:
            parts.append(text("changed scenes in {count} {count:?cell|cells}", count=detected.moved_scenes))
        names = [f"part{i}" for i in range(len(parts))]
        return Text(" | ".join(f"{{{name}}}" for name in names), dict(zip(names, parts, strict=True)))

    def _version(self) -> Text:
        commit = self.software.commit
        short = commit[:8] + ("+" if commit.endswith("+") else "")
        version = " ".join([self.software.versions.get("steel-scan-check", ""), short]).strip()
        return text("{version}", version=version) if version else text("no version")

    def as_object(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "night": self.night,
            "passed": self.passed,
            "line": str(self.line),
            "commit": self.software.commit,
            "code": self.software.code,
            "software": self.software.versions,
            "cells": [dict(cell) for cell in self.cells],
            "missed": list(self.missed),
            "coverage": [asdict(one) for one in self.coverage],
            "changes": [change_object(change) for change in self.detected.of(*ChangeKind)],
            "test": {
                "about": str(TEST),
                "alarm_rate": change_detection.ALARM_RATE,
                "figures": self.detected.figures,
                "paired": self.detected.paired,
                "fresh": self.detected.fresh,
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
        "said": str(change.message),
        "test": change.test,
        "p": change.p,
        "cases": change.cases,
        "unit": change.unit,
        **size,
    }


def _listed(changed: Sequence[Change]) -> Text:
    """Name the first changes with their sizes, and count the others."""
    parts = [
        text(
            "{step} ({method}) {figure} {change}",
            step=label(change.name[0]),
            method=change.name[1],
            figure=_figure(change.name, change.quantity, change.statistic),
            change=change.message,
        )
        for change in changed[:MOST_NAMED]
    ]
    if len(changed) > MOST_NAMED:
        parts.append(text("{count} more", count=len(changed) - MOST_NAMED))
    listed = parts[-1]
    for part in reversed(parts[:-1]):
        listed = text("{first}; {others}", first=part, others=listed)
    return listed


def _figure(name: Name, quantity: str, statistic: str) -> Text:
    """Return the name of a figure; that in files where the history has no quantity and statistic of it."""
    return figure_name(quantity, Statistic(statistic)) if statistic else label(name[2])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- the page of all nights -----------------------------------------------------------------------------------------


def nights_html(summary: Summary, nights: Sequence[Mapping[str, Any]], rows: Sequence[Row], lang: str = "en") -> str:
    """Return the page in a language: the nights, the latest first, and every figure over the nights."""
    shown = [night["night"] for night in nights][-SPARK_NIGHTS:]
    course: dict[tuple[int, Name], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    last: dict[tuple[int, Name], Row] = {}
    origins = list(Origin)
    for row in rows:
        key = (origins.index(Origin(row.origin)), row.name)
        course[key][row.night].append(row.value)
        last[key] = row
    change_of = {change.name: change for change in summary.detected.changes}
    figures = []
    for key in sorted(course):
        if summary.night not in course[key]:
            continue
        levels = [finite_median(course[key].get(night, [])) for night in shown]
        name = key[1]
        change, row = change_of.get(name), last[key]
        figures.append(
            {
                "origin": origins[key[0]],
                "step": label(name[0]),
                "method": name[1],
                "name": _figure(name, row.quantity, row.statistic),
                "unit": row.unit,
                "value": f"{levels[-1]:.3g}" if math.isfinite(levels[-1]) else NO_NUMBER,
                "spark": _spark(levels),
                "kind": change.kind if change else "",
                "change": change.message if change else "",
            }
        )
    page = templates.render(
        "validation", "nights.html", lang, summary=summary, nights=list(reversed(nights)), figures=figures, test=TEST,
        width=SPARK_WIDTH, height=SPARK_HEIGHT,
    )  # fmt: skip
    return page + "\n"


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
