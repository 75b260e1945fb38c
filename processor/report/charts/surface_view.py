"""What the page's script draws of a surface compared with its design: core points by their deviation, and marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from processor.language.messages import Message, text
from processor.model import Floats, Ints
from processor.report.style import DIVERGING_STOPS, colour_limit
from processor.store.json_values import json_ready

MOST_POINTS = 60_000  # about 1.4 MB of the page
LEAST_POINTS, SAMPLE = 20, 2_000  # that the spacing is estimated from
TONES = ("#0072B2", "#000000")
MOST_REGIONS, MOST_TICKS = 400, 40  # outlines drawn, and those of them with a separate tick


@dataclass(frozen=True)
class Region:
    """A part of the surface to be outlined, with its name, a short and a full description.

    ``outline`` (m, 3) are the corners of a closed line in mm, ``outward`` (3,) the direction towards the viewer.
    """

    name: str
    brief: Message
    text: Message
    outline: Floats
    outward: Floats


def surface_view_data(
    title: str | Message,
    method: str,
    points: Floats,
    values: Floats,
    parts: Sequence[tuple[str, Ints]],
    marks: Sequence[Any] = (),
    regions: Sequence[Region] = (),
    region_of: Ints | None = None,
    named: bool = True,
    grey: float = 0.0,
) -> dict[str, Any] | None:
    """Return what the page draws of points (n, 3) with values (n,), mm; None where there are no values.

    ``parts`` are names with the rows of their points, which can be switched off; if not ``named`` by files, the names
    are translated. ``marks`` belong to the last part: dicts with name, at (3,), radius and text. Of ``regions`` the
    first are outlined, each with a mark and a tick to switch it; ``region_of`` (n,) is the row of each point's region,
    -1 = none. Values below ``grey`` may be noise and are drawn without a colour.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return None
    origin = np.round(points[finite].mean(axis=0))
    step = max(1, -(-int(finite.sum()) // MOST_POINTS))
    drawn = []
    for name, rows in parts:
        drawn_rows = rows[finite[rows]][::step]
        near = points[drawn_rows] - origin
        drawn.append(
            {
                "name" if named else "text": name,
                "edges": [],
                "points": np.rint(near).astype(int).ravel(),
                "residual": np.round(values[drawn_rows], 3),
                **({} if region_of is None else {"region": region_of[drawn_rows]}),
            }
        )
    if marks:
        drawn.append({"text": text("defects"), "edges": [], "points": [], "residual": []})
    shown = [_mark(mark, len(drawn) - 1, origin) for mark in marks]
    lines, spots, places = _outlined(regions, origin, len(drawn))
    data = {
        "title": title,
        "arrows": "",
        "values": text("deviations"),
        "method": method,
        "origin": origin,
        "stops": DIVERGING_STOPS,
        "tones": TONES,
        "limit": max(colour_limit(values), 2.0 * grey),
        "grey": grey,
        "spacing": spacing(points[finite][::step]),
        "parts": drawn + lines,
        "marks": shown + spots,
        "regions": [_heading(region) for region in regions] if region_of is not None else [],
        "places": places,
    }
    made: dict[str, Any] = json_ready(data)
    return made


def _mark(mark: dict[str, Any], part: int, origin: Floats) -> dict[str, Any]:
    """Return a mark of the part in row ``part``, about the view's origin."""
    return {**mark, "part": part, "tone": 1, "at": np.round(np.asarray(mark["at"]) - origin, 1)}


def spacing(points: Floats) -> float:
    """Return the median distance of points (n, 3) to their nearest neighbours."""
    if len(points) < LEAST_POINTS:
        return 0.0
    centred = points - points.mean(axis=0)
    sample = centred[:: max(1, len(points) // SAMPLE)]
    return round(float(np.median(cKDTree(centred).query(sample, k=2)[0][:, 1])), 2)


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
