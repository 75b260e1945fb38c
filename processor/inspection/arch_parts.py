"""Inspection of the parts of an arch bridge, by the ends and edges that preassembly measured.

All is linear in these measurements to within their errors, so their covariance is propagated. It holds point noise,
differences between views and the error of the registration, which cancels as the shape of a part does not depend on its
pose. The scale of the scanner, which no part shows, is added by its class.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from processor.adjustment import scanner_class_errors
from processor.geometry.lines_and_polylines import Polyline
from processor.inspection import characteristic, part_geometry
from processor.inspection.part_geometry import Value
from processor.inspection.result import AxisDepartures, InspectedComponent, Quantity, Result
from processor.limits.judging import Measured
from processor.model import (
    ENDS,
    NORMAL_95,
    ArchDesign,
    DesignPart,
    Floats,
    Ints,
    Status,
    Tolerance,
    reason,
)

NAN = float("nan")
LEAST_REACH = 0.7  # of the edges' length, over which both have to be seen


def inspect(
    design: ArchDesign,
    assembled: Any,
    tolerance: Tolerance | None,
    method: str,
    holes_of_parts: Mapping[str, Sequence[Measured]] | None = None,
    holes_of_joints: Mapping[str, Sequence[Measured]] | None = None,
) -> Result:
    """Inspect the parts of a bridge, and its bolted joints, by the result of step ``preassemble``.

    What was measured of bolt holes is given by the names of parts and joints.
    """
    if assembled is None or assembled.adjustment is None or not assembled.adjustment.shapes:
        return Result(status=Status.OK, method=method, reasons=(reason("inspect.no-measured-ends"),))
    shapes = {shape.name: shape for shape in assembled.adjustment.shapes}
    states = dict(zip(assembled.components.name, assembled.components.status, strict=True))
    components = tuple(
        _part(
            part,
            design_ends(design, i),
            shapes[part.name],
            states[part.name],
            tolerance,
            (holes_of_parts or {}).get(part.name, ()),
        )
        for i, part in enumerate(design.parts)
    )
    components += tuple(_joints(design, holes_of_joints or {}, states, tolerance))
    remarks = () if tolerance is not None else (reason("inspect.no-limits"),)
    return Result.of_components(components, method, remarks)


def _joints(
    design: ArchDesign,
    found: Mapping[str, Sequence[Measured]],
    states: Mapping[str, Status],
    tolerance: Tolerance | None,
) -> Iterator[InspectedComponent]:
    """Yield the bolted joints; where a part may lie the other way round, its holes may be those of the other end."""
    for name, left, right in zip(design.joint_names, design.joint_left, design.joint_right, strict=True):
        if name in found:
            doubtful = Status.AMBIGUOUS in (states[left], states[right])
            yield InspectedComponent(
                name=name,
                status=Status.AMBIGUOUS if doubtful else Status.OK,
                reasons=(reason("inspect.ambiguous"),) if doubtful else (),
                characteristics=characteristic.table(found[name], tolerance, name, {}, doubtful),
            )


def design_ends(design: ArchDesign, part: int) -> Floats:
    """Return the ends (2, 8, 3) of a part as designed; NaN at an end without a joint, and at both of a branch."""
    joined = design.joined
    ends = np.full((2, 8, 3), np.nan)
    for end, side in enumerate((1, 0)):  # a part starts at the joint whose right part it is
        at = np.flatnonzero(joined[:, side] == part)
        if len(at) > 1:
            return np.full((2, 8, 3), np.nan)
        if len(at):
            ends[end] = design.joint_points[at[0]]
    return ends


def _part(
    part: DesignPart,
    design: Floats,
    shape: Any,
    status: Status,
    tolerance: Tolerance | None,
    others: Sequence[Measured],
) -> InspectedComponent:
    if status is Status.FAILED:
        return InspectedComponent(name=part.name, status=status, reasons=(reason("inspect.not-registered"),))
    doubtful = status is Status.AMBIGUOUS
    remarks = (reason("inspect.ambiguous"),) if doubtful else ()
    if np.isnan(design).all():
        sizes = {"length": _length(part, design)}
        return InspectedComponent(
            name=part.name,
            reasons=(reason("inspect.branch"), *remarks),
            characteristics=characteristic.table(others, tolerance, part.name, sizes, doubtful),
        )
    axis, departures = _axis(part, shape)
    found = [*_sections(design, shape), *_lengths(part, design, shape), *departures, *others]
    width, height = part_geometry.section_sizes(design)
    sizes = {"length": _length(part, design), "width": width, "height": height}
    return InspectedComponent(
        name=part.name,
        status=status,
        reasons=remarks,
        characteristics=characteristic.table(found, tolerance, part.name, sizes, doubtful),
        axis=axis,
    )


def _length(part: DesignPart, design: Floats) -> float:
    """Return the length of a part as designed, along its bottom edges if it has any."""
    edges = [edge for edge in (part.bottom_edge_left, part.bottom_edge_right) if len(edge) > 1]
    if edges:
        return float(np.mean([Polyline.through(edge).length for edge in edges]))
    return float(np.linalg.norm(design[1, :4].mean(axis=0) - design[0, :4].mean(axis=0)))


def _sections(design: Floats, shape: Any) -> Iterator[Measured]:
    """Yield the characteristics of the end sections at joints."""
    for end in range(2):
        if np.isfinite(design[end]).all():
            yield from _of_ends(list(part_geometry.of_end(end)), design, shape, [end])


def _lengths(part: DesignPart, design: Floats, shape: Any) -> Iterator[Measured]:
    """Yield what both ends determine; of a part with one joint the length at the middle of the bottom alone."""
    joined = np.isfinite(design).all(axis=(1, 2))
    if joined.all():
        yield from _of_ends(list(part_geometry.of_both_ends(design)), design, shape, [0, 1])
        return
    nominal, deviation, variance = NAN, NAN, NAN
    if len(part.bottom_edge_left) and len(part.bottom_edge_right):
        nominal, deviation, variance = _foot_length(part, design, shape, int(np.flatnonzero(joined)[0]))
    if np.isfinite(deviation):
        yield characteristic.normal("length-bottom", Quantity.LENGTH, nominal, deviation, variance)
    else:
        yield characteristic.absent("length-bottom", Quantity.LENGTH, nominal, reason("inspect.outer-end-not-seen"))
    for end in ENDS:
        name = f"{end}-squareness"
        if np.isfinite(design[ENDS.index(end)]).all():
            yield characteristic.absent(name, Quantity.SQUARENESS, 0.0, reason("inspect.one-section-alone"))
    yield characteristic.absent("twist", Quantity.TWIST, 0.0, reason("inspect.one-section-alone"))


def _of_ends(values: Sequence[Value], design: Floats, shape: Any, needed: Sequence[int]) -> Iterator[Measured]:
    """Yield functions of the ends with their intervals; without an end that is ``needed``, why they are not known."""
    unknown = [end for end in needed if not np.isfinite(shape.ends[end]).all()]
    of_needed = np.concatenate([np.arange(24 * end, 24 * end + 24) for end in needed])
    # An end that is not needed may be unknown: its coordinates have no influence.
    as_built, as_designed = (np.where(np.isfinite(ends), ends, 0.0) for ends in (shape.ends, design))
    if not unknown:
        by_ends = part_geometry.derivatives(values, as_built)[:, of_needed]
        covariance = by_ends @ shape.ends_covariance[np.ix_(of_needed, of_needed)] @ by_ends.T
    for row, value in enumerate(values):
        nominal = float(value.of(as_designed))
        if unknown:
            why = reason("inspect.end-not-measured", ends=tuple(ENDS[end] for end in unknown))
            yield characteristic.absent(value.id, value.quantity, nominal, why)
        else:
            deviation = float(value.of(as_built)) - nominal
            variance = covariance[row, row] + scanner_class_errors.scale_variance(nominal)
            yield characteristic.normal(value.id, value.quantity, nominal, deviation, variance)


def _foot_length(part: DesignPart, design: Floats, shape: Any, joint: int) -> tuple[float, float, float]:
    """Nominal length of a part with one joint, deviation and variance: from its outer end to the joint's bottom middle.

    The outer end is a plane across the part, so its place along the part is all that counts.
    """
    outermost = 0 if joint == 1 else -1
    outer = 0.5 * (part.bottom_edge_left[outermost] + part.bottom_edge_right[outermost])
    chord = design[joint, 4] - outer
    nominal = float(np.linalg.norm(chord))
    along = chord / nominal
    departure = shape.ends[joint, 4] - design[joint, 4]
    rows = slice(24 * joint + 12, 24 * joint + 15)
    variance = float(along @ shape.ends_covariance[rows, rows] @ along) + shape.outer_variance
    return nominal, float(departure @ along) + shape.outer, variance + scanner_class_errors.scale_variance(nominal)


def _axis(part: DesignPart, shape: Any) -> tuple[AxisDepartures, list[Measured]]:
    """Departures of the axis from the design's, and the greatest sideways and up.

    The axis is the middle between the bottom edges. A motion of the part is taken off. Departures sideways and up are
    known without their common errors, which are taken as independent.
    """
    left, right = (np.flatnonzero(np.array(shape.edge) == side) for side in ("left", "right"))
    _, *same = np.intersect1d(shape.chainage[left], shape.chainage[right], return_indices=True)
    left, right = left[same[0]], right[same[1]]
    known = np.flatnonzero(np.isfinite(shape.departure[left] + shape.departure[right]).all(axis=1))
    kinds = (Quantity.SWEEP, Quantity.CAMBER)
    if len(known) < 3 or known[-1] - known[0] < LEAST_REACH * len(left):
        why = reason("inspect.edges-not-seen")
        return AxisDepartures(), [characteristic.absent(str(kind), kind, 0.0, why) for kind in kinds]
    chainage = shape.chainage[left[known]]
    both = np.concatenate([left[known], right[known]])
    edges = (Polyline.through(edge).at(chainage) for edge in (part.bottom_edge_left, part.bottom_edge_right))
    columns, found = [], []
    for kind, to_axis in zip(kinds, part_geometry.axis_of_shape(*edges), strict=True):
        departure = to_axis @ shape.departure[both].T.ravel()
        of_ways = np.split(to_axis, 2, axis=1)
        errors = (shape.departure_covariance[a][np.ix_(both, both)] for a in range(2))
        covariance = sum(way @ one @ way.T for way, one in zip(of_ways, errors, strict=True))
        columns += [departure, NORMAL_95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))]
        found.append(characteristic.greatest(kind, departure, covariance))
    return AxisDepartures(
        chainage=chainage, sideways=columns[0], sideways_ci95=columns[1], up=columns[2], up_ci95=columns[3]
    ), [*found, _middle_width(part, shape, left[known], right[known])]


def _middle_width(part: DesignPart, shape: Any, left: Ints, right: Ints) -> Measured:
    """Width at the bottom half way along the part."""
    at = int(np.argmin(np.abs(shape.chainage[left] - shape.chainage[left].mean())))
    a, b = left[at], right[at]
    edges = Polyline.through(part.bottom_edge_left), Polyline.through(part.bottom_edge_right)
    points = [edge.at(shape.chainage[[row]])[0] for edge, row in zip(edges, (a, b), strict=True)]
    nominal = float(np.linalg.norm(points[0] - points[1]))
    covariance = shape.departure_covariance[0]
    variance = covariance[a, a] + covariance[b, b] - 2.0 * covariance[a, b]
    deviation = float(shape.departure[a, 0] - shape.departure[b, 0])
    return characteristic.normal("middle-width-bottom", Quantity.WIDTH, nominal, deviation, float(variance))
