"""The parts of a bridge as structures of their own, each with its scans where step preassemble has placed them.

A part is compared with its own design, wherever the assembly has it: a part that was moved or turned has no defect by
that, and ends that touch in the assembly were scanned apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from processor.adjustment import thermal
from processor.geometry import rigid
from processor.large_arrays import allocate, blocks
from processor.model import (
    DesignBodies,
    DesignPart,
    Floats,
    InputError,
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


class _Placed(NamedTuple):
    """A scan that step preassemble used: p_bridge = T_bridge_scan (shrink p_scan)."""

    scan: Scan
    T_bridge_scan: Floats


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
        row = rows.get(part.name, -1)
        scans = [scan for scan in scene.scans if scan.component == part.name and len(scan.points)]
        poses = assembled.components.poses_of_scans(row) if row >= 0 else {}
        placed = [_Placed(scan, poses[scan.name]) for scan in scans if scan.name in poses]
        status = assembled.components.status[row] if row >= 0 else Status.FAILED
        if part.source != MESH:
            yield PartScene(part.name, None, Status.FAILED, (reason("parts.no-surface"),))
        elif status is Status.FAILED or not placed:
            yield PartScene(part.name, None, Status.FAILED, (reason("parts.not-registered"),))
        else:
            ambiguous = status is Status.AMBIGUOUS
            doubts = (reason("parts.pose-ambiguous"),) if ambiguous else ()
            unused = tuple(scan.name for scan in scans if scan.name not in poses)
            remarks = (reason("parts.scans-not-used", scans=unused),) if unused else ()
            # The papers' methods take lengths as they were scanned.
            shrink = 1.0 / thermal.expansion(scene.temperature_C) if assembled.method == ADJUSTED else 1.0
            structure = _structure(scene, part, placed, shrink)
            yield PartScene(part.name, structure, Status.AMBIGUOUS if ambiguous else Status.OK, (*doubts, *remarks))


def together(parts: Sequence[PartScene], results: Sequence[Any]) -> tuple[Status, tuple[Reason, ...]]:
    """Return the status of the ``results`` of all parts as one, and why: the first reason of each doubtful part."""
    states = [result.status for result in results]
    sure = Status.OK if all(one is Status.OK for one in states) else Status.WEAK
    some = Status.PARTIAL if Status.FAILED in states else sure
    status = Status.FAILED if all(one is Status.FAILED for one in states) else some
    doubts = [
        reason("parts.of-part", part=part.name, why=result.reasons[:1])
        for part, result in zip(parts, results, strict=True)
        if result.status is not Status.OK and result.reasons
    ]
    return status, (reason("parts.each-at-its-best-fit"), *doubts)


def _structure(scene: Scene, part: DesignPart, placed: list[_Placed], shrink: float) -> Scene:
    """Return a part as a structure with its ``placed`` scans.

    ``shrink`` brings lengths at another temperature to the design's. Stations are those of each scan: registered by
    itself, it has moved them by an error of its own.
    """
    scans, stations, before = [], [], 0
    for one in placed:
        named = scene.stations if len(one.scan.point_station) else None
        if named is not None:
            stations.append(_stations(named, one, shrink, again=before > 0))
        points, station = allocate(*one.scan.points.shape), allocate(len(one.scan.point_station), dtype=np.int32)
        for rows in blocks(len(points)):
            points[rows] = one.scan.points[rows] * shrink
            of_rows = one.scan.point_station[rows]
            station[rows] = np.where(of_rows >= 0, before + of_rows, -1)
        scans.append(
            replace(
                one.scan,
                points=points,
                origin=one.scan.origin * shrink,
                position=one.scan.position * shrink,
                point_station=station,
                T_project_scan=one.T_bridge_scan,
                component="",
            )
        )
        before += 0 if named is None else len(named.ids)
    bodies = DesignBodies(names=(part.name,), of_facet=np.zeros(len(part.faces), np.int64))
    return Scene(
        scene.name,
        "structure",
        tuple(scans),
        stations=Stations.concat(stations) if stations else None,
        temperature_C=scene.temperature_C,
        units=scene.units,
        units_reason=scene.units_reason,
        structure=StructureDesign(part.name, part.vertices, part.faces, bodies),
        tolerance=scene.tolerance,
    )


def _stations(known: Stations, placed: _Placed, shrink: float, again: bool) -> Stations:
    """Return the stations where a scan has them, in the bridge's frame.

    ``again`` marks stations of a further scan: their ids have its name, so that they differ from those of the first.
    """
    T_scan_project, T_bridge_scan = rigid.invert(placed.scan.pose), placed.T_bridge_scan
    T = known.T_project_station
    if len(T):
        T = T_scan_project @ T
        T[:, :3, 3] *= shrink
        T = T_bridge_scan @ T
    return Stations(
        ids=tuple(f"{id_}, {placed.scan.name}" if again else id_ for id_ in known.ids),
        positions=rigid.apply(T_bridge_scan, shrink * rigid.apply(T_scan_project, known.positions)),
        T_project_station=T,
    )
