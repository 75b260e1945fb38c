"""The record that the search for defects answers with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from processor.model import Checked, Floats, Ints, Labels, Shorts, column, names, optional

DOUBTFUL = 0.01  # places as strong that chance brings on 100 m2
CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
    "unknown",
)  # fmt: skip


@dataclass(frozen=True)
class Result(Checked):
    """Defects by columns, in the design's frame (mm); a depth inward is positive.

    ``status``: ok | failed. ``second`` is the next best class. ``axes`` are unit directions of the largest extent, of
    the one across and outward; ``extent`` the full lengths along the first two. ``examined_mm2`` is the surface that
    deviations were looked for on, ``expected_mm2`` that which scanners should have seen. Curves and pictures are kept
    one behind the other: ``curve_defect`` and ``picture_defect`` name the row of the defect.
    """

    status: str
    method: str
    message: str = ""
    T_design_project: Floats = optional(4, 4)
    registration_error_mm: float = float("nan")  # standard deviation, median over the surface
    cell_mm: float = float("nan")
    noise_mm: float = float("nan")  # of one point, median
    lod95_mm: float = float("nan")  # of one cell, median
    examined_mm2: float = float("nan")
    expected_mm2: float = float("nan")
    points: int = 0  # of the cloud
    used: int = 0  # within reach of the design
    scale_mm: Floats = column("s")  # sides of windows, the depth that each finds, and how much its noise was inflated
    scale_least_mm: Floats = column("s")
    scale_inflation: Floats = column("s")
    ids: Ints = column("k", dtype=np.int64)
    classes: tuple[str, ...] = names("k")
    confidence: Floats = column("k")
    second: tuple[str, ...] = names("k")
    components: tuple[str, ...] = names("k")
    centres: Floats = column("k", 3)
    axes: Floats = column("k", 3, 3)
    extent: Floats = column("k", 2)
    area_mm2: Floats = column("k")
    depth_max: Floats = column("k")
    depth_ci95: Floats = column("k")
    depth_mean: Floats = column("k")
    volume_mm3: Floats = column("k")
    volume_ci95: Floats = column("k")
    edge_mm: Floats = column("k")  # from the centre to the border of the face
    curvature_per_m: Floats = column("k")  # largest principal curvature of the deviation at the deepest place
    lod95: Floats = column("k")  # at the defect's own size
    z: Floats = column("k")  # how many standard deviations it is beyond noise
    chance: Floats = column("k")  # how many as strong chance brings on 100 m2
    remarks: tuple[str, ...] = names("k")
    curve_defect: Ints = column("c", dtype=np.int64)
    curve_at_mm: Floats = column("c")
    curve_mm: Floats = column("c")
    curve_ci95: Floats = column("c")
    picture_defect: Ints = column("p", dtype=np.int64)
    picture_shape: Ints = column("p", 2, dtype=np.int64)
    picture_low: Floats = column("p", 2)  # of the first cell's corner relative to the defect's centre, along its axes
    picture_cell_mm: Floats = column("p")
    picture_mm: Shorts = column("q", dtype=np.float32)  # deviations, u slowest; NaN = nothing seen
    picture_part: Labels = column("q", dtype=np.int32)  # 1 = of the defect
    # Places spread over the surface that was seen, so many that they can be drawn, and all of small defects.
    surface_at: Floats = column("t", 3)
    surface_mm: Shorts = column("t", dtype=np.float32)  # deviations, outward positive
    surface_defect: Labels = column("t", dtype=np.int32)  # row of the defect, -1 = of none

    @property
    def doubtful(self) -> npt.NDArray[np.bool_]:
        """Return which defects (k,) may be chance: one as strong comes on less than 10 000 m2."""
        found: npt.NDArray[np.bool_] = self.chance > DOUBTFUL
        return found
