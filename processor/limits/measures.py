"""What limits are compared with: the measures of each step, as ``Limit.measure`` names them, and limits of projects.

A row of a standard names the measure that a step compares with it, or under ``needs`` the measurement that would have
to be made first. Measures of single parts, by step ``inspect``, begin with "part ".
"""

from __future__ import annotations

import math
from collections.abc import Iterator

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


def of_projects() -> tuple[Limit, ...]:
    """Limits that no standard here has, but possibly a project; their numbers are a place for the project's own.

    Two bounds are finite or infinite where a project gives both; a least value alone has a ``low`` alone.
    """
    return (
        Limit(NODE_PLACE, "distance of a space frame's node from its nominal place", measure="node_place"),
        Limit(
            "deviation_mm",
            "deviation of the surface from the design, outward positive",
            low=-math.inf,
            high=math.inf,
            measure=DEVIATION,
        ),
        Limit(
            "deviation_share",
            "share of the surface measured that keeps deviation_mm",
            unit="1",
            low=0.0,
            measure=DEVIATION_SHARE,
        ),
        *_of_defects(),
        Limit("closure_mm", "misclosure of a loop of scans", measure=CLOSURE),
        Limit("control_point_mm", "distance of a control point as scanned from its known place", measure=CONTROL_POINT),
        Limit("scan_position_mm", "95 % uncertainty of a scan's place", measure=SCAN_POSITION),
    )


def _of_defects() -> Iterator[Limit]:
    for name in (ANY_CLASS, *DEFECT_CLASSES):
        key, what = name.replace("-", "_"), "defect of any class" if name == ANY_CLASS else name
        yield Limit(f"{key}_depth_mm", f"depth of a {what}", measure=DEFECT_DEPTH)
        yield Limit(f"{key}_area_mm2", f"area of a {what}", unit="mm2", measure=DEFECT_AREA)
