"""What both methods of step ``deviation`` put into its result alike."""

from __future__ import annotations

from typing import Any

import numpy as np

from processor.adjustment.distance_summary import Summary
from processor.deviation.result import NAN, CorePoints

NEAR_MM = 10.0  # of the key within_10mm_share


def statistics(core: CorePoints, total: Summary) -> dict[str, Any]:
    """Return the fields of the result that are statistics of its core points."""
    distance = core.distance[np.isfinite(core.lod95)]
    share = total.significant_share
    return {
        "core_points": total.core_points,
        "core_points_measured": total.core_points - total.without_lod,
        "significant_share": share.share,
        "significant_share_ci95": (share.low, share.high),
        "within_10mm_share": float(np.mean(np.abs(distance) <= NEAR_MM)) if len(distance) else NAN,
        "mean": total.mean,
        "median": total.median,
        "sd": total.sd,
        "min": total.min,
        "min_ci95": total.min_ci95,
        "max": total.max,
        "max_ci95": total.max_ci95,
        "lod95_median": total.lod95_median,
    }
