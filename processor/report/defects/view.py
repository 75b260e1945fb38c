"""What the page's script draws of defects: the surface by its deviation, and every defect outlined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.defects.result import Result
from processor.model import Ints, Scene, StepRun
from processor.report import surface_view
from processor.report.surface_view import Region
from processor.report.table import shown


def of_runs(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return what the page draws of the answer, mm, in the design's frame; None where nothing was seen."""
    result: Result = runs[0].result
    everything: Ints = np.arange(len(result.surface_at), dtype=np.int64)
    return surface_view.of_points(
        "Defects in space",
        runs[0].method,
        result.surface_at,
        np.asarray(result.surface_mm, np.float64),
        [("surface", everything)],
        regions=[_region(result, k) for k in range(len(result.ids))],
        region_of=np.asarray(result.surface_defect, np.int64),
        named=False,
    )


def _region(result: Result, k: int) -> Region:
    """Outline a defect by the rectangle of its extent about its centre."""
    along, across, out = result.axes[k]
    length, width = 0.5 * result.extent[k]
    sides = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    corners = np.array([result.centres[k] + u * length * along + v * width * across for u, v in sides])
    depth = f"{shown(float(result.depth_max[k]))} ± {shown(float(result.depth_ci95[k]))}"
    text = f"{result.classes[k]}, depth {depth} mm, area {result.area_mm2[k]:.0f} mm2, {shown(result.components[k])}"
    return Region(str(result.ids[k]), result.classes[k], text, corners, out)
