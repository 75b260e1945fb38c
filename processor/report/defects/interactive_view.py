"""The view of defects in space on the page: the surface coloured by its deviation, and an outline of each defect."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from processor.defects.result import Defects, Result
from processor.language.messages import text
from processor.model import Ints, Scene, StepRun
from processor.report.charts import surface_view
from processor.report.charts.surface_view import Region


def interactive_data(_: Scene, runs: Sequence[StepRun]) -> dict[str, Any] | None:
    """Return the data of the view of the first run, mm, design frame; None without points on the surface."""
    result: Result = runs[0].result
    everything: Ints = np.arange(len(result.surface), dtype=np.int64)
    return surface_view.surface_view_data(
        text("Defects in space"),
        runs[0].method,
        result.surface.points,
        np.asarray(result.surface.deviation, np.float64),
        [("surface", everything)],
        regions=[_region(result.defects, k) for k in range(len(result.defects))],
        region_of=np.asarray(result.surface.defect, np.int64),
        named=False,
    )


def _region(defects: Defects, k: int) -> Region:
    """Outline a defect by the rectangle of its extent about its centre."""
    along, across, outward = defects.axes[k]
    length, width = 0.5 * defects.extent[k]
    signs = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    corners = np.array([defects.centre[k] + u * length * along + v * width * across for u, v in signs])
    description = text(
        "{kind}, depth {depth} ± {ci95} mm, area {area:.0f} mm2, {component}",
        kind=defects.defect_class[k],
        depth=float(defects.depth_max[k]),
        ci95=float(defects.depth_ci95[k]),
        area=float(defects.area_mm2[k]),
        component=defects.component[k],
    )
    return Region(
        name=str(defects.id[k]), brief=defects.defect_class[k], text=description, outline=corners, outward=outward
    )
