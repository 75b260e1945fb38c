"""Points picked by hand in pairs of scans, with noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from designgen.checks import expect_all
from designgen.randomness import generator
from processor.model import Bools, Floats, Picks, Scan, UsageError

AWAY_FROM_A_LINE = 0.15  # least extent of the points across their line, as a fraction of their largest distance
MOST_DRAWS = 10_000  # work: then places far enough apart are given up
PLACES = ("points", "corners")
CORNER_REACH_MM = 100.0  # from a corner that a scan saw to a point of it


@dataclass(frozen=True)
class Params:
    """How points are picked; ``apart_mm`` is the least distance between two points of a pair of scans.

    ``at`` is "points", any points of the first scan of a pair, or "corners" of the structure that it saw.
    """

    points: int = 3
    sigma_mm: float = 5.0  # of each coordinate in each scan
    apart_mm: float = 4000.0
    at: str = "points"

    def __post_init__(self) -> None:
        expect_all(
            "picks",
            (self.points >= 3, "points", self.points, "3 or more"),
            (self.sigma_mm >= 0.0, "sigma_mm", self.sigma_mm, "0 or more"),
            (self.apart_mm >= 0.0, "apart_mm", self.apart_mm, "0 or more"),
            (self.at in PLACES, "at", self.at, " or ".join(PLACES)),
        )


def pick(
    scans: Sequence[Scan],
    T_project_scan: Sequence[Floats],
    params: Params,
    seed: int,
    corners: Floats | None = None,
    sees: Callable[[Floats], Bools] | None = None,
) -> tuple[Picks, Floats]:
    """Pick points in a ring of scans, each paired with the two after it; also their true places (q, 3) in the project.

    They are points of the first scan of a pair, or those of the ``corners`` (c, 3), project's frame, that it saw. The
    second ``sees`` them if they lie in its field of view; whether anything hides them is not checked. Coordinates in
    both scans have noise. A pair of scans without such points far enough from one another is left out. Raises
    UsageError for less than two scans, and where too few pairs are left to join all scans.
    """
    if len(scans) < 2:
        raise UsageError("picks: expected two scans or more; give the recipe more stations, and leave them unmerged")
    rng = generator(seed, "picks")
    scan_a, scan_b, names = [], [], []
    in_a, in_b, places = [], [], []
    for a, b in _pairs(len(scans)):
        points = scans[a].points + scans[a].origin
        if params.at == "corners" and corners is not None:
            points = _seen(_into(T_project_scan[a], corners), points)
        if sees is not None:
            points = points[sees(_into(T_project_scan[b], _out_of(T_project_scan[a], points)))]
        drawn = _draw_points(points, params, rng)
        if drawn is None:
            continue
        place = _out_of(T_project_scan[a], drawn)
        true_b = _into(T_project_scan[b], place)
        places.append(place)
        in_a.append(drawn + rng.normal(0.0, params.sigma_mm, drawn.shape))
        in_b.append(true_b + rng.normal(0.0, params.sigma_mm, true_b.shape))
        scan_a += [scans[a].name] * len(place)
        scan_b += [scans[b].name] * len(place)
        names += [f"P{k + 1}" for k in range(len(place))]
    _check_joined(scans, list(zip(scan_a, scan_b, strict=True)), params)
    return Picks(tuple(scan_a), tuple(scan_b), tuple(names), np.vstack(in_a), np.vstack(in_b)), np.vstack(places)


def _out_of(T: Floats, points: Floats) -> Floats:
    moved: Floats = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _into(T: Floats, points: Floats) -> Floats:
    moved: Floats = (points - T[:3, 3]) @ T[:3, :3]
    return moved


def _seen(corners: Floats, points: Floats) -> Floats:
    """Return the corners (k, 3) that a scan of points (n, 3) has points at."""
    from scipy.spatial import cKDTree

    unique = np.unique(np.round(corners, 3), axis=0)
    seen: Floats = unique[cKDTree(points).query(unique)[0] < CORNER_REACH_MM]
    return seen


def _check_joined(scans: Sequence[Scan], pairs: Sequence[tuple[str, str]], params: Params) -> None:
    """Raise UsageError for scans that no chain of pairs joins to the first."""
    joined = {scans[0].name}
    while more := {name for pair in pairs for name in pair if joined & set(pair)} - joined:
        joined |= more
    if alone := next((scan.name for scan in scans if scan.name not in joined), None):
        raise UsageError(
            f"picks: scan {alone} has no {params.points} {params.at} in common with the others that lie "
            f"{params.apart_mm:g} mm from one another and away from a line; give fewer points or a smaller "
            "picks.apart_mm"
        )


def _pairs(count: int) -> list[tuple[int, int]]:
    ring = {tuple(sorted((i, (i + step) % count))) for i in range(count) for step in (1, 2) if step < count}
    return sorted((a, b) for a, b in ring)


def _draw_points(candidates: Floats, params: Params, rng: np.random.Generator) -> Floats | None:
    """Draw points (k, 3) that are far from one another and from a common line; None where none were found."""
    for _ in range(MOST_DRAWS):
        if len(candidates) < params.points:
            break
        points: Floats = candidates[rng.choice(len(candidates), params.points, replace=False)]
        sides = np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(params.points, 1)]
        if sides.min() < params.apart_mm:
            continue
        # The second singular value is the points' extent across their best line.
        across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1]
        if across > AWAY_FROM_A_LINE * sides.max():
            return points
    return None
