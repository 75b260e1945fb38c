"""Things in the way of scanners that are no part of what is scanned: poles between stations and it.

Those of roofs are in :mod:`designgen.frame_surfaces`, as they hang below the roof wherever stations stand.
"""

from __future__ import annotations

import numpy as np

from designgen.surfaces import Builder
from processor.model import Floats

ABOVE_MM = 1_000.0  # how far a pole reaches past the line of sight


def add_pole(
    builder: Builder,
    station: Floats,
    target: Floats,
    up: Floats,
    shares: tuple[float, float],
    rng: np.random.Generator,
    *,
    on_ground: bool,
) -> None:
    """Add a pole along ``up`` (3,) across the line from a station (3,) to a target (3,), between two shares of it.

    A pole ``on_ground`` starts at z = 0, another as far below the line as it reaches above it.
    """
    at = station + (target - station) * rng.uniform(*shares) + rng.uniform(-500.0, 500.0, 3)
    radius = rng.uniform(25.0, 60.0)
    below = max(float(at[2]), 0.0) if on_ground else ABOVE_MM
    builder.cone(-1, "pole", at - below * up, up, (radius, radius), below + ABOVE_MM)
