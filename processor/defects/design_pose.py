"""Where the scans are in the design's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from processor.defects.params import Params
from processor.geometry import merging, mesh_distance, rigid, surface_registration
from processor.geometry.principal import AMBIGUOUS
from processor.geometry.surface_registration import Registration
from processor.model import Floats, Scene

ADVICE = "run the steps stitch and deviation first, or give the scans poses in the design's frame"
UNKNOWN_ERROR_MM = 1.0  # of scans that come in the design's frame, where nothing says what they are known to
SAMPLE = 200_000


@dataclass(frozen=True)
class Placing:
    """``T_design_project`` (4, 4), None where there is none; the sd of its place (mm), and what is to be said of it."""

    T_design_project: Floats | None
    error_mm: float
    said: str = ""
    status: str = "ok"


def pose(scene: Scene, earlier: dict[str, Any], params: Params) -> Placing:
    """Place the scans at the design: as step deviation did where that ran, else by the same rule.

    Scans that lie at the design are left there; others are registered by principal axes and a best fit.
    """
    before = earlier.get("deviation")
    if before is not None and before.T_design_scan.size:
        own = before.registration_error
        error = next((e for e in (params.registration_error_mm, own) if math.isfinite(e)), UNKNOWN_ERROR_MM)
        status = "ambiguous" if before.status == "ambiguous" else "ok"
        return Placing(before.T_design_scan, error, f"placed by step deviation ({before.registration})", status)
    error = params.registration_error_mm if math.isfinite(params.registration_error_mm) else UNKNOWN_ERROR_MM
    assert scene.structure is not None
    cloud = merging.merged(scene, with_scanner=False)
    if len(cloud.points) < merging.FEWEST_POINTS:
        return Placing(None, error, "too few points to place the scans at the design")
    vertices, origin = merging.local_design(scene.structure)
    few = cloud.points[:: max(1, len(cloud.points) // SAMPLE)]
    given = rigid.transform(np.eye(3), cloud.origin - origin)
    surface = mesh_distance.of_design(vertices, scene.structure.faces)
    placed = surface_registration.place(few, surface, given, "auto")
    if placed.registration is Registration.AS_GIVEN:
        return Placing(np.eye(4), error)
    if not np.isfinite(placed.T_best_fit).all():
        return Placing(None, error, f"the scans are not in the design's frame and could not be placed there; {ADVICE}")
    shift = rigid.transform(np.eye(3), origin) @ placed.T @ rigid.transform(np.eye(3), -cloud.origin)
    twice = placed.ambiguity < AMBIGUOUS
    said = "placed by principal axes and a best fit, which takes up what the whole was moved by"
    return Placing(
        shift, error, said + ("; another attitude fits as well" if twice else ""), "ambiguous" if twice else "ok"
    )
