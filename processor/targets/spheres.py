"""Sphere targets of a known radius in one scan, by the search of step ``spheres``."""

from __future__ import annotations

import numpy as np

from processor.model import Floats
from processor.scene_cloud import MergedCloud
from processor.space_frame.params import Params
from processor.space_frame.result import Balls, Flag
from processor.space_frame.spheres import search_without_design

MOST = 30  # spheres of a view


def find(points: Floats, scanner: Floats | None, radius_mm: float) -> tuple[Balls, bool]:
    """Return the spheres among points (n, 3), flagged ones too, and whether the search stopped at MOST of them.

    ``scanner`` (3,) is where the points were seen from, None if not known.
    """
    seen_from = None if scanner is None else np.broadcast_to(scanner, points.shape)
    params = Params(radius_mm=radius_mm, max_balls=MOST)
    balls = search_without_design.search(MergedCloud(points, np.zeros(3), seen_from), params).balls
    return balls, len(balls) >= MOST


def sure(balls: Balls) -> list[int]:
    """Return the rows of the spheres that nothing contradicts."""
    return [row for row, flag in enumerate(balls.flag) if flag is Flag.OK]
