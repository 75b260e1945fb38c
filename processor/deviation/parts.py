"""Deviations of the parts of a bridge, each from its own design at its own best fit, as one result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from processor.adjustment import distance_summary
from processor.components import bridge_parts
from processor.components.bridge_parts import PartScene
from processor.deviation import result_fields
from processor.deviation.result import CorePoints, ErrorSource, PartFits, Result
from processor.geometry import m3c2
from processor.limits.judging import JudgedLimits
from processor.model import Scene, Status


def deviations(parts: Sequence[PartScene], method: str, one: Callable[[Scene], Result]) -> Result:
    """Compare each part with its design by ``one``, and join what was found.

    Registrations and poses are those of the parts, in the table ``parts``; the statistics are of all core points.
    """
    results = [part_result(part, method, one) for part in parts]
    known = [result for result in results if len(result.core)]
    table = _table(parts, results)
    status, reasons = bridge_parts.together(parts, results)
    if not known:
        return Result(status=status, method=method, reasons=reasons, parts=table)
    origin = known[0].origin
    shifted = [replace(result.core, points=result.core.points + (result.origin - origin)) for result in known]
    core = CorePoints.concat(shifted)
    core = replace(core, body=np.full_like(core.body, -1))  # rows of one part's bodies, which the whole does not name
    total = distance_summary.of_distances(
        core.distances, core.points, core.normals, known[0].projection_diameter, m3c2.PAPER_POINTS_A_CYLINDER
    )
    error = np.array([result.registration_error for result in known])
    return Result(
        status=status,
        method=method,
        reasons=reasons,
        registration=known[0].registration,
        registration_error=float(np.sqrt(np.mean(error**2))),
        registration_error_from=ErrorSource.COVARIANCE,
        points_read=sum(result.points_read for result in known),
        points_kept=sum(result.points_kept for result in known),
        on_surface_share=_mean(known, "on_surface_share"),
        spacing=_mean(known, "spacing"),
        sigma=_mean(known, "sigma"),
        projection_diameter=max(result.projection_diameter for result in known),
        max_depth=max(result.max_depth for result in known),
        origin=origin,
        core=core,
        limits=JudgedLimits.joined(result.limits for result in known),
        parts=table,
        **result_fields.statistics(core, total),
    )


def part_result(part: PartScene, method: str, one: Callable[[Scene], Result]) -> Result:
    """Return the result of one part; a failed one where it cannot be compared."""
    if part.scene is None:
        return Result(status=Status.FAILED, method=method, reasons=part.reasons)
    found = one(part.scene)
    found = replace(found, reasons=(*part.reasons, *found.reasons))
    if part.status is Status.AMBIGUOUS and found.status is not Status.FAILED:
        return replace(found, status=Status.AMBIGUOUS)
    return found


def _table(parts: Sequence[PartScene], results: Sequence[Result]) -> PartFits:
    none, unknown = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    return PartFits.from_items(
        results,
        name=tuple(part.name for part in parts),
        T_design_scan=np.array([result.T_design_scan if result.T_design_scan.size else none for result in results]),
        covariance=np.array([result.covariance if result.covariance.size else unknown for result in results]),
        core_points=np.array([len(result.core) for result in results], np.int64),
    )


def _mean(results: Sequence[Result], name: str) -> float:
    return float(np.mean([getattr(result, name) for result in results]))
