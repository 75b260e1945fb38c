"""The table of what a step compared with limits, alike for all steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from processor.language.messages import Text, label, text
from processor.limits.judging import JudgedLimits
from processor.model import WORST_FIRST
from processor.report.columns import columns
from processor.report.table import Table

COLUMNS = columns("limit", "of", "verdict", "value", "ci95", "least", "greatest", "unit", "clause")
NOTE = text(
    "± is the 95 % half-width, a dash is no bound or no number. Pass: the whole interval keeps the limit; fail: the "
    "whole interval exceeds it; indeterminate: the limit lies within it, or the value is in doubt."
)
UNVERIFIED = "{note} Not verified: the limits from {sources} were not compared with the published text; do so first."


def limit_table(limits: JudgedLimits | None, file: str) -> list[Table]:
    """Return the table of comparisons, the worst first; none where nothing is limited."""
    if limits is None:
        return []
    note = with_unverified(NOTE, [limits.clause[k] for k in np.flatnonzero(~limits.verified).tolist()])
    title = text("Compared with limits")
    return [Table(title, COLUMNS, tuple(_rows(limits)), file, note, on_page=False)]


def with_unverified(note: Text, clauses: Iterable[str]) -> Text:
    """Add to a note that the limits from these clauses were not compared with the text of their standard."""
    sources = sorted(set(clauses))
    return text(UNVERIFIED, note=note, sources=", ".join(sources)) if sources else note


def worst_first(limits: JudgedLimits) -> list[int]:
    """Return the rows of comparisons, those of the worst verdict first."""
    return sorted(range(len(limits)), key=lambda k: WORST_FIRST.index(limits.verdict[k]))


def _rows(limits: JudgedLimits) -> Iterator[tuple[Any, ...]]:
    for k in worst_first(limits):
        numbers = (float(column[k]) for column in (limits.value, limits.ci95, limits.low, limits.high))
        clause = label(limits.clause[k])
        yield (label(limits.what[k]), limits.of[k], limits.verdict[k], *numbers, limits.unit[k], clause)
