"""Live view of stitched scans for the page's script: points coloured by the distance of the other scans' surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from processor.geometry import rigid, thread_ranges
from processor.language.messages import text
from processor.large_arrays import every
from processor.model import NORMAL_95, Floats, Scan, Scene, Status, StepRun
from processor.report.charts.surface_view import spacing
from processor.report.style import DIVERGING_STOPS, colour_limit
from processor.stitching.result import Result, Scans
from processor.store.json_values import json_ready

MOST_POINTS = 60_000  # of all scans: about 1.4 MB of the page
MOST_SEARCHED, MOST_SEARCHED_OF_ALL = 400_000, 4_000_000  # of each scan, and of all scans
NEIGHBOURS = 12  # a mean of twelve has 0.3 of the noise, and lies within some centimetres
REACH_MM = 200.0  # of neighbours, at most
LEAST_FLAT = 4.0  # least ratio of width to thickness of neighbours that are one surface
TONES = ("#0072B2", "#D55E00")  # of stations without and with a flag


def interactive_data(scene: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of the scans that were placed, mm; None where there are fewer than two."""
    result: Result = runs[0].result
    scans = result.scans
    row = {name: i for i, name in enumerate(scans.name)}
    placed = [
        (scan, row[scan.name])
        for scan in scene.scans
        if len(scan.points) and scan.name in row and scans.placed[row[scan.name]]
    ]
    if len(placed) < 2:
        return None
    first = np.array([rigid.apply(scans.T_project_scan[i], scan.points[:1] + scan.origin)[0] for scan, i in placed])
    origin: Floats = np.round(first.mean(axis=0))
    most = min(MOST_SEARCHED, MOST_SEARCHED_OF_ALL // len(placed))
    clouds = [_in_project(scan, scans.T_project_scan[i], origin, most) for scan, i in placed]
    trees = thread_ranges.each(cKDTree, clouds)
    step = max(1, -(-sum(map(len, clouds)) // MOST_POINTS))
    drawn = [cloud[::step] for cloud in clouds]
    distances = [
        _distances(drawn[k], trees[k], trees[:k] + trees[k + 1 :], scans.position[i] - origin)
        for k, (_, i) in enumerate(placed)
    ]
    parts, marks = [], []
    for k, (scan, i) in enumerate(placed):
        places = np.rint(drawn[k]).astype(int).ravel()
        parts.append({"name": scan.name, "edges": [], "points": places, "residual": distances[k].round(3)})
        if np.isfinite(scans.position[i]).all():
            marks.append(_station(scans, i, k, origin))
    data: dict[str, Any] = json_ready(
        {
            "title": text("Scans in space"),
            "arrows": "",
            "values": text("distances between scans"),
            "from": text("from the other scans at"),
            "side": text("towards the scanner"),
            "method": runs[0].method,
            "origin": origin,
            "stops": DIVERGING_STOPS,
            "tones": TONES,
            "spacing": spacing(np.vstack(drawn)),
            "limit": colour_limit(np.concatenate(distances)),
            "parts": parts,
            "marks": marks,
        }
    )
    return data


def _in_project(scan: Scan, T: Floats, origin: Floats, most: int) -> Floats:
    """Return points (n, 3) of a scan, at most ``most``, in the project's frame less ``origin``."""
    points = every(scan.points, max(1, -(-len(scan.points) // most)))
    return rigid.apply(rigid.between_origins(T, scan.origin, origin), points[np.isfinite(points).all(axis=1)])


def _distances(points: Floats, tree: cKDTree, other_trees: Sequence[cKDTree], scanner: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) from the nearest other scan's surface, positive to their scanner.

    Both surfaces are the means of NEIGHBOURS points; the distance is along the normal of the other one. NaN = none.
    """
    nearest, least = np.full(len(points), -1), np.full(len(points), np.inf)
    for k, other_tree in enumerate(other_trees):
        distance = other_tree.query(points, distance_upper_bound=REACH_MM, workers=-1)[0]
        nearer = distance < least
        nearest[nearer], least[nearer] = k, distance[nearer]
    distances = np.full(len(points), np.nan)
    for k, other_tree in enumerate(other_trees):
        rows = np.flatnonzero(nearest == k)
        if not len(rows):
            continue
        near, width = _neighbours(tree, points[rows])
        there, wide = _neighbours(other_tree, points[rows])
        enough = np.maximum(width, wide) < REACH_MM
        rows, near, there = rows[enough], near[enough], there[enough]
        middle = there.mean(axis=1)
        size, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", there - middle[:, None], there - middle[:, None]))
        normal = axes[:, :, 0]
        if np.isfinite(scanner).all():
            normal *= np.where(np.einsum("ni,ni->n", normal, scanner - middle) < 0.0, -1.0, 1.0)[:, None]
        flat = size[:, 1] > LEAST_FLAT**2 * size[:, 0]
        off = np.einsum("ni,ni->n", normal, middle - near.mean(axis=1))
        distances[rows[flat]] = off[flat]
    return distances


def _neighbours(tree: cKDTree, points: Floats) -> tuple[npt.NDArray[np.float64], Floats]:
    """Return the NEIGHBOURS points (n, k, 3) of a tree nearest to points (n, 3), and their greatest distance (n,)."""
    k = min(NEIGHBOURS, tree.n)
    distance, at = tree.query(points, k=[*range(1, k + 1)], workers=-1)
    return np.asarray(tree.data)[at], distance[:, -1]


def _station(scans: Scans, i: int, part: int, origin: Floats) -> dict[str, Any]:
    sd = tuple((NORMAL_95 * scans.position_sd[i]).tolist())
    return {
        "part": part,
        "tone": int(scans.status[i] != Status.OK),
        "name": scans.name[i],
        "text": text("{status}, ± {ci95} mm", status=scans.status[i], ci95=sd),
        "at": np.round(scans.position[i] - origin, 1),
        "radius": 0.0,
        "label": True,
    }
