"""Every ball of a frame, by method ``ray``: members, then stations against each other, then balls, then the design.

Source: paper 001 has the balls and their two estimators; what is here starts from the members instead of a crop a ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from processor.geometry import rigid
from processor.model import Floats, FrameDesign, Ints, Tolerance
from processor.space_frame.catalogue import Catalogue
from processor.space_frame.design import matching, movement
from processor.space_frame.design.matching import Found, Matching
from processor.space_frame.design.movement import Movement
from processor.space_frame.members import junctions, members
from processor.space_frame.members.members import Measured
from processor.space_frame.members.records import Nodes, Tubes
from processor.space_frame.points.corrected_source import Corrected, corrected_gathered
from processor.space_frame.points.source import Source
from processor.space_frame.spheres import fit_all, quality, visibility
from processor.space_frame.spheres.quality import Bools
from processor.space_frame.spheres.records import Balls
from processor.space_frame.stations import registration
from processor.space_frame.stations.control_points import ControlPoints
from processor.space_frame.stations.records import Stations
from processor.space_frame.stations.tube_points import tube_points

SAME_FRAME_SHARE = 0.6  # of the design's nodes that are found where it has them: the frames are the same
NEAR_MM = 40.0  # of a node's nominal place, in the same frame
NOMINAL_SD_MM = 20.0  # of a node that no axes fix, about its nominal place
APART_MM = 0.15  # stations that seem less off each other than this are left where they are


@dataclass(frozen=True)
class Extracted:
    """All that was found of a frame; places are less the source's origin.

    Rows are nodes: found blind, or those of the design in its order and then what else was found. ``design_row`` (k,)
    is the row of the design, -1 = none. ``datum`` (k, 3, 3) is the part of a centre's covariance that all nodes have in
    common; the balls' own does not hold it. ``source`` has the points as the stations' corrections put them.
    """

    source: Source
    nodes: Nodes
    tubes: Tubes
    balls: Balls
    design_row: Ints
    datum: Floats
    stations: Stations | None = None
    matching: Matching | None = None
    movement: Movement | None = None
    said: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Start:
    """Where nodes are, to 20 mm, and pairs of them that a member may join; the design's row (k,) of each, -1 = none.

    ``pose`` is T_design_scan where the design had to be found, with the matching that says so.
    """

    starts: Floats
    pairs: Ints
    design_row: Ints
    measured: Measured
    pose: Matching | None = None
    said: tuple[str, ...] = ()


def extract(
    source: Source,
    design: FrameDesign | None,
    catalogue: Catalogue,
    params: members.Params,
    expansion: float = 1.0,
    control: ControlPoints | None = None,
    register_stations: bool = True,
    datum_mm: float = 0.0,
    limits: Tolerance | None = None,
) -> Extracted | None:
    """Find every node of a frame; None where the cloud has no members that meet.

    ``expansion`` is the factor by which temperature lengthens the design. ``control`` points hold the datum; where
    they do not, all stations share a shift of standard deviation ``datum_mm`` beside their own. ``limits`` say how far
    a ball's radius may be off its nominal one, where no catalogue tells its size.
    """
    start = _blind(source, params) if design is None else _designed(source, design, catalogue, expansion, params)
    if start is None:
        return None
    measured, said = start.measured, list(start.said)
    registered: Stations | None = None
    apart = len(source.scanners) > 1 and measured.apart_mm > APART_MM
    if register_stations and (apart or control is not None):
        source, measured, registered = _registered(source, start, control, params, datum_mm)
        said.append(registered.message)
    design_row = start.design_row
    if design is None:
        measured = members.believed(measured, params.largest_scatter_mm)
        design_row = np.full(measured.nodes.count, -1, np.int64)
    known = design_row >= 0
    expected, disputed = np.full(len(design_row), np.nan), np.zeros(len(design_row), bool)
    nodes = measured.nodes
    if design is not None:
        expected, disputed = _expected(start, design, source.origin, expansion)
        nodes = _somewhere(nodes, start.starts)
    trusted = registered is not None and registered.status in ("ok", "weak")
    between = registered.between if registered is not None and trusted else None
    found = fit_all.find_balls(source, nodes, measured.tubes, catalogue, expected, between, limits=limits)
    smallest = float(catalogue.radii.min()) if len(catalogue.radii) else np.nan
    found = visibility.told(quality.ambiguous(found, disputed), source, smallest)
    beside = np.zeros((len(found.radii), 3, 3))
    datum = np.tile(datum_mm**2 * np.eye(3), (len(found.radii), 1, 1))
    if registered is not None and trusted:
        datum = registered.datum_at(found.centres)
    if registered is not None:
        beside = registered.shared_offset_at(found.centres)
        found = quality.doubted(found, beside)
    matched = moved = None
    if design is not None and known.any():
        matched, moved = _moved(
            source,
            measured.tubes,
            found,
            beside,
            design,
            start.pose,
            registered if trusted else None,
            expansion,
            datum_mm,
        )
    return Extracted(
        source, nodes, measured.tubes, found, design_row, datum + beside, registered, matched, moved, tuple(said)
    )


def _blind(source: Source, params: members.Params) -> _Start | None:
    lines = members.rough_lines(source, params)
    graph = junctions.graph(lines) if len(lines.points) > 1 else None
    if graph is None or not len(graph.pairs):
        return None
    points = members.points_near(source, graph.nodes, graph.pairs, params)
    measured = members.measure(points, source.scanners, graph.nodes, graph.pairs, params)
    return _Start(graph.nodes, graph.pairs, np.full(len(graph.nodes), -1, np.int64), measured)


def _designed(
    source: Source, design: FrameDesign, catalogue: Catalogue, expansion: float, params: members.Params
) -> _Start | None:
    """Measure at the design's nodes in its own frame; where they are not there, find the nodes blind and match them."""
    row = {int(id_): i for i, id_ in enumerate(design.ids)}
    pairs = np.array([[row[int(a)], row[int(b)]] for a, b in zip(design.member_a, design.member_b, strict=True)])
    pairs = pairs.reshape(-1, 2).astype(np.int64)
    middle = design.centres.mean(axis=0)
    starts = (design.centres - middle) * expansion + (middle - source.origin)
    rows = np.arange(len(starts))
    if len(pairs):
        points = members.points_near(source, starts, pairs, params)
        measured = members.measure(points, source.scanners, starts, pairs, params)
        off = np.linalg.norm(measured.nodes.positions - starts, axis=1)
        if np.mean(off < NEAR_MM) >= SAME_FRAME_SHARE:
            return _Start(starts, pairs, rows, measured)
    blind = _blind(source, params)
    if blind is None:
        return None
    seen = members.believed(blind.measured, params.largest_scatter_mm)
    found = Found(seen.nodes.positions, source.origin, np.empty(0), np.empty(0), seen.tubes.node_a, seen.tubes.node_b)

    def sized() -> Found:
        fitted = fit_all.find_balls(source, seen.nodes, seen.tubes, catalogue)
        return replace(found, radii=fitted.radii, radius_sd=np.sqrt(fitted.covariance[:, 3, 3]))

    pose = matching.match(found, design, expansion=expansion, sized=sized)
    if pose.status == "failed":
        lost = _Start(blind.starts, blind.pairs, blind.design_row, blind.measured)
        return replace(lost, said=(f"the design was not found in the cloud: {pose.message}",))
    back = rigid.invert(pose.T_design_scan)
    nominal = (design.centres - middle) * expansion + middle
    starts = rigid.apply(back, nominal) - source.origin
    # A node that was found is where it was found; one that was not, where the design has it.
    other = pose.assignment < 0
    starts[pose.assignment[~other]] = seen.nodes.positions[~other]
    place = np.where(other, len(starts) + np.cumsum(other) - 1, pose.assignment)
    ends = np.stack([seen.tubes.node_a, seen.tubes.node_b], axis=1)
    whole = (ends >= 0).all(axis=1)
    extra = place[ends[whole]]
    every = np.unique(np.sort(np.vstack([pairs, extra]), axis=1), axis=0)
    starts = np.vstack([starts, seen.nodes.positions[other]])
    rows = np.concatenate([rows, np.full(int(other.sum()), -1)])
    points = members.points_near(source, starts, every, params)
    measured = members.measure(points, source.scanners, starts, every, params)
    return _Start(starts, every, rows, measured, pose)


