"""Offsets of whole faces, of designs of few components, that an error of the stations which saw them may be."""

from __future__ import annotations

import numpy as np

from processor.defects.component_deviations import FEWEST_SEEN, LEAST_Z
from processor.defects.deviation_field import Field
from processor.model import Floats


def unproven(field: Field) -> Floats:
    """Return the median deviation of each face, for all of its cells (cells,), where it is not significant; else 0.

    A face that one station saw alone deviates by that station's error. A search that does not leave it out finds the
    whole face in place of what deviates from the rest of it.
    """
    charts, offsets = field.surface.charts, np.zeros(len(field.deviation))
    for chart in range(len(charts.kind)):
        rows = charts.cells(chart)
        seen = np.flatnonzero(field.seen[rows] > 0.0) + rows.start
        if len(seen) >= FEWEST_SEEN:
            median = float(np.median(field.deviation[seen]))
            if abs(median) < LEAST_Z * field.stations_sd(seen):
                offsets[rows] = median
    return offsets
