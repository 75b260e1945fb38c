"""The scans of a scene as one cloud in the project's frame, and the mesh of its design in a local frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor import large_arrays
from processor.geometry import coincident_points, mesh_distance, rigid
from processor.model import (
    DesignFaults,
    Floats,
    InputError,
    Reason,
    Scan,
    Scene,
    Status,
    StructureDesign,
    per_point_fields,
    reason,
)

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


def with_points_once(scene: Scene) -> tuple[Scene, tuple[Reason, ...]]:
    """Return a scene in which coincident points count once, with what was left out of each scan.

    Scans in one frame, of one component, are one cloud: exports may overlap. Raises InputError for a scan whose points
    are nearly all those of others.
    """
    frames: dict[tuple[str, bytes], list[int]] = {}
    for number, scan in enumerate(scene.scans):
        frames.setdefault((scan.component, scan.T_project_scan.tobytes()), []).append(number)
    scans, reasons = list(scene.scans), []
    for numbers in frames.values():
        of_frame = [scans[number] for number in numbers]
        offsets = [scan.origin - of_frame[0].origin for scan in of_frame]
        used = coincident_points.used_once_of([scan.points for scan in of_frame], offsets)
        for number, scan, kept in zip(numbers, of_frame, used or [], strict=used is not None):
            left = int(np.count_nonzero(kept))
            if left == len(kept):
                continue
            if left < min(FEWEST_POINTS, len(kept) // 2):
                raise InputError(
                    f"scan {scan.name!r}: {len(kept) - left} of its {len(kept)} points are those of "
                    f"{', '.join(one.name for one in of_frame if one is not scan)}; leave one of the files out"
                )
            columns: dict[str, Any] = {
                name: large_arrays.chosen(getattr(scan, name), kept)
                for name in per_point_fields(Scan)
                if len(getattr(scan, name)) == len(kept)
            }
            scans[number] = replace(scan, **columns)
            reasons.append(coincident(len(kept) - left, len(kept), scan.name))
    return (replace(scene, scans=tuple(scans)) if reasons else scene), tuple(reasons)


def coincident(left_out: int, count: int, cloud: str) -> Reason:
    """Return the reason that of the points of a cloud some coincide with others and do not count."""
    return reason("points.coincident", cloud=cloud, left_out=left_out, count=count, share=100.0 * left_out / count)


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


def design_faults(faults: DesignFaults | None) -> Iterator[Reason]:
    """Yield what was wrong with the design's mesh."""
    if faults is not None and faults.repeated:
        yield reason("design.repeated", repeated=faults.repeated)
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
