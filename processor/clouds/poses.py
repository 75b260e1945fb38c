"""Poses of the scans in the frame of a cloud, as a run found them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from processor.adjustment import thermal
from processor.clouds.earlier_run import Run
from processor.components import bridge_parts
from processor.geometry import rigid
from processor.model import Floats, InputError, Reason, Scan, Status, UsageError, reason
from processor.scene_cloud import UNPLACED
from processor.stitching import poses_with_scale


@dataclass(frozen=True)
class Placed:
    """A scan and its pose: p = T (scale p_scan), with a rigid ``T`` (4, 4), mm. ``known``: the pose is no default."""

    number: int  # row of the scene's scans
    scan: Scan
    T: Floats
    scale: float = 1.0
    known: bool = True
    component: str = ""

    def origin(self) -> Floats:
        """Return where the origin (3,) of the scan's points lies."""
        return rigid.apply(self.T, self.scale * self.scan.origin)

    def moved(self, points: Floats, origin: Floats) -> Floats:
        """Map points (n, 3) less the scan's origin to points less ``origin`` (3,)."""
        return rigid.apply(self.to_local(self.T, origin), self.scale * points)

    def to_local(self, T: Floats, origin: Floats) -> Floats:
        """Return the map (4, 4) by T (4, 4) of scaled points less the scan's origin to points less ``origin`` (3,)."""
        return rigid.between_origins(T, self.scale * self.scan.origin, origin)


@dataclass(frozen=True)
class Poses:
    """The scans that have a pose, and remarks on those that have none or a doubtful one."""

    scans: tuple[Placed, ...]
    remarks: tuple[Reason, ...] = field(default=())


def own_frames(run: Run) -> Poses:
    """Return all scans with the poses found where they are known, else as they are."""
    try:
        found = {placed.number: placed for placed in in_project(run, "").scans}
    except UsageError:
        found = {}
    scans = [found.get(i, Placed(i, scan, np.eye(4), known=False)) for i, scan in enumerate(run.scene.scans)]
    return Poses(tuple(scans))


def in_project(run: Run, what: str) -> Poses:
    """Return the scans in the project's frame: by step stitch if it was run, else by the poses of the input.

    Raises UsageError, which names ``what`` needs the poses, where scans without poses were not stitched, InputError
    where no scan was placed.
    """
    scans = run.scene.scans
    if "stitch" in run.steps:
        return _stitched(run, what)
    unposed = [scan.name for scan in scans[1:] if not scan.T_project_scan.size]
    if unposed and run.scene.kind == "arch-bridge":
        raise UsageError(
            f"{what} needs scans in one frame, but those of {run.name} are parts without poses ({unposed[0]}): "
            "use --what assembled or clean"
        )
    if unposed and run.scene.kind == "structure":
        run.step("stitch", what)
    posed = [scan.T_project_scan.size > 0 for scan in scans]
    poses = [scan.T_project_scan if known else np.eye(4) for scan, known in zip(scans, posed, strict=True)]
    return Poses(tuple(Placed(i, scan, poses[i], known=posed[i]) for i, scan in enumerate(scans)))


def _stitched(run: Run, what: str) -> Poses:
    table = run.steps["stitch"].scans
    rows = {name: row for row, name in enumerate(table.name)}
    placed, remarks = [], []
    for number, scan in enumerate(run.scene.scans):
        row = rows[scan.name]
        T, status = table.T_project_scan[row], table.status[row]
        if status in UNPLACED or not np.isfinite(T).all():
            remarks.append(reason("export.scan-not-placed", scan=scan.name, status=status))
            continue
        if status != Status.OK:
            remarks.append(reason("export.scan-doubtful", scan=scan.name, status=status))
        scale = poses_with_scale.scale_of(T) if run.parameters["stitch"].get("scale") == "free" else 1.0
        if scale != 1.0:
            remarks.append(reason("export.scan-scaled", scan=scan.name, scale=scale))
        pose = rigid.transform(poses_with_scale.rotation_of(T) if scale != 1.0 else T[:3, :3], T[:3, 3])
        placed.append(Placed(number, scan, pose, scale))
    if not placed:
        raise InputError(f"{run.name}: step stitch placed no scan, so there is nothing to export as {what}")
    return Poses(tuple(placed), tuple(remarks))


def in_bridge(run: Run) -> Poses:
    """Return the scans of each part in the bridge's frame, at the reference temperature.

    Raises UsageError where step preassemble was not run, InputError where it placed no part.
    """
    result = run.step("preassemble", "assembled")
    scene, table = run.scene, result.components
    scale = 1.0 / thermal.expansion(scene.temperature_C) if result.method == bridge_parts.ADJUSTED else 1.0
    placed, remarks = [], []
    for row, name in enumerate(table.name):
        status, poses = table.status[row], table.poses_of_scans(row)
        of_part = [(number, scan) for number, scan in enumerate(scene.scans) if scan.component == name]
        used = [(number, scan) for number, scan in of_part if scan.name in poses]
        if status == Status.FAILED or not used:
            remarks.append(reason("export.part-not-placed", part=name))
            continue
        if status != Status.OK:
            remarks.append(reason("export.part-doubtful", part=name, status=status))
        placed += [Placed(number, scan, poses[scan.name], scale, component=name) for number, scan in used]
        others = tuple(scan.name for _, scan in of_part if scan.name not in poses)
        if others:
            remarks.append(reason("export.further-scans", part=name, scans=others))
    if not placed:
        raise InputError(f"{run.name}: step preassemble placed no part, so there is nothing to export as assembled")
    return Poses(tuple(placed), tuple(remarks))
