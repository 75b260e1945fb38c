"""Parameters that the papers state, beside those that their methods are run with here."""

from __future__ import annotations

from processor.deviation.params import Params as DeviationParams
from processor.language.messages import Text, text
from processor.model import Reason, reason
from processor.preassembly.baselines.edge_features import EDGE_BOX
from processor.preassembly.params import Params as PreassemblyParams
from tests.bench.papers.rows import Row, Rule

Stated = tuple[Text, Text, str, float, float, Reason]  # place, quantity, unit, published, ours


def rows(paper: str, seeds: int) -> list[Row]:
    """Return a row for each parameter that a paper states; with values where ``seeds`` were measured with it."""
    return [
        Row(
            paper=paper, place=place, data="", method="", quantity=quantity, unit=unit, published=published,
            values=(ours,) * seeds, rule=Rule.NEAR, reason=why,
        )
        for place, quantity, unit, published, ours, why in STATED[paper]()
    ]  # fmt: skip


def _preassembly() -> list[Stated]:
    params, as_stated = PreassemblyParams(), reason("papers.as-stated")
    boxes, slices, match = params.boxes, params.slices, params.match
    table_1, section_2_4 = text("table {number}", number="1"), text("section {number}", number="2.4")
    thicker = reason("papers.bridge-slices", thickness=slices.thickness)
    return [
        (table_1, text("L_edge, in thicknesses of the plate"), "", 1.5, EDGE_BOX, as_stated),
        (table_1, text("range of the boxes along an edge, in its length"), "", 0.4, boxes.box_range, as_stated),
        (table_1, text("boxes per edge"), "", 10.0, float(boxes.box_count), as_stated),
        (table_1, text("distance of P beyond the end"), "mm", 200.0, boxes.search_offset_mm, as_stated),
        (section_2_4, text("thickness of a slice, in spacings"), "", 0.5, slices.thickness, thicker),
        (section_2_4, text("distance of the lines of the slices"), "mm", 200.0, slices.search_offset_mm, as_stated),
        (text("section {number}", number="2.6"), text("parts of the range of an angle"), "", 5.0, float(match.pfh_bins),
         as_stated),
    ]  # fmt: skip


def _deviation() -> list[Stated]:
    params, as_stated, place = DeviationParams(), reason("papers.as-stated"), text("section {number}", number="2")
    paper = params.paper
    return [
        (place, text("neighbours K of the outlier removal"), "", 20.0, float(params.neighbours), as_stated),
        (place, text("standard deviations n of the outlier removal"), "", 1.0, params.outlier_ratio, as_stated),
        (place, text("side L of a voxel"), "mm", 2.0, paper.voxel_mm, as_stated),
        (place, text("points n per voxel"), "", 5.0, float(paper.voxel_points), as_stated),
        (place, text("normal scale"), "mm", 110.541, paper.normal_diameter_mm, as_stated),
        (place, text("projection scale"), "mm", 55.27, paper.projection_diameter_mm, as_stated),
    ]


STATED = {"000": _preassembly, "002": _deviation}
