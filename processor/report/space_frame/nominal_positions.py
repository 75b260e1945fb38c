"""Where the design has the nodes of a frame, in the input's own frame."""

from __future__ import annotations

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Scene
from processor.space_frame.result import Result


def nominal_places(result: Result) -> Floats:
    """Return where the design has each node (k, 3); NaN where no movement is known."""
    balls = result.balls
    if result.movement_reference is None or result.matching is None:
        return np.full_like(balls.centres, np.nan)
    places: Floats = balls.centres - balls.movement @ result.matching.T_design_scan[:3, :3]
    return places


def designed_places(scene: Scene, result: Result) -> Floats:
    """Return where the design has each ball (k, 3); NaN where it has none.

    If the movement of the ball is known, this is the measured centre less the movement. Otherwise it is the design's
    position, placed by the estimated pose if there is one.
    """
    places = nominal_places(result)
    if scene.frame is None:
        return places
    nodes = scene.frame.centres
    if result.matching is not None:
        nodes = rigid.apply(rigid.invert(result.matching.T_design_scan), nodes)
    place_of_id = dict(zip(scene.frame.ids.tolist(), nodes, strict=True))
    for i in np.flatnonzero(~np.isfinite(places).all(axis=1)).tolist():
        places[i] = place_of_id.get(int(result.balls.ids[i]), places[i])
    return places
