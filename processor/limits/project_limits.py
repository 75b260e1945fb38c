"""Limits that a project sets: which it can, and how they take the place of a standard's."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

from processor.limits import measurands, standards
from processor.limits.limit_bounds import at_least
from processor.model import Floats, Limit, Tolerance

NAN = float("nan")
OF_HOLES_AND_MEMBERS = {
    "hole-position": "place of a hole within its group, along and across, less the design's",
    "hole-pitch": "distance of two neighbouring holes less the design's",
    "hole-diameter": "diameter of a hole less the design's",
    "diameter": "diameter of a tube less the design's",
    "bow": "bow of a tube",
    "alignment": "place of a member's end, square to it, from the line as designed through its other end",
}


def choice(base: Tolerance) -> dict[str, Limit]:
    """Return the limits that a project can set, by key: those of its standard, else of all, and :func:`of_projects`."""
    limits = base.limits or tuple(
        limit for of in (standards.load(standards.DEFAULT), *standards.standards().values()) for limit in of.limits
    )
    first: dict[str, Limit] = {}
    for limit in (*limits, *of_projects()):
        first.setdefault(limit.key, limit)
    return first


def override(
    base: Tolerance,
    values: Mapping[str, Floats],
    source: str,
    root_gap_mm: float = 0.0,
    of_components: Mapping[str, Mapping[str, Floats]] | None = None,
) -> Tolerance:
    """Replace limits of a standard by those of a project, or add them.

    ``values`` maps a key to the greatest value (1,), to the least where only that is limited, or to the least and the
    greatest (2,). ``of_components`` has such values by a pattern of the components' names; they come after those of
    all. These limits count as verified. ``source`` names the file that gives them.
    """
    known = choice(base)
    given = {key: _given(known[key], value, source) for key, value in values.items()}
    limits = [given.pop(limit.key, limit) for limit in base.limits]
    own = [
        replace(_given(known[key], value, source), component=pattern)
        for pattern, of_one in (of_components or {}).items()
        for key, value in of_one.items()
    ]
    return replace(base, limits=(*limits, *given.values(), *own), root_gap_mm=root_gap_mm)


def _given(limit: Limit, value: Floats, source: str) -> Limit:
    least_alone = at_least(limit)
    return replace(
        limit,
        low=float(value[0]) if len(value) == 2 or least_alone else NAN,
        high=NAN if least_alone else float(value[-1]),
        low_ratio=NAN,
        high_ratio=NAN,
        rule="",
        clause="",
        verified=True,
        source=source,
    )


@cache
def of_projects() -> tuple[Limit, ...]:
    """Limits that no standard here states but a project may; their numbers are placeholders for those of the project.

    Two bounds are finite or infinite where a project gives both; a least value alone has a ``low`` alone.
    """
    return (
        Limit(measurands.NODE_PLACE, "distance of a space frame's node from its nominal place", measure="node_place"),
        Limit(
            "deviation_mm",
            "deviation of the surface from the design, outward positive",
            low=-math.inf,
            high=math.inf,
            measure=measurands.DEVIATION,
        ),
        Limit(
            "deviation_share",
            "share of the surface measured that keeps deviation_mm",
            unit="1",
            low=0.0,
            measure=measurands.DEVIATION_SHARE,
        ),
        *(
            Limit(
                f"part_{quantity.replace('-', '_')}_mm", what, low=-math.inf, high=math.inf, measure=f"part {quantity}"
            )
            for quantity, what in OF_HOLES_AND_MEMBERS.items()
        ),
        Limit(
            "part_pass_through_ratio",
            "share of a group's holes that a gauge pin passes, 1 mm thinner than the hole, less 1",
            unit="1",
            low=-1.0,
            high=0.0,
            measure="part pass-through",
        ),
        *(
            Limit(
                f"{name.replace('-', '_')}_{size}",
                f"{extent} of a {'defect of any class' if name == measurands.ANY_CLASS else name}",
                unit=unit,
                measure=measure,
            )
            for name in (measurands.ANY_CLASS, *measurands.DEFECT_CLASSES)
            for size, extent, unit, measure in (
                ("depth_mm", "depth", "mm", measurands.DEFECT_DEPTH),
                ("area_mm2", "area", "mm2", measurands.DEFECT_AREA),
            )
        ),
        Limit("closure_mm", "misclosure of a loop of scans", measure=measurands.CLOSURE),
        Limit(
            "control_point_mm",
            "distance of a control point as scanned from its known place",
            measure=measurands.CONTROL_POINT,
        ),
        Limit("scan_position_mm", "95 % uncertainty of a scan's place", measure=measurands.SCAN_POSITION),
    )
