"""The parts of a bridge as structures of their own, each with its scans where step preassemble registered them.

A part is compared with its own design, wherever the assembly has it: a part that was moved or turned has no defect by
that, and ends that touch in the assembly were scanned apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor.adjustment import thermal
from processor.geometry import rigid
from processor.model import (
    DesignBodies,
    DesignPart,
    Floats,
    InputError,
    Ints,
    Reason,
    Scan,
    Scene,
    Stations,
    Status,
    StructureDesign,
    UsageError,
    reason,
)

ADJUSTED = "adjustment"  # method of preassemble that brings lengths to the design's temperature
MESH = "mesh"  # source of a part's design that has all of its surfaces


@dataclass(frozen=True)
class PartScene:
    """A part as a structure in the bridge's frame; without a scene for the ``reasons``."""

    name: str
    scene: Scene | None
    status: Status = Status.OK
    reasons: tuple[Reason, ...] = ()


def of_bridge(scene: Scene, assembled: Any, step: str) -> Iterator[PartScene]:
    """Yield the parts of a bridge by the result of step preassemble.

    Raises InputError for a scene without scans of parts, UsageError where preassemble did not run.
    """
    if scene.arch is None or not any(len(scan.points) for scan in scene.scans):
        raise InputError(f"{scene.name}: expected scans of the parts of a bridge with a design, found none")
    if assembled is None:
        raise UsageError(f"{step}: the parts of a bridge are placed by step preassemble; add it to --steps")
    rows = {name: row for row, name in enumerate(assembled.components.name)}
    for part in scene.arch.parts:
        scans = [scan for scan in scene.scans if scan.component == part.name and len(scan.points)]
        row = rows.get(part.name, -1)
        if part.source != MESH:
            yield PartScene(part.name, None, Status.FAILED, (reason("parts.no-surface"),))
        elif not scans or row < 0 or assembled.components.status[row] is Status.FAILED:
            yield PartScene(part.name, None, Status.FAILED, (reason("parts.not-registered"),))
        else:
            status = assembled.components.status[row]
            doubt = (reason("parts.pose-ambiguous"),) if status is Status.AMBIGUOUS else ()
            used, T = assembled.components.scans[row], assembled.components.T_bridge_scan[row]
            # The papers' methods take lengths as they were scanned.
            shrink = 1.0 / thermal.expansion(scene.temperature_C) if assembled.method == ADJUSTED else 1.0
            placed = _placed(scene, part, scans, used, T, shrink)
            yield PartScene(part.name, placed, Status.AMBIGUOUS if doubt else Status.OK, doubt)


def _placed(
    scene: Scene, part: DesignPart, scans: list[Scan], used: str, T_bridge_scan: Floats, shrink: float
) -> Scene:
    """Return a part as a structure, its scans in the bridge's frame; T_bridge_scan is of the first one ``used``.

    ``shrink`` brings lengths at another temperature to the design's.
    """
    first = next((scan for scan in scans if used == scan.name or used.startswith(f"{scan.name}, ")), scans[0])
    T_bridge_project = T_bridge_scan @ rigid.invert(first.pose)
    number = np.unique(np.concatenate([scan.point_station for scan in scans]))
    number = number[number >= 0]
    placed = []
    for scan in scans:
        at = scan.position
        placed.append(
            replace(
                scan,
                points=scan.points * shrink,
                position=scan.origin + shrink * (at - scan.origin) if at.size else at,
                point_station=np.where(scan.point_station < 0, -1, np.searchsorted(number, scan.point_station)),
                T_project_scan=T_bridge_project @ scan.pose,
                component="",
            )
        )
    bodies = DesignBodies(names=(part.name,), of_facet=np.zeros(len(part.faces), np.int64))
    return Scene(
        scene.name,
        "structure",
        tuple(placed),
        stations=_stations(scene, number, rigid.apply(first.pose, first.origin), shrink, T_bridge_project),
        temperature_C=scene.temperature_C,
        units=scene.units,
        units_reason=scene.units_reason,
        structure=StructureDesign(part.name, part.vertices, part.faces, bodies),
        tolerance=scene.tolerance,
    )


def _stations(scene: Scene, number: Ints, about: Floats, shrink: float, T_bridge_project: Floats) -> Stations | None:
    """Return the stations that saw a part, in the bridge's frame, nearer to a place (3,) by a factor."""
    known = scene.stations
    if known is None or not len(number):
        return None
    nearer = known.T_project_station[number].copy() if len(known.T_project_station) else known.T_project_station
    if len(nearer):
        nearer[:, :3, 3] = about + shrink * (nearer[:, :3, 3] - about)
    return Stations(
        ids=tuple(known.ids[k] for k in number),
        positions=rigid.apply(T_bridge_project, about + shrink * (known.positions[number] - about)),
        T_project_station=T_bridge_project @ nearer if len(nearer) else nearer,
    )
