"""The page of the comparison with the source papers, and its summary line."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from processor.language.messages import NO_NUMBER, Text, text
from processor.report import templates
from processor.report.charts import line_chart as drawing
from processor.report.charts.line_chart import Chart
from tests.bench.papers.data_sets import Measured
from tests.bench.papers.rows import DECADE, TOLERANCE, Outcome, Row

RULE = text(
    "An error is reproduced where the median over the seeds is at most the published one, a quantity where it is near "
    "it, both with a tolerance of {percent:.0f} %; a blunder where it is within a factor of {decade:.1f}; a statement "
    "where it holds in every seed. Rows without a published number are for comparison. The data are simulated.",
    percent=100.0 * TOLERANCE,
    decade=DECADE,
)


def summary_line(rows: Sequence[Row], seeds: int) -> Text:
    """Return the line that says how many numbers are reproduced."""
    outcomes = [row.outcome for row in rows if math.isfinite(row.published)]
    return text(
        "{yes} of {total} published numbers reproduced, {no} not, {none} not made; {seeds} {seeds:?seed|seeds}",
        yes=outcomes.count(Outcome.YES),
        no=outcomes.count(Outcome.NO),
        none=outcomes.count(Outcome.NOT_MADE),
        total=len(outcomes),
        seeds=seeds,
    )


def html(
    by_paper: Mapping[str, tuple[Sequence[Row], Sequence[Chart], Sequence[Measured]]], line: Text, lang: str
) -> str:
    """Return the page in a language, with the rows, charts and data sets of every paper."""
    papers = []
    for number, (rows, charts, measured) in by_paper.items():
        papers.append(
            {
                "number": number,
                "rows": [_cells(row) for row in rows],
                "charts": [{"title": one.title, "image": drawing.png(one)} for one in charts],
                "failures": [
                    f"{one.data_set.name} ({one.data_set.seed}): {one.failed}" for one in measured if one.failed
                ],
            }
        )
    return templates.render(Path(__file__).parent, "page.html", lang, line=line, rule=RULE, papers=papers) + "\n"


def _cells(row: Row) -> dict[str, Any]:
    return {
        "place": row.place,
        "data": row.data,
        "method": row.method,
        "quantity": row.quantity,
        "published": "" if math.isnan(row.published) else number(row.published),
        "median": number(row.median),
        "worst": number(row.worst),
        "unit": row.unit,
        "outcome": row.outcome,
        "reason": row.reason,
    }


def number(value: float) -> str:
    """Write a number with three significant digits."""
    if not math.isfinite(value):
        return NO_NUMBER
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
