"""Supports and deflections of a space frame against the limits of GB 50205 and JGJ 7 (clauses 11.3.6 and 6.11).

Supports are nodes that the design names so. Heights are compared by movement: the difference of two supports' movements
along z is how much the difference of their heights departs from the design's. Two supports are adjacent if the circle
whose diameter is the line between them in plan contains no third one (Gabriel graph). This gives neighbours along an
edge as well as across a field of columns. A deflection is how far a node has moved down from the plane that fits the
supports' own movements best, relative to what the design computes for it. Errors of different nodes are taken as
independent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from processor.limits import judging, measurands
from processor.limits.judging import JudgedLimits, Measured
from processor.model import NORMAL_95, SUPPORTS, Bools, Floats, FrameDesign, Ints, Tolerance
from processor.space_frame.result import Balls, Evidence

PERIMETER, MULTI_POINT = (number for number, _ in enumerate(SUPPORTS, 1))
LEAST_OF_A_PLANE = 3  # three points determine a plane
LEAST_SPREAD = 1e-3  # of supports across the line through them, relative to along it; less fixes no plane


def judge(balls: Balls, design: FrameDesign, tolerance: Tolerance, matched: bool) -> JudgedLimits | None:
    """Compare supports and deflections with limits; None where the design names none.

    ``balls`` have movements, and ids of the design's nodes. ``matched`` is False where it is not certain which node is
    which: then all is indeterminate.
    """
    nodes = _Nodes(balls, design, matched)
    return judging.table(
        judging.judge(limit, measured, tolerance)
        for limit in tolerance.limits
        if limit.measure in QUANTITIES
        for measured in QUANTITIES[limit.measure](nodes)
    )


class _Nodes:
    """Movements (k, 3) of the design's nodes and their standard deviations (k, 3); NaN of nodes that were not found."""

    def __init__(self, balls: Balls, design: FrameDesign, matched: bool) -> None:
        self.design, self.matched = design, matched
        k = len(design.ids)
        row = {number: i for i, number in enumerate(balls.ids.tolist())}
        rows = np.array([row.get(number, -1) for number in design.ids.tolist()], np.int64)
        found = np.array(
            [i >= 0 and balls.evidence[i] is not Evidence.AXES for i in rows.tolist()], np.bool_
        )  # where axes meet is not the centre of a ball
        self.movement, self.sd, self.covariance = (np.full(shape, np.nan) for shape in ((k, 3), (k, 3), (k, 3, 3)))
        if len(balls.movement):
            self.movement[found] = balls.movement[rows[found]]
            self.covariance[found] = balls.movement_covariance[rows[found]]
        self.sd = np.sqrt(np.maximum(np.einsum("kii->ki", self.covariance), 0.0))

    def supports(self, kind: int = 0) -> Ints:
        """Rows of the supports, of one kind or of all."""
        stated = self.design.supports
        if not len(stated):
            return np.empty(0, np.int64)
        return np.flatnonzero(stated == kind) if kind else np.flatnonzero(stated > 0)

    def name(self, row: int) -> str:
        return str(self.design.names[row])


def _centres(nodes: _Nodes) -> Iterator[Measured]:
    """Yield the offsets of supports in plan; the length is the shorter side of the frame in plan."""
    plan = nodes.design.centres[:, :2]
    length = float(np.ptp(plan, axis=0).min()) if len(plan) else np.nan
    for row in nodes.supports().tolist():
        offset, covariance = nodes.movement[row, :2], nodes.covariance[row, :2, :2]
        size = float(np.linalg.norm(offset))
        along = offset / size if size > 0.0 else np.array([1.0, 0.0])
        half = NORMAL_95 * float(np.sqrt(max(along @ covariance @ along, 0.0)))
        yield Measured.within(nodes.name(row), size, half, sizes_mm={"length": length}, doubtful=not nodes.matched)


def _heights(nodes: _Nodes) -> Iterator[Measured]:
    """Yield the greatest difference in height of the supports along the edges."""
    rows = nodes.supports(PERIMETER)
    if len(rows) < 2:
        return
    z, sd = nodes.movement[rows, 2], nodes.sd[rows, 2]
    if not np.isfinite(z).all():
        missing = ", ".join(nodes.name(row) for row in rows[~np.isfinite(z)].tolist()[:3])
        yield Measured(f"supports (not seen: {missing})")
        return
    top, bottom = int(np.argmax(z)), int(np.argmin(z))
    between = f"{nodes.name(int(rows[top]))} - {nodes.name(int(rows[bottom]))}"
    yield Measured.within(
        between, float(z[top] - z[bottom]), NORMAL_95 * float(np.hypot(sd[top], sd[bottom])), doubtful=not nodes.matched
    )


