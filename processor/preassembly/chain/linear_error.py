"""Departures of the assembled bottom edges from the design's, along the whole bridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from processor.geometry import rigid
from processor.geometry.lines_and_polylines import Polyline
from processor.model import ArchDesign, Floats
from processor.preassembly.chain.adjustment import Adjusted
from processor.preassembly.parts.measure import MeasuredPart


@dataclass(frozen=True)
class EdgeErrors:
    """Departures (s, 2), to the left and up, of both edges as assembled, and with the first part on its design; mm.

    ``chainage`` (s,) is from the start of the design's bottom edge; variances (s, 2) are of the departures.
    """

    chainage: Floats
    edge: tuple[str, ...]  # left | right
    assembled: Floats
    assembled_variance: Floats
    at_rest: Floats
    at_rest_variance: Floats


def along_bridge(parts: Sequence[MeasuredPart], adjusted: Adjusted, design: ArchDesign) -> EdgeErrors:
    """Join the departures of all parts."""
    return EdgeErrors(
        chainage=_chainages(parts, design),
        edge=tuple(side for part in parts for side in part.member.edges.side),
        assembled=np.vstack(adjusted.departures),
        assembled_variance=np.vstack(adjusted.departure_variance),
        at_rest=np.vstack(_first_at_rest(parts, adjusted)),
        at_rest_variance=np.vstack(adjusted.at_rest_variance),
    )


def _chainages(parts: Sequence[MeasuredPart], design: ArchDesign) -> Floats:
    chainages, start = [], {"left": 0.0, "right": 0.0}
    for design_part, part in zip(design.parts, parts, strict=True):
        edges = part.member.edges
        chainages.append(np.array([start[side] for side in edges.side]) + edges.chainage)
        start["left"] += Polyline.through(design_part.bottom_edge_left).length
        start["right"] += Polyline.through(design_part.bottom_edge_right).length
    return np.concatenate(chainages)


def _first_at_rest(parts: Sequence[MeasuredPart], adjusted: Adjusted) -> list[Floats]:
    """Departures (k, 2) of every part with the whole bridge moved so that the first part lies on its design."""
    back = rigid.invert(adjusted.motions[0])
    departures = []
    for part, departure in zip(parts, adjusted.departures, strict=True):
        edges = part.member.edges
        assembled = edges.points + np.einsum("ka,kai->ki", departure, edges.axes)
        shift = rigid.apply(back, assembled) - edges.points
        departures.append(np.einsum("kai,ki->ka", edges.axes, shift))
    return departures
