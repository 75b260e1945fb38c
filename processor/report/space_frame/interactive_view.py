"""Live view of a space frame for the page's script: balls to scale by their flag, tubes, movements as arrows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.language.messages import text
from processor.model import NORMAL_95, Floats, Scene, StepRun
from processor.report.style import DIVERGING_STOPS
from processor.space_frame.result import LOCATED_FLAGS, Flag, Result
from processor.store.json_values import json_ready

TONES = ("#0072B2", "#D55E00", "#000000")  # of LOCATED_FLAGS
MOST_BALLS = 5_000  # about 1 MB of the page; flagged balls are always included
MOST_TUBES = 15_000  # three for each ball shown


def interactive_data(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of balls, mm less ``origin``; None where there are fewer than two."""
    result: Result = runs[0].result
    balls = result.balls
    placed = np.flatnonzero(balls.placed)
    if len(placed) < 2:
        return None
    flagged = ~balls.flagged(Flag.OK)[placed]
    rest = placed[~flagged]
    step = max(1, -(-len(rest) // max(1, MOST_BALLS - int(flagged.sum()))))
    drawn = np.sort(np.concatenate([placed[flagged], rest[::step]]))
    origin = np.round(balls.centres[placed].mean(axis=0))
    used = [flag for flag in LOCATED_FLAGS if flag in {balls.flag[i] for i in drawn}]
    tubes = np.stack([result.tubes.start, result.tubes.end], axis=1)[:MOST_TUBES]
    empty = {"name": "", "edges": [], "points": [], "residual": []}
    parts: list[dict[str, Any]] = [{**empty, "text": text("balls: {flag}", flag=flag)} for flag in used]
    parts.append({**empty, "text": text("tubes"), "edges": [np.round(tube - origin, 1) for tube in tubes]})
    data: dict[str, Any] = json_ready(
        {
            "title": text("Balls in space"),
            "arrows": text("movements as arrows"),
            "values": "",
            "method": runs[0].method,
            "origin": origin,
            "stops": DIVERGING_STOPS,
            "tones": TONES,
            "limit": 1.0,
            "parts": parts,
            "marks": [_mark(result, i, origin, used) for i in drawn.tolist()],
        }
    )
    return data


def _mark(result: Result, i: int, origin: Floats, used: Sequence[Flag]) -> dict[str, Any]:
    balls, flag = result.balls, result.balls.flag[i]
    mark = {
        "part": used.index(flag),
        "tone": LOCATED_FLAGS.index(flag),
        "name": f"{balls.names[i]}",
        "at": np.round(balls.centres[i] - origin, 2),
        "radius": round(float(balls.radii[i]), 2),
        "text": text(
            "r {radius} ± {half} mm, z min {x:.1f}, {y:.1f}, {z:.1f} mm, {flag}",
            radius=float(balls.radii[i]),
            half=NORMAL_95 * float(np.sqrt(balls.covariance[i, 3, 3])),
            **dict(zip("xyz", balls.lowest[i].tolist(), strict=True)),
            flag=flag,
        ),
    }
    if len(balls.movement) and np.isfinite(balls.movement[i]).all():
        turn = np.eye(3) if result.matching is None else result.matching.T_design_scan[:3, :3].T
        mark |= {"by": np.round(turn @ balls.movement[i], 3), "ci95": np.round(balls.movement_ci95[i], 3)}
    return mark
