"""What the page's script draws of a space frame: balls to scale by their flag, tubes, movements as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.model import NORMAL_95, Scene, StepRun
from processor.report.results_json import plain
from processor.report.style import DIVERGING_STOPS
from processor.report.table import shown
from processor.space_frame import step as space_frame_step

FLAGS = ("ok", "low-confidence", "wrong-size")
TONES = ("#0072B2", "#D55E00", "#000000")  # of FLAGS
MOST_BALLS = 5_000  # about 1 MB of the page; those to look at are always among them
MOST_TUBES = 15_000


def of_runs(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of balls, mm less ``origin``; None where there is but one."""
    result: space_frame_step.Result = runs[0].result
    placed = np.flatnonzero(np.isfinite(result.centres).all(axis=1))
    if len(placed) < 2:
        return None
    flagged = np.array([result.flag[i] != "ok" for i in placed], bool)
    rest = placed[~flagged]
    step = max(1, -(-len(rest) // max(1, MOST_BALLS - int(flagged.sum()))))
    drawn = np.sort(np.concatenate([placed[flagged], rest[::step]]))
    origin = np.round(result.centres[placed].mean(axis=0))
    used = [flag for flag in FLAGS if flag in {result.flag[i] for i in drawn}]
    tubes = np.stack([result.tube_start, result.tube_end], axis=1)[:MOST_TUBES] if len(result.tube_start) else ()
    parts = [{"name": "", "text": f"balls: {flag}", "edges": [], "points": [], "residual": []} for flag in used]
    parts.append(
        {
            "name": "",
            "text": "tubes",
            "edges": [np.round(tube - origin, 1) for tube in tubes],
            "points": [],
            "residual": [],
        }
    )
    found = {
        "title": "Balls in space",
        "arrows": "movements as arrows",
        "values": "",
        "method": runs[0].method,
        "origin": origin,
        "stops": DIVERGING_STOPS,
        "tones": TONES,
        "limit": 1.0,
        "parts": parts,
        "marks": [_mark(result, i, origin, used) for i in drawn.tolist()],
    }
    made: dict[str, Any] = plain(found)
    return made


def _mark(result: space_frame_step.Result, i: int, origin: Any, used: Sequence[str]) -> dict[str, Any]:
    flag = result.flag[i]
    half = NORMAL_95 * float(np.sqrt(result.covariance[i, 3, 3]))
    lowest = ", ".join(f"{value:.1f}" for value in result.lowest[i])
    mark = {
        "part": used.index(flag),
        "tone": FLAGS.index(flag),
        "name": f"{result.ids[i]}",
        "at": np.round(result.centres[i] - origin, 2),
        "radius": round(float(result.radii[i]), 2),
        "text": f"r {shown(float(result.radii[i]))} ± {shown(half)} mm, z min {lowest} mm, {flag}",
    }
    if len(result.movement) and np.isfinite(result.movement[i]).all():
        turn = result.T_design_scan[:3, :3].T if result.T_design_scan.size else np.eye(3)
        mark |= {"by": np.round(turn @ result.movement[i], 3), "ci95": np.round(result.movement_ci95[i], 3)}
    return mark
