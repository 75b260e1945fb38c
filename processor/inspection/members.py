"""Inspection of the members of a space frame, by the spheres and tubes that step ``spheres`` measured.

A member is named by the ids of its nodes. Its length is the distance of the centres of its nodes' spheres, its bow the
greatest distance of the tube's axis from the straight line through the ends of the tube as seen, its diameter that of
the tube. None depends on where the member lies. Its alignment is how far one end lies, square to the member, from the
line as designed through the other end: of a column it is out of plumb, of a beam out of level or line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from processor.adjustment import scanner_class_errors, thermal
from processor.components.frame_members import SEEN
from processor.geometry import rigid
from processor.inspection import characteristic
from processor.inspection.result import InspectedComponent, Quantity, Result
from processor.limits.judging import Measured
from processor.model import NORMAL_95, Floats, FrameDesign, Scene, Status, reason

CERTAIN = "ok"  # flag of a sphere that nothing contradicts


def inspect(scene: Scene, found: Any, method: str) -> Result:
    """Inspect the members of a frame with a design by the result of step ``spheres``."""
    design = scene.frame
    if design is None or found is None or not len(found.tubes):
        return Result(status=Status.OK, method=method, reasons=(reason("inspect.no-tubes"),))
    ball = {int(found.balls.ids[k]): k for k in np.flatnonzero(found.balls.placed).tolist()}
    pairs = zip(found.tubes.a.tolist(), found.tubes.b.tolist(), strict=True)
    tube = {frozenset(pair): m for m, pair in enumerate(pairs) if -1 not in pair}
    doubtful = found.matching is not None and found.matching.status is Status.AMBIGUOUS
    row = {int(id_): k for k, id_ in enumerate(design.ids)}
    rows = [(row[a], row[b]) for a, b in zip(design.member_a.tolist(), design.member_b.tolist(), strict=True)]
    components = tuple(_member(scene, design, m, ends, found, ball, tube, doubtful) for m, ends in enumerate(rows))
    remarks = () if scene.tolerance is not None else (reason("inspect.no-limits"),)
    if doubtful:
        remarks = (reason("inspect.pose-ambiguous"), *remarks)
    return Result.of_components(components, method, remarks)


def name_of(design: FrameDesign, member: int) -> str:
    """Name a member by its nodes."""
    name_of = design.name_of
    return f"{name_of[int(design.member_a[member])]}-{name_of[int(design.member_b[member])]}"


def _member(
    scene: Scene,
    design: FrameDesign,
    member: int,
    rows: tuple[int, int],  # of its nodes in the design
    found: Any,
    ball: dict[int, int],
    tube: dict[frozenset[int], int],
    doubtful: bool,
) -> InspectedComponent:
    nodes = int(design.member_a[member]), int(design.member_b[member])
    ends, at, row = design.centres[list(rows)], [ball.get(node, -1) for node in nodes], tube.get(frozenset(nodes))
    length, diameter = _length(ends, at, found.balls, scene.temperature_C), float(design.tube_diameters[member])
    own = [_alignment(ends, at, found.balls), *_of_tube(diameter, found.tubes, row)]
    sizes = {"length": length.nominal, "diameter": diameter}
    seen, name = row is not None or np.isfinite(length.value), name_of(design, member)
    return InspectedComponent(
        name=name,
        status=Status.OK if seen else Status.FAILED,
        reasons=() if seen else (reason("inspect.member-not-seen"),),
        characteristics=characteristic.table([length, *own], scene.tolerance, name, sizes, doubtful),
    )


def _length(ends: Floats, at: list[int], balls: Any, temperature_C: float) -> Measured:
    """Distance of the centres of a member's nodes, at the reference temperature if the steel's is known.

    ``ends`` (2, 3) are the nodes as designed, ``at`` the rows of their balls, -1 without a centre.
    """
    nominal = float(np.linalg.norm(ends[1] - ends[0]))
    if min(at) < 0 or any(str(balls.evidence[k]) not in SEEN for k in at):
        return characteristic.absent("length", Quantity.LENGTH, nominal, reason("inspect.node-not-seen"))
    off = balls.centres[at[1]] - balls.centres[at[0]]
    actual = float(np.linalg.norm(off))
    along = off / actual
    of_balls = float(sum(along @ balls.covariance[k][:3, :3] @ along for k in at))
    deviation = actual / thermal.expansion(temperature_C) - nominal
    length = characteristic.normal(
        "length", Quantity.LENGTH, nominal, deviation, of_balls + scanner_class_errors.scale_variance(actual)
    )
    flagged = [k for k in at if str(balls.flag[k]) != CERTAIN]
    why = tuple(reason("inspect.node-flagged", node=balls.names[k], flag=balls.flag[k]) for k in flagged)
    return replace(length, doubtful=bool(flagged), reasons=why)


def _alignment(ends: Floats, at: list[int], balls: Any) -> Measured:
    """Distance of a member's end, square to it, from the line as designed through its other end; ends as of _length.

    It is that of the movements of both nodes, by the same datum. What their errors have in common is not taken off.
    """
    line = ends[1] - ends[0]
    line /= np.linalg.norm(line)
    moved = balls.movement[at] if min(at) >= 0 and len(balls.movement) else np.full((2, 3), np.nan)
    if not np.isfinite(moved).all():
        return characteristic.absent("alignment", Quantity.ALIGNMENT, 0.0, reason("inspect.node-not-moved"))
    off = moved[1] - moved[0]
    off = off - (off @ line) * line
    size = float(np.linalg.norm(off))
    across = off / size if size > 0.0 else rigid.axes_across(line)[0]
    half = NORMAL_95 * float(np.sqrt(across @ balls.movement_covariance[at].sum(axis=0) @ across))
    return Measured(
        "alignment", size, max(size - half, 0.0), size + half, what=Quantity.ALIGNMENT, unsigned=True,
        doubtful=any(str(balls.flag[k]) != CERTAIN for k in at),
    )  # fmt: skip


def _of_tube(diameter: float, tubes: Any, row: int | None) -> Iterator[Measured]:
    """Yield diameter and bow of the tube in a ``row`` of those found."""
    if row is None:
        why = reason("inspect.tube-not-seen")
        yield characteristic.absent("diameter", Quantity.DIAMETER, diameter, why)
        yield characteristic.absent("bow", Quantity.BOW, 0.0, why)
        return
    sd = 2.0 * float(tubes.radius_ci95[row]) / NORMAL_95
    yield characteristic.normal(
        "diameter", Quantity.DIAMETER, diameter, 2.0 * float(tubes.radii[row]) - diameter, sd**2
    )
    bow, half = float(tubes.bow[row]), float(tubes.bow_ci95[row]) if len(tubes.bow_ci95) else float("nan")
    yield Measured("bow", bow, max(bow - half, 0.0), bow + half, what=Quantity.BOW, unsigned=True)
