"""Where the scans are in the design's frame."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from processor.defects.params import Params
from processor.geometry.merging import merged
from processor.model import Floats, Scene

ADVICE = "run the steps stitch and deviation first, or give the scans poses in the design's frame"
UNKNOWN_ERROR_MM = 1.0  # of scans that come in the design's frame, where nothing says what they are known to
SAMPLE = 20_000
NEAR_SHARE = 0.2  # of the points in the design's box, below which they are not in its frame


def pose(scene: Scene, earlier: dict[str, Any], params: Params) -> tuple[Floats | None, float, str]:
    """T_design_project (4, 4), the standard deviation of its place (mm) and what is to be said of it.

    As step deviation found it where that ran; otherwise the scans have to be in the design's frame: None where they
    are not.
    """
    error = params.registration_error_mm
    before = earlier.get("deviation")
    if before is not None and np.size(getattr(before, "T_design_scan", ())) == 16 and before.status != "failed":
        own = float(getattr(before, "registration_error", math.nan))
        known = error if math.isfinite(error) else own if math.isfinite(own) else UNKNOWN_ERROR_MM
        return np.asarray(before.T_design_scan, float), known, "registered to the design by step deviation"
    if not math.isfinite(error):
        error = UNKNOWN_ERROR_MM
    cloud = merged(scene, with_scanner=False)
    design = scene.structure
    if design is None or not len(cloud.points):
        return None, error, ADVICE
    points = cloud.points[:: max(1, len(cloud.points) // SAMPLE)] + cloud.origin
    low, high = design.vertices.min(axis=0) - params.reach_mm, design.vertices.max(axis=0) + params.reach_mm
    inside = ((points > low) & (points < high)).all(axis=1).mean()
    if inside < NEAR_SHARE:
        return None, error, f"the scans are not in the design's frame ({inside:.0%} of the points near it); {ADVICE}"
    return np.eye(4), error, ""
