"""What the page's script draws of a surface held against its design: core points by their deviation, and marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from processor.language.messages import Message, text
from processor.model import Floats, Ints
from processor.report.results_json import plain
from processor.report.style import DIVERGING_STOPS, colour_limit

MOST_POINTS = 60_000  # about 1.4 MB of the page
LEAST_POINTS, SAMPLE = 20, 2_000  # to tell the spacing from
TONES = ("#0072B2", "#000000")
MOST_REGIONS, MOST_TICKS = 400, 40  # outlines drawn, and those of them with a tick of their own


@dataclass(frozen=True)
class Region:
    """A part of the surface to be outlined: its name and what is said of it, briefly and in full.

    ``outline`` (m, 3) are the corners of a closed line, ``outward`` (3,) where it is looked at from; both mm.
    """

    name: str
    brief: Message
    text: Message
    outline: Floats
    outward: Floats


def of_points(
    title: str | Message,
    method: str,
    points: Floats,
    values: Floats,
    parts: Sequence[tuple[str, Ints]],
    marks: Sequence[Any] = (),
    regions: Sequence[Region] = (),
    region_of: Ints | None = None,
    named: bool = True,
) -> dict[str, Any] | None:
    """Return what the page draws of points (n, 3) with values (n,), mm; None where there are no values.

    ``parts`` are names with the rows of their points; each can be switched off; where they are not ``named`` by files
    the page translates them. ``marks`` stand on the last part, a dict each with name, at (3,), radius and text.
    ``regions`` are the first ones outlined, with a mark in each and a tick to switch it; ``region_of`` (n,) is the row
    of the region a point is of, -1 = of none.
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
                "name" if named else "text": name,
                "edges": [],
                "points": np.rint(near).astype(int).ravel(),
                "residual": np.round(values[own], 3),
                **({} if region_of is None else {"region": region_of[own]}),
            }
        )
    if marks:
        drawn.append({"text": "defects", "edges": [], "points": [], "residual": []})
    shown = [
        {**mark, "part": len(drawn) - 1, "tone": 1, "at": np.round(np.asarray(mark["at"]) - origin, 1)}
        for mark in marks
    ]
    lines, spots, places = _outlined(regions, origin, len(drawn))
    found = {
        "title": title,
        "arrows": "",
        "values": "deviations",
        "method": method,
        "origin": origin,
        "stops": DIVERGING_STOPS,
        "tones": TONES,
        "limit": colour_limit(values),
        "spacing": spacing(points[known][::step]),
        "parts": drawn + lines,
        "marks": shown + spots,
        "regions": [_heading(region) for region in regions] if region_of is not None else [],
        "places": places,
    }
    made: dict[str, Any] = plain(found)
    return made


def spacing(points: Floats) -> float:
    """Return how far points (n, 3) are apart, by the median of the distances to the nearest ones."""
    if len(points) < LEAST_POINTS:
        return 0.0
    middle = points - points.mean(axis=0)
    some = middle[:: max(1, len(points) // SAMPLE)]
    return round(float(np.median(cKDTree(middle).query(some, k=2)[0][:, 1])), 2)


def _outlined(
    regions: Sequence[Region], origin: Floats, first: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    """Return parts from the row ``first`` on, marks, and places to look at; regions past MOST_TICKS share a part."""
    lines: list[dict[str, Any]] = []
    marks: list[dict[str, Any]] = []
    places: list[dict[str, Any]] = []
    for row, region in enumerate(regions[:MOST_REGIONS]):
        corners = np.round(region.outline - origin, 1)
        brief = _heading(region)
        if row <= MOST_TICKS:
            tick = brief if row < MOST_TICKS else "further ones"
            lines.append({"text": tick, "edges": [], "points": [], "residual": [], "bold": True})
        lines[-1]["edges"].append(np.vstack([corners, corners[:1]]))
        width = float(np.ptp(region.outline, axis=0).max())
        spot = {"name": region.name, "text": region.text, "at": np.round(corners.mean(axis=0), 1), "label": True}
        marks.append({**spot, "part": first + len(lines) - 1, "tone": 1, "radius": round(0.02 * width, 1)})
        places.append({"text": brief, "at": corners, "outward": np.round(region.outward, 4)})
    return lines, marks, places


def _heading(region: Region) -> Message:
    return text("{name}: {brief}", name=region.name, brief=region.brief)
