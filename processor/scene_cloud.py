"""The scans of a scene as one cloud in the project's frame, and the mesh of its design in a local frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processor import large_arrays
from processor.geometry import coincident_points, mesh_distance
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
from processor.views import views

ORIGIN_STEP_MM = 1000.0  # whole metres, which people recognise
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
    seen = views(scene)
    points, view = seen.placed()
    scanners = seen.scanners(view) if with_scanner else None
    return MergedCloud(points, seen.origin, None if scanners is None else scanners[view])


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
