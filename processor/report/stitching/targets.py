"""The targets found in the scans as a CSV file, for the steps that use them as control points."""

from __future__ import annotations

from processor.model import NORMAL_95, Scene
from processor.report.columns import columns
from processor.report.table import csv_of_rows

FILE = "targets.csv"
COLUMNS = columns("scan", "station", "kind", "name", "x_mm", "y_mm", "z_mm", "ci95_mm", "points", "fit")


def files(scene: Scene) -> dict[str, bytes]:
    """Return the file: places in the frame of each scan, name empty where none is known; nothing without a search."""
    found = scene.targets
    if found is None:
        return {}
    stations = () if scene.stations is None else scene.stations.ids
    rows = [
        (
            scene.scans[int(found.scan[k])].name,
            stations[found.station[k]] if found.station[k] >= 0 else "",
            str(found.kind[k]),
            found.name[k],
            *found.places[k].tolist(),
            NORMAL_95 * float(found.sd[k]),
            int(found.points[k]),
            float(found.fit[k]),
        )
        for k in range(len(found))
    ]
    return {FILE: csv_of_rows(COLUMNS, rows).encode("utf-8")}
