"""What the page's script draws of stitched scans: their points, by how far the other scans' surface lies from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.geometry import parallel, rigid
from processor.model import NORMAL_95, Floats, Scan, Scene, StepRun
from processor.report.results_json import plain
from processor.report.style import DIVERGING_STOPS, colour_limit
from processor.report.surface_view import spacing
from processor.report.table import shown
from processor.stitching.result import Result

MOST_POINTS = 60_000  # of all scans: about 1.4 MB of the page
MOST_SEARCHED = 400_000  # of each scan
NEIGHBOURS = 12
REACH_MM = 200.0  # of neighbours, at most
LEAST_FLAT = 4.0  # how much wider than thick neighbours lie, to be of one surface
TONES = ("#0072B2", "#D55E00")  # of stations without and with a flag


def of_runs(scene: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of the scans that were placed, mm; None where there are fewer than two."""
    result: Result = runs[0].result
    row = {name: i for i, name in enumerate(result.scans)}
    placed = [
        (scan, row[scan.name])
        for scan in scene.scans
        if len(scan.points) and scan.name in row and np.isfinite(result.T_project_scan[row[scan.name]]).all()
    ]
    if len(placed) < 2:
        return None
    first = np.array([_first(scan, result.T_project_scan[i]) for scan, i in placed])
    origin: Floats = np.round(first.mean(axis=0))
    clouds = [_placed(scan, result.T_project_scan[i], origin) for scan, i in placed]
    trees = parallel.each(cKDTree, clouds)
    step = max(1, -(-sum(map(len, clouds)) // MOST_POINTS))
    drawn = [cloud[::step] for cloud in clouds]
    apart = [
        _apart(drawn[k], trees[k], trees[:k] + trees[k + 1 :], result.position[i] - origin)
        for k, (_, i) in enumerate(placed)
    ]
    parts, marks = [], []
    for k, (scan, i) in enumerate(placed):
        places = np.rint(drawn[k]).astype(int).ravel()
        parts.append({"name": scan.name, "edges": [], "points": places, "residual": apart[k].round(3)})
        if np.isfinite(result.position[i]).all():
            marks.append(_station(result, i, k, origin))
    made: dict[str, Any] = plain(
        {
            "title": "Scans in space",
            "arrows": "",
            "values": "distances between scans",
            "from": "from the other scans at",
            "side": "towards the scanner",
            "method": runs[0].method,
            "origin": origin,
            "stops": DIVERGING_STOPS,
            "tones": TONES,
            "spacing": spacing(np.vstack(drawn)),
            "limit": colour_limit(np.concatenate(apart)),
            "parts": parts,
            "marks": marks,
        }
    )
    return made


def _first(scan: Scan, T: Floats) -> Floats:
    found: Floats = rigid.apply(T, scan.points[:1] + scan.origin)[0]
    return found


def _placed(scan: Scan, T: Floats, origin: Floats) -> Floats:
    """Return points (n, 3) of a scan, at most MOST_SEARCHED, in the project's frame less ``origin``."""
    points = scan.points[:: max(1, -(-len(scan.points) // MOST_SEARCHED))]
    shift = T[:3, :3] @ scan.origin + (T[:3, 3] - origin)
    found: Floats = points[np.isfinite(points).all(axis=1)] @ T[:3, :3].T + shift
    return found


def _apart(points: Floats, own: cKDTree, others: Sequence[cKDTree], scanner: Floats) -> Floats:
    """Tell how far the other scans' surface lies from that of points (n, 3), positive to their scanner; NaN = none.

    Both surfaces are the means of NEIGHBOURS points, along the normal of the other scan's, of that which is nearest.
    """
    nearest, away = np.full(len(points), -1), np.full(len(points), np.inf)
    for k, other in enumerate(others):
        far = other.query(points, distance_upper_bound=REACH_MM, workers=-1)[0]
        nearer = far < away
        nearest[nearer], away[nearer] = k, far[nearer]
    found = np.full(len(points), np.nan)
    for k, other in enumerate(others):
        rows = np.flatnonzero(nearest == k)
        if not len(rows):
            continue
        near, width = _neighbours(own, points[rows])
        there, wide = _neighbours(other, points[rows])
        enough = np.maximum(width, wide) < REACH_MM
        rows, near, there = rows[enough], near[enough], there[enough]
        middle = there.mean(axis=1)
        size, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", there - middle[:, None], there - middle[:, None]))
        normal = axes[:, :, 0]
        if np.isfinite(scanner).all():
            normal *= np.where(np.einsum("ni,ni->n", normal, scanner - middle) < 0.0, -1.0, 1.0)[:, None]
        flat = size[:, 1] > LEAST_FLAT**2 * size[:, 0]
        off = np.einsum("ni,ni->n", normal, middle - near.mean(axis=1))
        found[rows[flat]] = off[flat]
    return found


def _neighbours(tree: cKDTree, points: Floats) -> tuple[npt.NDArray[np.float64], Floats]:
    """Return the NEIGHBOURS points (n, k, 3) of a tree nearest to points (n, 3), and how far they reach (n,)."""
    k = min(NEIGHBOURS, tree.n)
    far, at = tree.query(points, k=[*range(1, k + 1)], workers=-1)
    return np.asarray(tree.data)[at], far[:, -1]


def _station(result: Result, i: int, part: int, origin: Floats) -> dict[str, Any]:
    sd = ", ".join(shown(float(NORMAL_95 * value)) for value in result.position_sd[i])
    return {
        "part": part,
        "tone": int(result.scan_status[i] != "ok"),
        "name": result.scans[i],
        "text": f"{result.scan_status[i]}, ± {sd} mm",
        "at": np.round(result.position[i] - origin, 1),
        "radius": 0.0,
        "label": True,
    }