def _adjacent(nodes: _Nodes, kind: int) -> Iterator[Measured]:
    """Yield the differences in height of adjacent supports of a kind, with their spacing in plan."""
    rows = nodes.supports(kind)
    plan = nodes.design.centres[rows, :2]
    for i, j in adjacent(plan):
        a, b = int(rows[i]), int(rows[j])
        difference = float(abs(nodes.movement[a, 2] - nodes.movement[b, 2]))
        half = NORMAL_95 * float(np.hypot(nodes.sd[a, 2], nodes.sd[b, 2]))
        spacing = float(np.linalg.norm(plan[i] - plan[j]))
        name = f"{nodes.name(a)} - {nodes.name(b)}"
        yield Measured.within(name, difference, half, sizes_mm={"spacing": spacing}, doubtful=not nodes.matched)


def adjacent(plan: Floats) -> list[tuple[int, int]]:
    """Return the pairs of places (n, 2) between which no third one lies in or on the circle over their line."""
    pairs = []
    for i in range(len(plan)):
        for j in range(i + 1, len(plan)):
            middle, radius = 0.5 * (plan[i] + plan[j]), 0.5 * np.linalg.norm(plan[i] - plan[j])
            others = np.delete(plan, (i, j), axis=0)
            if not (np.linalg.norm(others - middle, axis=1) <= radius * (1.0 + 1e-9)).any():
                pairs.append((i, j))
    return pairs


def _deflections(nodes: _Nodes) -> Iterator[Measured]:
    """Yield the deflections of nodes relative to the computed ones; without a plane of supports none is known."""
    design = nodes.design
    computed = design.deflections if len(design.deflections) else np.full(len(design.ids), np.nan)
    rows = np.flatnonzero(computed > 0.0)
    if not len(rows):
        return
    deflection, sd = _below_supports(nodes, rows)
    for k, row in enumerate(rows.tolist()):
        ratio, half = deflection[k] / computed[row], NORMAL_95 * sd[k] / computed[row]
        yield Measured.within(nodes.name(row), float(ratio), float(half), doubtful=not nodes.matched)


def _below_supports(nodes: _Nodes, rows: Ints) -> tuple[Floats, Floats]:
    """Movement (n,) of nodes ``rows`` (n,) down from the plane of the supports' movements, and its sd (n,)."""
    supports = nodes.supports()
    supports = supports[_known(nodes.movement[supports])]
    nan = np.full(len(rows), np.nan)
    if len(supports) < LEAST_OF_A_PLANE:
        return nan, nan
    middle = nodes.design.centres[supports, :2].mean(axis=0)
    at = nodes.design.centres[supports, :2] - middle
    spread = np.linalg.svd(at, compute_uv=False)
    if spread[1] < LEAST_SPREAD * spread[0]:
        return nan, nan
    A = np.column_stack([np.ones(len(at)), at])
    gain = np.column_stack([np.ones(len(rows)), nodes.design.centres[rows, :2] - middle]) @ np.linalg.pinv(A)
    # A node that is a support itself is part of its plane.
    own = (rows[:, None] == supports[None, :]).astype(np.float64) - gain
    others = ~np.isin(rows, supports)
    deflection = gain @ nodes.movement[supports, 2] - nodes.movement[rows, 2]
    variance = np.square(own) @ np.square(nodes.sd[supports, 2])
    variance += np.where(others, np.square(nodes.sd[rows, 2]), 0.0)
    return deflection, np.sqrt(variance)


def _known(movement: Floats) -> Bools:
    return np.asarray(np.isfinite(movement).all(axis=1))


QUANTITIES: Mapping[str, Callable[[_Nodes], Iterator[Measured]]] = {
    measurands.SUPPORT_CENTRE: _centres,
    measurands.SUPPORT_HEIGHT: _heights,
    measurands.ADJACENT: partial(_adjacent, kind=PERIMETER),
    measurands.MULTI_POINT: partial(_adjacent, kind=MULTI_POINT),
    measurands.DEFLECTION: _deflections,
}
