"""Points picked by hand in pairs of scans, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from designgen.randomness import generator
from processor.model import Floats, Picks, Scan, UsageError

AWAY_FROM_A_LINE = 0.15  # least extent of the points across their line, as a fraction of their largest distance
MOST_DRAWS = 10_000


@dataclass(frozen=True)
class Params:
    """How points are picked; ``apart_mm`` is the least distance between two points of a pair of scans."""

    points: int = 3
    sigma_mm: float = 5.0  # of each coordinate in each scan
    apart_mm: float = 4000.0


def pick(scans: Sequence[Scan], T_project_scan: Sequence[Floats], params: Params, seed: int) -> tuple[Picks, Floats]:
    """Pick points in a ring of scans, each paired with the two after it; also their true places (q, 3) in the project.

    The points are points of the first scan of a pair; whether the second scan sees them is not checked. Coordinates in
    both scans have noise. Raises UsageError for less than two scans or three points, and for a scan without points far
    enough from one another.
    """
    if params.points < 3 or not params.sigma_mm >= 0.0 or not params.apart_mm >= 0.0:
        raise UsageError(
            "picks: expected points from 3, sigma_mm and apart_mm from 0, got "
            f"{params.points}, {params.sigma_mm:g} and {params.apart_mm:g}"
        )
    if len(scans) < 2:
        raise UsageError("picks: expected two scans or more; give the recipe more stations, and leave them unmerged")
    rng = generator(seed, "picks")
    scan_a, scan_b, names = [], [], []
    in_a, in_b, places = [], [], []
    for a, b in _pairs(len(scans)):
        true_a = _draw_points(scans[a], params, rng) + scans[a].origin
        place = true_a @ T_project_scan[a][:3, :3].T + T_project_scan[a][:3, 3]
        true_b = (place - T_project_scan[b][:3, 3]) @ T_project_scan[b][:3, :3]
        places.append(place)
        in_a.append(true_a + rng.normal(0.0, params.sigma_mm, true_a.shape))
        in_b.append(true_b + rng.normal(0.0, params.sigma_mm, true_b.shape))
        scan_a += [scans[a].name] * len(place)
        scan_b += [scans[b].name] * len(place)
        names += [f"P{k + 1}" for k in range(len(place))]
    return Picks(tuple(scan_a), tuple(scan_b), tuple(names), np.vstack(in_a), np.vstack(in_b)), np.vstack(places)


def _pairs(count: int) -> list[tuple[int, int]]:
    ring = {tuple(sorted((i, (i + step) % count))) for i in range(count) for step in (1, 2) if step < count}
    return sorted((a, b) for a, b in ring)


def _draw_points(scan: Scan, params: Params, rng: np.random.Generator) -> Floats:
    """Draw points (k, 3) of a scan that are far from one another and from a common line."""
    for _ in range(MOST_DRAWS):
        if len(scan.points) < params.points:
            break
        points: Floats = scan.points[rng.choice(len(scan.points), params.points, replace=False)]
        sides = np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(params.points, 1)]
        # The second singular value is the points' extent across their best line.
        across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
        if sides.min() >= params.apart_mm and across > AWAY_FROM_A_LINE * sides.max():
            return points
    raise UsageError(
        f"picks: scan {scan.name} has no {params.points} points {params.apart_mm:g} mm from one another and away from "
        "a line; give fewer points or a smaller picks.apart_mm"
    )
