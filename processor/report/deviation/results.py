"""results.json of step ``deviation``; lengths mm, coordinates in the design's frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.deviation.result import Result
from processor.model import Floats

NEAR_MM = 10.0
NAN = float("nan")


def figures(result: Result) -> dict[str, float]:
    """Return what the core points that have a level of detection say together, by name.

    ``min_lod95`` and ``max_lod95`` are those of the two core points that ``min`` and ``max`` are of.
    """
    known = np.isfinite(result.lod95)
    distance, lod95 = result.distance[known], result.lod95[known]
    return {
        "mean": _of(np.mean, distance),
        "median": _of(np.median, distance),
        "sd": _of(np.std, distance),
        "min": _of(np.min, distance),
        "max": _of(np.max, distance),
        "min_lod95": float(lod95[np.argmin(distance)]) if len(distance) else NAN,
        "max_lod95": float(lod95[np.argmax(distance)]) if len(distance) else NAN,
        "within_10mm_share": _of(np.mean, (np.abs(distance) <= NEAR_MM).astype(np.float64)),
        "lod95_median": _of(np.median, lod95),
        "measured": float(len(distance)),
    }


def _of(figure: Any, values: Floats) -> float:
    return float(figure(values)) if len(values) else NAN


def written(result: Result) -> dict[str, Any]:
    """Return the step's object."""
    found = figures(result)
    measured = int(found.pop("measured"))
    lod95 = {end: found.pop(f"{end}_lod95") for end in ("min", "max")}
    ends = {f"{end}_ci95": [found[end] - half, found[end] + half] for end, half in lod95.items()}
    return {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "T_design_scan": result.T_design_scan,
        "registration": result.registration,
        "registration_error": result.registration_error,
        "registration_error_from": result.registration_error_from,
        "covariance": result.covariance,
        "ambiguity": result.ambiguity,
        "best_fit": {"T_design_scan": result.T_best_fit, "shift": result.best_fit_shift, "turn": result.best_fit_turn},
        "core_points": len(result.core),
        "core_points_measured": measured,
        "significant_share": result.significant_share,
        "significant_share_ci95": [result.significant_low, result.significant_high],
        **found,
        **ends,
        "spacing": result.spacing,
        "sigma": result.sigma,
        "points": {"read": result.points_read, "kept": result.points_kept, "on_surface": result.on_surface_share},
        "normal_diameter": result.normal_diameter,
        "projection_diameter": result.projection_diameter,
        "max_depth": result.max_depth,
    }
