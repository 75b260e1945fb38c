"""Nodes, axes and movements of a frame as a drawing (DXF, release 2010) in millimetres, in the input's own frame.

Layers: NODES has a circle of each ball's radius and a point at its centre, AXES a line a tube, MOVEMENTS a line from
each node's nominal place to where it was found (true to scale), IDS the ids, LOWEST a point at each ball's lowest
place. With a ceiling HANGERS has a line from there to the ceiling and its length, CLASHES a circle about each hanger
that fails. Ids are printable texts; no other text from outside is in it.
"""

from __future__ import annotations

import importlib
import io
from typing import Any

import numpy as np

from processor.model import Verdict
from processor.plain_text import printable
from processor.report.space_frame.nominal_positions import nominal_places
from processor.space_frame.result import Hangers, Result

MILLIMETRES = 4  # of $INSUNITS
METRIC = 1  # of $MEASUREMENT
# With the colours of AutoCAD's index.
LAYERS = {"NODES": 5, "AXES": 8, "MOVEMENTS": 30, "IDS": 7, "LOWEST": 3, "HANGERS": 4, "CLASHES": 1}
TEXT_HEIGHT_MM, CLASH_RADIUS_MM = 50.0, 150.0  # drawn size: 2.5 mm at 1:20; a circle as large as a ball


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
        _draw(document.modelspace(), result)
        low, high = _extent(result)
        document.header["$EXTMIN"], document.header["$EXTMAX"] = tuple(low), tuple(high)
        # The library takes them from a set, whose order differs from run to run.
        document.classes.add_required_classes(document.dxfversion)
        document.classes.classes = dict(sorted(document.classes.classes.items()))
        out = io.StringIO(newline="\n")
        document.write(out)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = fixed
    return out.getvalue().encode("utf-8")


def _draw(space: Any, result: Result) -> None:
    balls, nominal = result.balls, nominal_places(result)
    for i, centre in enumerate(balls.centres.tolist()):
        if not np.isfinite(centre).all():
            continue
        on_nodes, on_ids = {"layer": "NODES"}, {"layer": "IDS"}
        space.add_point(centre, dxfattribs=on_nodes)
        aside = 0.0
        if np.isfinite(balls.radii[i]):
            aside = float(balls.radii[i])
            space.add_circle(centre, aside, dxfattribs=on_nodes)
        text = space.add_text(printable(str(balls.names[i])), height=TEXT_HEIGHT_MM, dxfattribs=on_ids)
        text.set_placement((centre[0] + aside, centre[1] + aside, centre[2]))
        if np.isfinite(nominal[i]).all():
            space.add_line(nominal[i].tolist(), centre, dxfattribs={"layer": "MOVEMENTS"})
        if np.isfinite(balls.lowest[i]).all():
            space.add_point(balls.lowest[i].tolist(), dxfattribs={"layer": "LOWEST"})
    for start, end in zip(result.tubes.start.tolist(), result.tubes.end.tolist(), strict=True):
        space.add_line(start, end, dxfattribs={"layer": "AXES"})
    if result.hangers is not None:
        _draw_hangers(space, result.hangers)


def _draw_hangers(space: Any, hangers: Hangers) -> None:
    on_hangers, on_clashes = {"layer": "HANGERS"}, {"layer": "CLASHES"}
    for i in np.flatnonzero(np.isfinite(hangers.length)).tolist():
        top, bottom = hangers.top[i].tolist(), hangers.bottom[i].tolist()
        space.add_line(top, bottom, dxfattribs=on_hangers)
        text = space.add_text(f"{hangers.length[i]:.0f}", height=TEXT_HEIGHT_MM, dxfattribs=on_hangers)
        text.set_placement((bottom[0], bottom[1] - 1.5 * TEXT_HEIGHT_MM, bottom[2]))
        if hangers.verdict[i] is Verdict.FAIL:
            space.add_circle(top, CLASH_RADIUS_MM, dxfattribs=on_clashes)


def _extent(result: Result) -> tuple[list[float], list[float]]:
    """Corners of all places, so that a viewer opens on the frame and not on the origin."""
    ends = [] if result.hangers is None else [result.hangers.bottom]
    places = np.vstack([result.balls.centres, result.tubes.start, result.tubes.end, *ends])
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return [0.0] * 3, [0.0] * 3
    return places.min(axis=0).tolist(), places.max(axis=0).tolist()
