"""The pose of the scans in the design's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor import scene_cloud
from processor.defects.params import Params
from processor.geometry import mesh_distance, rigid
from processor.model import Floats, Reason, Scene, Status, reason
from processor.registration import surface_registration
from processor.registration.surface_registration import Registration

DEFAULT_ERROR_MM = 1.0  # registration error of scans in the design's frame, where none is known
SAMPLE = 200_000  # points: more than the registration itself takes of any scan


@dataclass(frozen=True)
class DesignPose:
    """``T_design_project`` (4, 4), None where it is not known; the standard deviation of its translation in mm.

    ``doubt`` is why no defect is sure at this pose; None where the pose is sure.
    """

    T_design_project: Floats | None
    error_mm: float
    reasons: tuple[Reason, ...] = ()
    status: Status = Status.OK
    doubt: Reason | None = None


def pose(scene: Scene, earlier: dict[str, Any], params: Params) -> DesignPose:
    """Return the pose of step deviation where it ran, else a pose by the same rule.

    Scans that lie at the design stay there; others are registered by principal axes and a best fit.
    """
    before: Any = earlier.get("deviation")
    known = before is not None and before.T_design_scan.size > 0
    errors = (params.registration_error_mm, before.registration_error if known else DEFAULT_ERROR_MM)
    error = next((value for value in errors if math.isfinite(value)), DEFAULT_ERROR_MM)
    if known:
        reasons: tuple[Reason, ...] = (reason("defects.placed-by-deviation", registration=before.registration),)
        if before.status == Status.FAILED:
            return DesignPose(None, error, (*reasons, *before.reasons))
        T, ambiguous = before.T_design_scan, before.status == Status.AMBIGUOUS
    else:
        assert scene.structure is not None
        cloud = scene_cloud.merged(scene, with_scanner=False)
        if len(cloud.points) < scene_cloud.FEWEST_POINTS:
            return DesignPose(None, error, (reason("defects.too-few-points"),))
        vertices, origin = scene_cloud.local_design(scene.structure)
        few = cloud.points[:: max(1, len(cloud.points) // SAMPLE)]
        surface = mesh_distance.of_design(vertices, scene.structure.faces)
        given = rigid.transform(np.eye(3), cloud.origin - origin)
        placed = surface_registration.place(few, surface, given, "auto")
        if placed.registration is Registration.AS_GIVEN:
            return DesignPose(np.eye(4), error)
        fits = np.isfinite(placed.T_best_fit).all() and surface_registration.fits_design(placed, few, surface)
        if not fits:
            return DesignPose(None, error, (reason("defects.not-placed"),))
        T = rigid.transform(np.eye(3), origin) @ placed.T @ rigid.transform(np.eye(3), -cloud.origin)
        reasons, ambiguous = (reason("defects.best-fit"),), placed.ambiguous
    if ambiguous:
        doubt = reason("defects.pose-ambiguous")
        return DesignPose(T, error, (*reasons, reason("defects.ambiguous")), Status.AMBIGUOUS, doubt)
    if known and surface_registration.is_unproven(before.reasons):
        return DesignPose(T, error, reasons, Status.WEAK, reason("defects.pose-unproven"))
    return DesignPose(T, error, reasons)
