"""What limits are compared with: the measures of each step, as ``Limit.measure`` names them.

A row of a standard names the measure that a step compares with it, or under ``needs`` the measurement that would have
to be made first. Measures of single parts, by step ``inspect``, begin with "part ".
"""

from __future__ import annotations

from processor.model import Limit

NODE_PLACE = "node_place_mm"
SUPPORT_CENTRE, SUPPORT_HEIGHT, ADJACENT = "support_centre", "support_height", "adjacent_support_height"
MULTI_POINT, DEFLECTION = "multi_point_support_height", "deflection"
DEVIATION, DEVIATION_SHARE = "deviation", "deviation_share"
DEFECT_DEPTH, DEFECT_AREA = "defect_depth", "defect_area"
CEILING = "ceiling"
CLOSURE, CONTROL_POINT, SCAN_POSITION = "closure", "control_point", "scan_position"

MEASURES = {
    "preassemble": (
        "misalignment", "groove_gap", "eccentricity", "span", "unit_length", "inner_arc", "lateral_axis", "elevation",
    ),
    "spheres": ("node_place", "ball_size", SUPPORT_CENTRE, SUPPORT_HEIGHT, ADJACENT, MULTI_POINT, DEFLECTION),
    "stitch": (CLOSURE, CONTROL_POINT, SCAN_POSITION),
    "deviation": (DEVIATION, DEVIATION_SHARE),
    "defects": (DEFECT_DEPTH, DEFECT_AREA),
}  # fmt: skip
DEFECT_CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
    "unknown",
)  # fmt: skip
ANY_CLASS = "defect"


def class_of(limit: Limit) -> str:
    """Return the class of defects that a limit is for, "" for all; its key is the class, then depth_mm or area_mm2."""
    name = limit.key.rsplit("_", 2)[0].replace("_", "-")
    return "" if name == ANY_CLASS else name
