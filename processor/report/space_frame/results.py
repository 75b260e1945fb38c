"""Balls in results.json; what method ``ray`` alone knows stands only where there is something."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.space_frame import result as space_frame_result
from processor.space_frame.result import Result

BOUNDED = ("x", "y", "z", "radius", "lowest")  # columns of Result.bound_sd
EFFICIENT = ("centre", "radius", "lowest")  # columns of Result.efficiency


def written(result: Result) -> dict[str, Any]:
    """Write the result of step ``spheres``."""
    found: dict[str, Any] = {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "balls": [
            {
                "id": int(result.ids[i]),
                "centre": result.centres[i],
                "radius": result.radii[i],
                "lowest": result.lowest[i],
                "lowest_sd": result.lowest_sd[i],
                "covariance": result.covariance[i],
                "points": int(result.points[i]),
                "visible_fraction": result.visible_fraction[i],
                "rms": result.rms[i],
                "nominal_radius": result.nominal_radii[i],
                "evidence": result.evidence[i],
                "flag": result.flag[i],
                "reason": result.reason[i],
            }
            for i in range(len(result.ids))
        ],
    }
    if len(result.sizes):
        for i, ball in enumerate(found["balls"]):
            ball |= {
                "size": result.sizes[i],
                "axes": int(result.axes[i]),
                "stations": int(result.stations[i]),
                "bound_sd": dict(zip(BOUNDED, result.bound_sd[i], strict=True)),
                "efficiency": dict(zip(EFFICIENT, result.efficiency[i], strict=True)),
            }
    if result.gauge:
        _add_movements(found, result)
    if result.matching:
        found["matching"] = {
            "status": result.matching,
            "T_design_scan": result.T_design_scan,
            "covariance": result.T_design_scan_covariance,
            "rivals": result.T_rivals,
        }
    if len(result.tube_radii):
        found["tubes"] = _tubes(result)
    if result.station_names:
        found["stations"] = [
            {"name": name, "T": result.T_station[i], "said": result.station_said[i]}
            for i, name in enumerate(result.station_names)
        ]
    if result.datum:
        found["datum"] = result.datum
    if result.control_names:
        found["control"] = [
            {
                "name": name,
                "scan": result.control_scan[i],
                "off": result.control_off[i],
                "used": bool(result.control_used[i]),
            }
            for i, name in enumerate(result.control_names)
        ]
    return found


def _add_movements(found: dict[str, Any], result: Result) -> None:
    """Put each node's movement to its ball, and what all are relative to and held against to the step."""
    judged = space_frame_result.of_result(result)
    found["gauge"] = result.gauge
    found["movement_limit"] = {"mm": result.movement_limit, "source": result.movement_limit_source}
    for i, ball in enumerate(found["balls"]):
        if np.isfinite(result.movement[i]).all():
            ball["movement"] = {
                "vector": result.movement[i],
                "ci95": result.movement_ci95[i],
                "size": judged.size[i],
                "size_ci95": judged.ci95[i],
                "verdict": judged.verdict[i],
            }


def _tubes(result: Result) -> list[dict[str, Any]]:
    return [
        {
            "a": int(result.tube_a[i]),
            "b": int(result.tube_b[i]),
            "start": result.tube_start[i],
            "end": result.tube_end[i],
            "radius": result.tube_radii[i],
            "bow": result.tube_bow[i],
        }
        for i in range(len(result.tube_radii))
    ]
