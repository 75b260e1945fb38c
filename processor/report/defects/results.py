"""Defects in results.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.defects.result import Result


def written(result: Result) -> dict[str, Any]:
    """Write a result: lengths mm, centres and axes in the design's frame, a depth inward positive."""
    return {
        "status": result.status,
        "method": result.method,
        "message": result.message,
        "T_design_project": result.T_design_project if result.T_design_project.size else None,
        "registration_error": result.registration_error_mm,
        "cell": result.cell_mm,
        "noise": result.noise_mm,
        "lod95": result.lod95_mm,
        "examined_mm2": result.examined_mm2,
        "expected_mm2": result.expected_mm2,
        "points": result.points,
        "points_used": result.used,
        "least_depth": [
            {"side": side, "depth": depth, "noise_inflation": more}
            for side, depth, more in zip(
                result.scale_mm.tolist(), result.scale_least_mm.tolist(), result.scale_inflation.tolist(), strict=True
            )
        ],
        "defects": [_defect(result, k) for k in range(len(result.ids))],
    }


def _defect(result: Result, k: int) -> dict[str, Any]:
    curve = np.flatnonzero(result.curve_defect == k)
    return {
        "id": result.ids[k],
        "class": result.classes[k],
        "confidence": result.confidence[k],
        "otherwise": result.second[k],
        "component": result.components[k],
        "centre": result.centres[k],
        "area_mm2": result.area_mm2[k],
        "depth_max": result.depth_max[k],
        "depth_ci95": result.depth_ci95[k],
        "depth_mean": result.depth_mean[k],
        "volume_mm3": result.volume_mm3[k],
        "volume_ci95": result.volume_ci95[k],
        "axes": result.axes[k],
        "extent": result.extent[k],
        "edge_distance": result.edge_mm[k],
        "curvature_per_m": result.curvature_per_m[k],
        "lod95": result.lod95[k],
        "z": result.z[k],
        "by_chance_on_100_m2": result.chance[k],
        "doubtful": bool(result.doubtful[k]),
        "remark": result.remarks[k],
        "deflection": {
            "along": result.curve_at_mm[curve],
            "displacement": result.curve_mm[curve],
            "ci95": result.curve_ci95[curve],
        }
        if len(curve)
        else None,
    }
