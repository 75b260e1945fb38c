"""Nodes, axes and movements of a frame as a drawing (DXF, release 2010) in millimetres, in the input's own frame.

Layers: NODES has a circle of each ball's radius and a point at its centre, AXES a line a tube, MOVEMENTS a line from
each node's nominal place to where it was found (true to scale), IDS the ids, LOWEST a point at each ball's lowest
place. With a ceiling HANGERS has a line from there to the ceiling and its length, CLASHES a circle about each hanger
that fails. No text from outside is in it.
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from processor.model import Verdict
from processor.report.space_frame.nominal_positions import nominal_places
from processor.space_frame.result import Hangers, Result

MILLIMETRES = 4  # of $INSUNITS
METRIC = 1  # of $MEASUREMENT
# With the colours of AutoCAD's index.
LAYERS = {"NODES": 5, "AXES": 8, "MOVEMENTS": 30, "IDS": 7, "LOWEST": 3, "HANGERS": 4, "CLASHES": 1}
SECTION = "  0\nSECTION\n  2\nENTITIES\n"
TEXT_HEIGHT_MM, CLASH_RADIUS_MM = 50.0, 150.0


def drawing(result: Result) -> bytes:
    """Draw a frame; the same bytes for the same result."""
    ezdxf: Any = importlib.import_module("ezdxf")  # takes a while: not where nothing is drawn

    fixed = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # no dates, no random ids
    try:
        document: Any = ezdxf.new("R2010", units=MILLIMETRES)
        document.header["$MEASUREMENT"] = METRIC
        for name, colour in LAYERS.items():
            document.layers.add(name, color=colour)
        entities = Entities(document.entitydb.next_handle, document.modelspace().layout_key)
        _draw(entities, result)
        low, high = _extent(result)
        document.header["$EXTMIN"], document.header["$EXTMAX"] = tuple(low), tuple(high)
        # The library takes them from a set, whose order differs from run to run.
        document.classes.add_required_classes(document.dxfversion)
        document.classes.classes = dict(sorted(document.classes.classes.items()))
        out = io.StringIO(newline="\n")
        document.write(out)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = fixed
    head, section, tail = out.getvalue().partition(SECTION)
    return "".join([head, section, *entities.written, tail]).encode("utf-8")


class Entities:
    """Entities of a drawing's model space as text: the library takes six times as long to make and write them.

    ``handle`` gives the next one of the drawing, ``owner`` is the handle of the model space.
    """

    def __init__(self, handle: Callable[[], str], owner: str) -> None:
        self.written: list[str] = []
        self._handle, self._owner = handle, owner

    def add(self, kind: str, layer: str, *groups: tuple[int, Any], end: str = "") -> None:
        """Add an entity with the groups of its own subclass: code and value. ``end`` names a subclass without any."""
        name = f"AcDb{kind.title()}"
        head = ((0, kind), (5, self._handle()), (330, self._owner), (100, "AcDbEntity"), (8, layer), (100, name))
        last = ((100, end),) if end else ()
        self.written += [f"{code:>3}\n{value}\n" for code, value in (*head, *groups, *last)]

    def add_point(self, layer: str, place: Sequence[float]) -> None:
        """Add a point at a place (3,)."""
        self.add("POINT", layer, *_at(place))

    def add_circle(self, layer: str, centre: Sequence[float], radius: float) -> None:
        """Add a circle about a place (3,)."""
        self.add("CIRCLE", layer, *_at(centre), (40, radius))

    def add_line(self, layer: str, start: Sequence[float], end: Sequence[float]) -> None:
        """Add a line between places (3,)."""
        self.add("LINE", layer, *_at(start), *_at(end, 1))

    def add_text(self, layer: str, written: str, place: Sequence[float]) -> None:
        """Add a text of a line at a place (3,)."""
        self.add("TEXT", layer, *_at(place), (40, TEXT_HEIGHT_MM), (1, written), *_at(place, 1), end="AcDbText")


def _at(place: Sequence[float], number: int = 0) -> tuple[tuple[int, float], ...]:
    """Return the groups of a place (3,), the first or a further one of an entity."""
    return tuple((10 * axis + number, value) for axis, value in enumerate(place, start=1))


def _draw(entities: Entities, result: Result) -> None:
    balls, nominal = result.balls, nominal_places(result)
    for i, centre in enumerate(balls.centres.tolist()):
        if not np.isfinite(centre).all():
            continue
        entities.add_point("NODES", centre)
        aside = 0.0
        if np.isfinite(balls.radii[i]):
            aside = float(balls.radii[i])
            entities.add_circle("NODES", centre, aside)
        entities.add_text("IDS", str(int(balls.ids[i])), (centre[0] + aside, centre[1] + aside, centre[2]))
        if np.isfinite(nominal[i]).all():
            entities.add_line("MOVEMENTS", nominal[i].tolist(), centre)
        if np.isfinite(balls.lowest[i]).all():
            entities.add_point("LOWEST", balls.lowest[i].tolist())
    for start, end in zip(result.tubes.start.tolist(), result.tubes.end.tolist(), strict=True):
        entities.add_line("AXES", start, end)
    if result.hangers is not None:
        _draw_hangers(entities, result.hangers)


def _draw_hangers(entities: Entities, hangers: Hangers) -> None:
    for i in np.flatnonzero(np.isfinite(hangers.length)).tolist():
        top, bottom = hangers.top[i].tolist(), hangers.bottom[i].tolist()
        entities.add_line("HANGERS", top, bottom)
        beside = (bottom[0], bottom[1] - 1.5 * TEXT_HEIGHT_MM, bottom[2])
        entities.add_text("HANGERS", f"{hangers.length[i]:.0f}", beside)
        if hangers.verdict[i] is Verdict.FAIL:
            entities.add_circle("CLASHES", top, CLASH_RADIUS_MM)


def _extent(result: Result) -> tuple[list[float], list[float]]:
    """Corners of all places, so that a viewer opens on the frame and not on the origin."""
    ends = [] if result.hangers is None else [result.hangers.bottom]
    places = np.vstack([result.balls.centres, result.tubes.start, result.tubes.end, *ends])
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return [0.0] * 3, [0.0] * 3
    return places.min(axis=0).tolist(), places.max(axis=0).tolist()
