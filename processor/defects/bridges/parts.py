"""Defects of the parts of a bridge, each against its own design at its own best fit, as one result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from processor.components import bridge_parts
from processor.components.bridge_parts import PartScene
from processor.defects.result import Defects, PartPoses, Picture, Result, SurfacePlaces, Windows
from processor.defects.verdicts import depths_and_areas
from processor.limits.judging import JudgedLimits
from processor.model import Scene, Status


def defects(
    scene: Scene,
    parts: Sequence[PartScene],
    method: str,
    deviation: Any,
    one: Callable[[Scene, dict[str, Any]], Result],
) -> Result:
    """Find the defects of each part by ``one``, from the pose that step ``deviation`` found, and join them.

    Poses are those of the parts, in the table ``parts``; defects are numbered over all parts.
    """
    results = [
        Result(status=Status.FAILED, method=method, reasons=part.reasons)
        if part.scene is None
        else one(part.scene, _pose(part.name, deviation))
        for part in parts
    ]
    known = [result for result in results if result.status is not Status.FAILED]
    status, reasons = bridge_parts.together(parts, results)
    if not known:
        return Result(status=status, method=method, reasons=reasons, parts=_table(parts, results))
    found = list(_numbered(known))
    # A picture a defect: empty ones for those of which there is none
    pictures = ([*one.pictures, *[Picture()] * (len(one.defects) - len(one.pictures))] for one in found)
    return Result(
        status=status,
        method=method,
        reasons=reasons,
        registration_error=float(np.sqrt(np.mean([result.registration_error**2 for result in known]))),
        cell=max(result.cell for result in known),
        noise=float(np.median([result.noise for result in known])),
        lod95=float(np.median([result.lod95 for result in known])),
        examined_mm2=sum(result.examined_mm2 for result in known),
        expected_mm2=sum(result.expected_mm2 for result in known),
        points=sum(result.points for result in known),
        points_used=sum(result.points_used for result in known),
        least_depth=_least_depth(known),
        defects=Defects.concat([result.defects for result in found if len(result.defects)]),
        pictures=tuple(chain.from_iterable(pictures)),
        surface=SurfacePlaces.concat([result.surface for result in found if len(result.surface)]),
        limits=JudgedLimits.joined(depths_and_areas.judge(scene, result) for result in found),
        parts=_table(parts, results),
    )


def _pose(name: str, deviation: Any) -> dict[str, Any]:
    """Return the pose of a part as step deviation states it; nothing where the step did not run."""
    table = None if deviation is None else deviation.parts
    if table is None or name not in table.name:
        return {}
    row = table.name.index(name)
    if not np.isfinite(table.T_design_scan[row]).all():
        return {}
    of_part = {name: getattr(table, name)[row] for name in ("status", "reasons", "T_design_scan", "registration")}
    return {"deviation": replace(deviation, **of_part, registration_error=float(table.registration_error[row]))}


def _numbered(results: Sequence[Result]) -> Iterator[Result]:
    """Yield the results with the defects numbered over all of them, and the rows that places refer to."""
    before = 0
    for result in results:
        places = result.surface.defect
        yield replace(
            result,
            defects=replace(result.defects, id=result.defects.id + before),
            surface=replace(result.surface, defect=np.where(places < 0, places, places + before)),
        )
        before += len(result.defects)


def _least_depth(results: Sequence[Result]) -> Windows:
    """Return the windows of the part whose least depths are the largest: what is found on every part."""
    known = [result.least_depth for result in results if len(result.least_depth)]
    return max(known, key=lambda table: float(np.max(table.depth))) if known else Windows()


def _table(parts: Sequence[PartScene], results: Sequence[Result]) -> PartPoses:
    none, unknown = np.full((4, 4), np.nan), np.full((6, 6), np.nan)
    poses = [result.T_design_project if result.T_design_project.size else none for result in results]
    return PartPoses.from_items(
        results,
        name=tuple(part.name for part in parts),
        T_design_project=np.array(poses),
        covariance=np.array([result.covariance if result.covariance.size else unknown for result in results]),
        defects=np.array([len(result.defects) for result in results], np.int64),
    )
