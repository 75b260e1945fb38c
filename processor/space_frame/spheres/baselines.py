"""The source paper's two estimators on the points that the ray fit had: to be compared, not to be relied on.

Source: paper 001 (Huang et al. 2019), equations 12-15 and section 2.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry.sphere import Sphere, algebraic, ransac
from processor.model import Checked, Floats, Ints, Tolerance, UsageError, column
from processor.space_frame.extract import Extracted
from processor.space_frame.members.records import Nodes, Tubes
from processor.space_frame.params import Params as PaperParams
from processor.space_frame.points.sphere_crops import Crops, gather
from processor.space_frame.result import Result
from processor.space_frame.spheres import isolated, occlusion
from processor.space_frame.spheres.fit_all import Params
from processor.space_frame.spheres.gauss_newton import select
from processor.space_frame.spheres.records import Balls

MARGIN_MM = 8.0  # beyond a ball and within it: about what the ray fit looks at with 2 mm of noise
SLEEVES_MM = 26.0  # beyond a ball: sleeves are measured there
SAME = "fitted to the points that method ray took for each ball, off sleeves and process hole; covariances are formal"
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
    margin_mm: float = MARGIN_MM,
    tau_mm: float = 4.0,
) -> Baselines:
    """Fit every ball to the points that :func:`points_of_balls` gives.

    RANSAC draws from a generator of (seed, row of the node): it depends on them, as the paper's does.
    """
    if method not in METHODS:
        raise UsageError(f"the paper's methods: expected {' or '.join(METHODS)}, got {method!r}")
    k = nodes.count
    states, covariance, counts = np.full((k, 4), np.nan), np.full((k, 4, 4), np.nan), np.zeros(k, np.int64)
    for i, on in enumerate(points_of_balls(crops, nodes, tubes, balls, margin_mm)):
        sphere: Sphere | None
        if method == "least-squares":
            sphere = algebraic(on)
        else:
            consensus = ransac(on, np.random.default_rng([seed, i]), tau_mm) if len(on) else None
            sphere = None if consensus is None else consensus.sphere
        counts[i] = len(on)
        if sphere is not None:
            states[i] = np.append(sphere.centre + nodes.positions[i], sphere.radius)
            covariance[i] = sphere.covariance
    return Baselines(states[:, :3], states[:, 3], covariance, counts)


def points_of_balls(
    crops: Crops, nodes: Nodes, tubes: Tubes, balls: Balls, margin_mm: float = MARGIN_MM
) -> list[Floats]:
    """Points (n, 3) of each ball, less its node: within ``margin_mm`` of it, off sleeves and process hole."""
    found = occlusion.ends(nodes, tubes)
    local = np.column_stack([balls.centres - nodes.positions, balls.radii])
    corner = occlusion.measured(found, crops.start, crops.points, local[:, :3], local[:, 3])
    keep_off = corner + occlusion.FLAT_MM + occlusion.AXIS_MM
    params = Params()
    every = [np.empty((0, 3))] * nodes.count
    for i in np.flatnonzero((balls.points > 0) & np.isfinite(balls.radii)).tolist():
        points = crops.points[crops.start[i] : crops.start[i + 1]]
        members = slice(found.start[i], found.start[i + 1])
        chosen = np.zeros(len(points), np.uint8)
        select(
            points, np.zeros_like(points), found.points[members], found.directions[members], keep_off[members],
            params.process_hole_mm, local[i], 0.0, margin_mm, chosen,
        )  # fmt: skip
        every[i] = points[chosen == 1]
    return every


def compared(found: Extracted, ids: Ints, params: PaperParams, limits: Tolerance) -> Result:
    """Balls (k,) of method ``ray`` by one of the paper's methods, fitted to the same points."""
    balls, nodes = found.balls, found.nodes
    seen = balls.radii[balls.points > 0]
    largest = float(seen.max()) if len(seen) else 0.0
    apart = np.linalg.norm(balls.centres - nodes.positions, axis=1)[balls.points > 0].max(initial=0.0)
    crops = gather(found.source, nodes.positions, largest + float(apart) + SLEEVES_MM)
    points = points_of_balls(crops, nodes, found.tubes, balls)
    return isolated.fit_points(points, nodes.positions, ids, balls.expected, found.source.origin, params, limits, SAME)
