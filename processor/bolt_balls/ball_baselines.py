"""The source paper's two estimators on the points that the ray fit had: to be compared, not to be relied on.

Source: paper 001 (Huang et al. 2019), equations 12-15 and section 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.bolt_balls import ball_ends
from processor.bolt_balls.ball_records import Balls
from processor.bolt_balls.ball_residuals import select
from processor.bolt_balls.balls import Params
from processor.bolt_balls.crops import Crops
from processor.bolt_balls.nodes import Nodes, Tubes
from processor.geometry.sphere import Sphere, algebraic
from processor.geometry.sphere_ransac import ransac
from processor.model import Checked, Floats, Ints, UsageError, column

METHODS = ("least-squares", "ransac")


@dataclass(frozen=True)
class Baselines(Checked):
    """Balls by one of the paper's methods at k nodes, mm, less the source's origin; NaN where there is none."""

    centres: Floats = column("k", 3)
    radii: Floats = column("k")
    covariance: Floats = column("k", 4, 4)  # formal
    points: Ints = column("k", dtype=np.int64)


def paper_estimates(
    crops: Crops,
    nodes: Nodes,
    tubes: Tubes,
    balls: Balls,
    method: str = "least-squares",
    seed: int = 0,
    margin_mm: float = 8.0,
    tau_mm: float = 4.0,
) -> Baselines:
    """Fit every ball to the points within ``margin_mm`` of it that neither sleeves nor the process hole take away.

    RANSAC draws from a generator of (seed, row of the node): it depends on them, as the paper's does.
    """
    if method not in METHODS:
        raise UsageError(f"the paper's methods: expected {' or '.join(METHODS)}, got {method!r}")
    found = ball_ends.ends(nodes, tubes)
    local = np.column_stack([balls.centres - nodes.positions, balls.radii])
    corner = ball_ends.measured(found, crops.start, crops.points, local[:, :3], local[:, 3])
    keep_off = corner + ball_ends.FLAT_MM + ball_ends.AXIS_MM
    params = Params()
    k = nodes.count
    states, covariance, counts = np.full((k, 4), np.nan), np.full((k, 4, 4), np.nan), np.zeros(k, np.int64)
    for i in np.flatnonzero((balls.points > 0) & np.isfinite(balls.radii)):
        points = crops.points[crops.start[i] : crops.start[i + 1]]
        members = slice(found.start[i], found.start[i + 1])
        chosen = np.zeros(len(points), np.uint8)
        select(
            points, np.zeros_like(points), found.points[members], found.directions[members], keep_off[members],
            params.process_hole_mm, local[i], 0.0, margin_mm, chosen,
        )  # fmt: skip
        on = points[chosen == 1]
        sphere: Sphere | None
        if method == "least-squares":
            sphere = algebraic(on)
        else:
            consensus = ransac(on, np.random.default_rng([seed, int(i)]), tau_mm)
            sphere = None if consensus is None else consensus.sphere
        counts[i] = len(on)
        if sphere is not None:
            states[i] = np.append(sphere.centre + nodes.positions[i], sphere.radius)
            covariance[i] = sphere.covariance
    return Baselines(states[:, :3], states[:, 3], covariance, counts)
