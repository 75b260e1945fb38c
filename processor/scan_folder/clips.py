"""The tables [[clip]] of project.toml: boxes in the project's frame that scans are cut by as they are read."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from processor import large_arrays
from processor.model import Bools, Clips, InputError, Scan, per_point_fields
from processor.scan_folder.project_file import ClipBox

FEWEST_POINTS = 4  # a scan of fewer shows nothing: the box is elsewhere


@dataclass
class Clipper:
    """Cuts scans one after the other by boxes in mm, and counts; ``file`` has the boxes."""

    boxes: Sequence[ClipBox]
    file: str = ""
    inside: list[int] = field(default_factory=list)  # points of all scans so far, by box
    names: list[str] = field(default_factory=list)
    read: int = 0
    kept: int = 0

    def clip(self, scan: Scan) -> Scan:
        """Return a scan without what is clipped. Raises InputError where too little of it is left."""
        if not self.boxes:
            return scan
        self.inside = self.inside or [0] * len(self.boxes)
        self.names.append(scan.name)
        kept = np.ones(len(scan.points), bool)
        for rows in large_arrays.blocks(len(kept)):
            kept[rows] = self._kept(scan, rows)
        self.read += len(kept)
        self.kept += int(kept.sum())
        if kept.all():
            return scan
        if kept.sum() < FEWEST_POINTS:
            raise InputError(
                f"{self.file}: [[clip]] keeps {int(kept.sum())} of the {len(kept)} points of scan {scan.name!r}, "
                f"expected {FEWEST_POINTS} or more; correct the boxes (the project's frame and units), limit them to "
                "other scans by 'scan', or leave this file out by [[scan]]"
            )
        columns: dict[str, Any] = {
            name: large_arrays.chosen(getattr(scan, name), kept)
            for name in per_point_fields(Scan)
            if len(getattr(scan, name)) == len(kept)
        }
        return dataclasses.replace(scan, **columns)

    def _kept(self, scan: Scan, rows: slice) -> Bools:
        """Mark the points to keep: in one of the boxes to keep, if there are any for this scan, and in none other."""
        pose = scan.pose
        places = (scan.points[rows] + scan.origin) @ pose[:3, :3].T + pose[:3, 3]
        wanted, unwanted = np.zeros(len(places), bool), np.zeros(len(places), bool)
        limited = False
        for k, box in enumerate(self.boxes):
            if box.scan not in ("", scan.name):
                continue
            inside = ((places >= box.low) & (places <= box.high)).all(axis=1)
            self.inside[k] += int(inside.sum())
            limited |= box.keep
            (wanted if box.keep else unwanted)[inside] = True
        return ~unwanted & (wanted if limited else True)

    def record(self) -> Clips | None:
        """Return what was clipped; None without boxes. Raises InputError for a box that is for nothing."""
        if not self.boxes:
            return None
        for box, inside in zip(self.boxes, self.inside, strict=True):
            if box.scan and box.scan not in self.names:
                raise InputError(f"{box.where}: there is no scan {box.scan!r}; there are {', '.join(self.names)}")
            if box.keep and not inside:
                raise InputError(
                    f"{box.where}: no point lies in the box; it is in the project's frame and units (of a scan without "
                    "a pose: its own frame): correct it, or leave it out"
                )
        return Clips.from_items(self.boxes, inside=np.array(self.inside), read=self.read, kept=self.kept)
