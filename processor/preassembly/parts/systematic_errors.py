"""Systematic errors, common to all points of a scan: registration of stations, scanner offset and scale, temperature.

They move all points of an end together, so they are added to the covariance of the measured ends and edges: station
registration and scanner offset along each axis, errors of the part's length along the part, half at either end.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processor.adjustment.thermal import EXPANSION_PER_K
from processor.model import DesignPart, Floats, Word
from processor.preassembly.ends import bottom_edges
from processor.preassembly.ends.bottom_edges import EdgeDepartures
from processor.preassembly.params import SystematicParams


class BudgetSource(Word):
    """A source of error of an end of a part."""

    MEASURED = "ends as measured, median"
    REGISTRATION = "registration of stations"
    OFFSET = "scanner offset"
    SCALE = "scanner scale"
    TEMPERATURE = "temperature of the steel"


def budget(params: SystematicParams, length_mm: float) -> dict[BudgetSource, float]:
    """Return the standard deviation (mm) of an end along a part of a given length, by systematic source."""
    half = 0.5 * length_mm
    return {
        BudgetSource.REGISTRATION: params.registration_mm,
        BudgetSource.OFFSET: params.offset_mm,
        BudgetSource.SCALE: 1e-6 * params.scale_ppm * half,
        BudgetSource.TEMPERATURE: EXPANSION_PER_K * params.temperature_C * half,
    }


def end_variances(params: SystematicParams, part: DesignPart) -> Floats:
    """Systematic variances (24,) of an end's coordinates, mm^2; all points of the end share their errors."""
    terms = budget(params, chord(part))
    any_axis = terms[BudgetSource.REGISTRATION] ** 2 + terms[BudgetSource.OFFSET] ** 2
    along = terms[BudgetSource.SCALE] ** 2 + terms[BudgetSource.TEMPERATURE] ** 2
    return np.tile([any_axis + along, any_axis, any_axis], 8)


def chord(part: DesignPart) -> float:
    """Length of a part between the ends of its bottom edge, mm; without edges the diagonal of its box."""
    ends = (
        part.bottom_edge_left[[0, -1]]
        if len(part.bottom_edge_left)
        else np.stack([part.vertices.min(axis=0), part.vertices.max(axis=0)])
    )
    return float(np.linalg.norm(ends[1] - ends[0]))


def added_to_edges(edges: EdgeDepartures, params: SystematicParams) -> EdgeDepartures:
    """Return edges with their systematic errors in the covariance.

    Registration moves each view by itself; the offset of the scanner moves all faces inward.
    """
    inward = np.stack([np.where(np.array(edges.side) == "left", -1.0, 1.0), np.ones(len(edges.side))])
    by_offset = params.offset_mm**2 * np.einsum("ak,al->akl", inward, inward)
    registered = bottom_edges.with_errors_of_views(edges, params.registration_mm**2)
    return replace(registered, covariance=registered.covariance + by_offset)