def _expected(start: _Start, design: FrameDesign, origin: Floats, expansion: float) -> tuple[Floats, Bools]:
    """Nominal radii (k,) of the nodes, NaN = none or disputed; and which are: there poses that fit alike differ."""
    rows = start.design_row
    expected = np.where(rows >= 0, design.radii[np.maximum(rows, 0)], np.nan)
    disputed = np.zeros(len(rows), bool)
    if start.pose is None or not len(start.pose.rivals):
        return expected, disputed
    middle = design.centres.mean(axis=0)
    tree = cKDTree((design.centres - middle) * expansion)
    for T in start.pose.rivals:
        # offset less offset first: added to the nodes either would cost them their digits
        there = start.starts @ T[:3, :3].T + (T[:3, :3] @ origin + T[:3, 3] - middle)
        distance, nearest = tree.query(there)
        other = np.where(distance < matching.FAR * matching.TOLERANCE_MM, design.radii[nearest], np.nan)
        disputed |= (rows >= 0) & (other != expected)
    return np.where(disputed, np.nan, expected), disputed


def _registered(
    source: Source, start: _Start, control: ControlPoints | None, params: members.Params, datum_mm: float
) -> tuple[Source, Measured, Stations]:
    """Register the stations on the tubes, and measure the tubes again where that moved them."""
    measured = start.measured
    tubes = measured.tubes
    on_tubes = tube_points(measured.points, measured.lines, tubes)
    found = registration.register(
        on_tubes, tubes.points, tubes.directions, tubes.radii, source.scanners, control, datum_mm
    )
    if found.status not in ("ok", "weak"):
        return source, measured, found
    moved = Corrected(source, found)
    points = corrected_gathered(measured.points, found)
    return moved, members.measure(points, moved.scanners, start.starts, start.pairs, params), found


