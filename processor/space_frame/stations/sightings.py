"""The control points of a scene as its scanners saw them."""

from __future__ import annotations

import numpy as np

from processor.adjustment.control_points import Sightings
from processor.model import InputError, Scene
from processor.space_frame.design import unit_mistakes
from processor.space_frame.points.source import SceneSource

LEAST_SD_MM = 1e-3  # of a sighting: the covariance of exact ones would be singular
FARTHEST_MM = 1000.0  # control points farther from their sightings are in another frame


def control_of(scene: Scene, source: SceneSource) -> Sightings | None:
    """Return the sightings of the scene's control points; None without any from a known scanner.

    Raises InputError where the control points are in another frame or unit than the scans.
    """
    if scene.control is None or not len(scene.control.scan):
        return None
    control = scene.control
    view = [int(source.views.of_points(s, [k], 1)[0]) for s, k in zip(control.scan, control.station, strict=True)]
    scanner = source.station_of_view[view]
    rows = np.flatnonzero(scanner >= 0)
    if not len(rows):
        return None
    measured = np.empty((len(rows), 3))
    for i, row in enumerate(rows.tolist()):
        T = scene.scans[control.scan[row]].pose
        measured[i] = T[:3, :3] @ control.seen[row] + (T[:3, 3] - source.origin)
    point, target = control.point[rows], control.positions[control.point[rows]] - source.origin
    off = float(np.median(np.linalg.norm(target - measured, axis=1)))
    if off > FARTHEST_MM:
        # Distances between control points that one scanner saw do not depend on poses.
        a, b = np.triu_indices(len(point), 1)
        both = (scanner[rows[a]] == scanner[rows[b]]) & (point[a] != point[b])
        a, b = a[both], b[both]
        known, found = (np.linalg.norm(at[a] - at[b], axis=1) for at in (target, measured))
        factor = unit_mistakes.between(known, found)
        if factor:
            raise InputError(
                f"{scene.name}: control points lie {factor} times as far apart as the scans have them: one of the two "
                "is in another unit; correct the unit of the control points or of the scans"
            )
        raise InputError(
            f"{scene.name}: control points lie {off / 1000.0:.3g} m from where the scans have them (median); give "
            "the scans poses in the frame of the control points, or their coordinates in the scans' frame"
        )
    names = source.names or tuple(f"station {i}" for i in range(len(source.scanners)))
    return Sightings(
        point=point,
        body=scanner[rows].astype(np.int64),
        seen=measured,
        seen_sd=np.maximum(control.seen_sd[rows], LEAST_SD_MM),
        known=target,
        known_sd=control.sd[point],
        point_name=tuple(control.ids[k] for k in point.tolist()),
        body_name=tuple(names[k] for k in scanner[rows].tolist()),
    )
