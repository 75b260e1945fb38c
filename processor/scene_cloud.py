"""The scans of a scene as one cloud in the project's frame, and the mesh of its design in a local frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor.geometry import mesh_distance, rigid
from processor.model import Floats, InputError, Reason, Scene, Status, StructureDesign, reason

ORIGIN_STEP_MM = 1000.0
UNPLACED = (Status.FAILED, Status.AMBIGUOUS)  # of a scan: its pose may be wrong
FEWEST_POINTS = 100  # of a scan that is compared with a design


@dataclass(frozen=True)
class MergedCloud:
    """Points (n, 3) in the project's frame less ``origin`` (3,), mm, in the order of the scans.

    ``scanner`` (n, 3), less the origin too, is the position each point was seen from; None where any is unknown, and
    where positions were not requested.
    """

    points: Floats
    origin: Floats
    scanner: Floats | None


def merged(scene: Scene, with_scanner: bool) -> MergedCloud:
    """Merge the scans of a scene; a scan without a pose is taken to be in the project's frame already."""
    origin = rigid.apply(scene.scans[0].pose, scene.scans[0].origin) if scene.scans else np.zeros(3)
    points, scanners = [np.empty((0, 3))], [np.empty((0, 3))]
    known = with_scanner
    for scan in scene.scans:
        T = rigid.between_origins(scan.pose, scan.origin, origin)
        points.append(rigid.apply(T, scan.points) if scan.T_project_scan.size else scan.points + T[:3, 3])
        if not known:
            continue
        if scan.position.size:
            at = T[:3, :3] @ (scan.position - scan.origin) + T[:3, 3]
            scanners.append(np.broadcast_to(at, (len(scan.points), 3)))
        elif scene.stations is not None and len(scan.point_station) and scan.point_station.min() >= 0:
            scanners.append(scene.stations.positions[scan.point_station] - origin)
        else:
            known = False
    return MergedCloud(np.concatenate(points), origin, np.concatenate(scanners) if known else None)


def stitched(scene: Scene, result: Any) -> Scene:
    """Give the scans the poses of a ``result`` of step stitch, if there is one; leave out those it did not place.

    A scan whose pose is ambiguous is not placed.
    """
    if result is None:
        return scene
    table = result.scans
    T = {
        name: np.full((4, 4), np.nan) if status in UNPLACED else pose
        for name, status, pose in zip(table.name, table.status, table.T_project_scan, strict=True)
    }
    scans = tuple(
        replace(scan, T_project_scan=T[scan.name]) if scan.name in T else scan
        for scan in scene.scans
        if scan.name not in T or np.isfinite(T[scan.name]).all()
    )
    return replace(scene, scans=scans)


def design_faults(design: StructureDesign) -> Iterator[Reason]:
    """Yield what was wrong with the design's mesh."""
    faults = design.faults
    if faults is not None and faults.turned:
        yield reason("design.turned", turned=faults.turned)
    if faults is not None and faults.open_edges:
        yield reason("design.open", edges=faults.open_edges, parts=faults.open_parts)


def local_design(design: StructureDesign) -> tuple[Floats, Floats]:
    """Vertices (v, 3) of a design less an origin (3,) of whole metres near its middle, and that origin.

    Raises InputError for a mesh without area.
    """
    middle = 0.5 * (design.vertices.min(axis=0) + design.vertices.max(axis=0)) if len(design.vertices) else np.zeros(3)
    origin = np.floor(middle / ORIGIN_STEP_MM) * ORIGIN_STEP_MM
    vertices = design.vertices - origin
    if not len(design.faces) or not mesh_distance.area(vertices, design.faces) > 0.0:
        raise InputError(f"design {design.name}: expected a mesh with a surface, found none")
    return vertices, origin