def _somewhere(nodes: Nodes, starts: Floats) -> Nodes:
    """Put nodes that no axes fix where the design has them, as vaguely as that is known."""
    lost = ~np.isfinite(nodes.positions).all(axis=1)
    positions, covariance = nodes.positions.copy(), nodes.covariance.copy()
    positions[lost], covariance[lost] = starts[lost], NOMINAL_SD_MM**2 * np.eye(3)
    return Nodes(positions, covariance, np.where(lost, 0, nodes.axes), nodes.scatter)


def _moved(
    source: Source,
    tubes: Tubes,
    found: Balls,
    beside: Floats,
    design: FrameDesign,
    pose: Matching | None,
    registered: Stations | None,
    expansion: float,
    datum_mm: float,
) -> tuple[Matching, Movement]:
    """Match the balls as fitted with the design, and say how far each is from its nominal place."""
    rows = np.flatnonzero(np.array([flag != "not-found" for flag in found.flag], bool))
    place = np.full(len(found.radii), -1, np.int64)
    place[rows] = np.arange(len(rows))
    ends = [np.where(end >= 0, place[end], -1) for end in (tubes.node_a, tubes.node_b)]
    sd = np.sqrt(found.covariance[rows, 3, 3])
    nodes = Found(found.centres[rows], source.origin, found.radii[rows], sd, *ends)
    if pose is not None:
        # Where the pattern is has been decided: here it is only fitted again.
        T = pose.T_design_scan
        shifted = T[:3, :3] @ source.origin + T[:3, 3]
        there = replace(nodes, positions=nodes.positions @ T[:3, :3].T, origin=shifted)
        again = matching.match(there, design, expansion=expansion)
        matched = replace(again, how=matching.REGISTERED, status=pose.status, rivals=pose.rivals, message=pose.message)
        matched = replace(matched, T_design_scan=again.T_best_fit @ T, T_best_fit=again.T_best_fit @ T)
    else:
        matched = matching.match(nodes, design, expansion=expansion)
    at = nodes.positions.mean(axis=0)
    common = np.diag([0.0, 0.0, 0.0, *3 * [datum_mm**2]]) if registered is None else registered.common(at)
    moved = movement.movement(
        matched, nodes, found.covariance[rows, :3, :3] + beside[rows], design, common, at, expansion=expansion
    )
    return replace(
        matched,
        assignment=_spread(matched.assignment, rows, len(place), -1),
        weight=_spread(matched.weight, rows, len(place), 0.0),
    ), replace(moved, found=rows[moved.found])


def _spread(values: Any, rows: Ints, count: int, missing: float) -> Any:
    """Give values of some rows to all of them."""
    whole = np.full(count, missing, values.dtype)
    whole[rows] = values
    return whole
