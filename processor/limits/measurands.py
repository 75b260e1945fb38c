"""What limits are compared with: names of ``processor.model.MEASURES`` that several modules use.

A row of a standard names the measure that a step compares with it, or under ``needs`` the measurement that would have
to be made first.
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
PART = "part "  # before the quantity of a single part, by step inspect

DEFECT_CLASSES = (
    "dent", "bulge", "bend", "twist", "waviness", "edge-loss", "missing-part", "pit", "crack", "step", "misalignment",
    "unknown",
)  # fmt: skip
ANY_CLASS = "defect"


def class_of(limit: Limit) -> str:
    """Return the class of defects that a limit is for, "" for all; its key is the class, then depth_mm or area_mm2."""
    name = limit.key.rsplit("_", 2)[0].replace("_", "-")
    return "" if name == ANY_CLASS else name
