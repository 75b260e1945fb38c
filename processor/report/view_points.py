"""What the page's script draws of a surface held against its design: core points by their deviation, and marks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.model import Floats, Ints
from processor.report.drawing import DIVERGING_STOPS, LEAST_SHOWN_MM
from processor.report.results_json import plain

MOST_POINTS = 60_000  # about 1.4 MB of the page
TONES = ("#0072B2", "#000000")


def of_points(
    title: str,
    method: str,
    points: Floats,
    values: Floats,
    parts: Sequence[tuple[str, Ints]],
    marks: Sequence[Any] = (),
) -> dict[str, Any] | None:
    """Return what the page draws of points (n, 3) with values (n,), mm; None where there are no values.

    ``parts`` are names with the rows of their points; each can be switched off. ``marks`` stand on the last part, a
    dict each with name, at (3,), radius and text.
    """
    known = np.isfinite(values)
    if not known.any():
        return None
    origin = np.round(points[known].mean(axis=0))
    step = max(1, -(-int(known.sum()) // MOST_POINTS))
    drawn = []
    for name, rows in parts:
        own = rows[known[rows]][::step]
        near = points[own] - origin
        drawn.append(
            {
                "name": name,
                "edges": [],
                "points": np.rint(near).astype(int).ravel(),
                "residual": np.round(values[own], 3),
            }
        )
    if marks:
        drawn.append({"name": "defects", "edges": [], "points": [], "residual": []})
    found = {
        "title": title,
        "arrows": "",
        "values": "deviations",
        "method": method,
        "origin": origin,
        "stops": DIVERGING_STOPS,
        "tones": TONES,
        "limit": max(float(np.quantile(np.abs(values[known]), 0.98)), LEAST_SHOWN_MM),
        "parts": drawn,
        "marks": [
            {**mark, "part": len(drawn) - 1, "tone": 1, "at": np.round(np.asarray(mark["at"]) - origin, 1)}
            for mark in marks
        ],
    }
    made: dict[str, Any] = plain(found)
    return made
