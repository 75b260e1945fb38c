"""The scans of a scene as one cloud in the project's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.model import Floats, Scan, Scene


@dataclass(frozen=True)
class MergedCloud:
    """Points (n, 3) in the project's frame less ``origin`` (3,), mm, in the order of the scans.

    ``scanner`` (n, 3), less the origin too, is where each point was seen from; None where any is unknown or unasked.
    """

    points: Floats
    origin: Floats
    scanner: Floats | None


def merged(scene: Scene, with_scanner: bool) -> MergedCloud:
    """Merge the scans of a scene; a scan without a pose is taken to be in the project's frame already."""
    origin = rigid.apply(_pose(scene.scans[0]), scene.scans[0].origin) if scene.scans else np.zeros(3)
    points, scanners = [np.empty((0, 3))], [np.empty((0, 3))]
    known = with_scanner
    for scan in scene.scans:
        T = _pose(scan)
        # offset less offset first: added to the points either would cost them their digits
        shift = T[:3, :3] @ scan.origin + (T[:3, 3] - origin)
        points.append((scan.points @ T[:3, :3].T if scan.T_project_scan.size else scan.points) + shift)
        if not known:
            continue
        if scan.position.size:
            at = T[:3, :3] @ (scan.position - scan.origin) + shift
            scanners.append(np.broadcast_to(at, (len(scan.points), 3)))
        elif scene.stations is not None and len(scan.point_station) and scan.point_station.min() >= 0:
            scanners.append(scene.stations.positions[scan.point_station] - origin)
        else:
            known = False
    return MergedCloud(np.concatenate(points), origin, np.concatenate(scanners) if known else None)


def _pose(scan: Scan) -> Floats:
    return scan.T_project_scan if scan.T_project_scan.size else np.eye(4)
