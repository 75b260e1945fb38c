"""Parts scanned one after the other, each in a frame of its own: from stations around it, or as samples."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from designgen.designs.parametric_face import Patch
from designgen.randomness import generator, random_pose
from designgen.scanning import clutter, surroundings, survey
from designgen.scanning.sampler import Cloud
from designgen.scanning.scan_settings import ByRays, Scanning
from designgen.scanning.surfaces import Builder
from designgen.scanning.surroundings import Box
from designgen.scanning.survey import Survey
from processor.model import Floats, PointLabels, Scan, Stations, StationTruth


class SeparateScans:
    """Collects the scans of parts in the order of their ``names``, with the labels of the points and the stations."""

    def __init__(self, names: tuple[str, ...], scanning: Scanning, seed: int) -> None:
        self.names, self.scanning, self.seed = names, scanning, seed
        self.scans, self.labels, self._surveys = list[Scan](), list[PointLabels](), list[Survey]()

    def pose(self, name: str, box: Box) -> Floats:
        """Draw the pose T_scan_bridge (4, 4) of a part's scan; among surroundings its ``box`` is up."""
        T = random_pose(generator(self.seed, f"pose {name}"))
        on_floor = isinstance(self.scanning, ByRays) and self.scanning.surroundings is not None
        return box.levelled(T) if on_floor else T  # by a scanner on the same floor

    def add_survey(
        self, scanning: ByRays, patches: Iterable[Patch], box: Box, T_scan_bridge: Floats, poles: int = 0
    ) -> None:
        """Scan the next part, of faces in the bridge's frame, from stations around it, with ``poles`` in between."""
        name, params, about, builder = self.names[len(self.scans)], scanning.params, scanning.surroundings, Builder()
        for patch in patches:
            builder.patch(len(self.scans), patch)
        poses = survey.stations_around_box(box, params, self.seed, f"{name}/", on_floor=about is not None)
        surroundings.add(builder, about, box, poses, self.seed, name)
        places = [T[:3, 3] for T in poses.values()]
        for i in range(poles):
            rng = generator(self.seed, f"clutter {name} {i}")
            clutter.add_pole(
                builder, places[i % len(places)], box.middle, box.axes[2], (0.3, 0.6), rng, on_ground=False
            )
        surveyed = survey.survey(builder.to_surfaces(), self.names, poses, scanning.device, params, self.seed)
        before = sum(len(one.registered) for one in self._surveys)
        scan, label = survey.merged(surveyed, name, T_scan_bridge, before, name)
        self._surveys.append(survey.moved(surveyed, T_scan_bridge))
        self.scans.append(scan)
        self.labels.append(label)

    def add_samples(self, cloud: Cloud, T_scan_bridge: Floats) -> None:
        """Add samples of the next part in the bridge's frame."""
        name, points = self.names[len(self.scans)], cloud.points @ T_scan_bridge[:3, :3].T + T_scan_bridge[:3, 3]
        self.scans.append(Scan(name, points, component=name, sigma_mm=self.scanning.sigma_mm))
        self.labels.append(PointLabels(name, self.names, cloud.part, cloud.source))

    def stations(self) -> tuple[Stations | None, StationTruth | None]:
        """Return the stations of all parts, each in the frame of its part's scan, and their truth; None of samples."""
        if not self._surveys:
            return None, None
        truths = [one.truth for one in self._surveys]
        columns = ("T_project_station", "zero_offset_mm", "scale_ppm", "tilt")
        joined = {column: np.concatenate([getattr(one, column) for one in truths]) for column in columns}
        truth = StationTruth(tuple(name for one in truths for name in one.ids), **joined)
        return survey.stations_of(truth.ids, np.concatenate([one.registered for one in self._surveys])), truth
