"""Sphere targets of a known radius in one scan, by the search of step ``spheres``."""

from __future__ import annotations

import numpy as np

from processor.geometry.merging import MergedCloud
from processor.model import Floats
from processor.space_frame.params import Params
from processor.space_frame.result import Balls, Flag
from processor.space_frame.spheres import isolated

MOST = 30


def find(points: Floats, scanner: Floats | None, radius_mm: float) -> Balls:
    """Return the spheres without a flag among points (n, 3); ``scanner`` (3,) is where they were seen from."""
    seen_from = None if scanner is None else np.broadcast_to(scanner, points.shape)
    params = Params(radius_mm=radius_mm, max_balls=MOST)
    return isolated.search(MergedCloud(points, np.zeros(3), seen_from), params).balls


def sure(balls: Balls) -> list[int]:
    """Return the rows of the spheres that nothing contradicts."""
    return [row for row, flag in enumerate(balls.flag) if flag is Flag.OK]
